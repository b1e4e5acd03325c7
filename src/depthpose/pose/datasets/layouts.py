"""Layouts of pose data sets on the disk: which splits a folder has, and their instances."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from depthpose.pose.datasets.frames import Instance, bop_instances, bop_scenes, bop_splits
from depthpose.pose.datasets.linemod import (
    linemod_instances,
    linemod_splits,
    linemod_symmetries,
    segnet_mask,
)
from depthpose.pose.types import Symmetries


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How one kind of data set is read; its models are ``models/obj_NNNNNN.ply`` in millimetres.

    Attributes:
        splits: names of the splits of a folder; none where the folder is of another layout.
        instances: of one split of a folder.
        symmetries: of an object, by number, whose models declare none.
        predicted_mask: file of the mask that came with the data, for a folder and an instance;
            None: the data set has none.
    """

    splits: Callable[[Path], Sequence[str]]
    instances: Callable[[Path, str], Iterable[Instance]]
    symmetries: Callable[[int], Symmetries] = lambda _: Symmetries()
    predicted_mask: Callable[[Path, Instance], Path] | None = None


def _bop_instances(folder: Path, split: str) -> Iterable[Instance]:
    return (one for scene in bop_scenes(folder, split) for one in bop_instances(scene))


LAYOUTS: dict[str, Layout] = {
    "Linemod_preprocessed": Layout(
        splits=linemod_splits,
        instances=linemod_instances,
        symmetries=linemod_symmetries,
        predicted_mask=segnet_mask,
    ),
    "BOP": Layout(splits=bop_splits, instances=_bop_instances),
}
"""Name to layout: one more entry, and every command takes it. A folder is of the first that finds a
split in it."""


def find_layout(folder: Path) -> str | None:
    """Name the layout of a folder; None where none fits."""
    return next((name for name, layout in LAYOUTS.items() if layout.splits(folder)), None)


def layout_of(folder: Path) -> tuple[str, Layout]:
    """Give the layout of a folder by name, BOP's where none fits."""
    name = find_layout(folder) or "BOP"
    return name, LAYOUTS[name]
