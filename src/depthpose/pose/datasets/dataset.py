"""Datasets of poses: samples of any known layout, the check of all files, and writing BOP's."""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from depthpose.core.camera import project
from depthpose.core.errors import InputError
from depthpose.core.files import (
    image_size,
    read_depth_png,
    write_depth_png,
    write_image,
    write_json,
)
from depthpose.core.files.disk import write_bytes
from depthpose.core.findings import CheckReport, Problem, make_report, make_unreadable
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import (
    advise_unit,
    cloud_from_depth,
    grow_mask,
    require_points,
    require_same_size,
)
from depthpose.pose.datasets.layouts import (
    Instance,
    find_layout,
    find_model_file,
    list_bop_splits,
    read_bop_models,
    read_models_info,
    read_object_names,
)
from depthpose.pose.datasets.masks import find_mask_box, read_mask
from depthpose.pose.mesh import (
    measure_diameter,
    read_model,
    sample_surface,
    symmetries_from_bop,
    symmetries_to_bop,
)
from depthpose.pose.refusals import Refused
from depthpose.pose.types import ObjectModel, PoseTruth, ViewInput, ViewSample


@dataclass(frozen=True, kw_only=True, eq=False)
class BopDataset:
    """The instances of a split, whose files are read when a sample is asked for."""

    folder: Path  #: of the dataset
    split: str  #: its name, with that of the sensor where there are several
    layout: str  #: a key of ``LAYOUTS``
    instances: Sequence[Instance]  #: what is annotated, in the order of scene, image and place
    sha256: str  #: of all annotations of the split: tells datasets of one name apart

    def __len__(self) -> int:
        return len(self.instances)

    @property
    def folder_of_split(self) -> str:
        """The folder of the split: its name without that of the sensor."""
        splits = list_bop_splits(self.folder) if self.layout == "BOP" else {}
        return splits[self.split].folder if self.split in splits else self.split

    def __getitem__(self, index: int) -> ViewSample:
        """Read the view of an instance, with the annotated mask; see :meth:`view`."""
        return self.view(self.instances[index])

    @cached_property
    def objects(self) -> dict[int, ObjectModel]:
        """The models of all objects that occur, by number. Read when first asked for.

        Raises:
            InputError: a mesh is missing or damaged.
        """
        numbers = {instance.object_id for instance in self.instances}
        return read_bop_models(self.folder, numbers)

    def view(
        self, instance: Instance, mask: Bool[Tensor, "mask_h mask_w"] | None = None
    ) -> ViewSample:
        """Read the whole depth image of an instance, and its true pose.

        Args:
            instance: of this dataset.
            mask: a predicted one; None: the annotated one.

        Raises:
            InputError: a file is missing or damaged, or the mask does not fit the depth.
        """
        mask = read_instance_mask(instance) if mask is None else mask
        depth_m = read_depth_png(instance.depth, instance.depth_unit_m)
        require_same_size(mask, depth_m)
        return ViewSample(
            input=ViewInput(
                name=instance.name,
                depth_m=depth_m,
                mask=mask,
                K=instance.K,
                object=self.objects[instance.object_id].name,
            ),
            truth=PoseTruth(
                camera_from_model=instance.camera_from_model,
                visible_fraction=instance.visible_fraction,
                is_measured=instance.is_measured,
            ),
        )

    def of_objects(self, *objects: int | str) -> "BopDataset":
        """Select the instances of some objects, as a dataset of these alone.

        Args:
            objects: their numbers or names; digits are a number too.

        Raises:
            InputError: none is left.
        """
        # The objects that occur, and those that are asked for: digits are a number, or a name.
        present = sorted({instance.object_id for instance in self.instances})
        names = read_object_names(self.folder, present)
        digits = (o for o in objects if isinstance(o, str) and o.isdecimal())
        wanted = {*objects, *(int(o) for o in digits if o not in names.values())}
        instances = [i for i in self.instances if {i.object_id, names[i.object_id]} & wanted]
        if not instances:
            asked = ", ".join(map(repr, objects))
            listing = ", ".join(f"{number} ({name})" for number, name in names.items())
            raise InputError(
                f"{self.folder}: no instance of {asked}; objects here: {listing}; name one of them"
            )
        return replace(self, instances=instances)


def open_bop(folder: str | Path, split: str = "test") -> BopDataset:
    """Open a split of a dataset in BOP's layout, or in another of ``LAYOUTS``.

    Args:
        folder: of the dataset, with ``models`` and the splits in it.
        split: ``test``, ``train_pbr``, ..., of several sensors with that of one, such as
            ``val_photoneo``; ``train`` or ``test`` of Linemod_preprocessed.

    Raises:
        InputError: no such folder or split, or an annotation is damaged.
    """
    folder = Path(folder)
    name, layout = find_layout(folder)
    instances = list(layout.instances(folder, split))

    # What tells datasets of one name apart.
    digest = hashlib.sha256()
    for instance in instances:
        pose = instance.camera_from_model
        digest.update(f"{instance.name} {instance.object_id} {instance.depth_unit_m}".encode())
        numbers = torch.cat([instance.K.flatten(), pose.R.flatten(), pose.t_m]).double().numpy()
        digest.update(numbers.tobytes())
    return BopDataset(
        folder=folder,
        split=split,
        layout=name,
        instances=instances,
        sha256=digest.hexdigest(),
    )


def read_instance_mask(instance: Instance) -> Bool[Tensor, "mask_h mask_w"]:
    """Read the annotated mask of the visible part.

    Raises:
        InputError: there is none, or it is damaged.
    """
    if instance.mask is None:
        raise InputError(
            f"{instance.name}: there is no mask beside {instance.depth.parent}; render mask_visib, "
            "or give masks of your own"
        )
    return read_mask(instance.mask)


_DIAMETER_SLACK = 0.01  # share by which the declared diameter may differ from the mesh's
_FAR_DIAMETERS = 1.0  # of a cloud from the annotated pose, from which units are suspected
_NEAR_MEDIANS = 3  # of the median depth, from which a point is no part of an object's cloud
_FEW_IN_MASK = 0.5  # share of a posed model in its mask, below which the mask is another's
_CHECKED_POINTS = 500  # of a model, by which that share is measured
_MASK_MARGIN_PX = 2  # by which a mask may be too small
_NOWHERE_PX = -9  # pixel of a point that has none


def check_bop(
    folder: str | Path,
    split: str | None = None,
    *,
    with_decoding: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> CheckReport:
    """Check every file of a dataset: are they there and whole, and do they agree?

    Units are checked too: a cloud a thousand times smaller than its model, or a metre away from
    its annotated pose, is reported.

    Args:
        folder: of the dataset.
        split: its name; None: all.
        with_decoding: read images whole; else their headers alone.
        progress: called with the number of instances done and of all.

    Raises:
        InputError: there is no such split.
    """
    folder = Path(folder)
    name, layout = find_layout(folder)
    splits = layout.splits(folder)
    if split is not None and split not in splits:
        raise InputError(f"{folder}: no split {split!r}. Here: {', '.join(splits) or 'none'}.")

    # Annotations and models.
    problems: list[Problem] = []
    instances: list[Instance] = []
    for split_name in splits if split is None else [split]:
        try:
            instances += open_bop(folder, split_name).instances
        except InputError as error:
            problems.append(Problem(path=folder, kind="unreadable", message=str(error)))
    models = _check_models(folder, {i.object_id for i in instances}, problems)

    # The files of each instance.
    for done, instance in enumerate(instances, 1):
        model = models.get(instance.object_id) if with_decoding else None
        try:
            problems += _check_instance(instance, model)
        except InputError as error:
            problems.append(_describe_unreadable(instance, error))
        if progress is not None:
            progress(done, len(instances))

    # The report.
    counts = {
        "images": len({(i.depth.parent, i.image_id) for i in instances}),
        "instances": len(instances),
        "masks": sum(i.mask is not None for i in instances),
        "objects": len({i.object_id for i in instances}),
        "models": len(models),
    }
    return make_report(name, counts, problems)


def _describe_unreadable(instance: Instance, error: InputError) -> Problem:
    """Describe an error in reading an instance's files as a problem of one of these.

    It is the file that the error names, or else the depth image.
    """
    files = (instance.mask, instance.rgb)
    named = (path for path in files if path is not None and str(path) in str(error))
    problem = make_unreadable(next(named, instance.depth), error)
    return problem if problem.path.is_file() else replace(problem, kind="missing")


def _check_models(
    folder: Path, numbers: set[int], problems: list[Problem]
) -> dict[int, ObjectModel]:
    """Read the models that can be read; what is wrong with them is added to ``problems``.

    Returns:
        The models by number.
    """
    models: dict[int, ObjectModel] = {}
    try:
        models_folder, infos = read_models_info(folder)
    except InputError as error:
        problems.append(Problem(path=folder, kind="missing", message=str(error)))
        return models
    for number in sorted(numbers):
        # Is there a mesh, and can it be read?
        path = find_model_file(models_folder, number)
        if path is None:
            message = f"has no mesh of object {number}, which is annotated"
            problems.append(Problem(path=models_folder, kind="missing", message=message))
            continue
        try:
            symmetries_from_bop(infos.get(number, {}), source=f"object {number}")
            models[number] = read_model(path, "mm", number=number)
        except InputError as error:
            problems.append(make_unreadable(path, error))
            continue

        problems += _check_diameter(path, models[number], infos.get(number, {}).get("diameter"))

    # Estimators know objects by name, and refuse two of one.
    names = read_object_names(folder, numbers)
    for name, count in sorted(Counter(names.values()).items()):
        if count > 1:
            of_name = " and ".join(str(n) for n in sorted(names) if names[n] == name)
            message = f"calls objects {of_name} {name!r}; rename all but one in models_info"
            problems.append(Problem(path=models_folder, kind="mismatch", message=message))
    return models


def _check_diameter(path: Path, model: ObjectModel, declared_mm: object) -> Iterator[Problem]:
    """Compare the diameter of a mesh with that which the dataset declares, if it does."""
    measured_mm = 1000 * measure_diameter(model.vertices_m)
    if not isinstance(declared_mm, int | float):
        message = "has no declared diameter; that of the mesh is taken"
        yield Problem(path=path, kind="note", message=message)
    elif abs(measured_mm - declared_mm) > _DIAMETER_SLACK * declared_mm:
        message = f"is {measured_mm:.1f} mm across, but models_info says {declared_mm:.1f} mm"
        yield Problem(path=path, kind="mismatch", message=message)


def _check_instance(instance: Instance, model: ObjectModel | None) -> Iterator[Problem]:
    """Compare the sizes of an instance's files, and what they show with the model at its pose.

    Args:
        instance: the annotation and its files.
        model: of its object; None: sizes are compared alone.

    Yields:
        What does not agree, and notes.

    Raises:
        InputError: a file is missing or damaged.
    """
    # What is noted of the annotation.
    if instance.mask is None:
        message = f"has no mask_visib of annotation {instance.index}"
        yield Problem(path=instance.depth, kind="note", message=message)
    if not instance.is_measured:
        message = f"annotation {instance.index} is itself fitted to this depth; quote no accuracy"
        yield Problem(path=instance.depth, kind="note", message=message)

    # Are all images of one size?
    width, height = image_size(instance.depth)
    for path in filter(None, (instance.mask, instance.rgb)):
        size = image_size(path)
        if size != (width, height):
            message = f"is {size[0]}x{size[1]}, but its depth image is {width}x{height}"
            yield Problem(path=path, kind="mismatch", message=message)
            return
    if instance.mask is not None and model is not None:
        yield from _compare_with_model(instance, instance.mask, model)


def _compare_with_model(
    instance: Instance, mask_path: Path, model: ObjectModel
) -> Iterator[Problem]:
    """Compare what an instance's depth image and mask show with its model at the annotated pose."""
    # Does the mask show enough points?
    mask = read_mask(mask_path)
    depth_m = read_depth_png(instance.depth, instance.depth_unit_m)
    cloud = cloud_from_depth(depth_m, mask, instance.K)
    try:
        require_points(cloud)
    except Refused as refused:
        # Instances that are fully occluded are annotated too: no fault, but no test either.
        yield Problem(path=mask_path, kind="note", message=refused.reason)
        return

    # Do they lie at the annotated pose? And if so, does the posed model lie in the mask?
    centre_m = instance.camera_from_model.apply(model.vertices_m.double()).mean(0)
    away_m = float((cloud.double().median(0).values - centre_m).norm())
    if away_m > _FAR_DIAMETERS * model.diameter_m:
        near_cloud = cloud[cloud[:, 2] < _NEAR_MEDIANS * cloud[:, 2].median()]
        advice = advise_unit(model.diameter_m, near_cloud)
        message = (
            f"the cloud lies {away_m:.2f} m from the annotated pose; are depth_scale and "
            "cam_t_m2c both for millimetres?"
        )
        if advice is not None:
            message = advice.message
        yield Problem(path=instance.depth, kind="mismatch", message=f"{instance.name}: {message}")
        return
    is_visible = instance.visible_fraction is None or instance.visible_fraction >= _FEW_IN_MASK
    if is_visible and _measure_share_in_mask(instance, model, mask) < _FEW_IN_MASK:
        message = f"{instance.name}: the posed model does not lie on its mask; is it another's?"
        yield Problem(path=mask_path, kind="mismatch", message=message)


def _measure_share_in_mask(
    instance: Instance, model: ObjectModel, mask: Bool[Tensor, "h w"]
) -> float:
    """Measure the share of a posed model's points whose pixel is in the mask, or near it."""
    height, width = mask.shape
    surface_m, _ = sample_surface(model, _CHECKED_POINTS)
    points_m = instance.camera_from_model.apply(surface_m.double())
    pixels = project(points_m, instance.K).nan_to_num(_NOWHERE_PX).round().long()
    u, v = pixels.unbind(1)
    is_inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    grown = grow_mask(mask, _MASK_MARGIN_PX)
    is_hit = grown[v.clamp(0, height - 1), u.clamp(0, width - 1)] & is_inside
    return float(is_hit.double().mean())


_DEPTH_UNIT_M = 0.0001  # tenths of a millimetre reach 6.5 m, and no imitated sensor is finer


@dataclass(frozen=True, kw_only=True, eq=False)
class BopObject:
    """An annotated object of a frame."""

    number: int  #: its ``obj_id``
    camera_from_model: Rigid  #: its pose
    visible: Bool[Tensor, "h w"]  #: its pixels that nothing occludes
    silhouette: Bool[Tensor, "h w"]  #: all its pixels in the image, occluded ones too


@dataclass(frozen=True, kw_only=True, eq=False)
class BopFrame:
    """An image of a scene, with its annotations."""

    number: int  #: its ``im_id``
    K: Float[Tensor, "3 3"]  #: intrinsic matrix
    depth_m: Float[Tensor, "h w"]  #: NaN where there is no reading
    objects: Sequence[BopObject]  #: what is annotated
    rgb: Float[Tensor, "3 h w"] | None = None  #: the picture, if there is one


def write_bop_scene(
    folder: Path, split: str, scene_id: int, frames: Sequence[BopFrame]
) -> Path:  # fmt: skip
    """Write a scene in BOP's layout, its images and masks before the JSON that names them.

    Args:
        folder: of the dataset.
        split: name of the split.
        scene_id: number of the scene.
        frames: its images.

    Returns:
        The folder of the scene.

    Raises:
        InputError: the disk refuses.
    """
    scene = folder / split / f"{scene_id:06d}"
    truths: dict[str, list[dict[str, Any]]] = {}
    infos: dict[str, list[dict[str, Any]]] = {}
    for frame in frames:
        # The images of a frame.
        name = f"{frame.number:06d}"
        write_depth_png(scene / "depth" / f"{name}.png", frame.depth_m, _DEPTH_UNIT_M)
        if frame.rgb is not None:
            write_image(scene / "rgb" / f"{name}.png", frame.rgb)
        for index, shown in enumerate(frame.objects):
            write_mask(scene / "mask_visib" / f"{name}_{index:06d}.png", shown.visible)
            write_mask(scene / "mask" / f"{name}_{index:06d}.png", shown.silhouette)

        # The annotations of its objects.
        truths[str(frame.number)] = [_describe_pose(shown) for shown in frame.objects]
        infos[str(frame.number)] = [_describe_visible(shown, frame) for shown in frame.objects]
    scale_mm = 1000 * _DEPTH_UNIT_M
    cameras = {
        str(f.number): {"cam_K": f.K.flatten().tolist(), "depth_scale": scale_mm} for f in frames
    }
    write_json(scene / "scene_gt_info.json", infos)
    write_json(scene / "scene_gt.json", truths)
    write_json(scene / "scene_camera.json", cameras)
    return scene


def _describe_pose(shown: BopObject) -> dict[str, Any]:
    """Make the entry of an object in ``scene_gt.json``."""
    pose = shown.camera_from_model
    return {
        "cam_R_m2c": pose.R.double().flatten().tolist(),
        "cam_t_m2c": (1000 * pose.t_m.double()).tolist(),
        "obj_id": shown.number,
    }


def _describe_visible(shown: BopObject, frame: BopFrame) -> dict[str, Any]:
    """Make the entry of an object in ``scene_gt_info.json``."""
    silhouette_px = int(shown.silhouette.sum())
    visible_px = int(shown.visible.sum())
    return {
        "bbox_obj": find_mask_box(shown.silhouette),
        "bbox_visib": find_mask_box(shown.visible),
        "px_count_all": silhouette_px,
        "px_count_valid": int((shown.silhouette & frame.depth_m.isfinite()).sum()),
        "px_count_visib": visible_px,
        "visib_fract": visible_px / silhouette_px if silhouette_px else 0.0,
    }


def write_bop_models(folder: Path, models: Sequence[ObjectModel]) -> Path:
    """Write models in BOP's layout: ``models/obj_NNNNNN.ply`` in mm, and ``models_info.json``.

    The geometry and the symmetries are written; colours, normals and keypoints are left out.

    Returns:
        The folder of the models.

    Raises:
        InputError: the disk refuses.
    """
    import trimesh

    models_folder = folder / "models"
    info: dict[str, Any] = {}
    for model in models:
        # Its mesh, or its points.
        vertices_mm = 1000 * model.vertices_m.double().numpy()
        mesh = trimesh.Trimesh(vertices_mm, model.faces.numpy(), process=False)
        shape = mesh if len(model.faces) else trimesh.PointCloud(vertices_mm)
        data = shape.export(file_type="ply")
        assert isinstance(data, bytes)
        write_bytes(models_folder / f"obj_{model.number:06d}.ply", data)

        # Its entry: diameter, name, box and symmetries.
        low = vertices_mm.min(0)
        size = np.ptp(vertices_mm, axis=0)
        entry: dict[str, Any] = {"diameter": 1000 * model.diameter_m, "name": model.name}
        entry |= {f"min_{axis}": float(low[i]) for i, axis in enumerate("xyz")}
        entry |= {f"size_{axis}": float(size[i]) for i, axis in enumerate("xyz")}
        info[str(model.number)] = entry | symmetries_to_bop(model.symmetries)
    write_json(models_folder / "models_info.json", info)
    return models_folder


def write_mask(path: Path, mask: Bool[Tensor, "h w"]) -> None:
    """Write a mask as an 8-bit PNG, 255 on the object."""
    encoded = BytesIO()
    Image.fromarray(mask.cpu().numpy().astype(np.uint8) * 255).save(encoded, "PNG")
    write_bytes(path, encoded.getvalue())
