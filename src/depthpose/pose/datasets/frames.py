"""Folders of BOP's layout to instances: one object in one image, and where its parts lie.

And those that an evaluation asks for (``test_targets_bop19.json``).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.core.rigid import Rigid
from depthpose.pose.datasets.parse import (
    camera_from_bop,
    entry_number,
    integer,
    number,
    pose_from_bop,
    read_mapping,
    read_rows,
)

_IMAGE_FOLDERS = ("rgb", "gray")


@dataclass(frozen=True, kw_only=True, eq=False)
class Instance:
    """One annotated object in one image.

    Attributes:
        scene_id: number of the scene.
        image_id: number of the image in it.
        index: place among the annotations of the image: names the mask.
        object_id: BOP's ``obj_id``.
        K: intrinsic matrix.
        depth: the depth image.
        depth_unit_m: metres a unit of it.
        mask: of the visible part; None where there is no such file.
        rgb: the picture, where there is one.
        camera_from_model: the annotated pose.
        visible_fraction: share of the silhouette that is seen, where it is given.
        is_measured: whether the pose was annotated, not itself fitted to the same depth.
    """

    scene_id: int
    image_id: int
    index: int
    object_id: int
    K: Float[Tensor, "3 3"]
    depth: Path
    depth_unit_m: float
    mask: Path | None
    rgb: Path | None
    camera_from_model: Rigid
    visible_fraction: float | None = None
    is_measured: bool = True

    @property
    def name(self) -> str:
        """Scene, image and place among its annotations: unique in a split."""
        return f"{self.scene_id:06d}_{self.image_id:06d}_{self.index:06d}"


def bop_splits(folder: Path) -> list[str]:
    """Name the folders that hold scenes."""
    found = {path.parent.parent.name for path in folder.glob("*/*/scene_camera.json")}
    return sorted(found)


def bop_scenes(folder: Path, split: str) -> list[Path]:
    """List the scenes of a split.

    Raises:
        InputError: there is no such split, or no scene in it.
    """
    scenes = sorted(path.parent for path in (folder / split).glob("*/scene_camera.json"))
    if not scenes:
        known = ", ".join(bop_splits(folder)) or "none"
        raise InputError(
            f"{folder}: no split {split!r} with a scene (SPLIT/000001/scene_camera.json). "
            f"Here: {known}."
        )
    for scene in scenes:
        if entry_number(scene.name) is None:
            raise InputError(f"{scene}: scenes have numbers for names, as 000001; rename it")
    return scenes


def bop_instances(scene: Path) -> Iterator[Instance]:
    """Read the annotations of one scene.

    Raises:
        InputError: a file is missing or damaged, or an entry is not what it must be.
    """
    cameras = read_mapping(scene / "scene_camera.json")
    truths = read_mapping(scene / "scene_gt.json")
    info_path = scene / "scene_gt_info.json"
    infos = read_mapping(info_path) if info_path.is_file() else {}
    for key in sorted(truths, key=_image_number):
        source = f"{scene / 'scene_gt.json'}: image {key}"
        if key not in cameras:
            raise InputError(f"{source} has no entry in scene_camera.json; add its camera")
        entries, more = truths[key], infos.get(key, [])
        if not isinstance(entries, list) or not isinstance(more, list):
            raise InputError(f"{source}: is no list of annotations")
        for index, entry in enumerate(entries):
            extra = more[index] if index < len(more) and isinstance(more[index], dict) else {}
            at = f"{source}, annotation {index}"
            yield _make_instance(scene, (int(key), index), (entry, cameras[key], extra), at)


def _make_instance(
    scene: Path, place: tuple[int, int], parts: tuple[Any, Any, dict[str, Any]], source: str
) -> Instance:
    image, index = place
    entry, camera, extra = parts
    K, unit_m = camera_from_bop(camera, f"{scene / 'scene_camera.json'}: image {image}")
    mask = scene / "mask_visib" / f"{image:06d}_{index:06d}.png"
    visible = number(extra, "visib_fract", -1.0, source)
    return Instance(
        scene_id=int(scene.name),
        image_id=image,
        index=index,
        object_id=integer(entry, "obj_id", source),
        K=K,
        depth=_depth(scene, image),
        depth_unit_m=unit_m,
        mask=mask if mask.is_file() else None,
        rgb=_picture(scene, image),
        camera_from_model=pose_from_bop(entry, source),
        visible_fraction=visible if visible >= 0 else None,
        is_measured=not str(extra.get("pose_source", "")).startswith("pseudo"),
    )


def _depth(scene: Path, image: int) -> Path:
    tiff = scene / "depth" / f"{image:06d}.tif"  # of ITODD
    return tiff if tiff.is_file() else tiff.with_suffix(".png")


def _picture(scene: Path, image: int) -> Path | None:
    named = (scene / folder / f"{image:06d}{suffix}"
             for folder in _IMAGE_FOLDERS for suffix in LISTED_SUFFIXES)  # fmt: skip
    return next((path for path in named if path.is_file()), None)


def _image_number(key: str) -> int:
    number = entry_number(key)
    if number is None:
        raise InputError(
            f"scene_gt.json: {key[:80]!r} is no number of an image; name images 0, 1, ..."
        )
    return number


@dataclass(frozen=True, kw_only=True, order=True)
class Target:
    """So many instances of an object in an image."""

    scene_id: int
    image_id: int
    object_id: int
    count: int


def read_targets(path: str | Path) -> list[Target]:
    """Read a list of targets.

    Raises:
        InputError: it is missing or damaged.
    """
    path = Path(path)
    targets = []
    for row_number, row in enumerate(read_rows(path)):
        source = f"{path}: entry {row_number}"
        scene, image, wanted, count = (
            integer(row, key, source) for key in ("scene_id", "im_id", "obj_id", "inst_count")
        )
        targets.append(Target(scene_id=scene, image_id=image, object_id=wanted, count=count))
    return targets
