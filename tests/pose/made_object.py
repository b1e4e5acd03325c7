"""An object whose sides all differ, its views, and a network that answers what a test says."""

import torch
from torch import Tensor

from depthpose.pose.config import CloudConfig, MeshConfig, RefusalConfig
from depthpose.pose.mesh import make_model
from depthpose.pose.network import ResUNet, ResUNetConfig
from depthpose.pose.types import Axis, ObjectModel, Symmetries
from depthpose.pose.weights import PoseWeights

FACTS = {"trained_on": "nothing", "licence": "MIT"}


def box_faces() -> tuple[Tensor, Tensor]:
    """Corners of a unit cube about the origin, faces outward."""
    corners = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    return corners, torch.tensor(faces)


def bracket(name: str = "bracket", keypoints: int = 8) -> ObjectModel:
    """Three boxes of different lengths that meet in a corner, 20 cm long: no two sides are alike."""
    corners, faces = box_faces()
    parts = [((0.2, 0.06, 0.05), (0.0, 0.0, 0.0)), ((0.05, 0.12, 0.04), (-0.075, 0.07, 0.0)),
             ((0.04, 0.05, 0.09), (0.06, 0.0, 0.06))]  # fmt: skip
    vertices = torch.cat([corners * torch.tensor(s) + torch.tensor(at) for s, at in parts])
    every = torch.cat([faces + 8 * k for k in range(len(parts))])
    return make_model(vertices, every, name=name, number=7, config=MeshConfig(keypoints=keypoints))


def bottle(name: str = "bottle") -> ObjectModel:
    """A cylinder, 18 cm high, that declares its axis."""
    angle = torch.arange(48) * (2 * torch.pi / 48)
    ring = torch.stack([0.04 * angle.cos(), 0.04 * angle.sin(), torch.zeros(48)], -1)
    up = torch.tensor([0.0, 0.0, 0.09])
    vertices = torch.cat([ring - up, ring + up, -up[None], up[None]])
    i = torch.arange(48)
    j = (i + 1) % 48
    bottom, top = torch.full_like(i, 96), torch.full_like(i, 97)
    faces = [(i, j, j + 48), (i, j + 48, i + 48), (j, i, bottom), (i + 48, j + 48, top)]
    axis = Axis(direction=torch.tensor([0.0, 0.0, 1.0]), point_m=torch.zeros(3))
    return make_model(
        vertices,
        torch.cat([torch.stack(f, -1) for f in faces]),
        name=name,
        symmetries=Symmetries(continuous=(axis,)),
    )


def tiny_weights(*models: ObjectModel, **changes: object) -> PoseWeights:
    """A network of a few numbers that has learnt nothing, with its objects."""
    torch.manual_seed(0)
    widths = {"encoder": (4, 6, 8, 10), "decoder": (5, 6, 7, 8)}
    sizes = {"classes": len(models), "keypoints": len(models[0].keypoints_m), "first_kernel": 3}
    network = ResUNet(ResUNetConfig(**widths, **sizes)).eval()
    parts = {"cloud": CloudConfig(), "refusal": RefusalConfig(), "facts": FACTS, **changes}
    return PoseWeights(network=network, models=models, **parts)  # pyright: ignore[reportArgumentType]
