"""Whole frames: several objects on a table, as picture, depth and masks.

Light is linear RGB until the camera encodes it as sRGB.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int64
from torch import Tensor

from depthpose.core.camera import back_project
from depthpose.core.errors import InputError
from depthpose.core.loop import make_sample_generator
from depthpose.core.render import Raster, rasterize
from depthpose.core.rigid import Rigid
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.datasets import BopFrame, BopObject
from depthpose.pose.mesh import drawn_triangles, sample_surface
from depthpose.pose.synthetic.depth_sensors import simulate_depth
from depthpose.pose.synthetic.random_numbers import random_index, random_rotation, uniform
from depthpose.pose.types import ObjectModel

_WAVES = 6  # of a pattern
_COLOR_SEED = 0xC0102  # of the colours of objects, which are the same in every dataset
_DISTINCT_HUE = (0.7, 1.0)  # shares of a hue by which objects are told apart
_HIGHLIGHT_POWER = 1 / math.radians(2)  # of Blinn's cosine: the larger, the smaller a highlight
_GAMMA = 2.2  # about that of sRGB


@dataclass(frozen=True, kw_only=True, eq=False)
class Pattern:
    """The colour of a surface by place: a base colour, changed by waves in space."""

    base: Float[Tensor, "3"]  #: linear RGB
    waves: Float[Tensor, "w 3"]  #: amplitude of each wave in RGB, a share of the base
    frequencies: Float[Tensor, "w 3"]  #: [rad/m] along x, y and z
    phases: Float[Tensor, " w"]  #: [rad]
    gloss: float  #: share of the lamp's light that is mirrored


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid:
    """A body of a scene, in its own frame."""

    triangles_m: Float[Tensor, "n 3 3"]  #: corners
    normals: Float[Tensor, "n 3 3"]  #: at each corner
    pattern: Pattern  #: its colour
    number: int | None  #: ``obj_id``; None for clutter


class PlacedSolid(NamedTuple):
    """A body at its place."""

    solid: Solid
    pose: Rigid  #: from the body's frame to that of the table or the camera


class _Light(NamedTuple):
    """A lamp far away, and light from everywhere."""

    towards: Float[Tensor, "3"]  #: unit vector to the lamp, in the camera frame
    lamp: Float[Tensor, "3"]  #: colour of its light
    ambient: Float[Tensor, "3"]  #: colour of the light from everywhere


def draw_pattern(
    generator: torch.Generator, size_m: float, hue_share: tuple[float, float] = (0.0, 0.8)
) -> Pattern:
    """Draw a random pattern.

    Args:
        generator: of random numbers.
        size_m: extent of the surface; features are about a third of it.
        hue_share: range of the share of a hue, against grey.
    """
    strength = uniform(generator, 0.0, 0.25)
    directions = torch.randn(_WAVES, 3, generator=generator)
    grey = uniform(generator, 0.1, 0.8)
    hue = torch.rand(3, generator=generator)
    share = uniform(generator, *hue_share)
    common = torch.randn(_WAVES, 1, generator=generator)
    waves = 0.5 * torch.randn(_WAVES, 3, generator=generator)
    return Pattern(
        base=(1 - share) * grey + share * hue,
        waves=strength * (common + waves) / math.sqrt(_WAVES),
        frequencies=directions * (2 * math.pi / size_m * uniform(generator, 1.0, 4.0)),
        phases=2 * math.pi * torch.rand(_WAVES, generator=generator),
        gloss=uniform(generator, 0.0, 0.4),
    )


def draw_clutter(generator: torch.Generator) -> Solid:
    """Draw a random body of clutter: a box, a ball or a can."""
    import trimesh

    size_m = uniform(generator, 0.04, 0.15)
    depth_share = uniform(generator, 0.3, 1.0)
    height_share = uniform(generator, 0.3, 1.0)
    match random_index(generator, 3):
        case 0:  # a box
            mesh = trimesh.creation.box((size_m, depth_share * size_m, height_share * size_m))
        case 1:  # a ball
            mesh = trimesh.creation.icosphere(3, 0.5 * size_m)
        case _:  # a can
            mesh = trimesh.creation.cylinder(0.5 * depth_share * size_m, size_m, 32)
    corners = torch.tensor(mesh.triangles, dtype=torch.float32)
    normals = torch.tensor(mesh.face_normals, dtype=torch.float32)[:, None].expand(-1, 3, 3)
    return Solid(
        triangles_m=corners, normals=normals, pattern=draw_pattern(generator, size_m), number=None
    )


def _shade(
    placed: Sequence[PlacedSolid], raster: Raster, K: Float[Tensor, "3 3"], light: _Light
) -> Float[Tensor, "n 3"]:
    """Compute the colours of the pixels that show a surface, in the order of the image's rows.

    By Lambert's law and a mirrored lamp (Blinn 1977); no shadow is cast.

    Args:
        placed: bodies in the camera frame, in the order of the raster's triangles.
        raster: of all of them.
        K: intrinsic matrix.
        light: on them.
    """
    assert raster.barycentric is not None
    is_seen = raster.primitive >= 0
    points_m = back_project(raster.depth_m, K)[is_seen]
    barycentric = raster.barycentric[is_seen]
    primitive = raster.primitive[is_seen]
    color = torch.zeros_like(points_m)
    start = 0
    for solid, pose in placed:
        stop = start + len(solid.triangles_m)
        of_solid = ((primitive >= start) & (primitive < stop)).nonzero()[:, 0]

        # Normals, toward the camera: both sides of a thin part are visible.
        corner_normals = solid.normals[primitive[of_solid] - start]
        normal = (corner_normals * barycentric[of_solid, :, None]).sum(1) @ pose.R.mT
        normal = F.normalize(normal, dim=-1)
        sight = F.normalize(-points_m[of_solid], dim=-1)
        normal = normal * torch.where((normal * sight).sum(-1, keepdim=True) < 0, -1.0, 1.0)

        # Light: from the lamp, directly and mirrored, and ambient, half as much from below.
        facing = (normal @ light.towards).clamp(min=0)[:, None]
        half = F.normalize(sight + light.towards, dim=-1)
        shine = (normal * half).sum(-1, keepdim=True).clamp(min=0) ** _HIGHLIGHT_POWER
        open_sky = 0.75 + 0.25 * (normal @ light.towards)[:, None]
        diffuse = light.ambient * open_sky + light.lamp * facing
        albedo = _find_albedo(solid.pattern, pose.inverse().apply(points_m[of_solid]))
        color[of_solid] = albedo * diffuse + solid.pattern.gloss * shine * light.lamp
        start = stop
    return color


def _find_albedo(pattern: Pattern, points_m: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Compute the share of the light that a surface reflects at its points, in RGB."""
    phase = points_m @ pattern.frequencies.mT + pattern.phases
    waves = torch.tanh(2 * phase.sin())
    return (pattern.base * (1 + waves @ pattern.waves)).clamp(0.01, 1)


_TRIES = 30  # places that are tried for a body on the table
_FRAMES_SEED = 0xF4A3E5  # added to the seed, so that frames share no random numbers with views


def make_frames(
    models: Sequence[ObjectModel], config: ObjectsConfig, number: int, first: int = 0
) -> Iterator[BopFrame]:
    """Make frames of several objects on a table, one after the other, for a dataset of BOP.

    A frame depends on the seed and its number alone. It shows each object at most once, or if
    ``config.frame_pile`` is set a pile of a single object. Poses are exact; the depth has a
    sensor's errors.

    Args:
        models: of the objects; their numbers become ``obj_id``.
        config: of the frames.
        number: how many frames are made.
        first: number of the first frame.

    Raises:
        InputError: no model, two of one number, or a least distance of the camera below two
            diameters of the largest object.
    """
    if not models:
        raise InputError("there is no object to show; give one model at least")
    numbers = [model.number for model in models]
    repeated = sorted({number for number in numbers if numbers.count(number) > 1})
    if repeated:
        raise InputError(
            f"two models have the number {repeated[0]}, by which frames name an object; give each "
            "a number of its own"
        )
    widest_m = max(model.diameter_m for model in models)
    if config.distance_m[0] < 2 * widest_m:
        raise InputError(
            f"distance_m begins at {config.distance_m[0]:g} m, but the largest object is "
            f"{widest_m:.3g} m wide and would fill the image; begin at {3 * widest_m:.2g}"
        )
    solids = [_make_solid(model) for model in models]
    for index in range(first, first + number):
        yield _make_frame(models, solids, config, index)


def _make_solid(model: ObjectModel) -> Solid:
    """Make the body of an object, which looks alike in every frame of every dataset."""
    generator = make_sample_generator(model.number, _COLOR_SEED)
    pattern = draw_pattern(generator, model.diameter_m, _DISTINCT_HUE)
    corners = drawn_triangles(model)
    if len(model.faces):
        normals = model.normals[model.faces]
    else:  # of a model of points triangles are drawn between samples, with normals of their own
        first, second = corners.diff(dim=1).unbind(1)
        normal = F.normalize(torch.linalg.cross(first, second), dim=-1)
        normals = normal[:, None].expand(-1, 3, 3)
    return Solid(triangles_m=corners, normals=normals, pattern=pattern, number=model.number)


def _make_frame(
    models: Sequence[ObjectModel], solids: Sequence[Solid], config: ObjectsConfig, index: int
) -> BopFrame:
    """Render a frame: objects on a table before a blurred background, in colour and depth."""
    # The scene in the table's frame (z up), and the camera.
    generator = make_sample_generator(index, config.seed + _FRAMES_SEED)
    if config.frame_pile:
        scene = _drop_pile(models, solids, config, generator)
    else:
        scene = _arrange(solids, config, generator)
    at_origin = Rigid(torch.eye(3), torch.zeros(3))
    scene.append(PlacedSolid(_draw_table(generator), at_origin))
    camera_from_table = _draw_viewpoint(config, generator)
    placed = [PlacedSolid(solid, camera_from_table @ pose) for solid, pose in scene]

    # The intrinsic matrix.
    assert config.centre_px is not None, "the config computes a centre left out"
    fx, fy = config.focal_px
    cx, cy = config.centre_px
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)

    # What each pixel shows: the index of a body, or -1.
    width, height = config.image_px
    triangles_m = [pose.apply(solid.triangles_m) for solid, pose in placed]
    raster = rasterize(torch.cat(triangles_m), K, width, height)
    body_of_triangle = torch.cat([
        torch.full((len(triangles),), i) for i, triangles in enumerate(triangles_m)
    ])  # fmt: skip
    body = body_of_triangle[raster.primitive.clamp(min=0)]
    visible_body = torch.where(raster.primitive >= 0, body, -1)

    # The picture: a background, lit bodies before it, and a camera's errors.
    image = _draw_background(height, width, generator)
    up = camera_from_table.R[:, 2]
    light = _draw_light(up, generator)
    image[:, raster.primitive >= 0] = _shade(placed, raster, K, light).mT
    rgb = _photograph(image, generator)

    # Depth, and the objects that are annotated, by what each would show alone.
    focal_px = (config.focal_px[0], config.focal_px[0])  # the window is the whole image
    depth_m = simulate_depth(raster.depth_m, focal_px, config.sensor, generator)
    shown: list[BopObject] = []
    for i, (solid, pose) in enumerate(placed):
        if solid.number is None:
            continue
        alone = rasterize(triangles_m[i], K, width, height, with_barycentric=False)
        silhouette = alone.depth_m.isfinite()
        if bool(silhouette.any()):
            shown.append(
                BopObject(
                    number=solid.number,
                    camera_from_model=pose,
                    visible=visible_body == i,
                    silhouette=silhouette,
                )
            )
    return BopFrame(number=index, K=K, depth_m=depth_m, objects=shown, rgb=rgb)


def _draw_table(generator: torch.Generator) -> Solid:
    """Draw the top of a table: a square about the origin, at height 0, of random size."""
    half_m = 0.5 * uniform(generator, 0.8, 3.0)
    first = [[-half_m, -half_m, 0.0], [half_m, -half_m, 0.0], [half_m, half_m, 0.0]]
    second = [[-half_m, -half_m, 0.0], [half_m, half_m, 0.0], [-half_m, half_m, 0.0]]
    return Solid(
        triangles_m=torch.tensor([first, second]),
        normals=torch.tensor([0.0, 0.0, 1.0]).expand(2, 3, 3),
        pattern=draw_pattern(generator, uniform(generator, 0.05, 0.5)),
        number=None,
    )


def _draw_background(
    height: int, width: int, generator: torch.Generator
) -> Float[Tensor, "3 {height} {width}"]:
    """Draw a random background out of focus: blots of several sizes over a colour."""
    image = torch.rand(3, 1, 1, generator=generator) * torch.ones(1, height, width)
    for cells in (3, 8, 24):
        blots = torch.randn(1, 3, cells, cells, generator=generator)
        smooth = F.interpolate(blots, (height, width), mode="bilinear", align_corners=False)
        image = image + uniform(generator, 0.0, 0.25) * smooth[0]
    return image.clamp(0, 1)


def _draw_light(up: Float[Tensor, "3"], generator: torch.Generator) -> _Light:
    """Draw a lamp above a table, and ambient light; ``up`` is the table's z in the camera frame."""
    towards = F.normalize(1.2 * up + 0.8 * torch.randn(3, generator=generator), dim=0)
    strength = uniform(generator, 0.3, 0.9)
    warmth = uniform(generator, -0.15, 0.15)
    color = torch.tensor([1 + warmth, 1.0, 1 - warmth])
    ambient = uniform(generator, 0.2, 0.6) * (2 - color)  # the colder, the warmer the lamp
    return _Light(towards=towards, lamp=strength * color, ambient=ambient)


def _photograph(
    image: Float[Tensor, "3 h w"], generator: torch.Generator
) -> Float[Tensor, "3 h w"]:
    """Imitate a camera: blur, tint and expose linear light, add noise, and encode it as sRGB."""
    # Blurred.
    blur = uniform(generator, 0.0, 0.3)
    near = F.avg_pool2d(image[None], 3, 1, 1, count_include_pad=False)[0]
    image = torch.lerp(image, near, blur)

    # Tinted, exposed, with noise.
    tint = 1 + 0.15 * (2 * torch.rand(3, 1, 1, generator=generator) - 1)
    gain = math.exp(uniform(generator, -0.8, 0.2))
    noise = uniform(generator, 0.0, 0.02) * torch.randn(image.shape, generator=generator)
    return (gain * tint * image + noise).clamp(1e-6, 1) ** (1 / _GAMMA)


def _arrange(
    solids: Sequence[Solid], config: ObjectsConfig, generator: torch.Generator
) -> list[PlacedSolid]:
    """Lay random bodies on the table, none in another; their poses are in its frame (z up)."""
    # Some of the objects, and clutter.
    fewest, most = (min(count, len(solids)) for count in config.frame_objects)
    order = torch.randperm(len(solids), generator=generator)
    objects = fewest + random_index(generator, most - fewest + 1)
    chosen = [solids[i] for i in order[:objects].tolist()]
    fewest, most = config.frame_clutter
    clutter = fewest + random_index(generator, most - fewest + 1)
    chosen += [draw_clutter(generator) for _ in range(clutter)]

    # Each is tried at places until its circle is free, farther from the middle with every try and
    # with every body that lies there. One that never finds a free place is left out.
    placed: list[PlacedSolid] = []
    circles: list[_Circle] = []
    for solid in chosen:
        R = random_rotation(generator).float()
        corners = solid.triangles_m.reshape(-1, 3) @ R.mT
        middle = (corners.amin(0) + corners.amax(0)) / 2
        radius_m = float((corners - middle)[:, :2].norm(dim=1).max())
        for attempt in range(_TRIES):
            reach_m = 0.08 + 0.015 * attempt + 0.03 * len(circles)
            x, y = (uniform(generator, -reach_m, reach_m) for _ in range(2))
            circle = _Circle(x, y, radius_m)
            if all(circle.is_apart(other) for other in circles):
                height_m = -float(corners[:, 2].min())  # at which the body stands on the table
                shift_m = [x - float(middle[0]), y - float(middle[1]), height_m]
                placed.append(PlacedSolid(solid, Rigid(R, torch.tensor(shift_m))))
                circles.append(circle)
                break
    return placed


class _Circle(NamedTuple):
    """The circle about a body on the table."""

    x_m: float
    y_m: float
    radius_m: float

    def is_apart(self, other: "_Circle") -> bool:
        """Whether two circles do not touch."""
        distance_m = math.hypot(self.x_m - other.x_m, self.y_m - other.y_m)
        return distance_m > self.radius_m + other.radius_m


_CELL_M = 0.004  # side of a cell of the height map of a pile
_DROPS = 10  # places that are tried for each body of a pile
_PILE_POINTS = 20_000  # of a body's surface, which land on the height map


class _Drop(NamedTuple):
    """A body that was dropped on a pile."""

    pose: Rigid  #: of the body about its middle, in the table's frame
    cell: Int64[Tensor, " n"]  #: of the height map, of each of its points
    top_m: Float[Tensor, " n"]  #: height of each of its points


def _drop_pile(
    models: Sequence[ObjectModel],
    solids: Sequence[Solid],
    config: ObjectsConfig,
    generator: torch.Generator,
) -> list[PlacedSolid]:
    """Drop copies of one object straight down until they touch; poses in the table's frame (z up).

    Each copy is dropped several times; the drop after which its middle lies lowest is taken.
    """
    # One of the objects, about the middle of its box.
    chosen = random_index(generator, len(solids))
    points_m, _ = sample_surface(models[chosen], _PILE_POINTS)
    middle_m = (points_m.amin(0) + points_m.amax(0)) / 2
    points_m = points_m - middle_m

    # A map of the pile's height, about the middle of the table.
    radius_m = float(points_m.norm(dim=1).max())
    reach_m = 0.6 * radius_m * math.sqrt(config.frame_pile)  # an area that grows with their number
    cells = math.ceil((reach_m + radius_m) / _CELL_M)  # from the middle to each side
    height_m = torch.zeros((2 * cells + 1) ** 2)

    # Of several drops the lowest is taken, and the pile grows by it.
    placed: list[PlacedSolid] = []
    for _ in range(config.frame_pile):
        drops = [_drop_body(points_m, height_m, cells, reach_m, generator) for _ in range(_DROPS)]
        lowest = min(drops, key=lambda drop: float(drop.pose.t_m[2]))
        height_m = height_m.scatter_reduce(0, lowest.cell, lowest.top_m, "amax")
        pose = Rigid(lowest.pose.R, lowest.pose.t_m - lowest.pose.R @ middle_m)
        placed.append(PlacedSolid(solids[chosen], pose))
    return placed


def _drop_body(
    points_m: Float[Tensor, "n 3"],
    height_m: Float[Tensor, " cells"],
    cells: int,
    reach_m: float,
    generator: torch.Generator,
) -> _Drop:
    """Drop a body on a pile: rotated and shifted at random, and as low as the pile lets it.

    Args:
        points_m: points of its surface, about its middle.
        height_m: of the pile in each cell, row after row.
        cells: from the middle of the table to each side of the map.
        reach_m: largest shift along x and y.
        generator: of random numbers.
    """
    R = random_rotation(generator).float()
    x, y = (uniform(generator, -reach_m, reach_m) for _ in range(2))
    moved_m = points_m @ R.mT + torch.tensor([x, y, 0.0])
    column, row = ((moved_m[:, :2] / _CELL_M).round().long() + cells).unbind(1)
    cell = row * (2 * cells + 1) + column

    # The body rises until its lowest point in each cell is above the pile.
    bottom_m = torch.full_like(height_m, math.inf)
    bottom_m = bottom_m.scatter_reduce(0, cell, moved_m[:, 2], "amin")
    z = float((height_m - bottom_m)[bottom_m.isfinite()].max())
    return _Drop(pose=Rigid(R, torch.tensor([x, y, z])), cell=cell, top_m=moved_m[:, 2] + z)


def _draw_viewpoint(config: ObjectsConfig, generator: torch.Generator) -> Rigid:
    """Draw the pose ``camera_from_table`` of a camera that looks down at about the table's middle.

    It is 25 to 85 degrees above the table.
    """
    # Where it stands, looking at the middle.
    elevation = math.radians(uniform(generator, 25.0, 85.0))
    azimuth = uniform(generator, 0.0, 2 * math.pi)
    distance_m = uniform(generator, *config.distance_m)
    along_table = math.cos(elevation)
    toward_camera = [
        along_table * math.cos(azimuth),
        along_table * math.sin(azimuth),
        math.sin(elevation),
    ]
    forward = -torch.tensor(toward_camera)
    right = F.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    R = torch.stack([right, torch.linalg.cross(forward, right), forward])

    # Rolled a little [rad], and aimed at a point near the middle [m].
    roll = uniform(generator, -0.3, 0.3)
    cosine = math.cos(roll)
    sine = math.sin(roll)
    R = torch.tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ R
    target = torch.tensor([uniform(generator, -0.05, 0.05), uniform(generator, -0.05, 0.05), 0.03])
    return Rigid(R, -R @ (target + distance_m * torch.tensor(toward_camera)))
