"""``depthpose reproduce 3.1``, ``3.2`` and ``3.3``."""

from pathlib import Path

from depthpose.cli.options import PoseDataOptions, PoseTableOptions, refuse_below
from depthpose.core.errors import InputError


def table_3_1(
    weights: tuple[str, ...],
    out: Path,
    data: PoseDataOptions = PoseDataOptions(),
    estimates: PoseTableOptions = PoseTableOptions(),
) -> int:
    """Reproduce table 3.1: the method beside its baselines, by object, on the same data.

    Give weights of the method first, then of the baselines (kinds pointnet and depth-image): each
    is run by the estimator of its kind. Writes rows.json, rows.csv, table.md (percent by object),
    all.json (every number), instances.csv, report.md and report.html. The thesis's own
    numbers are not at hand: differences are those of the first weights to the others.

        depthpose reproduce 3.1 --bop lm --weights ours.safetensors pointnet.safetensors --out out

    Args:
        weights: the method's, then those of each baseline; open3d is Open3D's registration
            (an extra), which needs no weights.
        out: folder to write to.
    """
    from depthpose.cli.thesis.pose_tables import make_spec, reproduce_by_object

    if len(weights) < 2:
        raise InputError(
            "table 3.1 compares the method with its baselines: give two weights or more"
        )
    return reproduce_by_object(make_spec("3.1", data, estimates), weights, estimates, out)


def table_3_2(
    out: Path,
    weights: tuple[str, ...] = (),
    csv: tuple[Path, ...] = (),
    data: PoseDataOptions = PoseDataOptions(),
    estimates: PoseTableOptions = PoseTableOptions(),
) -> int:
    """Reproduce table 3.2: LineMOD's ADD(-S) by object, published rows, ours, and the difference.

    Writes rows.json, rows.csv, table.md (percent by object), all.json (every number),
    instances.csv, report.md and report.html. Masks truth and predicted are two rows of ours.

        depthpose reproduce 3.2 --linemod Linemod_preprocessed --weights W --out out/table-3.2

    Args:
        out: folder to write to.
        weights: files or names.
        csv: BOP results of any method, each a row of ours.
    """
    from depthpose.cli.thesis.pose_tables import make_spec, reproduce_by_object

    if not weights and not csv:
        raise InputError("table 3.2: there is nothing to measure; give --weights FILE or --csv.")
    return reproduce_by_object(make_spec("3.2", data, estimates), weights, estimates, out, csv)


def table_3_3(
    weights: str,
    out: Path,
    data: PoseDataOptions = PoseDataOptions(),
    synthetic: int | None = None,
    points: tuple[int, ...] = (500, 1000, 2000, 5000),
) -> int:
    """Reproduce table 3.3: RANSAC against least squares on the same directions of one network.

    Compares a loop of 50 hypotheses one by one in NumPy (published practice), our RANSAC of 50,
    128 and 1024 hypotheses by both tests for inliers, and least squares as published and as ours:
    success by ADD(-S) without ICP, and milliseconds of the vote alone, all in one process. Without
    a data set the clouds are synthetic views of the weights' objects.

        depthpose reproduce 3.3 --weights W.safetensors --linemod Linemod_preprocessed --out out

    Args:
        weights: file or name, of the sparse network.
        out: folder for rows.json, rows.csv, table.md and report.html.
        synthetic: number of synthetic views where no data set is given; 40 unless told.
        points: at most so many votes of a cloud; a block of rows each.
    """
    from depthpose.cli.thesis.pose_tables import reproduce_voting

    folder = data.folder
    if synthetic is not None and folder is not None:
        raise InputError(
            f"--synthetic {synthetic}: views are rendered where no data set is given, and "
            f"{folder} is; leave one out"
        )
    number = 40 if synthetic is None else synthetic
    refuse_below(1, "--synthetic", number, "40")
    _refuse_points(points)
    return reproduce_voting(weights, data, number, points, out)


def _refuse_points(points: tuple[int, ...]) -> None:
    if not points:
        raise InputError("--points without a value: give a number of votes, such as 500")
    for count in points:
        refuse_below(1, "--points", count, "500")
        if points.count(count) > 1:
            raise InputError(f"--points {count} is given twice; each is a block: give it once")
