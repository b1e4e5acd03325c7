"""An object whose sides all differ, its views, and a network that answers what a test says."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from depthpose.core.camera import Camera, back_project
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid
from depthpose.pose.config import CloudConfig, MeshConfig, RefusalConfig
from depthpose.pose.geometry.surface import Surface, prepare_surface
from depthpose.pose.mesh import make_model
from depthpose.pose.network_pose import CloudJob, GeoPoseNet
from depthpose.pose.networks.resunet import ResUNet, ResUNetConfig
from depthpose.pose.synthetic.parts import make_circle, make_part_mesh, make_ring
from depthpose.pose.types import Axis, ObjectModel, PoseEstimate, Symmetries
from depthpose.pose.weights import PoseWeights

FACTS = {"trained_on": "nothing", "licence": "MIT"}


def box_faces() -> tuple[Tensor, Tensor]:
    """Corners of a unit cube about the origin, faces outward."""
    corners = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    return corners, torch.tensor(faces)


Block = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Size and middle of a box [m]."""


def boxes(name: str, *blocks: Block) -> ObjectModel:
    """A model of boxes."""
    corners, faces = box_faces()
    vertices = torch.cat([corners * torch.tensor(size) + torch.tensor(at) for size, at in blocks])
    every = torch.cat([faces + 8 * k for k in range(len(blocks))])
    return make_model(vertices, every, name=name, number=1)


def bracket(name: str = "bracket", keypoints: int = 8) -> ObjectModel:
    """Three boxes of different lengths that meet in a corner, 20 cm long, of no two equal sides."""
    corners, faces = box_faces()
    parts = [((0.2, 0.06, 0.05), (0.0, 0.0, 0.0)), ((0.05, 0.12, 0.04), (-0.075, 0.07, 0.0)),
             ((0.04, 0.05, 0.09), (0.06, 0.0, 0.06))]  # fmt: skip
    vertices = torch.cat([corners * torch.tensor(s) + torch.tensor(at) for s, at in parts])
    every = torch.cat([faces + 8 * k for k in range(len(parts))])
    return make_model(vertices, every, name=name, number=7, config=MeshConfig(keypoints=keypoints))


@cache
def bracket_surface() -> Surface:
    """The prepared surface of :func:`bracket`, made once, which no test changes."""
    return prepare_surface(bracket())


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


def bar(bump_m: float = 0.004) -> ObjectModel:
    """A bar of 20 x 7 x 3 cm, one end of which is a little narrower."""
    corners, faces = box_faces()
    vertices = corners * torch.tensor([0.2, 0.07, 0.03])
    is_end = (vertices[:, 0] > 0)[:, None]
    vertices = torch.where(is_end, vertices - bump_m * vertices.sign() * torch.tensor([0, 1, 0]),
                           vertices)  # fmt: skip
    return make_model(vertices, faces, name="bar", number=1)


def gear(teeth: int = 12, keyway_mm: float = 0.0) -> ObjectModel:
    """A gear of 60 mm with a bore, of 8, 12 or 24 teeth; a keyway makes no two teeth alike."""
    number = torch.arange(96)
    angle = number * (2 * torch.pi / 96)
    is_tooth = number % (96 // teeth) < 48 // teeth
    radius_mm = torch.where(is_tooth, 30.0, 25.0)
    outline = torch.stack([radius_mm * angle.cos(), radius_mm * angle.sin()], 1)
    bore = torch.from_numpy(make_circle(8.0)).clone()
    bore[torch.minimum(number, 96 - number) <= 5] *= 1 + keyway_mm / 8
    vertices_mm, faces = make_ring(outline.double().numpy(), bore.numpy(), 12.0)
    return make_model(
        torch.from_numpy(vertices_mm) * 0.001, torch.from_numpy(faces), name="gear", number=3
    )


def tiny_weights(*models: ObjectModel, **changes: Any) -> PoseWeights:  # noqa: ANN401
    """A network of a few numbers that has learnt nothing, with its objects."""
    torch.manual_seed(0)
    config = ResUNetConfig(
        classes=len(models),
        keypoints=len(models[0].keypoints_m),
        first_kernel=3,
        encoder=(4, 6, 8, 10),
        decoder=(5, 6, 7, 8),
    )
    parts = {"cloud": CloudConfig(), "refusal": RefusalConfig(), "facts": FACTS, **changes}
    return PoseWeights(network=ResUNet(config).eval(), models=models, **parts)


K = torch.tensor([[500.0, 0, 160], [0, 500, 120], [0, 0, 1]], dtype=torch.float64)
"""Of the views here: 320 x 240 pixels."""
CAMERA = Camera(width=320, height=240, K=K, depth_unit_m=0.001)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_pose(seed: int, batch: tuple[int, ...] = ()) -> Rigid:
    """Poses before the camera in double precision, turned by chance."""
    q, _ = torch.linalg.qr(torch.randn(*batch, 3, 3, generator=generator(seed)).double())
    shift = torch.tensor([0.1, -0.1, 0.9]).double().expand(*batch, 3)
    return Rigid(q * torch.linalg.det(q)[..., None, None], shift)


def pose_at(x_m: float = 0.0, z_m: float = 0.8, seed: int = 0) -> Rigid:
    """A pose before the camera, turned by chance."""
    q, r = torch.linalg.qr(torch.randn(3, 3, generator=generator(seed)))
    R = q * r.diagonal().sign()
    R = R * torch.linalg.det(R).sign()
    return Rigid(R, torch.tensor([x_m, 0.0, z_m]))


def view_of(model: ObjectModel, *poses: Rigid) -> tuple[Tensor, Tensor]:
    """Depth image [m, NaN where nothing is] and mask of some instances of one object."""
    triangles = torch.cat([pose.apply(model.vertices_m)[model.faces] for pose in poses])
    depth_m = rasterize(triangles, K, 320, 240).depth_m
    return depth_m, depth_m.isfinite()


def cloud_of(model: ObjectModel, pose: Rigid) -> Tensor:
    """What a camera sees of one object, without noise."""
    depth_m, mask = view_of(model, pose)
    return back_project(depth_m, K)[mask]


def noisy(cloud_m: Tensor) -> Tensor:
    """The cloud with noise of 1 mm."""
    return cloud_m.float() + 0.001 * torch.randn(cloud_m.shape, generator=generator(0))


class Oracle(GeoPoseNet):
    """The estimator with true directions in place of the network's: off by noise, some wrong.

    The truth of a cloud is the pose whose origin is nearest to it.
    """

    def __init__(self, weights: PoseWeights, truths: list[Rigid], **changes: Any) -> None:  # noqa: ANN401
        super().__init__(weights, changes.get("config"))
        self.truths = truths
        self.noise = changes.get("noise", 0.0)
        self.wrong = changes.get("wrong", 0.0)
        self.calls: list[int] = []

    def _run_network(self, group: Sequence[CloudJob | PoseEstimate]) -> None:
        ready = [one for one in group if isinstance(one, CloudJob)]
        self.calls += [len(ready)] if ready else []
        for one in ready:
            one.directions = self._true(one.voxels.points_m, one.target.number)
            one.watch.seconds["network"] = 0.01

    def _true(self, points_m: Tensor, number: int) -> Tensor:
        middle = points_m.mean(0)
        pose = min(self.truths, key=lambda truth: float((truth.t_m - middle).norm()))
        pose = Rigid(pose.R.float(), pose.t_m.float())
        keypoints_m = pose.apply(self.weights.models[number].keypoints_m)
        directions = keypoints_m[None] - points_m[:, None]
        directions = directions / directions.norm(dim=-1, keepdim=True)
        chance = generator(1)
        noise = torch.randn(directions.shape, generator=chance)
        is_wrong = torch.rand(len(points_m), generator=chance) < self.wrong
        return torch.where(is_wrong[:, None, None], noise, directions + self.noise * noise)


def write_stl(path: Path, model: ObjectModel) -> Path:
    """Write a model as a CAD file in millimetres."""
    import trimesh

    trimesh.Trimesh(1000 * model.vertices_m.numpy(), model.faces.numpy()).export(path)
    return path


def write_part(name: str, folder: Path) -> Path:
    """Write a part as an STL file in millimetres, as a CAD program would; give the file."""
    import trimesh

    data = trimesh.Trimesh(*make_part_mesh(name), process=False).export(file_type="stl")
    assert isinstance(data, bytes)
    path = folder / f"{name}.stl"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path
