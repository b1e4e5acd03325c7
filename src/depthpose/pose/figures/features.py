"""Figure 3-2: what the network makes of each point, as a colour, on the posed cloud."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.pose.estimator import GeoPoseNet
from depthpose.pose.estimator.prepare import AnyInput, Refusal, prepare_cloud
from depthpose.pose.figures.canvas import blank, draw_discs, spectral
from depthpose.pose.mesh import sample_surface
from depthpose.pose.network import ResUNet
from depthpose.pose.sparse import Voxels
from depthpose.pose.types import ObjectModel

_SURFACE = 4000
_MARGIN = 1.08
_TURN_RAD, _TILT_RAD = math.radians(35), math.radians(20)
"""From where models are looked at: from the side and somewhat from above."""


@torch.inference_mode()
def seen_points(
    net: GeoPoseNet, given: AnyInput
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n c"]] | None:
    """Give the points that the network sees of an input, and its features of them.

    Returns:
        Points in the camera frame, and the features before the last layer; None where the input
        cannot be posed.

    Raises:
        InputError: the weights are of another kind.
    """
    network = net.weights.network
    if not isinstance(network, ResUNet):
        raise InputError("figure 3-2 shows features of the sparse network; give weights of it")
    model = next(m for m in net.weights.models if m.name == given.object)
    prepared = prepare_cloud(given, model, net.weights.cloud, net.config)
    if isinstance(prepared, Refusal):
        return None
    grid = prepared.voxels
    rows = torch.cat([torch.zeros_like(grid.coordinates[:, :1]), grid.coordinates], 1)
    voxels = Voxels.from_points(rows, grid.features)
    return prepared.points_m, network.point_features(voxels).float()


def draw_features(
    points_m: Float[Tensor, "n 3"],
    share: Float[Tensor, " n"],
    model: ObjectModel,
    size_px: int = 400,
) -> Float[Tensor, "3 size size"]:
    """Draw a cloud in the frame of its model, which is black.

    Looked at along parallel lines from the side that the cloud was seen from, so that the model
    does not hide it; the model's z axis is up.

    Args:
        points_m: in the model frame.
        share: 0..1 for each point: its colour in the Spectral scale.
        model: the object.
        size_px: side of the picture.
    """
    surface_m = sample_surface(model, _SURFACE)[0].double()
    middle_m = (surface_m.amin(0) + surface_m.amax(0)) / 2
    view = _view_of(points_m.double() - middle_m)
    scale = size_px / (_MARGIN * model.diameter_m)
    image = blank(size_px, size_px)
    black = torch.zeros(len(surface_m), 3)
    image = draw_discs(image, _places(surface_m - middle_m, view, scale, size_px), black, 1.0)
    places = _places(points_m.double() - middle_m, view, scale, size_px)
    return draw_discs(image, places, spectral(share), max(2.0, size_px / 110))


def _view_of(points: Float[Tensor, "n 3"]) -> Float[Tensor, "3 3"]:
    """Rows: right, down and forward of a view from the side where the points lie."""
    out = points.mean(0)
    azimuth = math.atan2(float(out[1]), float(out[0])) + _TURN_RAD
    level = math.hypot(float(out[0]), float(out[1]))
    tilt = math.atan2(float(out[2]), level) * 0.5 + _TILT_RAD
    forward = -torch.tensor([
        math.cos(azimuth) * math.cos(tilt), math.sin(azimuth) * math.cos(tilt), math.sin(tilt),
    ], dtype=torch.float64)  # fmt: skip
    right = torch.tensor([-math.sin(azimuth), math.cos(azimuth), 0.0], dtype=torch.float64)
    return torch.stack([right, torch.linalg.cross(forward, right), forward])


def _places(
    points: Float[Tensor, "n 3"], view: Float[Tensor, "3 3"], scale: float, size_px: int
) -> Float[Tensor, "n 3"]:
    seen = points @ view.T * scale
    return seen + torch.tensor([size_px / 2, size_px / 2, 0.0], dtype=torch.float64)
