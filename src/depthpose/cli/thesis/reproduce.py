"""``depthpose reproduce`` and ``depthpose figure``."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from depthpose.cli.depth.options import MatcherOptions, ProtocolOptions, refuse_ignored
from depthpose.cli.help import group
from depthpose.cli.options import refuse_below
from depthpose.core.errors import InputError
from depthpose.depth.config import MatcherConfig

if TYPE_CHECKING:
    from depthpose.cli.depth.methods import Method
    from depthpose.depth.datasets import Dataset
    from depthpose.thesis.depth_tables import PublishedTable

TableNumber = Literal["2.1", "2.2", "2.3"]
FigureNumber = Literal["2-1", "2-5"]


@group
class RowOptions:
    """The methods of a table, a row each."""

    weights: tuple[str, ...] = ()
    """weights files; 2.2 takes a stereo matcher's too."""
    matcher: Literal["sgbm"] | None = None
    """sgbm: OpenCV's StereoSGBM as a row of table 2.2."""
    beside: tuple[str, ...] | None = None
    """tables 2.1 and 2.3: weights of other methods, a row each; by default those that ship.
    '--beside' without a name: none."""
    train: tuple[Path, ...] = ()
    """training folders, for two baselines (best depth of each row, nearest image)."""
    train_without: tuple[str, ...] = ()
    """names of training frames to leave out."""

    def refuse_unusable(self, table: "PublishedTable") -> None:
        """Refuse rows that a table does not have, and frames to leave out of no training.

        Raises:
            InputError: which, and the rule.
        """
        if self.beside is not None and table.with_right:
            raise InputError(
                f"--beside {' '.join(self.beside)}: adds methods of one image, and table "
                f"{table.number} is of pairs; leave it out, or give more --weights"
            )
        if self.train_without and not self.train:
            raise InputError(
                f"--train-without {' '.join(self.train_without)}: leaves frames out of --train, "
                "and none is given; give its folders, or leave this out"
            )

    def methods(
        self, table: "PublishedTable", config: MatcherConfig, dataset: "Dataset"
    ) -> "list[tuple[str, Method]]":
        """Build each method for a dataset, with the thesis's own row that it stands for, if any."""
        from depthpose.cli.depth import evaluating, methods
        from depthpose.cli.thesis.depth_tables import own_methods

        chosen = own_methods(table, self.weights, self.matcher, config)
        names = {method.name for _, method in chosen}
        if not table.with_right:
            named = ("default",) if self.beside is None else self.beside
            others = [methods.weights_method(n, config, with_right=False) for n in named]
            chosen += [("", other) for other in others if other.name not in names]
        if self.train:
            training = evaluating.open_training(self.train, self.train_without, dataset)
            baselines = [methods.baseline_method(name, training) for name in ("rows", "nearest")]
            # A baseline uses no right image, but is measured on the frames of the other rows.
            chosen += [("", one._replace(with_right=table.with_right)) for one in baselines]
        return chosen


def reproduce(
    table: tyro.conf.Positional[TableNumber],
    kitti: Path,
    out: Path,
    rows: RowOptions = RowOptions(),
    split: str = "eigen-test",
    pictures: int = 3,
    comparison: ProtocolOptions = ProtocolOptions(),
    matching: MatcherOptions = MatcherOptions(),
) -> int:
    """Reproduce a table of the thesis, from data on disk to published rows, ours and difference.

    2.1: depth from one image. 2.2: depth from the real stereo pair. 2.3: depth from one image
    without and with fine-tuning: give two weights, in this order. Writes rows.json, rows.csv,
    table.md, report.md and report.html (with the frames of figures 2-1 and 2-5), with protocol,
    weights, settings and environment. A rerun uses existing predictions.

        depthpose reproduce 2.1 --kitti /data/kitti --weights apart.safetensors --out out/table-2.1

    Args:
        table: number in the thesis.
        kitti: KITTI raw with LiDAR; or any folder that 'depth evaluate' takes, with --split all.
        out: folder to write to.
        split: eigen-test (697 frames), another split, a file of frames, or all.
        pictures: how many frames the page shows.
    """
    from depthpose.cli.depth import evaluating
    from depthpose.cli.thesis import depth_tables as reproducing
    from depthpose.depth.evaluate import find_protocol
    from depthpose.thesis.depth_tables import find_table

    published = find_table(table)
    rule = find_protocol(comparison.protocol)
    if rule.truth == "disparity":
        raise InputError(
            f"--protocol {comparison.protocol}: measures disparity, and the tables hold depth."
        )
    comparison.refuse_unusable()
    refuse_below(0, "--pictures", pictures, "3")
    rows.refuse_unusable(published)
    reproducing.refuse_wrong_count(published, rows.weights, rows.matcher)
    refuse_ignored(rows.weights, matching)
    dataset = evaluating.open_frames(kitti, None if split == "all" else split)
    chosen = rows.methods(published, matching.config, dataset)
    order = reproducing.TableSpec(
        table=published,
        dataset=dataset,
        protocol=comparison.protocol,
        caps_m=comparison.cap,
        pictures=pictures,
    )
    return reproducing.reproduce_table(order, chosen, out)


def figure(
    figure: tyro.conf.Positional[FigureNumber],
    kitti: Path,
    weights: str,
    out: Path,
    frames: tuple[str, ...] = (),
    number: int | None = None,
    split: str | None = None,
    matching: MatcherOptions = MatcherOptions(),
) -> int:
    """Draw a figure of the thesis from your frames and weights.

    2-1, one frame: left, real right, synthesised right, depth from left and synthesised right,
    depth from the real pair, LiDAR. 2-5, a column a frame: left, real right, predicted depth,
    predicted right, LiDAR. Colours mean the same metres in every panel. Writes figure-2-1.png or
    figure-2-5.png, and report.html with each panel and its caption.

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
    from depthpose.cli.depth import evaluating, methods
    from depthpose.cli.thesis import depth_tables as reproducing

    dataset = evaluating.open_frames(kitti, split)
    if number is not None:
        refuse_below(1, "--number", number, "4")
    count = number or (1 if figure == "2-1" else 4)
    chosen = reproducing.choose_frames(dataset, frames, count)
    method = methods.weights_method(
        weights, matching.config, with_right=False if figure == "2-1" else None
    )
    return reproducing.write_figure(figure, dataset, chosen, method, out)
