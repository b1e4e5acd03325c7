"""Synthetic street scenes as a dataset: both views, disparity, occlusion and a LiDAR scan.

In order: visibility and light at each pixel; the sensors, from light to a picture; a LiDAR of 64
beams as KITTI's; frames; and the dataset.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.camera import StereoRig, resize_camera
from depthpose.core.errors import InputError
from depthpose.core.render import Raster, barycentric_shares, edge_functions, rasterize
from depthpose.depth.augment import through_jpeg
from depthpose.depth.config import StreetsConfig
from depthpose.depth.disparity import disparity_from_depth
from depthpose.depth.synthetic.mesh import NUMBER, Indices, Numbers, Vectors
from depthpose.depth.synthetic.scene import (
    StreetScene,
    kitti_rig,
    make_clutter,
    make_scene,
    rig_number,
)
from depthpose.depth.synthetic.shading import Hits, Stage, prepare, shade, sky_light
from depthpose.depth.types import Map, Mask, RawFrame, StereoInput, StereoSample, StereoTruth, View

NEAR_M = 0.3
"""Depth of the near plane: nearer surfaces are not drawn."""


class Nearest(NamedTuple):
    """The nearest triangle on each of some rays."""

    primitive: Indices  # number of the triangle, -1 where there is none
    shares: Vectors  # barycentric coordinates
    depth_m: Numbers  # camera z

    def select(self, index: Indices) -> "Nearest":
        """Give those of the rays with some numbers."""
        return Nearest(*(values.index_select(0, index) for values in self))


@dataclass(frozen=True, kw_only=True, eq=False)
class Visibility:
    """Which triangles are visible from one camera."""

    raster: Raster  # visibility at the pixel centres
    K: Float64[Tensor, "3 3"]
    eye: Float[Tensor, "3"]  # its position in the left camera's frame [m]; it looks along z
    edges: Float64[Tensor, "n 3 3"]  # edge functions of all triangles; see ``core.render``
    volume: Float64[Tensor, " n"]  # divisors of the edge functions


def view_from(
    stage: Stage, K: Float64[Tensor, "3 3"], size: tuple[int, int], eye: Float[Tensor, "3"]
) -> Visibility:
    """Find the triangle that is visible at each pixel from ``eye`` [m].

    ``size``: height and width of the image [px].
    """
    corners = stage.corners - eye
    raster = rasterize(corners, K, size[1], size[0], NEAR_M, with_barycentric=False)
    edges, volume = edge_functions(corners.double() @ K.to(corners.device).mT)
    shares = barycentric_shares(edges, volume, raster.primitive)
    raster = replace(raster, barycentric=shares)
    return Visibility(raster=raster, K=K, eye=eye, edges=edges, volume=volume)


def nearest_at(
    visibility: Visibility, candidates: Int[Tensor, "n m"], places: list[Float64[Tensor, "n 2"]]
) -> list[Nearest]:
    """Find the nearest triangle on rays between the pixel centres, among candidates of each ray.

    Args:
        visibility: what the camera of the rays sees.
        candidates: numbers of triangles that are visible near each ray, -1 for none.
        places: lists of pixels (u, v) [px], which share the candidates.

    Returns:
        The nearest triangles, for each list of ``places``.
    """
    index = candidates.clamp(min=0).flatten()
    volume = visibility.volume.index_select(0, index)[:, None]
    edges = visibility.edges.flatten(1).index_select(0, index) / volume
    edges = edges.unflatten(0, candidates.shape)
    is_missing = candidates < 0
    row = torch.arange(len(candidates))
    results: list[Nearest] = []
    for pixels in places:
        u = pixels[:, :1]
        v = pixels[:, 1:]
        # Edge functions of the corners, one by one: a sum over so short an axis would take ten
        # times as long. Their sum is the inverse depth.
        weights = [
            torch.addcmul(edges[..., k + 2], edges[..., k], u).addcmul_(edges[..., k + 1], v)
            for k in (0, 3, 6)
        ]
        inverse = weights[0] + weights[1] + weights[2]
        smallest = torch.minimum(torch.minimum(weights[0], weights[1]), weights[2])
        is_missed = (smallest < -1e-9) | is_missing | ~(inverse < 1 / NEAR_M)

        inverse, nearest = inverse.masked_fill_(is_missed, 0).clamp_(min=0).max(1)
        primitive = torch.where(inverse > 0, candidates[row, nearest], -1)
        nearest_weights = torch.stack([weight[row, nearest] for weight in weights], 1)
        shares = (nearest_weights / inverse[:, None]).float()
        results.append(Nearest(primitive, shares, (1 / inverse).float()))
    return results


def neighbours(primitive: Int[Tensor, "h w"], index: Indices) -> Int[Tensor, "n 5"]:
    """Give the triangles that are visible at some pixels and at the four neighbours of each.

    ``index``: indices of the pixels in the flattened image.
    """
    height, width = primitive.shape
    column = index % width
    row = index // width
    flat = primitive.flatten()
    visible: list[Tensor] = []
    for x, y in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        rows = (row + y).clamp(0, height - 1)
        columns = (column + x).clamp(0, width - 1)
        visible.append(flat.index_select(0, rows * width + columns))
    return torch.stack(visible, 1)


_OFFSETS = ((-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375))
"""Samples of an edge pixel: a rotated square, which has no preferred direction."""


def draw_light(stage: Stage, visibility: Visibility) -> Float[Tensor, "h w 3"]:
    """Give the linear RGB that reaches each pixel, before any sensor.

    A pixel has the light of its centre; a pixel at an edge the mean of four samples (antialiasing).
    """
    assert visibility.raster.barycentric is not None
    height, width = visibility.raster.primitive.shape
    index = torch.arange(height * width)
    centres = torch.stack([index % width, index // width], 1).double()
    is_edge = _find_edge_pixels(stage, visibility.raster).flatten()
    inner = (~is_edge).nonzero()[:, 0]
    edge = is_edge.nonzero()[:, 0]

    at_centre = Nearest(
        visibility.raster.primitive.flatten(),
        visibility.raster.barycentric.flatten(0, 1),
        visibility.raster.depth_m.flatten(),
    )
    light = torch.zeros(height * width, 3)
    light[inner] = _light_of_rays(stage, visibility, centres[inner], at_centre.select(inner))
    if len(edge):
        light[edge] = _light_of_edges(
            stage, visibility, edge, centres[edge], at_centre.select(edge)
        )
    return light.reshape(height, width, 3)


def _find_edge_pixels(stage: Stage, raster: Raster) -> Bool[Tensor, "h w"]:
    """Find pixels with a neighbour of another surface, or of the same one at a sharp angle."""
    visible = raster.primitive.clamp(min=0)
    kind = torch.where(raster.primitive >= 0, stage.kind[visible], -1)
    normal = stage.attributes[:, 18:21].index_select(0, visible.flatten())
    normal = normal.unflatten(0, visible.shape)
    is_edge = torch.zeros(raster.primitive.shape, dtype=torch.bool)
    every = slice(None)
    after = slice(1, None)
    before = slice(None, -1)
    for here, beside in (((every, after), (every, before)), ((after, every), (before, every))):
        is_other_triangle = raster.primitive[here] != raster.primitive[beside]
        x, y, z = (normal[here] * normal[beside]).unbind(-1)
        is_bent = (x + y + z).abs() < 0.9
        differs = is_other_triangle & ((kind[here] != kind[beside]) | is_bent)
        is_edge[here] |= differs
        is_edge[beside] |= differs
    return is_edge


def _light_of_edges(
    stage: Stage,
    visibility: Visibility,
    index: Indices,
    centres: Float64[Tensor, "n 2"],
    at_centre: Nearest,
) -> Vectors:
    """Give the mean light of four samples of each edge pixel, of the triangles visible near it.

    Args:
        stage: the scene.
        visibility: what the camera sees.
        index: indices of the edge pixels in the flattened image.
        centres: (u, v) of their centres [px].
        at_centre: the triangles at their centres.
    """
    candidates = neighbours(visibility.raster.primitive, index)
    places = [centres + torch.tensor(offset, dtype=torch.float64) for offset in _OFFSETS]
    hits = []
    for hit in nearest_at(visibility, candidates, places):
        # A gap between the triangles that are visible near by: take that at the pixel's centre.
        is_gap = (hit.primitive < 0) & (candidates >= 0).all(1)
        hits.append(
            Nearest(
                torch.where(is_gap, at_centre.primitive, hit.primitive),
                torch.where(is_gap[:, None], at_centre.shares, hit.shares),
                torch.where(is_gap, at_centre.depth_m, hit.depth_m),
            )
        )
    nearest = Nearest(*(torch.cat(parts) for parts in zip(*hits, strict=True)))
    light = _light_of_rays(stage, visibility, torch.cat(places), nearest)
    # A glint in a quarter of a pixel would outshine the rest, as it does not in a sensor.
    return light.clamp(max=4).reshape(len(_OFFSETS), -1, 3).mean(0)


def _light_of_rays(
    stage: Stage, visibility: Visibility, pixels: Float64[Tensor, "n 2"], nearest: Nearest
) -> Vectors:
    """Give the linear RGB that comes along rays, from the nearest triangle or the sky.

    ``pixels``: (u, v) of the rays [px].
    """
    (a, b, c), (_, d, e), _ = visibility.K.inverse().tolist()
    u, v = pixels.unbind(1)
    rays = torch.stack([a * u + b * v + c, d * v + e, torch.ones_like(u)], 1).float()
    length = rays.norm(dim=1)
    towards = rays / length[:, None]
    sky = (nearest.primitive < 0).nonzero()[:, 0]
    hit = (nearest.primitive >= 0).nonzero()[:, 0]

    light = torch.empty_like(rays)
    light[sky] = sky_light(stage, towards[sky])
    points_m = rays * nearest.depth_m[:, None] + visibility.eye
    hits = Hits(
        primitive=nearest.primitive.index_select(0, hit),
        barycentric=nearest.shares.index_select(0, hit),
        points=points_m.index_select(0, hit),
        towards=towards.index_select(0, hit),
        distance_m=(length * nearest.depth_m).index_select(0, hit),
    )
    light[hit] = shade(stage, hits, float(visibility.K[0, 0]))
    return light


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Properties of one camera of a pair, by which light becomes a picture."""

    exposure: tuple[float, float, float]  # factor of the light, by channel
    blur: float  # share of a pixel's light that falls on its neighbours, along each axis
    glare: float  # share of the light that the lens scatters widely
    black: float  # light below which all is black
    vignette: float  # loss of light in the corners, as a share
    noise: tuple[float, float]  # standard deviation of the shot noise of white, and of read noise
    gamma: float  # exponent of the tone curve
    jpeg_quality: int | None  # None: not compressed
    noise_seed: int  # seed of the noise of this picture


def draw_sensors(
    rng: np.random.Generator, light: Float[Tensor, "h w 3"], jpeg_share: float
) -> tuple[Sensor, Sensor]:
    """Draw the cameras of a pair at random, equal but for small differences of gain and colour.

    Their exposure is metered by ``light``; ``jpeg_share`` is the probability of compression.
    """
    luminance = light.mean(-1)
    metered = luminance[len(luminance) // 3 :].clamp(max=1.2).mean() + 1e-3
    # Rounded, for the last bits of a long mean depend on how many threads took part.
    exposure = float(f"{float(0.27 / metered):.4g}") * float(np.exp(rng.normal(0, 0.28)))
    white = np.exp(rng.normal(0, 0.035, 3))
    is_jpeg = bool(rng.random() < jpeg_share)
    common = {
        "blur": rng.uniform(0.0, 0.22),
        "glare": rng.uniform(0, 0.02),
        "black": rng.uniform(0, 0.025),
        "vignette": rng.uniform(0, 0.2),
        "noise": (rng.uniform(0.004, 0.025), rng.uniform(0.0005, 0.004)),
        "gamma": rng.uniform(1.6, 2.1),
        "jpeg_quality": int(rng.integers(75, 98)) if is_jpeg else None,
    }
    gain = np.exp(rng.normal(0, 0.02) + rng.normal(0, 0.006, 3))
    seeds = rng.integers(1 << 31, size=2)
    left, right = (
        Sensor(exposure=tuple((exposure * white * factor).tolist()), noise_seed=int(seed), **common)
        for factor, seed in ((1.0, seeds[0]), (gain, seeds[1]))
    )
    return left, right


def expose(light: Float[Tensor, "h w 3"], sensor: Sensor) -> View:
    """Take a picture of the light by a sensor: RGB in [0, 1], in steps of 1/255."""
    # Exposure, and a vignette: the corners of an image of 3:1 are at a radius^2 of about 1.1.
    signal = light.permute(2, 0, 1) * torch.tensor(sensor.exposure)[:, None, None]
    height, width = signal.shape[1:]
    y = torch.linspace(-1, 1, height)[:, None] * height / width
    x = torch.linspace(-1, 1, width)[None]
    signal = signal * (1 - sensor.vignette * (x**2 + y**2) / 1.1)

    # Veiling glare: light of blocks of 32 px spreads over their neighbours. A pixel saturates at 8
    # times white.
    blocks = (max(height // 32, 1), max(width // 32, 1))
    small = F.avg_pool2d(F.adaptive_avg_pool2d(signal.clamp(max=6)[None], blocks), 3, 1, 1)
    wide = F.interpolate(small, (height, width), mode="bilinear")[0]
    signal = torch.lerp(signal.clamp(max=8), wide, sensor.glare)

    # Blur of the lens: three taps along both axes.
    for axis, size in ((1, height), (2, width)):
        before = signal.narrow(axis, 0, 1), signal.narrow(axis, 0, size - 1)
        after = signal.narrow(axis, 1, size - 1), signal.narrow(axis, size - 1, 1)
        beside = torch.cat(before, axis) + torch.cat(after, axis)
        signal = signal * (1 - sensor.blur) + beside * (sensor.blur / 2)

    # Shot noise and read noise.
    generator = torch.Generator().manual_seed(sensor.noise_seed)
    shot, dark = sensor.noise
    deviation = (signal * shot**2 + dark**2).sqrt()
    signal = signal + torch.randn(signal.shape, generator=generator) * deviation

    # The tone curve: a shoulder before white, as cameras have; beyond it light is clipped.
    signal = (signal - sensor.black) / (1 - sensor.black)
    signal = (signal * 1.12 / (1 + 0.12 * signal.clamp(min=0))).clamp(0, 1)
    picture = (signal ** (1 / sensor.gamma) * 255 + 0.5).floor() / 255
    return picture if sensor.jpeg_quality is None else through_jpeg(picture, sensor.jpeg_quality)


_BEAMS_RAD = np.deg2rad(np.concatenate([np.linspace(2, -8.33, 32), np.linspace(-8.87, -24.33, 32)]))
_AZIMUTHS_RAD = np.deg2rad(np.arange(-44.5, 44.5, 0.1728))
"""Elevations of the LiDAR's beams, and the azimuths in the cameras' field of view."""

_ORIGIN_M = (0.056, -0.076, -0.272)
"""Position of the LiDAR in the left camera's frame: a little above and behind."""

_AXES = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
CAMERA_FROM_VELODYNE = np.vstack([np.column_stack([_AXES, _ORIGIN_M]), [0, 0, 0, 1.0]])
"""From the LiDAR (x forward, y left, z up) to the left camera."""

_SIZE_PX = (440, 1200)
_FOCAL_PX = 600.0
"""Rows and columns, and focal length, of the image by which triangles near the beams are found."""
_MAX_RANGE_M = 115.0
_NOISE_M = 0.015
"""Standard deviation of the LiDAR's ranges."""


def scan(stage: Stage, rng: np.random.Generator) -> Float[Tensor, "n 4"]:
    """Scan a scene by the LiDAR: a row for each return, x forward, y left, z up [m], reflectance.

    The returns are exact: an image from the LiDAR's position shows which triangles are near each
    beam, and the beam is intersected with these.
    """
    grid = np.meshgrid(_BEAMS_RAD, _AZIMUTHS_RAD, indexing="ij")
    elevation, azimuth = (torch.from_numpy(angles.ravel()) for angles in grid)
    across = elevation.cos() * azimuth.sin()
    ahead = elevation.cos() * azimuth.cos()
    towards = torch.stack([across, -elevation.sin(), ahead], 1)

    height, width = _SIZE_PX
    K = torch.tensor(
        [[_FOCAL_PX, 0, width / 2], [0, _FOCAL_PX, 40], [0, 0, 1]], dtype=torch.float64
    )
    visibility = view_from(stage, K, _SIZE_PX, torch.tensor(_ORIGIN_M))
    pixels = (towards @ K.T)[:, :2] / towards[:, 2:]
    column = pixels[:, 0].round().long().clamp(0, width - 1)
    row = pixels[:, 1].round().long().clamp(0, height - 1)
    candidates = neighbours(visibility.raster.primitive, row * width + column)
    primitive, _, depth_m = nearest_at(visibility, candidates, [pixels])[0]
    range_m = depth_m / towards[:, 2]

    # Few beams return from glass, and fewer from far away and from dark surfaces.
    chance = torch.from_numpy(rng.random(len(primitive)))
    hit = primitive.clamp(min=0)
    material = stage.material[hit]
    tint = stage.attributes[hit, 15:18].mean(1)
    is_glass = (material == NUMBER["glass"]) | (material == NUMBER["pane"])
    dark = (0.12 - tint).clamp(min=0) * 2.5
    lost = 0.03 + 0.0025 * range_m + 0.65 * is_glass + dark * (range_m / 40).clamp(max=1)
    is_returned = (primitive >= 0) & (range_m < _MAX_RANGE_M) & (chance > lost)
    returned = is_returned.nonzero()[:, 0]
    noise = torch.from_numpy(rng.normal(0, _NOISE_M, len(returned)))
    far = range_m[returned].double() + noise
    x, y, z = (towards[returned] * far[:, None]).unbind(1)
    light = tint[returned].clamp(0.02, 0.99)
    return torch.stack([z, -x, -y, light.double()], 1).float()


_OCCLUSION_SHARE = 1e-4
"""A surface occludes a point if it is nearer by this share of the depth; less is rounding."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StreetFrame(RawFrame):
    """A synthetic pair with its exact truth."""

    right_disparity_px: Map  #: disparity of the right image; NaN in the sky, likewise
    depth_m: Map  #: camera z in the left image; NaN in the sky
    is_road: Mask  #: left pixels that show the carriageway


def draw_street(config: StreetsConfig, index: int) -> StreetFrame:
    """Make frame ``index``: a function of the configuration and the index alone.

    Raises:
        InputError: the index is negative.
    """
    if index < 0:
        raise InputError(f"index is {index}, but frames are counted from 0; take another")
    seed = (config.seed, index)
    is_clutter = np.random.default_rng([75, *seed]).random() < config.clutter_share
    scene = make_clutter(seed) if is_clutter else make_scene(seed)
    rig = kitti_rig(rig_number(config, index))
    width, height = (max(1, round(side * config.scale)) for side in (rig.width, rig.height))
    return draw_scene(scene, resize_camera(rig, width, height), config, seed)


@dataclass(frozen=True, kw_only=True)
class Projector:
    """A projector of dots, as active stereo cameras have."""

    place_m: tuple[float, float, float]  #: its position in the left camera's frame
    dots_per_radian: float  #: density of the dots
    strength: float  #: light of a dot as a share of the other light


@cache
def _make_dots() -> Float[Tensor, "1024 1024"]:
    """Make a pattern of dots at random places that can be tiled: one for 3 x 3 pixels on average.

    Its sides of 1024 pixels, a power of two, are quick to tile; the last row and column are dark.
    """
    rng = np.random.default_rng(79)
    cells = 341
    pattern = torch.zeros(3 * cells + 1, 3 * cells + 1)
    row, column = torch.from_numpy(rng.integers(0, 3 * cells, (2, cells * cells)))
    pattern[row, column] = torch.from_numpy(rng.uniform(0.5, 1, cells * cells)).float()
    kernel = torch.tensor([[0.2, 0.5, 0.2], [0.5, 1.0, 0.5], [0.2, 0.5, 0.2]])
    padded = F.pad(pattern[None, None], (1, 1, 1, 1), mode="circular")
    return F.conv2d(padded, kernel[None, None])[0, 0].clamp(max=1.5)


def _project_dots(
    light: Float[Tensor, "h w 3"], visibility: Visibility, projector: Projector
) -> Float[Tensor, "h w 3"]:
    """Add the light of the projector's dots to that which reaches a camera.

    The projector has no shadows: occluded surfaces have dots too.
    """
    # The points that are visible at the pixels, in the projector's frame.
    depth_m = visibility.raster.depth_m
    height, width = depth_m.shape
    column, row = torch.meshgrid(
        torch.arange(width).double(), torch.arange(height).double(), indexing="xy"
    )
    rays = torch.stack([column, row, torch.ones_like(row)], -1) @ visibility.K.inverse().T
    points_m = rays.float() * depth_m[..., None] + visibility.eye
    points_m = points_m - torch.tensor(projector.place_m)

    # Their places in the pattern, which is tiled and sampled bilinearly.
    pattern = _make_dots()
    side = len(pattern)
    pixels_per_radian = 3 * projector.dots_per_radian
    x = (pixels_per_radian * points_m[..., 0] / points_m[..., 2]).nan_to_num(0.0)
    y = (pixels_per_radian * points_m[..., 1] / points_m[..., 2]).nan_to_num(0.0)
    left = x.floor().long()
    top = y.floor().long()
    x_share = x - x.floor()
    y_share = y - y.floor()
    upper, lower = (
        torch.lerp(pattern[r % side, left % side], pattern[r % side, (left + 1) % side], x_share)
        for r in (top, top + 1)
    )
    dots = torch.lerp(upper, lower, y_share).where(depth_m.isfinite(), 0.0)
    return light * (1 + projector.strength * dots[..., None])


def draw_scene(
    scene: StreetScene,
    rig: StereoRig,
    config: StreetsConfig,
    seed: tuple[int, ...] = (0,),
    projector: Projector | None = None,
) -> StreetFrame:
    """Draw a scene with a rig, and give both views with their truth.

    Args:
        scene: the scene.
        rig: the cameras, whose size the views have, whatever the scale of ``config``.
        config: settings of the sensors.
        seed: seed of the noise and misalignment of the cameras, and of the LiDAR.
        projector: adds dots; None: none.
    """
    rng = np.random.default_rng([73, *seed])
    stage = prepare(scene, rig.width * rig.height)
    size = (rig.height, rig.width)
    left = view_from(stage, rig.K, size, torch.zeros(3))

    # The right camera, whose rows are off by a fraction of a pixel as real ones are.
    K = rig.K.clone()
    K[0, 2] += rig.cx_right_minus_left_px
    K[1, 2] += rng.normal(0, 1) * config.rectification_error_px
    right = view_from(stage, K, size, torch.tensor([rig.baseline_m, 0.0, 0.0]))

    left_light = draw_light(stage, left)
    right_light = draw_light(stage, right)
    if projector is not None:
        left_light = _project_dots(left_light, left, projector)
        right_light = _project_dots(right_light, right, projector)
    left_sensor, right_sensor = draw_sensors(rng, left_light, config.jpeg_share)
    points = scan(stage, rng) if config.with_lidar else None
    primitive = left.raster.primitive
    depth_m = left.raster.depth_m
    return StreetFrame(
        left=expose(left_light, left_sensor),
        right=expose(right_light, right_sensor),
        disparity_px=disparity_from_depth(depth_m, rig),
        right_disparity_px=disparity_from_depth(right.raster.depth_m, rig),
        depth_m=depth_m,
        occluded=_find_occluded(left, right, rig),
        is_sky=primitive < 0,
        is_road=(primitive >= 0) & (stage.material[primitive.clamp(min=0)] == NUMBER["road"]),
        lidar_points=points,
        camera_from_velodyne=CAMERA_FROM_VELODYNE,
        rig=rig,
    )


def _find_occluded(left: Visibility, right: Visibility, rig: StereoRig) -> Mask:
    """Find left pixels whose point is occluded in the right image, or lies outside of it."""
    height, width = left.raster.primitive.shape
    primitive = left.raster.primitive.flatten()
    depth_m = left.raster.depth_m.flatten()
    occluded = torch.zeros(height * width, dtype=torch.bool)
    index = (primitive >= 0).nonzero()[:, 0]

    # Where each point lies in the right image.
    pixels = torch.stack([index % width, index // width], 1).double()
    pixels[:, 0] -= disparity_from_depth(depth_m[None, index], rig)[0].double()
    pixels[:, 1] += right.K[1, 2] - left.K[1, 2]
    near = pixels.round().long()
    is_outside = (near[:, 0] < 0) | (near[:, 0] >= width)
    near = near[:, 1].clamp(0, height - 1) * width + near[:, 0].clamp(0, width - 1)
    candidates = neighbours(right.raster.primitive, near)

    # Most points have the same triangle there; the others are compared with the right depth.
    is_same = (candidates[:, :1] == primitive[index, None])[:, 0] & ~is_outside
    undecided = (~is_same & ~is_outside).nonzero()[:, 0]
    (nearest,) = nearest_at(right, candidates[undecided], [pixels[undecided]])
    least_m = depth_m[index[undecided]] * (1 - _OCCLUSION_SHARE)
    occluded[index[undecided]] = nearest.depth_m < least_m
    occluded[index[is_outside]] = True
    return occluded.reshape(height, width)


@dataclass(frozen=True)
class Streets:
    """A dataset of synthetic pairs, each rendered on demand from the seed and its index alone."""

    config: StreetsConfig  #: settings of the frames

    def __len__(self) -> int:
        """Give the number of frames."""
        return self.config.frames

    def __getitem__(self, index: int) -> StereoSample:
        """Make one sample; its truth is exact, and NaN in the sky."""
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        frame = draw_street(self.config, index)
        name = f"street_{self.config.seed}_{index:06d}"
        return StereoSample(
            input=StereoInput(name=name, left=frame.left, right=frame.right, camera=frame.rig),
            truth=StereoTruth(
                disparity_px=frame.disparity_px,
                depth_m=frame.depth_m,
                occluded=frame.occluded,
                right_disparity_px=frame.right_disparity_px,
                is_sky=frame.is_sky,
            ),
        )
