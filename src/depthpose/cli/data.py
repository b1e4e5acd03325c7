"""``depthpose data ...``."""

from pathlib import Path

import tyro

from depthpose.core.errors import InputError


def check(
    path: tyro.conf.Positional[Path], split: str | None = None, with_decoding: bool = True
) -> int:
    """Walk a dataset and name everything that is wrong: pairs, KITTI, Middlebury, BOP, LineMOD.

    A line for each file that is missing, truncated or of the wrong size, then a summary. Exit code
    0: nothing wrong. 1: something is. 2: the folder cannot be understood.

    Args:
        path: the dataset's folder.
        split: check only these frames: eigen-train, eigen-val, eigen-test, eigen-benchmark, or a
            file of monodepth's or monodepth2's form; of a BOP dataset, one of its splits.
        with_decoding: decode every image in full, which finds truncation; off reads headers only.
    """
    from tqdm import tqdm

    from depthpose.depth.kitti import check_dataset
    from depthpose.pose.bop import check_bop, is_bop

    check_folder = check_bop if is_bop(path) else check_dataset
    with tqdm(unit=" frames", leave=False, disable=None) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        report = check_folder(path, split, with_decoding=with_decoding, progress=show)
    for problem in (*report.notices, *report.problems):
        print(f"{problem.kind}: {problem.path}: {problem.message}")
    print(report.summary)
    return 0 if report.is_ok else 1


def duplicates(
    train: tyro.conf.Positional[Path],
    evaluation: tyro.conf.Positional[Path],
    at_least: float | None = None,
    out: Path | None = None,
) -> int:
    """List images of one set that show nearly the same as images of another.

    Training on a frame of the evaluation's drives flatters every number. Left images are compared
    by their fine structure over small shifts and zooms: 1 is the same picture, two streets stay
    below 0.3. The list is for the eye: look at what it names. Always says the likest pair. Exit
    code 0: none. 1: some.

        depthpose data duplicates my-pairs kitti-eval

    Args:
        train: folder of the first set, in any layout that 'data check' knows.
        evaluation: folder of the second set.
        at_least: list pairs from this likeness on; 0.3 by default.
        out: folder to write the list to as well: duplicates.json, .csv and .md.
    """
    from dataclasses import asdict

    from tqdm import tqdm

    from depthpose.core.report import markdown_table, write_table
    from depthpose.depth.kitti import DUPLICATE_LIKENESS, find_duplicates, open_dataset

    threshold = DUPLICATE_LIKENESS if at_least is None else at_least
    if not -1 <= threshold <= 1:
        raise InputError(f"--at-least {threshold:g}: a likeness is -1 .. 1; take 0.3")
    first, second = open_dataset(train), open_dataset(evaluation)
    ranked = find_duplicates(
        first, second, threshold, lambda frames: tqdm(frames, unit=" frames", disable=None)
    )
    rows = [asdict(pair) for pair in ranked if pair.likeness >= threshold]
    if rows:
        print(markdown_table(rows))
    if out is not None:
        write_table(out, rows, name="duplicates")
    likest = f"the likest: {ranked[0].first} and {ranked[0].second}, {ranked[0].likeness:.3f}"
    what = f"{len(first)} x {len(second)} images"
    print(f"{what}: {len(rows)} pairs of likeness {threshold:g} or more; {likest}")
    return 1 if rows else 0
