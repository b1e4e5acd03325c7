"""A box and a can with pictures on them, written by trimesh and drawn by depthpose's renderer."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh as _trimesh
from PIL import Image
from torch import Tensor

from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid, rotation_by
from depthpose.pose.types import ColorImage, ViewInput

trimesh: Any = _trimesh  # its classes carry no types
Mesh = Any

K = torch.tensor([[600.0, 0, 160], [0, 600, 120], [0, 0, 1]], dtype=torch.float64)
WIDTH, HEIGHT = 320, 240
BOX_M = (0.16, 0.06, 0.21)
CAN_M = (0.034, 0.1)  # radius, height


def print_of(seed: int, width: int, height: int) -> Image.Image:
    """A package's print: patches of colour of several sizes, never repeating."""
    random = np.random.default_rng(seed)
    layers = [
        np.asarray(
            Image.fromarray(random.integers(0, 256, (n, n, 3), dtype=np.uint8)).resize(
                (width, height), Image.Resampling.BICUBIC
            ),
            np.float64,
        )
        for n in (3, 7, 15)
    ]
    mean = np.average(layers, axis=0, weights=(3, 2, 1)) - 128
    return Image.fromarray((128 + 1.6 * mean).clip(0, 255).astype(np.uint8))


def textured_box(seed: int = 0) -> Mesh:
    """Eight corners, twelve faces, and a picture whose six fields are its sides; metres."""
    sides, corners, uv, faces = [], [], [], []
    for axis in range(3):
        for sign in (-1, 1):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            quad = np.zeros((4, 3))
            quad[:, axis] = sign * BOX_M[axis] / 2
            quad[:, a] = np.array([-1, 1, 1, -1]) * BOX_M[a] / 2
            quad[:, b] = np.array([-1, -1, 1, 1]) * BOX_M[b] / 2
            k = len(sides)
            sides.append(print_of(10 * seed + k, 128, 128))
            corners.append(quad)
            field = np.array([[0.02, 0.02], [0.98, 0.02], [0.98, 0.98], [0.02, 0.98]])
            uv.append((field + np.array([k, 0])) / np.array([6, 1]))
            order = [[0, 1, 2], [0, 2, 3]] if sign > 0 else [[0, 2, 1], [0, 3, 2]]
            faces.append(np.array(order) + 4 * k)
    picture = Image.new("RGB", (6 * 128, 128))
    for k, side in enumerate(sides):
        picture.paste(side, (128 * k, 0))
    return _textured(np.concatenate(corners), np.concatenate(faces), np.concatenate(uv), picture)


def textured_can(seed: int = 0, steps: int = 64) -> Mesh:
    """A cylinder about z with a label all around, and plain ends of one grey; metres."""
    radius, height = CAN_M
    angle = np.linspace(0, 2 * np.pi, steps + 1)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
    low = np.c_[ring, np.full(steps + 1, -height / 2)]
    high = np.c_[ring, np.full(steps + 1, height / 2)]
    share = angle / (2 * np.pi)
    uv = np.r_[np.c_[share, np.full(steps + 1, 0.01)], np.c_[share, np.full(steps + 1, 0.94)]]
    i = np.arange(steps)
    wall = np.r_[np.c_[i, i + 1, i + steps + 2], np.c_[i, i + steps + 2, i + steps + 1]]
    first = 2 * (steps + 1)
    ends = np.r_[low, high, [[0, 0, -height / 2], [0, 0, height / 2]]]
    down = np.c_[i + 1, i, np.full(steps, 2 * (steps + 1))] + first
    up = np.c_[i, i + 1, np.full(steps, 2 * (steps + 1) + 1)] + first
    up[:, :2] += steps + 1
    plain = np.full((len(ends), 2), (0.5, 0.98))
    label = print_of(100 + seed, 512, 256)
    label.paste((180, 180, 185), (0, 0, 512, 12))
    return _textured(
        np.r_[low, high, ends], np.r_[wall, down, up], np.r_[uv, plain], label
    )  # fmt: skip


def _textured(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, picture: Image.Image
) -> Mesh:
    material = trimesh.visual.material.SimpleMaterial(image=picture, diffuse=(255, 255, 255, 255))
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(vertices, faces, visual=visual, process=False)


def saved_glb(mesh: Mesh, path: Path) -> Path:
    path.write_bytes(mesh.export(file_type="glb"))
    return path


@dataclass(frozen=True)
class Light:
    """How a camera shows colours: each is changed by a real one, and says nothing of a pose."""

    toward: tuple[float, float, float] = (0.3, -0.5, -0.8)
    ambient: float = 0.5
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)
    noise: float = 0.02
    seed: int = 0


def drawn_view(
    mesh: Mesh,
    pose: Rigid,
    light: Light | None = None,
    *,
    color_from_depth: Rigid | None = None,
    color_K: Tensor = K,
    size: tuple[int, int] = (WIDTH, HEIGHT),
) -> ViewInput:
    """Draw depth and colour of a mesh before a grey wall, by a camera or two beside each other."""
    light = light or Light()
    corners = torch.from_numpy(np.asarray(mesh.vertices)[mesh.faces]).double()
    placed = pose.double().apply(corners.flatten(0, 1)).reshape(-1, 3, 3)
    seen = rasterize(placed, K, WIDTH, HEIGHT)
    random = torch.Generator().manual_seed(light.seed)
    depth_m = seen.depth_m + 0.001 * torch.randn(seen.depth_m.shape, generator=random)
    mask = seen.primitive >= 0
    depth_m = torch.where(mask, depth_m, 1.6).float()
    beside = color_from_depth or Rigid(torch.eye(3).double(), torch.zeros(3).double())
    turned = beside.double().apply(placed.flatten(0, 1)).reshape(-1, 3, 3)
    shown = rasterize(turned, color_K, *size)
    assert shown.barycentric is not None
    uv = torch.from_numpy(np.asarray(mesh.visual.uv)[mesh.faces])
    at = (uv[shown.primitive.clamp(min=0)] * shown.barycentric[..., None].double()).sum(-2)
    colors = trimesh.visual.color.uv_to_interpolated_color(
        at.reshape(-1, 2).numpy(), mesh.visual.material.image
    )[:, :3]
    linear = torch.from_numpy(colors / 255.0).reshape(*shown.primitive.shape, 3) ** 2.2
    sides = turned[:, 1:] - turned[:, :1]
    normals = torch.nn.functional.normalize(torch.linalg.cross(sides[:, 0], sides[:, 1]), dim=-1)
    toward = torch.nn.functional.normalize(torch.tensor(light.toward).double(), dim=0)
    lit = light.ambient + (1 - light.ambient) * (normals @ toward).clamp(min=0)
    linear = linear * lit[shown.primitive.clamp(min=0)][..., None]
    linear = torch.where((shown.primitive >= 0)[..., None], linear, 0.15)
    rgb = (linear * torch.tensor(light.gains).double()).clamp(0, 1) ** (1 / 2.2)
    rgb += light.noise * torch.randn(rgb.shape, generator=random)
    rgb = (rgb.clamp(0, 1) * 255).round() / 255
    return ViewInput(
        name="view",
        depth_m=depth_m,
        mask=mask,
        K=K.float(),
        object="thing",
        color=ColorImage(
            rgb=rgb.permute(2, 0, 1).float(), K=color_K.float(), color_from_depth=color_from_depth
        ),
    )


def random_pose(seed: int, distance_m: float = 0.7) -> Rigid:
    random = torch.Generator().manual_seed(seed)
    turn = torch.randn(3, generator=random, dtype=torch.float64)
    q = torch.randn(4, generator=random, dtype=torch.float64)
    angle = 2 * torch.acos((q[0] / q.norm()).clamp(-1, 1))
    R = rotation_by(angle * turn / turn.norm())
    return Rigid(R, torch.tensor([0.0, 0.0, distance_m], dtype=torch.float64))
