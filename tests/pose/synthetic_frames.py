"""A small dataset of synthetic frames in BOP's layout, and estimates of any quality."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import torch
from tests.pose.synthetic_objects import bottle, bracket

from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid, perturb
from depthpose.pose.datasets import (
    BopDataset,
    BopFrame,
    BopObject,
    Instance,
    open_bop,
    write_bop_models,
    write_bop_scene,
)
from depthpose.pose.predictions import Prediction, place_of
from depthpose.pose.types import ObjectModel, PoseEstimate

WIDTH, HEIGHT = 160, 120
K = torch.tensor([[200.0, 0, 79.5], [0, 200, 59.5], [0, 0, 1]], dtype=torch.float64)


def frame_models() -> list[ObjectModel]:
    """One that looks alike from no two sides, one that turns about an axis."""
    return [replace(bracket(), number=7), replace(bottle(), number=10)]


def pose_in_frame(x_m: float, seed: int) -> Rigid:
    generator = torch.Generator().manual_seed(seed)
    motion = 0.6 * torch.randn(6, generator=generator).double()
    motion[3:] = 0
    turned = perturb(Rigid(torch.eye(3).double(), torch.zeros(3).double()), motion)
    return Rigid(turned.R, torch.tensor([x_m, 0.01, 0.7]).double())


def draw_frame(number: int, models: Iterable[ObjectModel]) -> BopFrame:
    """Objects side by side before a wall, drawn exactly."""
    depth = torch.full((HEIGHT, WIDTH), 1.2)
    masks, poses = [], []
    for k, model in enumerate(models):
        pose = pose_in_frame(0.24 * k - 0.12, 10 * number + k)
        corners = pose.apply(model.vertices_m.double())[model.faces]
        seen = rasterize(corners, K, WIDTH, HEIGHT).depth_m.float()
        masks.append(seen.nan_to_num(9.0) < depth)
        depth = torch.where(masks[-1], seen, depth)
        poses.append((model.number, pose))
    objects = [
        BopObject(number=n, camera_from_model=pose, visible=mask, silhouette=mask)
        for (n, pose), mask in zip(poses, masks, strict=True)
    ]
    rgb = torch.full((3, HEIGHT, WIDTH), 0.5)
    return BopFrame(number=number, K=K, depth_m=depth, objects=objects, rgb=rgb)


def make_dataset(folder: Path, frames: int = 3) -> BopDataset:
    write_bop_models(folder, frame_models())
    write_bop_scene(folder, "test", 1, [draw_frame(i, frame_models()) for i in range(frames)])
    return open_bop(folder)


def moved(instance: Instance, motion: list[float]) -> Rigid:
    return perturb(instance.camera_from_model, torch.tensor(motion).double())


def predictions_of(
    dataset: BopDataset, answer: Callable[[Instance], Rigid | None]
) -> list[Prediction]:
    """An estimate of each instance; a refusal where the answer is None."""
    found = []
    for instance in dataset.instances:
        pose = answer(instance)
        estimate = PoseEstimate(
            name=instance.name,
            object=dataset.objects[instance.object_id].name,
            status="votes do not meet" if pose is None else "ok",
            reason="the directions are parallel" if pose is None else "",
            camera_from_model=pose,
            inlier_share=0.5,
            seconds={"network": 0.02, "proposal": 0.005},
        )
        found.append(Prediction(estimate=estimate, place=place_of(instance)))
    return found
