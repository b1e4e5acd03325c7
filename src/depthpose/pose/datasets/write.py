"""Data sets in BOP's layout: what is written can be shared, checked and read back."""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from depthpose.core.files import write_depth_png, write_image, write_json
from depthpose.core.files.disk import write_bytes
from depthpose.core.rigid import Rigid
from depthpose.pose.datasets.masks import mask_box
from depthpose.pose.mesh import symmetries_to_bop
from depthpose.pose.types import ObjectModel

_DEPTH_UNIT_M = 0.0001
"""Tenths of a millimetre reach 6.5 m and are finer than any sensor that is imitated."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BopObject:
    """One object of a frame.

    Attributes:
        number: its ``obj_id``.
        camera_from_model: its pose.
        visible: its pixels that nothing occludes.
        silhouette: all its pixels in the image, occluded ones too.
    """

    number: int
    camera_from_model: Rigid
    visible: Bool[Tensor, "h w"]
    silhouette: Bool[Tensor, "h w"]


@dataclass(frozen=True, kw_only=True, eq=False)
class BopFrame:
    """One image of a scene.

    Attributes:
        number: its ``im_id``.
        K: intrinsic matrix.
        depth_m: NaN where there is no reading.
        objects: what is annotated.
        rgb: the picture, if there is one.
    """

    number: int
    K: Float[Tensor, "3 3"]
    depth_m: Float[Tensor, "h w"]
    objects: Sequence[BopObject]
    rgb: Float[Tensor, "3 h w"] | None = None


def write_bop_scene(
    folder: Path, split: str, scene_id: int, frames: Sequence[BopFrame]
) -> Path:  # fmt: skip
    """Write a scene whole: images and masks first, so that its JSON never names what is missing.

    Returns:
        The folder of the scene.

    Raises:
        InputError: the disk refuses.
    """
    scene = folder / split / f"{scene_id:06d}"
    for frame in frames:
        _write_images(scene, frame)
    truths = {str(f.number): [_truth(o) for o in f.objects] for f in frames}
    infos = {str(f.number): [_info(o, f.depth_m) for o in f.objects] for f in frames}
    scale_mm = 1000 * _DEPTH_UNIT_M
    cameras = {
        str(f.number): {"cam_K": f.K.flatten().tolist(), "depth_scale": scale_mm} for f in frames
    }
    write_json(scene / "scene_gt_info.json", infos)
    write_json(scene / "scene_gt.json", truths)
    write_json(scene / "scene_camera.json", cameras)
    return scene


def write_bop_models(folder: Path, models: Sequence[ObjectModel]) -> Path:
    """Write ``models/obj_NNNNNN.ply`` in mm, and ``models_info.json`` with symmetries.

    Returns:
        The folder of models.

    Raises:
        InputError: the disk refuses.
    """
    import trimesh

    home = folder / "models"
    info: dict[str, Any] = {}
    for model in models:
        vertices = 1000 * model.vertices_m.double().numpy()
        mesh = trimesh.Trimesh(vertices, model.faces.numpy(), process=False)
        shape = mesh if len(model.faces) else trimesh.PointCloud(vertices)
        data = shape.export(file_type="ply")
        assert isinstance(data, bytes)
        write_bytes(home / f"obj_{model.number:06d}.ply", data)
        low, size = vertices.min(0), np.ptp(vertices, axis=0)
        entry: dict[str, Any] = {"diameter": 1000 * model.diameter_m, "name": model.name}
        entry |= {f"min_{axis}": float(low[i]) for i, axis in enumerate("xyz")}
        entry |= {f"size_{axis}": float(size[i]) for i, axis in enumerate("xyz")}
        info[str(model.number)] = entry | symmetries_to_bop(model.symmetries)
    write_json(home / "models_info.json", info)
    return home


def _write_images(scene: Path, frame: BopFrame) -> None:
    write_depth_png(scene / "depth" / f"{frame.number:06d}.png", frame.depth_m, _DEPTH_UNIT_M)
    if frame.rgb is not None:
        write_image(scene / "rgb" / f"{frame.number:06d}.png", frame.rgb)
    for index, shown in enumerate(frame.objects):
        name = f"{frame.number:06d}_{index:06d}.png"
        write_mask(scene / "mask_visib" / name, shown.visible)
        write_mask(scene / "mask" / name, shown.silhouette)


def write_mask(path: Path, mask: Bool[Tensor, "h w"]) -> None:
    """Write a mask as an 8-bit PNG, 255 on the object."""
    encoded = BytesIO()
    Image.fromarray(mask.cpu().numpy().astype(np.uint8) * 255).save(encoded, "PNG")
    write_bytes(path, encoded.getvalue())


def _truth(shown: BopObject) -> dict[str, Any]:
    pose = shown.camera_from_model
    return {
        "cam_R_m2c": pose.R.double().flatten().tolist(),
        "cam_t_m2c": (1000 * pose.t_m.double()).tolist(),
        "obj_id": shown.number,
    }


def _info(shown: BopObject, depth_m: Float[Tensor, "h w"]) -> dict[str, Any]:
    everything, visible = int(shown.silhouette.sum()), int(shown.visible.sum())
    return {
        "bbox_obj": mask_box(shown.silhouette),
        "bbox_visib": mask_box(shown.visible),
        "px_count_all": everything,
        "px_count_valid": int((shown.silhouette & depth_m.isfinite()).sum()),
        "px_count_visib": visible,
        "visib_fract": visible / everything if everything else 0.0,
    }
