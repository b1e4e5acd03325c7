"""Figures 3-2 (features as colours on the posed cloud) and 3-4 (directions to a keypoint).

Features become colours by exact t-SNE onto a line (van der Maaten, Hinton 2008).
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Float64
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.arrays import take_evenly
from depthpose.core.errors import InputError
from depthpose.core.files.images import picture_tensor
from depthpose.pose.cloud import prepare_cloud, sample_and_voxelise
from depthpose.pose.mesh import sample_surface
from depthpose.pose.network import ResUNet
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.sparse import Voxels
from depthpose.pose.types import AnyInput, ObjectModel, Refusal

_GAP_PX = 8

# Spectral of ColorBrewer (Brewer, 2003): red over yellow to blue.
_SPECTRAL = (
    (158, 1, 66), (213, 62, 79), (244, 109, 67), (253, 174, 97), (254, 224, 139), (255, 255, 191),
    (230, 245, 152), (171, 221, 164), (102, 194, 165), (50, 136, 189), (94, 79, 162),
)  # fmt: skip


def spectral(share: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
    """Colour numbers from 0 (red) over the middle (yellow) to 1 (blue)."""
    anchors = torch.tensor(_SPECTRAL, dtype=torch.float32) / 255
    position = share.float().clamp(0, 1) * (len(anchors) - 1)
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
    cells = [F.pad(p, (0, width - p.shape[2], 0, height - p.shape[1]), value=1.0) for p in pictures]
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
    """Draw points as discs of colours in [0, 1].

    ``places`` are (u, v) in pixels and the distance: near ones cover far ones.
    """
    order = places[:, 2].argsort(descending=True, stable=True)
    inks = (255 * colors[order]).round().int().tolist()
    for (u, v, _), ink in zip(places[order].tolist(), inks, strict=True):
        box = (u - radius_px, v - radius_px, u + radius_px, v + radius_px)
        pen.ellipse(box, fill=tuple(ink))


_SURFACE = 4000
_MARGIN = 1.08
_TURN_RAD = math.radians(35)
_TILT_RAD = math.radians(20)
"""From where models are looked at: from the side and somewhat from above."""


@torch.inference_mode()
def featured_points(
    net: GeoPoseNet, pose_input: AnyInput
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n c"]] | None:
    """Give the points that the network sees, in the camera frame, and its features of them.

    The features are those before the last layer; None where the input cannot be posed.
    """
    network = net.weights.network
    if not isinstance(network, ResUNet):
        raise InputError("figure 3-2 shows features of the sparse network; give weights of it")
    model = next(m for m in net.weights.models if m.name == pose_input.object)
    cloud = prepare_cloud(pose_input, model, net.weights.cloud, net.config)
    if isinstance(cloud, Refusal):
        return None
    grid = sample_and_voxelise(cloud.cloud_m, net.weights.cloud, net.config.voting.seed)
    rows = F.pad(grid.coordinates, (1, 0))
    voxels = Voxels.from_points(rows, grid.features)
    return grid.points_m, network.features(voxels).at_points().float()


def draw_features(
    points_m: Float[Tensor, "n 3"],
    share: Float[Tensor, " n"],
    model: ObjectModel,
    size_px: int = 400,
) -> Float[Tensor, "3 size size"]:
    """Draw a cloud in the frame of its model, which is black, each point's share as its colour.

    Looked at along parallel lines from the side that the cloud was seen from, so that the model
    does not occlude it; the model's z axis is up.
    """
    surface_m = sample_surface(model, _SURFACE)[0].double()
    middle_m = (surface_m.amin(0) + surface_m.amax(0)) / 2
    out = (points_m.double() - middle_m).mean(0)  # the side that the cloud was seen from
    azimuth = math.atan2(float(out[1]), float(out[0])) + _TURN_RAD
    level = math.hypot(float(out[0]), float(out[1]))
    tilt = math.atan2(float(out[2]), level) * 0.5 + _TILT_RAD
    forward = -torch.tensor([
        math.cos(azimuth) * math.cos(tilt), math.sin(azimuth) * math.cos(tilt), math.sin(tilt),
    ], dtype=torch.float64)  # fmt: skip
    right = torch.tensor([-math.sin(azimuth), math.cos(azimuth), 0.0], dtype=torch.float64)
    view_from_model = torch.stack([right, torch.linalg.cross(forward, right), forward])
    scale = size_px / (_MARGIN * model.diameter_m)
    centre_px = torch.tensor([size_px / 2, size_px / 2, 0.0], dtype=torch.float64)
    back, front = (
        (of_m - middle_m) @ view_from_model.T * scale + centre_px
        for of_m in (surface_m, points_m.double())
    )
    canvas = Image.new("RGB", (size_px, size_px), "white")
    pen = ImageDraw.Draw(canvas)
    draw_discs(pen, back, torch.zeros(len(surface_m), 3), 1.0)
    draw_discs(pen, front, spectral(share), max(2.0, size_px / 110))
    return picture_tensor(canvas, "figure 3-2")


_ARROWS = 220
_ARROW_PX = 22.0
_HEAD = 0.35
_YELLOW = (242, 191, 0)
_RED = (217, 13, 13)
_INK = (38, 64, 140)
_WHITE = (255, 255, 255)


def draw_field(
    points_m: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    true_m: Float[Tensor, "3"],
    voted_m: Float[Tensor, "3"] | None = None,
    size_px: int = 480,
) -> Float[Tensor, "3 size size"]:
    """Draw directions of some points; a yellow star at the true keypoint, a red cross at the voted.

    All are in the camera frame, directions of unit length. An arrow is as long as its direction
    lies in the plane: one that points away from the viewer is short. The part that is shown holds
    the cloud and both keypoints.
    """
    marks = torch.stack([true_m, true_m if voted_m is None else voted_m]).double()[:, :2]
    plane = points_m.double()[:, :2]
    everything = torch.cat([plane, marks])
    low = everything.amin(0)
    high = everything.amax(0)
    scale = (size_px - 3 * _ARROW_PX) / float((high - low).max().clamp(min=1e-9))
    middle = (low + high) / 2
    plane, marks = ((xy - middle) * scale + size_px / 2 for xy in (plane, marks))
    canvas = Image.new("RGB", (size_px, size_px), "white")
    pen = ImageDraw.Draw(canvas)
    starts = take_evenly(plane, _ARROWS)
    shafts = take_evenly(directions.double(), _ARROWS)
    shafts = _ARROW_PX * shafts[:, :2]
    for (x, y), (dx, dy) in zip(starts.tolist(), shafts.tolist(), strict=True):
        tip = (x + dx, y + dy)
        pen.line([(x, y), tip], _INK)
        for side in (-0.5, 0.5):
            barb = tip[0] - _HEAD * (dx + side * dy), tip[1] - _HEAD * (dy - side * dx)
            pen.line([tip, barb], _INK)
    (x, y), (u, v) = marks.tolist()
    rim = [(math.radians(36 * k - 90), 5 if k % 2 else 12) for k in range(10)]
    star = [(x + reach * math.cos(way), y + reach * math.sin(way)) for way, reach in rim]
    pen.polygon(star, fill=_YELLOW, outline=(0, 0, 0))
    for ink, width, reach in ((_WHITE, 6, 11), (_RED, 4, 9)) if voted_m is not None else ():
        pen.line([(u - reach, v - reach), (u + reach, v + reach)], ink, width)
        pen.line([(u - reach, v + reach), (u + reach, v - reach)], ink, width)
    return picture_tensor(canvas, "figure 3-4")


_STEPS = 300
_EXAGGERATED = 100
"""First steps, in which neighbours attract each other twelve times as much: groups form early."""
_EXAGGERATION = 12.0
_SEARCH = 40


def embed_line(features: Float[Tensor, "n c"], perplexity: float = 40.0) -> Float64[Tensor, " n"]:
    """Map features to numbers from 0 to 1, so that alike features get near numbers.

    Begins along the principal component, and so always gives the same answer; gradient descent
    with momentum and gains. Time and memory grow with the square of ``n``: thousands, not more.

    A point has about ``perplexity`` neighbours.

    Raises:
        InputError: there are fewer points than three neighbourhoods.
    """
    if not 1 <= perplexity < math.inf:
        raise InputError(f"t-SNE with a perplexity of {perplexity:g}: take 5 to 50, at least 1")
    if len(features) < 3 * perplexity:
        raise InputError(
            f"t-SNE of {len(features)} points with a perplexity of {perplexity:g}: give three "
            "times as many points, or a smaller perplexity"
        )
    P = joint_probabilities(features, perplexity)
    centred = features.double() - features.double().mean(0)
    y = centred @ torch.linalg.svd(centred, full_matrices=False)[2][0]
    y = 1e-4 * y / y.std().clamp(min=1e-12)
    speed = torch.zeros_like(y)
    gain = torch.ones_like(y)
    # A larger one than the curvature at the start allows tears groups apart, and on a line they
    # never come together again.
    rate = len(y) / (4 * _EXAGGERATION)
    for step in range(_STEPS):
        is_early = step < _EXAGGERATED
        gradient = kl_gradient(P * (_EXAGGERATION if is_early else 1.0), y)
        agrees = gradient.sign() != speed.sign()
        gain = torch.where(agrees, gain + 0.2, gain * 0.8).clamp(min=0.01)
        speed = (0.5 if is_early else 0.8) * speed - rate * gain * gradient
        y = y + speed
    low = y.amin()
    high = y.amax()
    return (y - low) / (high - low).clamp(min=1e-12)


def joint_probabilities(
    features: Float[Tensor, "n c"], perplexity: float
) -> Float64[Tensor, "n n"]:
    """Give the similarity of each pair: Gaussian neighbourhoods of equal perplexity, symmetric."""
    x = features.double()
    squares = torch.cdist(x, x, compute_mode="donot_use_mm_for_euclid_dist").square()
    squares.fill_diagonal_(torch.inf)
    near = squares.amin(1, keepdim=True)
    shifted = squares - near  # the nearest counts 1, so nothing vanishes
    low = torch.full_like(near, 1e-12)
    high = torch.full_like(near, 1e12)
    for _ in range(_SEARCH):
        precision = (low * high).sqrt()
        rows = torch.exp(-shifted * precision)
        total = rows.sum(1, keepdim=True)
        mean = torch.where(rows > 0, shifted * rows, 0).sum(1, keepdim=True) / total
        is_wide = total.log() + precision * mean > math.log(perplexity)  # entropy over its limit
        low = torch.where(is_wide, precision, low)
        high = torch.where(is_wide, high, precision)
    rows = torch.exp(-shifted * high)
    rows = rows / rows.sum(1, keepdim=True)
    return (rows + rows.T) / (2 * len(x))


def kl_gradient(P: Float64[Tensor, "n n"], y: Float64[Tensor, " n"]) -> Float64[Tensor, " n"]:
    """Gradient of the divergence of P from the Student neighbourhoods of y."""
    gap = y[:, None] - y
    near = 1 / (1 + gap.square())
    near.fill_diagonal_(0)
    return 4 * ((P - near / near.sum()) * near * gap).sum(1)
