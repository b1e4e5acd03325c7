"""A small synthetic street whose disparity is known exactly: boxes, spheres and a ground plane.

Each pixel's ray is cut with every solid in closed form, so depth is exact to rounding, and colour
is a function of the surface point alone, so both views of the pair see the same surface. Frame:
x right, y down, z forward, metres, origin at the left camera.
"""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import torch
from filelock import FileLock  # torch brings it
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.camera import StereoRig
from depthpose.core.files import cache_folder, write_depth_png, write_image
from depthpose.depth.disparity import disparity_from_depth
from depthpose.depth.types import DepthInput, DepthSample, DepthTruth

GROUND_Y_M = 1.65
SUN = (0.45, -0.75, -0.48)

# Cars: x, z, colour. Houses: x, z, width, height, length, colour. Trees: x, z, radius. Poles: x, z.
_CARS = (
    (-1.9, 9.0, 0.62, 0.12, 0.10), (1.9, 16.0, 0.15, 0.22, 0.45), (-4.6, 21.0, 0.75, 0.74, 0.70),
    (4.5, 11.5, 0.20, 0.21, 0.22), (-1.9, 34.0, 0.55, 0.50, 0.20),
)  # fmt: skip
_HOUSES = ((-14, 16, 11, 7, 16, 0.60, 0.45, 0.36), (-14, 33, 11, 11, 15, 0.62, 0.58, 0.50),
           (-15, 52, 12, 8, 18, 0.50, 0.36, 0.30), (14, 20, 10, 9, 18, 0.66, 0.60, 0.48),
           (14, 42, 10, 6, 20, 0.55, 0.52, 0.50), (4, 85, 46, 12, 8, 0.52, 0.48, 0.45))  # fmt: skip
_TREES = (
    (-7.0, 13.5, 1.7),
    (7.2, 14.5, 1.9),
    (-7.2, 27.0, 2.1),
    (7.0, 30.0, 2.0),
    (7.4, 44.0, 2.4),
)
_POLES = ((6.2, 8.5), (-6.2, 19.0), (6.2, 24.0))


@dataclass(frozen=True, eq=False)
class Solids:
    """Axis-aligned boxes and spheres; a colour for each, boxes first."""

    low_m: Float[Tensor, "boxes 3"]
    high_m: Float[Tensor, "boxes 3"]
    centre_m: Float[Tensor, "spheres 3"]
    radius_m: Float[Tensor, " spheres"]
    color: Float[Tensor, "solids 3"]


@dataclass(frozen=True, eq=False)
class Hit:
    """Where a ray first meets a surface.

    Attributes:
        depth: distance along the ray in units of its direction; infinite for the sky.
        normal: outward, unit length.
        solid: row of ``Solids.color``, -1 for the ground, -2 for the sky.
    """

    depth: Float[Tensor, " n"]
    normal: Float[Tensor, "n 3"]
    solid: Int64[Tensor, " n"]


def make_street(scale: float = 1.0) -> DepthSample:
    """Draw the pair and its exact disparity; each size once for all processes of a test run.

    Args:
        scale: size of the images as a share of KITTI's 1242 x 375.

    Returns:
        A sample with camera, both images, and disparity and depth of the left one (NaN: sky).
    """
    street = _drawn(scale)
    given, truth = street.input, street.truth
    assert given.right is not None
    assert truth.disparity_px is not None
    assert truth.depth_m is not None
    left, right = given.left.clone(), given.right.clone()
    disparity_px, depth_m = truth.disparity_px.clone(), truth.depth_m.clone()
    return DepthSample(
        input=replace(given, left=left, right=right),
        truth=replace(truth, disparity_px=disparity_px, depth_m=depth_m),
    )


@cache
def _drawn(scale: float) -> DepthSample:
    rig = _kitti_like_rig(scale)
    drawn = cache_folder() / f"street-{scale}.pt"
    drawn.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(drawn.with_suffix(".lock")):  # nine seconds of one processor, at half size
        if not drawn.exists():
            solids = _street_solids()
            views = [_draw_view(rig, solids, x_m) for x_m in (0.0, rig.baseline_m)]
            depth = _cast(torch.zeros(3), _pixel_rays(rig, 0.0, 0.0), solids).depth
            depth_m = depth.reshape(rig.height, rig.width)
            depth_m = torch.where(torch.isfinite(depth_m), depth_m, torch.nan)
            torch.save([*views, depth_m], drawn)
        left, right, depth_m = torch.load(drawn)
    true_px = disparity_from_depth(depth_m, rig)
    return DepthSample(
        input=DepthInput(name="street", left=left, right=right, camera=rig),
        truth=DepthTruth(disparity_px=true_px.float(), depth_m=depth_m.float()),
    )


def _kitti_like_rig(scale: float) -> StereoRig:
    width, height = round(1242 * scale), round(375 * scale)
    f, cx, cy = 721.5 * scale, width / 2 - 0.5, 0.46 * height
    K = torch.tensor([[f, 0, cx], [0, f, cy], [0, 0, 1]], dtype=torch.float64)
    return StereoRig(width=width, height=height, K=K, baseline_m=0.54)


def _street_solids() -> Solids:
    boxes: list[tuple[float, ...]] = []
    for x, z, *rgb in _CARS:
        boxes.append((x, 0.25, z, 1.75, 0.65, 4.1, *rgb))
        boxes.append((x, 0.90, z + 0.2, 1.55, 0.55, 2.1, 0.10, 0.12, 0.15))
        boxes += [(x + side, 0.0, z + along, 0.25, 0.6, 0.6, 0.03, 0.03, 0.03)
                  for side in (-0.75, 0.75) for along in (-1.3, 1.3)]  # fmt: skip
    boxes += [(x, 0.0, z, w, h, length, *rgb) for x, z, w, h, length, *rgb in _HOUSES]
    boxes += [(x, 0.0, z, 0.3, 2.6, 0.3, 0.22, 0.16, 0.11) for x, z, _ in _TREES]
    boxes += [(x, 0.0, z, 0.14, 6.0, 0.14, 0.42, 0.43, 0.44) for x, z in _POLES]
    box = torch.tensor(boxes, dtype=torch.float64)
    centre_m = torch.stack([box[:, 0], GROUND_Y_M - box[:, 1] - box[:, 4] / 2, box[:, 2]], 1)
    half_m = box[:, 3:6] / 2
    crowns = torch.tensor([(x, GROUND_Y_M - 2.2 - r, z) for x, z, r in _TREES], dtype=torch.float64)
    radius_m = torch.tensor([r for *_, r in _TREES], dtype=torch.float64)
    leaf = torch.tensor([[0.17, 0.27, 0.09]], dtype=torch.float64).expand(len(crowns), 3)
    return Solids(
        centre_m - half_m, centre_m + half_m, crowns, radius_m, torch.cat([box[:, 6:], leaf])
    )


def _draw_view(rig: StereoRig, solids: Solids, x_m: float) -> Float[Tensor, "3 h w"]:
    """Average four rays a pixel (rotated grid), shade, and bring to display brightness."""
    origin_m = torch.tensor([x_m, 0.0, 0.0])
    offsets_px = ((-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375))
    views = [_shade(origin_m, _pixel_rays(rig, *offset), solids, rig) for offset in offsets_px]
    linear = torch.stack(views).mean(0).reshape(rig.height, rig.width, 3).permute(2, 0, 1)
    return (1.15 * linear).clamp(0, 1).pow(1 / 2.2).float()


def _pixel_rays(rig: StereoRig, du_px: float, dv_px: float) -> Float[Tensor, "n 3"]:
    v, u = torch.meshgrid(
        torch.arange(rig.height, dtype=torch.float64) + dv_px,
        torch.arange(rig.width, dtype=torch.float64) + du_px,
        indexing="ij",
    )
    pixel = torch.stack([u, v, torch.ones_like(u)], -1).reshape(-1, 3)
    return pixel @ torch.linalg.inv(rig.K.double()).T


def _cast(origin_m: Float[Tensor, " 3"], ray: Float[Tensor, "n 3"], solids: Solids) -> Hit:
    """Find the first surface on each ray: slabs for boxes, the quadratic for spheres."""
    origin_m = origin_m.to(ray)
    ground = torch.where(ray[:, 1] > 0, (GROUND_Y_M - origin_m[1]) / ray[:, 1], torch.inf)
    depth = torch.cat([_cut_boxes(origin_m, ray, solids), _cut_spheres(origin_m, ray, solids)], 1)
    nearest, solid = depth.min(1)
    is_ground = ground < nearest
    nearest = torch.where(is_ground, ground, nearest)
    solid = torch.where(is_ground, -1, solid)
    solid = torch.where(torch.isinf(nearest), -2, solid)
    point_m = origin_m + ray * nearest.nan_to_num(posinf=0.0)[:, None]
    return Hit(nearest, _normal(point_m, solid, solids), solid)


def _cut_boxes(
    origin_m: Float[Tensor, " 3"], ray: Float[Tensor, "n 3"], solids: Solids
) -> Float[Tensor, "n boxes"]:
    columns = []
    for low_m, high_m in zip(solids.low_m, solids.high_m, strict=True):
        first, second = (low_m - origin_m) / ray, (high_m - origin_m) / ray
        enter = torch.minimum(first, second).amax(1)
        leave = torch.maximum(first, second).amin(1)
        columns.append(torch.where((enter <= leave) & (enter > 1e-6), enter, torch.inf))
    return torch.stack(columns, 1)


def _cut_spheres(
    origin_m: Float[Tensor, " 3"], ray: Float[Tensor, "n 3"], solids: Solids
) -> Float[Tensor, "n spheres"]:
    away_m = origin_m - solids.centre_m
    a = (ray * ray).sum(1, keepdim=True)
    half_b = ray @ away_m.T
    c = (away_m * away_m).sum(1) - solids.radius_m**2
    root = (half_b**2 - a * c).clamp(min=0).sqrt()
    depth = (-half_b - root) / a
    return torch.where((root > 0) & (depth > 1e-6), depth, torch.inf)


def _normal(
    point_m: Float[Tensor, "n 3"], solid: Int64[Tensor, " n"], solids: Solids
) -> Float[Tensor, "n 3"]:
    boxes = len(solids.low_m)
    box = solid.clamp(0, boxes - 1)
    middle_m, half_m = (solids.low_m + solids.high_m) / 2, (solids.high_m - solids.low_m) / 2
    share = (point_m - middle_m[box]) / half_m[box]
    is_face = F.one_hot(share.abs().argmax(1), 3).bool()
    of_box = torch.where(is_face, share.sign(), 0.0)
    of_sphere = F.normalize(point_m - solids.centre_m[(solid - boxes).clamp(min=0)], dim=1)
    up = torch.tensor([0.0, -1.0, 0.0], dtype=point_m.dtype)
    normal = torch.where((solid >= boxes)[:, None], of_sphere, of_box)
    return torch.where((solid < 0)[:, None], up, normal)


def _shade(
    origin_m: Float[Tensor, " 3"], ray: Float[Tensor, "n 3"], solids: Solids, rig: StereoRig
) -> Float[Tensor, "n 3"]:
    """Lambert's law with one sun, its hard shadow, and a blue sky light."""
    hit = _cast(origin_m, ray, solids)
    distance_m = hit.depth.nan_to_num(posinf=0.0)
    point_m = origin_m + ray * distance_m[:, None]
    sun = F.normalize(torch.tensor(SUN, dtype=ray.dtype), dim=0)
    footprint_m = distance_m / float(rig.K[0, 0])
    color = _surface_color(point_m, hit, solids, footprint_m)
    lit = (hit.normal @ sun).clamp(min=0)
    faces_sun = (lit > 0) & (hit.solid != -2)
    lit[faces_sun] *= _sees_sun((point_m + 1e-3 * hit.normal)[faces_sun], sun, solids)
    light = 0.95 * lit[:, None] + torch.tensor([0.32, 0.36, 0.42], dtype=ray.dtype)
    height = (-F.normalize(ray, dim=1)[:, 1:2]).clamp(0, 0.4)
    horizon, zenith = torch.tensor([[0.75, 0.82, 0.9], [0.3, 0.5, 0.8]], dtype=ray.dtype)
    sky = torch.lerp(horizon, zenith, height / 0.4)
    return torch.where((hit.solid == -2)[:, None], sky, color * light)


def _sees_sun(
    point_m: Float[Tensor, "n 3"], sun: Float[Tensor, " 3"], solids: Solids
) -> Float[Tensor, " n"]:
    sees = torch.ones(len(point_m), dtype=point_m.dtype)
    for low_m, high_m in zip(solids.low_m, solids.high_m, strict=True):
        first, second = (low_m - point_m) / sun, (high_m - point_m) / sun
        enter = torch.minimum(first, second).amax(1)
        leave = torch.maximum(first, second).amin(1)
        sees[(enter <= leave) & (leave > 0)] = 0.0
    for centre_m, radius_m in zip(solids.centre_m, solids.radius_m, strict=True):
        along = (centre_m - point_m) @ sun
        beside_m = torch.linalg.norm(centre_m - point_m - along[:, None] * sun, dim=1)
        sees[(along > 0) & (beside_m < radius_m)] = 0.0
    return sees


def _surface_color(
    point_m: Float[Tensor, "n 3"], hit: Hit, solids: Solids, footprint_m: Float[Tensor, " n"]
) -> Float[Tensor, "n 3"]:
    base = solids.color[hit.solid.clamp(min=0)]
    base = torch.where((hit.solid == -1)[:, None], _ground_color(point_m), base)
    base = base * torch.where(_is_window(point_m, hit, solids), 0.25, 1.0)[:, None]
    return base * (0.55 + 0.9 * _noise(point_m, footprint_m))[:, None]


def _ground_color(point_m: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    x_m, z_m = point_m[:, 0], point_m[:, 2]
    color = torch.tensor([0.20, 0.29, 0.11], dtype=point_m.dtype).repeat(len(point_m), 1)
    color[x_m.abs() < 8] = torch.tensor([0.42, 0.40, 0.38], dtype=point_m.dtype)
    color[x_m.abs() < 5.7] = torch.tensor([0.20, 0.20, 0.21], dtype=point_m.dtype)
    is_dash = (x_m.abs() < 0.08) & (z_m.remainder(9.0) < 4.0)
    color[is_dash | ((x_m.abs() - 5.3).abs() < 0.07)] = 0.8
    return color


def _is_window(
    point_m: Float[Tensor, "n 3"], hit: Hit, solids: Solids
) -> torch.BoolTensor | Tensor:
    tall = torch.zeros(len(solids.color), dtype=torch.bool)
    tall[: len(solids.low_m)] = ((solids.high_m - solids.low_m)[:, [0, 1]] > 4).all(1)
    is_wall = tall[hit.solid.clamp(min=0)] & (hit.solid >= 0) & (hit.normal[:, 1] == 0)
    along_m = torch.where(hit.normal[:, 0].abs() > 0.5, point_m[:, 2], point_m[:, 0])
    above_m = GROUND_Y_M - point_m[:, 1]
    return is_wall & (along_m.remainder(2.6) < 1.2) & ((above_m - 0.9).remainder(2.9) < 1.5)


def _noise(point_m: Float[Tensor, "n 3"], footprint_m: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Value noise of six octaves in 0..1; octaves finer than a pixel fade out."""
    total = torch.zeros_like(footprint_m)
    for octave in range(6):
        cell_m = 1.6 / 2.3**octave
        weight = 0.75**octave * (1 - 2 * footprint_m / cell_m).clamp(0, 1)
        is_seen = weight > 0
        noise = _lattice_noise(point_m[is_seen] / cell_m + 17.0 * octave)
        total[is_seen] += weight[is_seen] * (noise - 0.5)
    return (0.5 + 0.55 * total).clamp(0, 1)


def _lattice_noise(position: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    cell = position.floor()
    share = position - cell
    share = share * share * (3 - 2 * share)
    total = torch.zeros_like(position[:, 0])
    for corner in torch.cartesian_prod(*[torch.arange(2)] * 3):
        weight = torch.where(corner.bool(), share, 1 - share).prod(1)
        total += weight * _hash((cell + corner).long())
    return total


def _hash(cell: Int64[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Mix three integers to a number in 0..1: multiply by odd constants, xor the high bits down."""
    mixed = cell[:, 0] * 0x27D4EB2F + cell[:, 1] * 0x165667B1 + cell[:, 2] * 0x1B873593
    for factor in (0x2545F491, 0x6C8E9CF5):
        mixed = ((mixed ^ (mixed >> 15)) * factor) & 0x7FFFFFFF
    return (mixed ^ (mixed >> 13)).double() / 0x7FFFFFFF


def write_pairs(home: Path, scales: tuple[float, ...]) -> Path:
    """Write a plain folder of pairs with disparity, one for each scale; give the folder."""
    lines = []
    for number, scale in enumerate(scales):
        street = make_street(scale)
        rig, truth = street.input.camera, street.truth.disparity_px
        assert isinstance(rig, StereoRig)
        assert street.input.right is not None
        assert truth is not None
        name = f"{number:02d}"
        write_image(home / "left" / f"{name}.png", street.input.left)
        write_image(home / "right" / f"{name}.png", street.input.right)
        write_depth_png(home / "disp_occ" / f"{name}.png", truth)
        numbers = [rig.K[0, 0], rig.K[0, 2], rig.K[1, 2], rig.baseline_m]
        values = " ".join(str(float(n)) for n in numbers)
        lines.append(f"{name} {rig.width} {rig.height} {values}")
    (home / "calib.txt").write_text("\n".join(lines) + "\n")
    return home
