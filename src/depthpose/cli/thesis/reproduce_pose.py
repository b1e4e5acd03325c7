"""``depthpose reproduce 3.1``, ``3.2`` and ``3.3``."""

from pathlib import Path

from depthpose.cli.pose.commands import Voting, voting_method
from depthpose.core.errors import InputError
from depthpose.pose.config import DiameterTable


def table_3_1(
    weights: tuple[str, ...],
    out: Path,
    linemod: Path | None = None,
    bop: Path | None = None,
    split: str = "test",
    masks: tuple[str, ...] = ("truth",),
    objects: tuple[str, ...] = (),
    targets: Path | None = None,
    diameters: DiameterTable = "bop",
    voting: Voting = "ransac",
    icp: bool = True,
    vsd: bool = False,
    pictures: int = 4,
    device: str = "cpu",
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
        linemod: Linemod_preprocessed, or LineMOD in BOP's layout.
        bop: any other data set in BOP's layout.
        split: test, ...
        masks: truth, predicted, a file of BOP detections, or weights of a segmentation.
        objects: keep these alone, by name or number.
        targets: a BOP list of targets.
        diameters: bop, or pvnet.
        voting: ransac, or least-squares.
        icp: refine each pose by ICP, the same for all.
        vsd: measure VSD and BOP's average recall too.
        pictures: how many instances the page shows.
        device: cpu, cuda, cuda:1, ...
    """
    from depthpose.cli.thesis import pose_tables as pose_reproducing
    from depthpose.cli.thesis import views as pose_views

    if len(weights) < 2:
        raise InputError(
            "table 3.1 compares the method with its baselines: give two weights or more"
        )
    source = pose_views.Source(linemod=linemod, bop=bop, split=split, objects=objects)
    order = pose_reproducing.make_order("3.1", source, targets, pictures)
    rule = pose_reproducing.Rule(
        diameters=diameters, voting=voting_method(voting), with_icp=icp, with_vsd=vsd, device=device
    )
    return pose_reproducing.reproduce_by_object(order, weights, masks, rule, out)


def table_3_2(
    out: Path,
    weights: tuple[str, ...] = (),
    csv: tuple[Path, ...] = (),
    linemod: Path | None = None,
    bop: Path | None = None,
    split: str = "test",
    masks: tuple[str, ...] = ("truth",),
    objects: tuple[str, ...] = (),
    targets: Path | None = None,
    diameters: DiameterTable = "bop",
    voting: Voting = "ransac",
    icp: bool = True,
    vsd: bool = False,
    pictures: int = 4,
    device: str = "cpu",
) -> int:
    """Reproduce table 3.2: LineMOD's ADD(-S) by object, published rows, ours, and the difference.

    Writes rows.json, rows.csv, table.md (percent by object), all.json (every number),
    instances.csv, report.md and report.html. Masks truth and predicted are two rows of ours.

        depthpose reproduce 3.2 --linemod Linemod_preprocessed --weights W --out out/table-3.2

    Args:
        out: folder to write to.
        weights: files or names.
        csv: BOP results of any method, each a row of ours.
        linemod: Linemod_preprocessed, or LineMOD in BOP's layout.
        bop: any other data set in BOP's layout.
        split: test, ...
        masks: truth, predicted (Linemod_preprocessed's), a file of BOP detections, or weights of a
            segmentation.
        objects: keep these alone, by name or number.
        targets: a BOP list of targets.
        diameters: bop, or pvnet.
        voting: ransac, or least-squares.
        icp: refine each pose by ICP.
        vsd: measure VSD and BOP's average recall too.
        pictures: how many instances the page shows.
        device: cpu, cuda, cuda:1, ...
    """
    from depthpose.cli.thesis import pose_tables as pose_reproducing
    from depthpose.cli.thesis import views as pose_views

    if not weights and not csv:
        raise InputError("table 3.2: there is nothing to measure; give --weights FILE or --csv.")
    source = pose_views.Source(linemod=linemod, bop=bop, split=split, objects=objects)
    order = pose_reproducing.make_order("3.2", source, targets, pictures)
    rule = pose_reproducing.Rule(
        diameters=diameters, voting=voting_method(voting), with_icp=icp, with_vsd=vsd, device=device
    )
    return pose_reproducing.reproduce_by_object(order, weights, masks, rule, out, csv)


def table_3_3(
    weights: str,
    out: Path,
    linemod: Path | None = None,
    bop: Path | None = None,
    split: str = "test",
    objects: tuple[str, ...] = (),
    made: int = 40,
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
        linemod: Linemod_preprocessed, or LineMOD in BOP's layout; annotated masks.
        bop: any other data set in BOP's layout.
        split: test, ...
        objects: keep these alone, by name or number.
        made: number of synthetic views where no data set is given.
        points: at most so many votes of a cloud; a block of rows each.
    """
    from depthpose.cli.thesis import pose_tables as pose_reproducing
    from depthpose.cli.thesis import views as pose_views

    source = pose_views.Source(linemod=linemod, bop=bop, split=split, objects=objects, made=made)
    return pose_reproducing.reproduce_voting(weights, source, points, out)
