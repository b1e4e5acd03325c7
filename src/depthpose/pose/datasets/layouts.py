"""Layouts of pose datasets on the disk (BOP, Linemod_preprocessed): annotations and models."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.files import read_text
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.core.rigid import Rigid
from depthpose.pose.config import MeshConfig
from depthpose.pose.datasets.entries import (
    make_pose,
    parse_entry_number,
    read_bop_camera,
    read_integer,
    read_mapping,
    read_number,
    read_numbers,
    read_rows,
)
from depthpose.pose.mesh import read_model, symmetries_from_bop, turn_about
from depthpose.pose.types import ObjectModel, Symmetries

_IMAGE_FOLDERS = ("rgb", "gray")  # of a scene's pictures, in BOP's layout


@dataclass(frozen=True, kw_only=True, eq=False)
class Instance:
    """An annotated object in an image."""

    scene_id: int  #: number of the scene
    image_id: int  #: number of the image in it
    index: int  #: place among the annotations of the image: names the mask
    object_id: int  #: BOP's ``obj_id``
    K: Float[Tensor, "3 3"]  #: intrinsic matrix
    depth: Path  #: the depth image
    depth_unit_m: float  #: metres a unit of it
    mask: Path | None  #: of the visible part; None where there is no such file
    rgb: Path | None  #: the picture, where there is one
    camera_from_model: Rigid  #: the annotated pose
    visible_fraction: float | None = None  #: share of the silhouette that is seen, where annotated
    is_measured: bool = True  #: whether the pose was annotated, not itself fitted to the same depth

    @property
    def name(self) -> str:
        """Scene, image and place among its annotations, which are unique in a split."""
        return f"{self.scene_id:06d}_{self.image_id:06d}_{self.index:06d}"


class BopSplit(NamedTuple):
    """Where the files of a split are."""

    folder: str  #: name of the folder of its scenes
    suffix: str  #: of its files' names: that of a sensor, such as ``_photoneo``, or none


def list_bop_splits(folder: Path) -> dict[str, BopSplit]:
    """List the splits of a dataset in BOP's layout, by name.

    Where the scenes are of several sensors, as in BOP-Industrial, each sensor has its own files,
    such as ``scene_camera_photoneo.json`` beside ``depth_photoneo``. The split ``test`` of that
    sensor is called ``test_photoneo``. Sensors without depth images are left out.
    """
    splits: dict[str, BopSplit] = {}
    for path in folder.glob("*/*/scene_camera.json"):
        split = path.parent.parent.name
        splits[split] = BopSplit(split, "")
    for path in folder.glob("*/*/scene_camera_*.json"):
        suffix = path.stem.removeprefix("scene_camera")
        split = path.parent.parent.name
        if (path.parent / f"depth{suffix}").is_dir():
            splits.setdefault(split + suffix, BopSplit(split, suffix))
    return dict(sorted(splits.items()))


def _find_bop_split(folder: Path, split: str) -> BopSplit:
    """Find a split of a dataset by its name.

    Raises:
        InputError: there is none, or it is of several sensors.
    """
    splits = list_bop_splits(folder)
    if split not in splits:
        sensors = [name for name, files in splits.items() if files.folder == split and files.suffix]
        if sensors:
            raise InputError(
                f"{folder}: split {split!r} is of several sensors; name one of them with it: "
                f"{', '.join(sensors)}"
            )
        raise InputError(
            f"{folder}: no split {split!r} with a scene (SPLIT/000001/scene_camera.json). "
            f"Here: {', '.join(splits) or 'none'}."
        )
    return splits[split]


def _read_bop_split(folder: Path, split: str) -> Iterator[Instance]:
    """Read the annotations of all scenes of a split."""
    name, suffix = _find_bop_split(folder, split)
    scenes = sorted(path.parent for path in (folder / name).glob(f"*/scene_camera{suffix}.json"))
    for scene in scenes:
        if parse_entry_number(scene.name) is None:
            raise InputError(f"{scene}: scenes have numbers for names, as 000001; rename it")
    for scene in scenes:
        yield from read_bop_instances(scene, suffix)


def read_bop_instances(scene: Path, suffix: str = "") -> Iterator[Instance]:
    """Read the annotations of one scene, image by image.

    Args:
        scene: its folder.
        suffix: of its files' names, where they are of one of several sensors (_photoneo).

    Raises:
        InputError: a file is missing or damaged.
    """
    # The files of the scene.
    camera_path = scene / f"scene_camera{suffix}.json"
    truth_path = scene / f"scene_gt{suffix}.json"
    info_path = scene / f"scene_gt_info{suffix}.json"
    if not truth_path.is_file() and camera_path.is_file():
        raise InputError(
            f"{scene}: no {truth_path.name}: its poses are not annotated, or kept back by those who"
            " measure; take a split that has them, such as val"
        )
    cameras = read_mapping(camera_path)
    truths = read_mapping(truth_path)
    infos = read_mapping(info_path) if info_path.is_file() else {}
    wrong = [key for key in truths if parse_entry_number(key) is None]
    if wrong:
        raise InputError(
            f"{truth_path.name}: {wrong[0][:80]!r} is no number of an image; name images 0, 1, ..."
        )

    # Image by image, annotation by annotation.
    for key in sorted(truths, key=int):
        source = f"{truth_path}: image {key}"
        if key not in cameras:
            raise InputError(f"{source} has no entry in {camera_path.name}; add its camera")
        annotations = truths[key]
        image_infos = infos.get(key, [])
        if not isinstance(annotations, list) or not isinstance(image_infos, list):
            raise InputError(f"{source}: is no list of annotations")
        if not annotations:
            continue
        K, unit_m = read_bop_camera(cameras[key], f"{camera_path}: image {int(key)}")
        depth, rgb = _find_bop_images(scene, suffix, int(key))
        for index, annotation in enumerate(annotations):
            info = image_infos[index] if index < len(image_infos) else {}
            mask = scene / f"mask_visib{suffix}" / f"{int(key):06d}_{index:06d}.png"
            truth = _read_bop_truth(annotation, info, f"{source}, annotation {index}")
            yield Instance(
                scene_id=int(scene.name),
                image_id=int(key),
                index=index,
                object_id=truth.object_id,
                K=K,
                depth=depth,
                depth_unit_m=unit_m,
                mask=mask if mask.is_file() else None,
                rgb=rgb,
                camera_from_model=truth.camera_from_model,
                visible_fraction=truth.visible_fraction,
                is_measured=truth.is_measured,
            )


class _BopTruth(NamedTuple):
    """What is annotated of an instance; as in :class:`Instance`."""

    object_id: int
    camera_from_model: Rigid
    visible_fraction: float | None
    is_measured: bool


def _read_bop_truth(annotation: object, info: object, source: str) -> _BopTruth:
    """Read an entry of ``scene_gt.json``, and the one beside it in ``scene_gt_info.json``, if any.

    ``source`` names it in errors.
    """
    fields = info if isinstance(info, dict) else {}
    visible_fraction = read_number(fields, "visib_fract", -1.0, source)  # negative: not known
    return _BopTruth(
        object_id=read_integer(annotation, "obj_id", source),
        camera_from_model=make_pose(
            read_numbers(annotation, "cam_R_m2c", 9, source),
            read_numbers(annotation, "cam_t_m2c", 3, source),
            source,
        ),
        visible_fraction=visible_fraction if visible_fraction >= 0 else None,
        is_measured=not str(fields.get("pose_source", "")).startswith("pseudo"),
    )


def _find_bop_images(scene: Path, suffix: str, image_id: int) -> tuple[Path, Path | None]:
    """Find the depth image of a scene's image, and its picture, if there is one."""
    name = f"{image_id:06d}"
    tiff = scene / f"depth{suffix}" / f"{name}.tif"  # of ITODD
    depth = tiff if tiff.is_file() else tiff.with_suffix(".png")
    pictures = (
        scene / f"{folder}{suffix}" / f"{name}{ending}"
        for folder in _IMAGE_FOLDERS
        for ending in LISTED_SUFFIXES
    )
    return depth, next((path for path in pictures if path.is_file()), None)


@dataclass(frozen=True, kw_only=True)
class BopTarget:
    """An entry of a list of targets: instances of an image whose poses are to be estimated."""

    scene_id: int  #: number of the scene
    image_id: int  #: number of the image
    object_id: int | None = None  #: None: all objects in the image
    count: int | None = None  #: number of instances of the object; None: all


def read_targets(path: str | Path, folder: str | Path = ".") -> list[BopTarget]:
    """Read a list of targets: a file, or the name of one in the folder of its dataset.

    Entries of ``test_targets_bop19.json`` name an object and the number of its instances; those of
    ``test_targets_bop24.json`` may name images alone, with all their objects.

    Raises:
        InputError: the file is missing or damaged.
    """
    path = Path(path) if Path(path).is_file() else Path(folder, path)
    targets: list[BopTarget] = []
    for row_number, row in enumerate(read_rows(path)):
        source = f"{path}: entry {row_number}"
        has_object = "obj_id" in row
        has_count = "inst_count" in row
        targets.append(
            BopTarget(
                scene_id=read_integer(row, "scene_id", source),
                image_id=read_integer(row, "im_id", source),
                object_id=read_integer(row, "obj_id", source) if has_object else None,
                count=read_integer(row, "inst_count", source) if has_count else None,
            )
        )
    return targets


_MOST_LIST_BYTES = 2**22  # of a list of images

SYMMETRIC = (10, 11)  #: Eggbox and glue: measured by ADD-S ever since Hinterstoisser et al. (2012).


def read_linemod_instances(folder: Path, split: str) -> Iterator[Instance]:
    """Read the annotations of a split of Linemod_preprocessed, by the lists beside the data.

    The folder of an object shows others too (in that of object 2 they are annotated); only its own
    object counts, as in every published number.

    Args:
        folder: of the dataset.
        split: ``train`` or ``test``.

    Raises:
        InputError: a file is missing or damaged.
    """
    for scene in sorted(folder.glob("data/[0-9][0-9]")):
        listed = scene / f"{split}.txt"
        if not listed.is_file():
            raise InputError(f"{listed}: no such list; the splits are train and test")
        truths = read_mapping(scene / "gt.yml")
        infos = read_mapping(scene / "info.yml")
        for line in read_text(listed, _MOST_LIST_BYTES).split():
            if parse_entry_number(line) is None:
                raise InputError(f"{listed}: {line[:40]!r} is no number of an image")

            yield _read_linemod_instance(scene, int(line), truths, infos)


def _read_linemod_instance(
    scene: Path, image_id: int, truths: Mapping[Any, Any], infos: Mapping[Any, Any]
) -> Instance:
    """Read the annotation of the object of a folder in one of its images.

    Args:
        scene: the folder.
        image_id: number of the image.
        truths: annotations by image, of ``gt.yml``.
        infos: cameras by image, of ``info.yml``.

    Raises:
        InputError: an entry is missing or damaged.
    """
    # The one annotation of the folder's own object.
    number = int(scene.name)
    source = f"{scene / 'gt.yml'}: image {image_id}"
    annotations = truths.get(image_id)
    if not isinstance(annotations, list):
        raise InputError(f"{source} has no annotation; is the list of another download?")
    of_object = [
        index
        for index, annotation in enumerate(annotations)
        if read_integer(annotation, "obj_id", source) == number
    ]
    if len(of_object) != 1:
        raise InputError(
            f"{source} annotates object {number} {len(of_object)} times, where once belongs"
        )
    index = of_object[0]

    # Its camera and its images.
    K, unit_m = read_bop_camera(infos.get(image_id), f"{scene / 'info.yml'}: image {image_id}")
    file_name = f"{image_id:04d}.png"
    mask = scene / "mask" / file_name
    rgb = scene / "rgb" / file_name
    return Instance(
        scene_id=number,
        image_id=image_id,
        index=index,
        object_id=number,
        K=K,
        depth=scene / "depth" / file_name,
        depth_unit_m=unit_m,
        mask=mask if mask.is_file() else None,
        rgb=rgb if rgb.is_file() else None,
        camera_from_model=make_pose(
            read_numbers(annotations[index], "cam_R_m2c", 9, source),
            read_numbers(annotations[index], "cam_t_m2c", 3, source),
            source,
        ),
    )


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How one kind of pose dataset is read; its models are ``models/obj_NNNNNN.ply`` in mm."""

    splits: Callable[[Path], Sequence[str]]  #: names of a folder's splits; none in another layout
    instances: Callable[[Path, str], Iterable[Instance]]  #: of one split of a folder
    #: numbers of objects that look alike after half a turn about z, where their models declare no
    #: symmetry.
    half_turns: tuple[int, ...] = ()
    #: file of the mask that came with the data, by ``{object}`` and ``{image}``; None: it has none.
    predicted_mask: str | None = None


LAYOUTS: dict[str, Layout] = {
    "Linemod_preprocessed": Layout(
        splits=lambda folder: (
            ("train", "test") if any(folder.glob("data/[0-9][0-9]/gt.yml")) else ()
        ),
        instances=read_linemod_instances,
        half_turns=SYMMETRIC,  # as BOP's models_info.json of the same meshes declares
        predicted_mask="segnet_results/{object:02d}_label/{image:04d}_label.png",
    ),
    "BOP": Layout(
        splits=lambda folder: list(list_bop_splits(folder)),
        instances=_read_bop_split,
    ),
}
"""Name to layout: one more entry, and every command takes it. A folder is of the first that finds a
split in it."""


def find_layout(folder: Path) -> tuple[str, Layout]:
    """Find the layout of a folder, and return its name too; it is BOP's where none fits."""
    name = next((name for name, layout in LAYOUTS.items() if layout.splits(folder)), "BOP")
    return name, LAYOUTS[name]


_MODEL_FOLDERS = ("models", "models_eval", "models_points")


def read_models_info(folder: Path) -> tuple[Path, dict[int, dict[str, Any]]]:
    """Find a dataset's folder of models, and read what it says of them.

    Returns:
        The folder, and the entries of objects by number; there are none where there is neither
        ``models_info.json`` nor ``.yml``.

    Raises:
        InputError: there is no such folder, or the file is damaged.
    """
    folders = (folder / name for name in _MODEL_FOLDERS)
    models_folder = next((path for path in folders if path.is_dir()), None)
    if models_folder is None:
        raise InputError(f"{folder}: no folder {' or '.join(_MODEL_FOLDERS)}; put the meshes there")
    files = (models_folder / "models_info.json", models_folder / "models_info.yml")
    content = next((read_mapping(path) for path in files if path.is_file()), {})
    for key, entry in content.items():
        if parse_entry_number(key) is None or not isinstance(entry, dict):
            raise InputError(
                f"{models_folder}: models_info entry {str(key)[:80]!r} is no object's; correct it"
            )
    return models_folder, {int(key): entry for key, entry in content.items()}


def find_model_file(models_folder: Path, number: int) -> Path | None:
    """Find the mesh of an object in a folder of models; None where there is none."""
    for name in (f"obj_{number:06d}.ply", f"obj_{number:02d}.ply"):
        if (models_folder / name).is_file():
            return models_folder / name
    return None


def read_bop_models(
    folder: Path, numbers: Iterable[int], config: MeshConfig | None = None
) -> dict[int, ObjectModel]:
    """Read models with their declared symmetries, diameters and names.

    The diameter is the declared one, where there is one: published numbers are shares of it. The
    two symmetric objects of Linemod_preprocessed, which declares none, get theirs.

    Args:
        folder: of the dataset.
        numbers: of the objects.
        config: how many keypoints.

    Returns:
        The models by number.

    Raises:
        InputError: a mesh or its entry is missing or damaged.
    """
    models_folder, infos = read_models_info(folder)
    _, layout = find_layout(folder)
    models: dict[int, ObjectModel] = {}
    for number in sorted(set(numbers)):
        path = find_model_file(models_folder, number)
        if path is None:
            raise InputError(
                f"{models_folder}: no obj_{number:06d}.ply for object {number}; put it there"
            )

        # Its declared symmetries, and the half turn of an object that declares none.
        info = infos.get(number, {})
        source = f"{models_folder / 'models_info.json'}: object {number}"
        symmetries = symmetries_from_bop(info, source=source)
        if symmetries.is_none and number in layout.half_turns:
            up = torch.tensor([0.0, 0.0, 1.0]).double()
            origin = torch.zeros(3).double()
            turn = turn_about(up, origin, torch.tensor([math.pi]).double())
            symmetries = Symmetries(discrete=turn)

        # The mesh, with the declared name and diameter.
        model = read_model(
            path,
            "mm",
            name=_name_object(number, infos),
            number=number,
            symmetries=symmetries,
            config=config,
        )
        declared_m = 0.001 * read_number(info, "diameter", 1000 * model.diameter_m, source)
        models[number] = replace(model, diameter_m=declared_m)
    return models


def read_object_names(folder: Path, numbers: Iterable[int] | None = None) -> dict[int, str]:
    """Read the names of objects by number; None: of all in ``models_info``.

    Raises:
        InputError: there is no folder of models, or the file is damaged.
    """
    _, infos = read_models_info(folder)
    numbers = infos if numbers is None else numbers
    return {number: _name_object(number, infos) for number in numbers}


def _name_object(number: int, infos: Mapping[int, Mapping[str, Any]]) -> str:
    """Name an object as its entry of ``models_info`` does, else by its number."""
    return str(infos.get(number, {}).get("name", f"obj_{number:06d}"))
