"""Figures 3-2 (features as colours on the posed cloud) and 3-4 (directions to a keypoint)."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Float64
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.arrays import take_evenly
from depthpose.core.errors import InputError
from depthpose.core.files.images import rgb_from_pillow
from depthpose.pose.cloud import prepare_cloud
from depthpose.pose.geometry.grid import sample_and_voxelise
from depthpose.pose.mesh import sample_surface
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.networks.resunet import ResUNet
from depthpose.pose.networks.sparse import Voxels
from depthpose.pose.refusals import Refused
from depthpose.pose.types import AnyInput, ObjectModel

_GAP_PX = 8
"""White space between the pictures of a grid."""

# Spectral of ColorBrewer (Brewer, 2003): red over yellow to blue.
_SPECTRAL = (
    (158, 1, 66), (213, 62, 79), (244, 109, 67), (253, 174, 97), (254, 224, 139), (255, 255, 191),
    (230, 245, 152), (171, 221, 164), (102, 194, 165), (50, 136, 189), (94, 79, 162),
)  # fmt: skip


def spectral(value: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
    """Look up the RGB colours, 0..1, of numbers from 0 (red) over yellow to 1 (blue)."""
    # Between the two colours of the scale beside each number.
    anchors = torch.tensor(_SPECTRAL, dtype=torch.float32) / 255
    position = value.float().clamp(0, 1) * (len(anchors) - 1)
    below = position.long().clamp(max=len(anchors) - 2)
    return torch.lerp(anchors[below], anchors[below + 1], (position - below)[:, None])


def arrange_grid(
    pictures: Sequence[Float[Tensor, "3 _ _"]], columns: int
) -> Float[Tensor, "3 h w"]:
    """Lay pictures out in rows on white, each in a cell as large as the largest.

    Raises:
        InputError: there is no picture.
    """
    if not pictures:
        raise InputError("a figure of no picture cannot be arranged; give one at least.")
    height = max(picture.shape[1] for picture in pictures) + _GAP_PX
    width = max(picture.shape[2] for picture in pictures) + _GAP_PX
    cells: list[Tensor] = []
    for picture in pictures:
        missing_right = width - picture.shape[2]
        missing_below = height - picture.shape[1]
        cells.append(F.pad(picture, (0, missing_right, 0, missing_below), value=1.0))

    # Rows of cells, the last filled up with white.
    columns = min(columns, len(cells))
    cells += [torch.ones(3, height, width)] * (-len(cells) % columns)
    rows = [torch.cat(cells[k : k + columns], 2) for k in range(0, len(cells), columns)]
    return torch.cat(rows, 1)[:, :-_GAP_PX, :-_GAP_PX]


def draw_discs(
    pen: ImageDraw.ImageDraw,
    places: Float[Tensor, "n 3"],
    colors: Float[Tensor, "n 3"],
    radius_px: float,
) -> None:
    """Draw points as discs.

    Args:
        pen: draws into the picture.
        places: u and v [px] of each point, and its distance in any unit: near discs cover far ones.
        colors: RGB of each disc, 0..1.
        radius_px: radius of all discs.
    """
    far_to_near = places[:, 2].argsort(descending=True, stable=True)
    rgb = (255 * colors[far_to_near]).round().int().tolist()
    for (u, v, _), color in zip(places[far_to_near].tolist(), rgb, strict=True):
        box = (u - radius_px, v - radius_px, u + radius_px, v + radius_px)
        pen.ellipse(box, fill=tuple(color))


_SURFACE_POINTS = 4000
"""Points by which the model's surface is drawn."""
_MARGIN = 1.08
"""Side of the picture, in diameters of the model."""
_RADII_PER_SIDE = 110
"""Side of the picture, in radii of the discs of the cloud."""
_MIN_DISC_PX = 2.0
_AZIMUTH_OFFSET_RAD = math.radians(35)
_TILT_OFFSET_RAD = math.radians(20)
"""By which the view departs from the side that a cloud was seen from: sideways and upwards."""


@torch.inference_mode()
def compute_features(
    net: GeoPoseNet, pose_input: AnyInput
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n c"]] | None:
    """Compute the network's features before its last layer.

    Returns:
        The points that the network takes of the input [m, camera frame], and the features of each.
        None where the input cannot be posed.

    Raises:
        InputError: the weights are of another kind of network.
    """
    network = net.weights.network
    if not isinstance(network, ResUNet):
        raise InputError("figure 3-2 shows features of the sparse network; give weights of it")
    model = next(m for m in net.weights.models if m.name == pose_input.object)
    try:
        cloud = prepare_cloud(pose_input, model, net.weights.cloud, net.config)
    except Refused:
        return None
    grid = sample_and_voxelise(cloud.cloud_m, net.weights.cloud, net.config.voting.seed)
    coordinates = F.pad(grid.coordinates, (1, 0))  # all of cloud 0
    voxels = Voxels.from_points(coordinates, grid.features)
    return grid.points_m, network.features(voxels).at_points().float()


def draw_colored_cloud(
    points_m: Float[Tensor, "n 3"],
    value: Float[Tensor, " n"],
    model: ObjectModel,
    size_px: int = 400,
) -> Float[Tensor, "3 size size"]:
    """Draw a cloud in colours over its model in black, both in the model's frame.

    The projection is parallel, roughly from the side that the cloud was seen from, so that the
    cloud faces the viewer; the model's z axis is up. The cloud is drawn last, over the model.

    Args:
        points_m: the cloud, in the model's frame.
        value: of each point, 0 to 1, for its colour (:func:`spectral`).
        model: the object.
        size_px: width and height of the picture.
    """
    # Surface and cloud in the picture's pixels.
    surface_m = sample_surface(model, _SURFACE_POINTS)[0].double()
    centre_m = (surface_m.amin(0) + surface_m.amax(0)) / 2
    cloud_m = points_m.double()
    view_from_model = _look_at_cloud((cloud_m - centre_m).mean(0))
    scale = size_px / (_MARGIN * model.diameter_m)
    centre_px = torch.tensor([size_px / 2, size_px / 2, 0.0], dtype=torch.float64)
    surface_px = (surface_m - centre_m) @ view_from_model.T * scale + centre_px
    cloud_px = (cloud_m - centre_m) @ view_from_model.T * scale + centre_px

    # The cloud over the surface.
    canvas = Image.new("RGB", (size_px, size_px), "white")
    pen = ImageDraw.Draw(canvas)
    draw_discs(pen, surface_px, torch.zeros(len(surface_m), 3), 1.0)
    draw_discs(pen, cloud_px, spectral(value), max(_MIN_DISC_PX, size_px / _RADII_PER_SIDE))
    return rgb_from_pillow(canvas, "figure 3-2")


def _look_at_cloud(outward: Float64[Tensor, "3"]) -> Float64[Tensor, "3 3"]:
    """Make the rotation ``view_from_model`` of a view of the model's side towards ``outward``.

    The view is turned sideways and upwards from that side, and half as steep. Its axes are x right,
    y down, z forward.
    """
    x, y, z = outward.tolist()
    azimuth = math.atan2(y, x) + _AZIMUTH_OFFSET_RAD
    tilt = math.atan2(z, math.hypot(x, y)) * 0.5 + _TILT_OFFSET_RAD
    forward = -torch.tensor([
        math.cos(azimuth) * math.cos(tilt), math.sin(azimuth) * math.cos(tilt), math.sin(tilt),
    ], dtype=torch.float64)  # fmt: skip
    right = torch.tensor([-math.sin(azimuth), math.cos(azimuth), 0.0], dtype=torch.float64)
    return torch.stack([right, torch.linalg.cross(forward, right), forward])


_ARROWS = 220
"""Most directions that are drawn."""
_ARROW_PX = 22.0
"""Length of an arrow that lies in the plane of the picture."""
_BARB = 0.35
"""Length of the two lines of an arrow's head, as a share of the arrow."""
_STAR_TIPS = 5
_STAR_PX = (12, 5)
"""Outer and inner radius of the star."""
_CROSS_STROKES = (((255, 255, 255), 6, 11), ((217, 13, 13), 4, 9))
"""Colour, width and reach [px] of a red cross on a white one."""
_YELLOW = (242, 191, 0)
_ARROW_COLOR = (38, 64, 140)


def draw_directions(
    points_m: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    true_m: Float[Tensor, "3"],
    voted_m: Float[Tensor, "3"] | None = None,
    size_px: int = 480,
) -> Float[Tensor, "3 size size"]:
    """Draw directions of some points; a yellow star at the true keypoint, a red cross at the voted.

    All are in the camera frame, directions of unit length, and drawn in the plane of x and y: an
    arrow that points away from the viewer is short. The picture holds the cloud and both keypoints.

    Args:
        points_m: the points that vote.
        directions: the direction of each to the keypoint.
        true_m: the true keypoint.
        voted_m: the voted keypoint; None: none is drawn.
        size_px: width and height of the picture.
    """
    # The scale by which everything fits into the picture, with a margin for the arrows. Without a
    # voted keypoint the true one stands in its place, which changes nothing.
    keypoints_xy = torch.stack([true_m, true_m if voted_m is None else voted_m]).double()[:, :2]
    points_xy = points_m.double()[:, :2]
    all_xy = torch.cat([points_xy, keypoints_xy])
    low = all_xy.amin(0)
    high = all_xy.amax(0)
    scale = (size_px - 3 * _ARROW_PX) / float((high - low).max().clamp(min=1e-9))
    centre = (low + high) / 2
    points_px = (points_xy - centre) * scale + size_px / 2
    keypoints_px = (keypoints_xy - centre) * scale + size_px / 2

    # Arrows, and the keypoints over them.
    canvas = Image.new("RGB", (size_px, size_px), "white")
    pen = ImageDraw.Draw(canvas)
    starts = take_evenly(points_px, _ARROWS)
    shafts = _ARROW_PX * take_evenly(directions.double(), _ARROWS)[:, :2]
    for start, shaft in zip(starts.tolist(), shafts.tolist(), strict=True):
        _draw_arrow(pen, start, shaft)
    true_px, voted_px = keypoints_px.tolist()
    _draw_star(pen, true_px)
    if voted_m is not None:
        _draw_cross(pen, voted_px)
    return rgb_from_pillow(canvas, "figure 3-4")


def _draw_arrow(pen: ImageDraw.ImageDraw, start: Sequence[float], shaft: Sequence[float]) -> None:
    """Draw an arrow from a pixel along a vector [px]."""
    x, y = start
    dx, dy = shaft
    tip = (x + dx, y + dy)
    pen.line([(x, y), tip], _ARROW_COLOR)
    for side in (-0.5, 0.5):
        barb = (tip[0] - _BARB * (dx + side * dy), tip[1] - _BARB * (dy - side * dx))
        pen.line([tip, barb], _ARROW_COLOR)


def _draw_star(pen: ImageDraw.ImageDraw, centre: Sequence[float]) -> None:
    """Draw a yellow star about a pixel, a tip upwards."""
    x, y = centre
    corners: list[tuple[float, float]] = []
    for k in range(2 * _STAR_TIPS):
        angle = math.radians(180 / _STAR_TIPS * k - 90)
        radius = _STAR_PX[k % 2]
        corners.append((x + radius * math.cos(angle), y + radius * math.sin(angle)))
    pen.polygon(corners, fill=_YELLOW, outline=(0, 0, 0))


def _draw_cross(pen: ImageDraw.ImageDraw, centre: Sequence[float]) -> None:
    """Draw a red cross with a white border about a pixel."""
    u, v = centre
    for color, width, reach in _CROSS_STROKES:
        pen.line([(u - reach, v - reach), (u + reach, v + reach)], color, width)
        pen.line([(u - reach, v + reach), (u + reach, v - reach)], color, width)
