"""A small Linemod_preprocessed of synthetic frames."""

import json
from collections.abc import Sequence
from pathlib import Path

import yaml
from tests.pose.synthetic_frames import draw_frame, frame_models

from depthpose.core.files import write_depth_png, write_image
from depthpose.pose.config import MeshConfig
from depthpose.pose.datasets import BopDataset, open_bop
from depthpose.pose.datasets.dataset import read_instance_mask, write_bop_models, write_mask
from depthpose.pose.mesh import make_model
from depthpose.pose.types import ObjectModel
from depthpose.thesis.pose_tables import LINEMOD_DIAMETERS_M


def linemod_models() -> list[ObjectModel]:
    """The two of frames, as large as LineMOD's objects of their numbers."""
    return [
        make_model(
            model.vertices_m * (LINEMOD_DIAMETERS_M[model.number] / model.diameter_m),
            model.faces,
            name=model.name,
            number=model.number,
            symmetries=model.symmetries,
            config=MeshConfig(keypoints=len(model.keypoints_m)),
        )
        for model in frame_models()
    ]


def make_linemod(
    folder: Path, models: Sequence[ObjectModel] | None = None, frames: int = 3
) -> BopDataset:
    """A folder an object, lists, and predicted masks; each frame shows the object and another.

    As published: models have no name and no symmetry.
    """
    models = linemod_models() if models is None else models
    home = write_bop_models(folder, models)
    info = json.loads((home / "models_info.json").read_text())
    (home / "models_info.json").unlink()
    kept = {int(n): {k: v for k, v in e.items() if k[:3] in ("dia", "min", "siz")}
            for n, e in info.items()}  # fmt: skip
    (home / "models_info.yml").write_text(yaml.safe_dump(kept))
    for k, model in enumerate(models):
        (home / f"obj_{model.number:06d}.ply").rename(home / f"obj_{model.number:02d}.ply")
        _make_scene(folder, [model, models[k - 1]], frames)
    data = open_bop(folder)
    for instance in data.instances:
        predicted = folder / "segnet_results" / f"{instance.object_id:02d}_label"
        file = predicted / f"{instance.image_id:04d}_label.png"
        write_mask(file, read_instance_mask(instance))
    return data


def _make_scene(folder: Path, shown: Sequence[ObjectModel], frames: int) -> None:
    number = shown[0].number
    scene = folder / f"data/{number:02d}"
    truths, cameras = {}, {}
    for i in range(frames):
        frame = draw_frame(i, shown)
        write_depth_png(scene / f"depth/{i:04d}.png", frame.depth_m, 0.001)
        assert frame.rgb is not None
        write_image(scene / f"rgb/{i:04d}.png", frame.rgb)
        own = frame.objects[0]
        write_mask(scene / f"mask/{i:04d}.png", own.visible)
        pose = own.camera_from_model
        truths[i] = [{"cam_R_m2c": pose.R.flatten().tolist(), "obj_id": number,
                      "cam_t_m2c": (1000 * pose.t_m).tolist()}]  # fmt: skip
        cameras[i] = {"cam_K": frame.K.flatten().tolist(), "depth_scale": 1.0}
    (scene / "gt.yml").write_text(yaml.safe_dump(truths))
    (scene / "info.yml").write_text(yaml.safe_dump(cameras))
    (scene / "test.txt").write_text("0000\n0002\n")
    (scene / "train.txt").write_text("0001\n")
