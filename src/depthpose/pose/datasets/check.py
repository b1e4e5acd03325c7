"""The check of a BOP or LineMOD folder before hours of work: everything wrong, a line each."""

from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from depthpose.core.camera import project
from depthpose.core.errors import InputError
from depthpose.core.files import image_size, read_depth_png
from depthpose.core.findings import CheckReport, Problem, make_report, unreadable
from depthpose.pose.cloud import cloud_from_depth, refusal_of
from depthpose.pose.datasets.dataset import open_bop, read_instance_mask
from depthpose.pose.datasets.layouts import (
    Instance,
    layout_of,
    model_path,
    models_folder,
    object_name,
    read_models_info,
)
from depthpose.pose.mesh import (
    exact_diameter,
    read_model,
    sample_surface,
    symmetries_from_bop,
    unit_advice,
)
from depthpose.pose.types import ObjectModel

_DIAMETER_SLACK = 0.01
_FAR_DIAMETERS = 1.0
_FEW_IN_MASK = 0.5

Models = dict[int, ObjectModel]


def check_bop(
    folder: str | Path,
    split: str | None = None,
    *,
    with_decoding: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> CheckReport:
    """Check every file of a data set: are they there and whole, and do they agree?

    Units are checked too: a cloud a thousand times smaller than its model, or a metre away from
    its annotated pose, is reported.

    Args:
        folder: of the data set.
        split: check only this one; None: all.
        with_decoding: decode depth and masks and compare them with poses; else only headers.
        progress: called with the number of instances done and of all.

    Raises:
        InputError: there is no such split.
    """
    folder = Path(folder)
    name, layout = layout_of(folder)
    known = layout.splits(folder)
    if split is not None and split not in known:
        raise InputError(f"{folder}: no split {split!r}. Here: {', '.join(known) or 'none'}.")
    found: list[Problem] = []
    instances: list[Instance] = []
    for one in known if split is None else [split]:
        try:
            instances += open_bop(folder, one).instances
        except InputError as error:
            found.append(Problem(path=folder, kind="unreadable", message=str(error)))
    models, more = _check_models(folder, {i.object_id for i in instances})
    found += more
    for done, instance in enumerate(instances, 1):
        found += _check_instance(instance, models, with_decoding=with_decoding)
        if progress is not None:
            progress(done, len(instances))
    return make_report(name, _count(instances, models), found)


def _count(instances: list[Instance], models: Models) -> dict[str, int]:
    images = groupby(instances, key=lambda i: (i.depth.parent, i.image_id))
    return {
        "images": sum(1 for _ in images),
        "instances": len(instances),
        "masks": sum(i.mask is not None for i in instances),
        "objects": len({i.object_id for i in instances}),
        "models": len(models),
    }


def _check_models(folder: Path, numbers: set[int]) -> tuple[Models, list[Problem]]:
    try:
        home = models_folder(folder)
        infos = read_models_info(home)
    except InputError as error:
        return {}, [Problem(path=folder, kind="missing", message=str(error))]
    models: Models = {}
    found: list[Problem] = []
    for number in sorted(numbers):
        path = model_path(home, number)
        if path is None:
            message = f"has no mesh of object {number}, which is annotated"
            found.append(Problem(path=home, kind="missing", message=message))
            continue
        try:
            symmetries_from_bop(infos.get(number, {}), source=f"object {number}")
            models[number] = read_model(path, "mm", number=number)
        except InputError as error:
            found.append(unreadable(path, error))
            continue
        found += _check_diameter(path, models[number], infos.get(number, {}).get("diameter"))
    found += _check_names(home, {n: object_name(n, infos.get(n, {})) for n in numbers})
    return models, found


def _check_names(home: Path, names: dict[int, str]) -> Iterator[Problem]:
    """Report annotated objects of one name: estimators, which know them by name, refuse them."""
    for name in sorted(set(names.values())):
        own = sorted(number for number, one in names.items() if one == name)
        if len(own) > 1:
            numbers = " and ".join(map(str, own))
            message = f"calls objects {numbers} {name!r}; rename all but one in models_info"
            yield Problem(path=home, kind="mismatch", message=message)


def _check_diameter(path: Path, model: ObjectModel, declared_mm: object) -> Iterator[Problem]:
    if not isinstance(declared_mm, int | float):
        message = "has no declared diameter; that of the mesh is taken"
        yield Problem(path=path, kind="note", message=message)
        return
    measured_mm = 1000 * exact_diameter(model.vertices_m)
    if abs(measured_mm - declared_mm) > _DIAMETER_SLACK * declared_mm:
        message = f"is {measured_mm:.1f} mm across, but models_info says {declared_mm:.1f} mm"
        yield Problem(path=path, kind="mismatch", message=message)


def _check_instance(
    instance: Instance, models: Models, *, with_decoding: bool
) -> Iterator[Problem]:
    if instance.mask is None:
        message = f"has no mask_visib of annotation {instance.index}"
        yield Problem(path=instance.depth, kind="note", message=message)
    if not instance.is_measured:
        message = f"annotation {instance.index} is itself fitted to this depth; quote no accuracy"
        yield Problem(path=instance.depth, kind="note", message=message)
    try:
        sizes = {path: image_size(path) for path in (instance.depth, instance.mask, instance.rgb)
                 if path is not None}  # fmt: skip
    except InputError as error:
        path = next((p for p in (instance.depth, instance.mask, instance.rgb)
                     if p is not None and str(p) in str(error)), instance.depth)  # fmt: skip
        kind = "unreadable" if path.is_file() else "missing"
        problem = unreadable(path, error)
        yield Problem(path=path, kind=kind, message=problem.message)
        return
    width, height = sizes[instance.depth]
    for path, size in sizes.items():
        if size != (width, height):
            message = f"is {size[0]}x{size[1]}, but its depth image is {width}x{height}"
            yield Problem(path=path, kind="mismatch", message=message)
            return
    if with_decoding and instance.mask is not None and instance.object_id in models:
        yield from _check_content(instance, models[instance.object_id])


def _check_content(instance: Instance, model: ObjectModel) -> Iterator[Problem]:
    try:
        mask = read_instance_mask(instance)
        depth_m = read_depth_png(instance.depth, instance.depth_unit_m)
    except InputError as error:
        path = instance.mask if str(instance.mask) in str(error) else instance.depth
        assert path is not None
        yield unreadable(path, error)
        return
    assert instance.mask is not None
    cloud = cloud_from_depth(depth_m, mask, instance.K)
    refusal = refusal_of(cloud)
    if refusal is not None:
        # Instances that are fully occluded are annotated too: no fault, but no test either.
        yield Problem(path=instance.mask, kind="note", message=refusal)
        return
    advice = unit_advice(model.diameter_m, cloud[cloud[:, 2] < 3 * cloud[:, 2].median()])
    centre_m = instance.camera_from_model.apply(model.vertices_m.double()).mean(0)
    away_m = float((cloud.double().median(0).values - centre_m).norm())
    if advice is not None and away_m > _FAR_DIAMETERS * model.diameter_m:
        yield Problem(path=instance.depth, kind="mismatch", message=f"{instance.name}: {advice}")
    elif away_m > _FAR_DIAMETERS * model.diameter_m:
        message = (
            f"{instance.name}: the cloud lies {away_m:.2f} m from the annotated pose; are "
            "depth_scale and cam_t_m2c both for millimetres?"
        )
        yield Problem(path=instance.depth, kind="mismatch", message=message)
    elif _share_in_mask(instance, model, mask) < _FEW_IN_MASK and not (
        instance.visible_fraction is not None and instance.visible_fraction < _FEW_IN_MASK
    ):
        message = f"{instance.name}: the posed model does not lie on its mask; is it another's?"
        yield Problem(path=instance.mask, kind="mismatch", message=message)


def _share_in_mask(instance: Instance, model: ObjectModel, mask: Bool[Tensor, "h w"]) -> float:
    """Share of the model's points whose pixel is in the mask, grown by a pixel or two."""
    surface, _ = sample_surface(model, 500)
    points = instance.camera_from_model.apply(surface.double())
    pixels = project(points, instance.K).nan_to_num(-9).round().long()
    height, width = mask.shape
    grown = torch.nn.functional.max_pool2d(mask[None].float(), 5, 1, 2)[0] > 0
    u, v = pixels[:, 0], pixels[:, 1]
    is_inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    hit = grown[v.clamp(0, height - 1), u.clamp(0, width - 1)] & is_inside
    return float(hit.double().mean())
