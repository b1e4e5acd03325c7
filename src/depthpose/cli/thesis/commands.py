"""``depthpose reproduce ...`` and ``depthpose figure ...``."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from depthpose.cli.arguments import NewPath, WeightsName, refuse_below
from depthpose.cli.depth.options import MatcherOptions, ProtocolOptions
from depthpose.cli.pose.options import PoseDataOptions, PoseTableOptions
from depthpose.core.errors import InputError

if TYPE_CHECKING:
    from depthpose.cli.depth.methods import DepthMethod
    from depthpose.depth.config import MatcherConfig
    from depthpose.thesis.depth import PublishedTable


def reproduce_table(
    table: tyro.conf.Positional[Literal["2.1", "2.2", "2.3"]],
    kitti: Path,
    out: NewPath,
    weights: tuple[WeightsName, ...] = (),
    matcher: Literal["sgbm"] | None = None,
    beside: tuple[str, ...] | None = None,
    train: tuple[Path, ...] = (),
    train_without: tuple[str, ...] = (),
    split: str = "eigen-test",
    pictures: int = 3,
    comparison: ProtocolOptions = ProtocolOptions(),
    matching: MatcherOptions = MatcherOptions(),
) -> int:
    """Reproduce a table of the thesis, from data on disk to published rows, ours and difference.

    2.1: depth from one image. 2.2: from the real stereo pair. 2.3: from one image without and with
    fine-tuning: give two weights, in this order. Tables of poses have options of their own:
    'depthpose reproduce 3.1 --help', 3.2 and 3.3. Writes rows.json, rows.csv, table.md, report.md
    and report.html (with the frames of figures 2-1 and 2-5). A rerun uses existing predictions.

        depthpose reproduce 2.1 --kitti /data/kitti --weights apart.safetensors --out out/table-2.1

    Args:
        table: number in the thesis.
        kitti: KITTI raw with LiDAR; or any folder that 'depth evaluate' takes, with --split all.
        out: folder to write to.
        weights: weights files, a row each; 2.2 takes a stereo matcher's too.
        matcher: sgbm: OpenCV's StereoSGBM as a row of table 2.2.
        beside: tables 2.1 and 2.3: weights of other methods, a row each; by default those that
            ship, '--beside' without a name: none.
        train: training folders, for two baselines (best depth of each row, nearest image).
        train_without: names of training frames to leave out.
        split: eigen-test (697 frames), another split, a file of frames, or all.
        pictures: how many frames the page shows.
    """
    from depthpose.cli.depth.evaluate import fit_baseline, open_frames, open_training
    from depthpose.cli.thesis.depth import write_reproduced_table
    from depthpose.depth.evaluate import find_protocol
    from depthpose.thesis.depth import TABLES

    # Refuse what cannot be compared before anything is read.
    published = TABLES[table]
    if find_protocol(comparison.protocol).truth == "disparity":
        raise InputError(
            f"--protocol {comparison.protocol}: measures disparity, and the tables hold depth."
        )
    refuse_below(0, "--pictures", pictures, "3")
    _refuse_rows(published, weights, matcher, beside)
    dataset = open_frames(kitti, None if split == "all" else split)

    methods = _build_methods(matching.config, published, weights, matcher, beside)
    if train:
        training = open_training(train, train_without, dataset)
        baselines = [fit_baseline(name, training) for name in ("rows", "nearest")]
        # A baseline uses no right image, but is measured on the frames of the other rows.
        methods += [("", method._replace(with_right=published.with_right)) for method in baselines]

    return write_reproduced_table(
        published, dataset, methods, out, comparison.protocol, comparison.cap, pictures
    )


def _build_methods(
    config: "MatcherConfig",
    table: "PublishedTable",
    weights: Sequence[str],
    matcher: str | None,
    beside: Sequence[str] | None,
) -> list[tuple[str, "DepthMethod"]]:
    """Build each method, with the row of the thesis that it reproduces, or "" for none.

    Args:
        config: how the networks run.
        table: the printed table.
        weights: weights that reproduce its rows, in their order.
        matcher: "sgbm": OpenCV's matcher too; None: without it.
        beside: weights of further methods of one image; None: those that ship.

    Raises:
        InputError: two weights have one name.
    """
    from depthpose.cli.depth.methods import DepthNetworkSpec, SGBMSpec

    # A table with several rows of the thesis has weights for each, else all are of the one row.
    first_row = table.thesis_rows[0]
    row_names = table.thesis_rows if len(table.thesis_rows) > 1 else [first_row] * len(weights)
    method_of_name: dict[str, tuple[str, DepthMethod]] = {}
    for row_name, file in zip(row_names, weights, strict=True):
        spec = DepthNetworkSpec(weights=file, config=config, with_right=table.with_right)
        method = spec.build()
        if method.name in method_of_name:
            raise InputError(
                f"two weights are called {method.name!r}, and so would their predictions be: "
                "rename one."
            )
        method_of_name[method.name] = (row_name, method)

    # Methods beside them reproduce no row of the thesis; weights that have a row are not repeated.
    if not table.with_right:
        for file in ("default",) if beside is None else beside:
            method = DepthNetworkSpec(weights=file, config=config, with_right=False).build()
            _, same_name = method_of_name.setdefault(method.name, ("", method))
            if same_name.settings["weights_sha256"] != method.settings["weights_sha256"]:
                raise InputError(
                    f"--beside {file}: two weights are called {method.name!r}, and so would their "
                    "predictions be: rename one."
                )
    methods = list(method_of_name.values())
    if matcher is not None:
        methods.append((first_row, SGBMSpec(with_filled_holes=True).build()))
    return methods


def _refuse_rows(
    table: "PublishedTable",
    weights: Sequence[str],
    matcher: str | None,
    beside: Sequence[str] | None,
) -> None:
    """Refuse options that give a table rows which it does not have, or too few.

    The arguments are those of :func:`_build_methods`.
    """
    if beside is not None and table.with_right:
        raise InputError(
            f"--beside {' '.join(beside)}: adds methods of one image, and table {table.number} is "
            "of pairs; leave it out, or give more --weights"
        )
    if matcher is not None and not table.with_right:
        raise InputError(
            f"--matcher {matcher}: matches pairs, and table {table.number} is of one image; table "
            "2.2 takes it."
        )
    if not weights and matcher is None:
        alternative = " or --matcher sgbm" if table.with_right else ""
        raise InputError(
            f"table {table.number}: there is nothing to measure; give --weights FILE{alternative}."
        )
    if len(table.thesis_rows) > 1 and len(weights) != len(table.thesis_rows):
        rows = " and ".join(f"'{name}'" for name in table.thesis_rows)
        raise InputError(
            f"table {table.number}: has the rows {rows}, but {len(weights)} weights were given; "
            "give one for each, in this order."
        )


def draw_figure(
    figure: tyro.conf.Positional[Literal["2-1", "2-5"]],
    kitti: Path,
    weights: WeightsName,
    out: NewPath,
    frames: tuple[str, ...] = (),
    number: int | None = None,
    split: str | None = None,
    matching: MatcherOptions = MatcherOptions(),
) -> int:
    """Draw a figure of the thesis from your frames and weights.

    2-1, one frame: left, real right, synthesised right, depth from left and synthesised right, from
    the real pair, LiDAR. 2-5, a column a frame: left, real right, predicted depth, predicted right,
    LiDAR. Colours mean the same metres in every panel. Figures of poses have options of their own:
    'depthpose figure 3-2 --help', 3-4 and 3-5. Writes figure-NUMBER.png and report.html.

        depthpose figure 2-5 --kitti /data/kitti --weights W.safetensors --out out/figure-2-5

    Args:
        figure: number in the thesis.
        kitti: KITTI raw, or any folder of pairs.
        weights: weights that synthesise the right view (2-5 takes a stereo matcher's too).
        out: folder for the figure.
        frames: names of frames; by default some from all over the folder.
        number: how many frames where none is named: 1 for figure 2-1 and 4 for 2-5.
        split: choose among the frames of a split, such as eigen-test.
    """
    from depthpose.cli.depth.evaluate import open_frames
    from depthpose.cli.depth.methods import DepthNetworkSpec
    from depthpose.cli.thesis.depth import choose_frames, find_frames, write_figure

    dataset = open_frames(kitti, split)
    if number is not None:
        refuse_below(1, "--number", number, "4")
    if frames:
        indices = find_frames(dataset, frames)
    else:
        indices = choose_frames(dataset, number or (1 if figure == "2-1" else 4))
    # Figure 2-1 needs weights that estimate depth of the left view alone; write_figure has them
    # estimate the real pair as well. In figure 2-5, None leaves it to the weights: a stereo matcher
    # gets the real right view, a generator the left view alone.
    with_right = False if figure == "2-1" else None
    spec = DepthNetworkSpec(weights=weights, config=matching.config, with_right=with_right)
    return write_figure(figure, dataset, indices, spec.build(), out)


def reproduce_table_3_1(
    weights: tuple[WeightsName, ...],
    out: NewPath,
    data: PoseDataOptions = PoseDataOptions(),
    estimates: PoseTableOptions = PoseTableOptions(),
) -> int:
    """Reproduce table 3.1: the method beside its baselines, by object, on the same data.

    Each weights is run by the estimator of its kind. Writes rows.json, rows.csv, table.md (percent
    by object), all.json, instances.csv, report.md and report.html. The thesis's own numbers are not
    at hand: differences are those of the first weights to the others.

        depthpose reproduce 3.1 --bop lm --weights ours.safetensors pointnet.safetensors --out out

    Args:
        weights: the method's, then those of each baseline (kinds pointnet and depth-image).
        out: folder to write to.
    """
    from depthpose.cli.thesis.pose import reproduce_by_object

    if len(weights) < 2:
        raise InputError(
            "table 3.1 compares the method with its baselines: give two weights or more"
        )
    return reproduce_by_object("3.1", data, estimates, weights, (), out)


def reproduce_table_3_2(
    out: NewPath,
    weights: tuple[WeightsName, ...] = (),
    csv: tuple[Path, ...] = (),
    data: PoseDataOptions = PoseDataOptions(),
    estimates: PoseTableOptions = PoseTableOptions(),
) -> int:
    """Reproduce table 3.2: LineMOD's ADD(-S) by object, published rows, ours, and the difference.

    Writes rows.json, rows.csv, table.md (percent by object), all.json, instances.csv, report.md and
    report.html. Masks truth and predicted are two rows of ours.

        depthpose reproduce 3.2 --linemod Linemod_preprocessed --weights W --out out/table-3.2

    Args:
        out: folder to write to.
        weights: files or names.
        csv: BOP results of any method, each a row of ours.
    """
    from depthpose.cli.thesis.pose import reproduce_by_object

    return reproduce_by_object("3.2", data, estimates, weights, csv, out)


def reproduce_table_3_3(
    weights: WeightsName,
    out: NewPath,
    data: PoseDataOptions = PoseDataOptions(),
    synthetic: int | None = None,
    points: tuple[int, ...] = (500, 1000, 2000, 5000),
) -> int:
    """Reproduce table 3.3: RANSAC against least squares on the same directions of one network.

    A loop of 50 hypotheses one by one in NumPy (published practice), our RANSAC of 50, 128 and 1024
    by both tests for inliers, and least squares as published and as ours: success by ADD(-S)
    without ICP, and milliseconds of the vote alone. Without a dataset, on synthetic views.

        depthpose reproduce 3.3 --weights W.safetensors --linemod Linemod_preprocessed --out out

    Args:
        weights: file or name, of the sparse network.
        out: folder for rows.json, rows.csv, table.md and report.html.
        synthetic: number of synthetic views where no dataset is given; 40 unless told.
        points: largest number of votes of a cloud; a block of rows each.
    """
    from depthpose.cli.thesis.pose import reproduce_voting

    number = 40 if synthetic is None else synthetic
    refuse_below(1, "--synthetic", number, "40")
    if not points:
        raise InputError("--points without a value: give a number of votes, such as 500")
    for count in points:
        refuse_below(1, "--points", count, "500")
        if points.count(count) > 1:
            raise InputError(f"--points {count} is given twice; each is a block: give it once")
    return reproduce_voting(weights, data, number, points, out)


def draw_figure_3_2(
    weights: WeightsName,
    out: NewPath,
    data: PoseDataOptions = PoseDataOptions(),
    number: int = 4,
    perplexity: float = 40.0,
) -> int:
    """Draw figure 3-2: features of partial clouds as colours, each cloud posed on its model.

    The features before the last layer (64 numbers a point) are mapped to one number by an exact
    t-SNE and shown in the Spectral scale; the model is black. Without a dataset the clouds are
    synthetic. Writes figure-3-2.png, panels and report.html.

        depthpose figure 3-2 --weights W.safetensors --out out/figure-3-2

    Args:
        weights: file or name, of the sparse network.
        out: folder for the figure.
        number: how many clouds.
        perplexity: perplexity of t-SNE.
    """
    from depthpose.cli.thesis.pose import draw_feature_panels, write_figure

    settings = {"perplexity": perplexity}
    draw_panels = partial(draw_feature_panels, perplexity=perplexity)
    return write_figure("3-2", weights, data, number, out, draw_panels, settings, columns=4)


def draw_figure_3_4(
    weights: WeightsName,
    out: NewPath,
    data: PoseDataOptions = PoseDataOptions(),
    number: int = 20,
    keypoint: int | None = None,
) -> int:
    """Draw figure 3-4: true and predicted directions to the keypoint with the largest error.

    The worst of some views is drawn, in the plane of the camera's x and y: a yellow star is the
    true keypoint, a red cross the voted one. Without a dataset the views are synthetic. Writes
    figure-3-4.png, panels and report.html.

        depthpose figure 3-4 --weights W.safetensors --out out/figure-3-4

    Args:
        weights: file or name, of the sparse network.
        out: folder for the figure.
        number: how many views are looked at.
        keypoint: only this one, from 0 on.
    """
    from depthpose.cli.thesis.pose import draw_direction_panels, write_figure

    settings = {"keypoint": keypoint}
    draw_panels = partial(draw_direction_panels, keypoint=keypoint)
    return write_figure("3-4", weights, data, number, out, draw_panels, settings, columns=3)


def draw_figure_3_5(
    weights: WeightsName, out: NewPath, data: PoseDataOptions = PoseDataOptions(), number: int = 6
) -> int:
    """Draw figure 3-5: boxes of true (green, dashed) and estimated (blue, solid) poses.

    Over the picture, or the depth where there is none. Without a dataset the views are synthetic.
    Writes figure-3-5.png, panels and report.html.

        depthpose figure 3-5 --weights W.safetensors --linemod Linemod_preprocessed --out out

    Args:
        weights: file or name, of the method or of a baseline that votes.
        out: folder for the figure.
        number: how many views.
    """
    from depthpose.cli.thesis.pose import draw_box_panels, write_figure

    return write_figure("3-5", weights, data, number, out, draw_box_panels, {}, columns=3)
