"""``depthpose data ...``."""

from pathlib import Path

import tyro


def check(
    path: tyro.conf.Positional[Path], split: str | None = None, with_decoding: bool = True
) -> int:
    """Walk a folder of pairs or a KITTI or Middlebury dataset, and name everything that is wrong.

    A line for each file that is missing, truncated or of the wrong size, then a summary. Exit code
    0: nothing wrong. 1: something is. 2: the folder cannot be understood.

    Args:
        path: the dataset's folder.
        split: check only these frames: eigen-train, eigen-val, eigen-test, eigen-benchmark, or a
            file of monodepth's or monodepth2's form.
        with_decoding: decode every image in full, which finds truncation; off reads headers only.
    """
    from tqdm import tqdm

    from depthpose.depth.kitti import check_dataset

    with tqdm(unit=" frames", leave=False, disable=None) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        report = check_dataset(path, split, with_decoding=with_decoding, progress=show)
    for problem in (*report.notices, *report.problems):
        print(f"{problem.kind}: {problem.path}: {problem.message}")
    print(report.summary)
    return 0 if report.is_ok else 1
