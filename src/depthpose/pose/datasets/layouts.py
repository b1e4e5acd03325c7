"""Layouts of pose data sets on the disk (BOP, Linemod_preprocessed): annotations and models."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.camera.pinhole import check_intrinsics
from depthpose.core.errors import InputError
from depthpose.core.files import read_json, read_text
from depthpose.core.files.disk import parse_yaml, refuse_heavy
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.core.rigid import Rigid
from depthpose.pose.config import MeshConfig
from depthpose.pose.mesh import read_model, symmetries_from_bop, turn_about
from depthpose.pose.types import ObjectModel, Symmetries

_ROTATION_SLACK = 1e-2  # published ones are rounded; LineMOD's are off by a few thousandths


_OF_YAML = {b"[": 750, b"{": 750, b",": 450, b":": 500, b"\n": 500, b"- ": 500}
"""Bytes that a value takes while it is read, measured with PyYAML 6."""

MOST = 10**9  #: of scenes, images and objects: their numbers name files


def parse_entry_number(key: object) -> int | None:
    """Parse the number that names a scene, an image or an object; None where it is no number."""
    text = str(key)
    return int(text) if len(text) <= 9 and text.isascii() and text.isdecimal() else None


def read_mapping(path: Path) -> dict[Any, Any]:
    """Read a JSON or YAML file that holds names and their values."""
    if path.suffix == ".json":
        content = read_json(path)
    else:
        text = read_text(path)
        refuse_heavy(path, text.encode(), _OF_YAML)
        content = parse_yaml(path, text)
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds a {type(content).__name__}, where names to values belong")
    return content


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read a JSON file that holds a list of objects."""
    content = read_json(path)
    if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
        raise InputError(f"{path}: is no list of objects, one an entry")
    return content


def read_numbers(entry: object, key: str, count: int, source: str) -> list[float]:
    """Read a list of ``count`` finite numbers from an entry; ``source`` names it in errors."""
    values = entry.get(key) if isinstance(entry, Mapping) else None
    # A whole number beyond 1e300 has no float.
    if (
        not isinstance(values, list)
        or len(values) != count
        or not all(type(value) in (int, float) and abs(value) < 1e300 for value in values)
    ):
        raise InputError(f"{source}: {key} is {_shorten(values)}, where {count} numbers belong")
    return [float(value) for value in values]


def read_integer(entry: object, key: str, source: str) -> int:
    """Read a whole number of 0 or more from an entry; ``source`` names it in errors."""
    value = entry.get(key) if isinstance(entry, Mapping) else None
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= MOST:
        raise InputError(
            f"{source}: {key} is {_shorten(value)}, where a number from 0 to {MOST} belongs"
        )
    return value


def read_number(entry: object, key: str, default: float | None, source: str) -> float:
    """Read a finite number from an entry; ``default``, if any, where it is missing."""
    value = entry.get(key, default) if isinstance(entry, Mapping) else None
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < 1e300:
        raise InputError(f"{source}: {key} is {_shorten(value)}, where a number belongs")
    return float(value)


def make_pose(R: list[float], t_mm: list[float], source: str) -> Rigid:
    """Make a pose of a rotation matrix, row by row, and a translation in mm.

    The rotation is replaced by the nearest exact one, for published numbers are rounded.
    """
    rough = torch.tensor(R, dtype=torch.float64).reshape(3, 3)
    u, sizes, vh = torch.linalg.svd(rough)
    determinant = float(torch.linalg.det(rough))
    if float((sizes - 1).abs().max()) > _ROTATION_SLACK or determinant < 0:
        raise InputError(
            f"{source}: the rotation {_shorten(R)} is none: its determinant is "
            f"{determinant:.3f}, its stretches {_shorten(sizes.tolist())}. "
            "Write a rotation, row by row"
        )
    return Rigid(u @ vh, torch.tensor(t_mm, dtype=torch.float64) * 0.001)


def read_bop_camera(entry: object, source: str) -> tuple[Float64[Tensor, "3 3"], float]:
    """Read ``cam_K`` and ``depth_scale`` (mm a unit) as K and metres a unit."""
    K = torch.tensor(read_numbers(entry, "cam_K", 9, source), dtype=torch.float64).reshape(3, 3)
    try:
        check_intrinsics(K)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    scale_mm = read_number(entry, "depth_scale", 1.0, source)
    if scale_mm <= 0:
        raise InputError(f"{source}: depth_scale is {scale_mm:g}; it is millimetres a unit")
    return K, 0.001 * scale_mm


def _shorten(value: object) -> str:
    """Shorten what a file holds to 80 characters, for a message."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


_IMAGE_FOLDERS = ("rgb", "gray")


@dataclass(frozen=True, kw_only=True, eq=False)
class Instance:
    """One annotated object in one image."""

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
    visible_fraction: float | None = None  #: share of the silhouette that is seen, where given
    is_measured: bool = True  #: whether the pose was annotated, not itself fitted to the same depth

    @property
    def name(self) -> str:
        """Scene, image and place among its annotations: unique in a split."""
        return f"{self.scene_id:06d}_{self.image_id:06d}_{self.index:06d}"


def list_bop_splits(folder: Path) -> dict[str, tuple[str, str]]:
    """List the splits of a data set by name, with the folder and the suffix of file names of each.

    Where the scenes are of several sensors, as in BOP-Industrial, each sensor has its own files,
    such as ``scene_camera_photoneo.json`` beside ``depth_photoneo``. The split ``test`` of that
    sensor is called ``test_photoneo``. Sensors without depth images are left out.
    """
    splits = {
        path.parent.parent.name: (path.parent.parent.name, "")
        for path in folder.glob("*/*/scene_camera.json")
    }
    for path in folder.glob("*/*/scene_camera_*.json"):
        end = path.stem.removeprefix("scene_camera")
        split = path.parent.parent.name
        if (path.parent / f"depth{end}").is_dir():
            splits.setdefault(split + end, (split, end))
    return dict(sorted(splits.items()))


def list_bop_scenes(folder: Path, split: str) -> tuple[list[Path], str]:
    """List the scenes of a split, and give the suffix of its files' names."""
    splits = list_bop_splits(folder)
    if split not in splits:
        sensors = [name for name, (home, end) in splits.items() if home == split and end]
        if sensors:
            raise InputError(
                f"{folder}: split {split!r} is of several sensors; name one of them with it: "
                f"{', '.join(sensors)}"
            )
        raise InputError(
            f"{folder}: no split {split!r} with a scene (SPLIT/000001/scene_camera.json). "
            f"Here: {', '.join(splits) or 'none'}."
        )
    home, end = splits[split]
    scenes = sorted(path.parent for path in (folder / home).glob(f"*/scene_camera{end}.json"))
    for scene in scenes:
        if parse_entry_number(scene.name) is None:
            raise InputError(f"{scene}: scenes have numbers for names, as 000001; rename it")
    return scenes, end


def read_bop_instances(scene: Path, end: str = "") -> Iterator[Instance]:
    """Read the annotations of one scene; ``end`` is the suffix of its files' names (_photoneo)."""
    # The files of the scene.
    camera_path = scene / f"scene_camera{end}.json"
    truth_path = scene / f"scene_gt{end}.json"
    info_path = scene / f"scene_gt_info{end}.json"
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

    # Image by image.
    for key in sorted(truths, key=int):
        source = f"{truth_path}: image {key}"
        if key not in cameras:
            raise InputError(f"{source} has no entry in {camera_path.name}; add its camera")
        entries = truths[key]
        visibilities = infos.get(key, [])
        if not isinstance(entries, list) or not isinstance(visibilities, list):
            raise InputError(f"{source}: is no list of annotations")
        camera_source = f"{camera_path}: image {int(key)}"
        image = f"{int(key):06d}"
        tiff = scene / f"depth{end}" / f"{image}.tif"  # of ITODD
        pictures = (
            scene / f"{folder}{end}" / f"{image}{suffix}"
            for folder in _IMAGE_FOLDERS
            for suffix in LISTED_SUFFIXES
        )
        rgb = next((path for path in pictures if path.is_file()), None)

        # Annotation by annotation.
        for index, entry in enumerate(entries):
            K, unit_m = read_bop_camera(cameras[key], camera_source)
            info = visibilities[index] if index < len(visibilities) else {}
            info = info if isinstance(info, dict) else {}
            mask = scene / f"mask_visib{end}" / f"{image}_{index:06d}.png"
            annotation_source = f"{source}, annotation {index}"
            visible = read_number(info, "visib_fract", -1.0, annotation_source)
            yield Instance(
                scene_id=int(scene.name),
                image_id=int(key),
                index=index,
                object_id=read_integer(entry, "obj_id", annotation_source),
                K=K,
                depth=tiff if tiff.is_file() else tiff.with_suffix(".png"),
                depth_unit_m=unit_m,
                mask=mask if mask.is_file() else None,
                rgb=rgb,
                camera_from_model=make_pose(
                    read_numbers(entry, "cam_R_m2c", 9, annotation_source),
                    read_numbers(entry, "cam_t_m2c", 3, annotation_source),
                    annotation_source,
                ),
                visible_fraction=visible if visible >= 0 else None,
                is_measured=not str(info.get("pose_source", "")).startswith("pseudo"),
            )


def _read_bop_split(folder: Path, split: str) -> Iterator[Instance]:
    """Read the annotations of all scenes of a split."""
    scenes, end = list_bop_scenes(folder, split)
    for scene in scenes:
        yield from read_bop_instances(scene, end)


@dataclass(frozen=True, kw_only=True)
class BopTarget:
    """An entry of a list of targets: instances that are to be posed in an image."""

    scene_id: int  #: number of the scene
    image_id: int  #: number of the image
    object_id: int | None = None  #: None: all objects in the image
    count: int | None = None  #: number of instances of the object; None: all


def read_targets(path: str | Path, folder: str | Path = ".") -> list[BopTarget]:
    """Read a list of targets: a file, or the name of one in the folder of its data set.

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


_MAX_BYTES = 2**22  # of a list of images

SYMMETRIC = (10, 11)  #: Eggbox and glue: measured by ADD-S ever since Hinterstoisser et al. (2012).


def read_linemod_instances(folder: Path, split: str) -> Iterator[Instance]:
    """Read the annotations of a split: ``train`` or ``test``, by the lists beside the data.

    The folder of an object shows others too (in that of object 2 they are annotated); only its own
    object counts, as in every published number.
    """
    for scene in sorted(folder.glob("data/[0-9][0-9]")):
        listed = scene / f"{split}.txt"
        if not listed.is_file():
            raise InputError(f"{listed}: no such list; the splits are train and test")
        truths = read_mapping(scene / "gt.yml")
        infos = read_mapping(scene / "info.yml")
        for line in read_text(listed, _MAX_BYTES).split():
            if parse_entry_number(line) is None:
                raise InputError(f"{listed}: {line[:40]!r} is no number of an image")

            # The one annotation of the folder's own object.
            image = int(line)
            number = int(scene.name)
            source = f"{scene / 'gt.yml'}: image {image}"
            entries = truths.get(image)
            if not isinstance(entries, list):
                raise InputError(f"{source} has no annotation; is the list of another download?")
            of_object = [e for e in entries if read_integer(e, "obj_id", source) == number]
            if len(of_object) != 1:
                raise InputError(
                    f"{source} annotates object {number} {len(of_object)} times, where once belongs"
                )

            # Its camera and its images.
            camera_source = f"{scene / 'info.yml'}: image {image}"
            K, unit_m = read_bop_camera(infos.get(image), camera_source)
            depth = scene / "depth" / f"{image:04d}.png"
            mask = scene / "mask" / f"{image:04d}.png"
            rgb = scene / "rgb" / f"{image:04d}.png"
            yield Instance(
                scene_id=number,
                image_id=image,
                index=entries.index(of_object[0]),
                object_id=number,
                K=K,
                depth=depth,
                depth_unit_m=unit_m,
                mask=mask if mask.is_file() else None,
                rgb=rgb if rgb.is_file() else None,
                camera_from_model=make_pose(
                    read_numbers(of_object[0], "cam_R_m2c", 9, source),
                    read_numbers(of_object[0], "cam_t_m2c", 3, source),
                    source,
                ),
            )


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How one kind of data set is read; its models are ``models/obj_NNNNNN.ply`` in millimetres."""

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
    """Find the name and the layout of a folder; BOP's where none fits."""
    name = next((name for name, layout in LAYOUTS.items() if layout.splits(folder)), "BOP")
    return name, LAYOUTS[name]


_MODEL_FOLDERS = ("models", "models_eval", "models_points")


def read_models_info(folder: Path) -> tuple[Path, dict[int, dict[str, Any]]]:
    """Find a data set's folder of models, and read its entries of objects, by number.

    There are no entries where there is neither ``models_info.json`` nor ``.yml``.

    Raises:
        InputError: there is no such folder, or the file is damaged.
    """
    home = next((folder / name for name in _MODEL_FOLDERS if (folder / name).is_dir()), None)
    if home is None:
        raise InputError(f"{folder}: no folder {' or '.join(_MODEL_FOLDERS)}; put the meshes there")
    files = (home / "models_info.json", home / "models_info.yml")
    content = next((read_mapping(path) for path in files if path.is_file()), {})
    wrong = [
        k for k, v in content.items() if parse_entry_number(k) is None or not isinstance(v, dict)
    ]
    if wrong:
        raise InputError(
            f"{home}: models_info entry {str(wrong[0])[:80]!r} is no object's; correct it"
        )
    return home, {int(key): entry for key, entry in content.items()}


def read_bop_models(
    folder: Path, numbers: Iterable[int], config: MeshConfig | None = None
) -> dict[int, ObjectModel]:
    """Read models with their declared symmetries, diameters and names.

    The diameter is the declared one, where there is one: published numbers are shares of it. The
    two symmetric objects of Linemod_preprocessed, which declares none, get theirs.
    """
    home, infos = read_models_info(folder)
    _, layout = find_layout(folder)
    models: dict[int, ObjectModel] = {}
    for wanted in sorted(set(numbers)):
        candidates = (home / f"obj_{wanted:06d}.ply", home / f"obj_{wanted:02d}.ply")
        path = next((path for path in candidates if path.is_file()), None)
        if path is None:
            raise InputError(f"{home}: no obj_{wanted:06d}.ply for object {wanted}; put it there")

        # Its declared symmetries, and the half turn of an object that declares none.
        info = infos.get(wanted, {})
        source = f"{home / 'models_info.json'}: object {wanted}"
        symmetries = symmetries_from_bop(info, source=source)
        if symmetries.is_none and wanted in layout.half_turns:
            up = torch.tensor([0.0, 0.0, 1.0]).double()
            origin = torch.zeros(3).double()
            turn = turn_about(up, origin, torch.tensor([math.pi]).double())
            symmetries = Symmetries(discrete=turn)

        # The mesh, with the declared name and diameter.
        model = read_model(
            path,
            "mm",
            name=str(info.get("name", f"obj_{wanted:06d}")),
            number=wanted,
            symmetries=symmetries,
            config=config,
        )
        declared_m = 0.001 * read_number(info, "diameter", 1000 * model.diameter_m, source)
        models[wanted] = replace(model, diameter_m=declared_m)
    return models


def read_object_names(folder: Path, numbers: Iterable[int] | None = None) -> dict[int, str]:
    """Read the names of objects by number; of all in ``models_info`` where none are given.

    Raises:
        InputError: there is no folder of models, or the file is damaged.
    """
    _, infos = read_models_info(folder)
    wanted = infos if numbers is None else numbers
    return {k: str(infos.get(k, {}).get("name", f"obj_{k:06d}")) for k in wanted}
