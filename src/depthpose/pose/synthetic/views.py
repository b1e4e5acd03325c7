"""Clean views of one object: drawn at a pose, or turned out of a view that was drawn before.

A camera that turns about its own centre sees the same surface points, along other rays. A stored
view is therefore a view from every direction of gaze, and only its pixels are interpolated: inverse
depth, which is linear in the picture of a plane, so that flat parts stay exact.

With the triangles that a camera may see of a model, and the box of their picture.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, KDTree, QhullError
from torch import Tensor

from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid, turn_axis_to
from depthpose.pose.types import ObjectModel

_CORNERS = 6
"""Of a disc: three quarters of its area, in four triangles."""
_REACH = 1.6
"""Radius of a disc, in spacings of its points: neighbours then overlap, and nothing shows through
where the points are twice as far apart as usual."""


def drawn_triangles(model: ObjectModel) -> Float[Tensor, "n 3 3"]:
    """Give the faces of a model, or a disc at each point of one that has no faces."""
    return model.triangles_m if len(model.faces) else surfel_triangles(model)


def surfel_triangles(model: ObjectModel) -> Float[Tensor, "n 3 3"]:
    """Lay a flat six-cornered disc on each point, across its normal (Pfister et al. 2000).

    Each is as large as its own neighbourhood is sparse: the distance to the third nearest point,
    but no more than twice the usual one, so that a stray point makes no plate.
    """
    points = model.vertices_m.double()
    distance, _ = KDTree(points.numpy()).query(points.numpy(), k=min(4, len(points)))
    spacing = torch.from_numpy(distance[:, -1])
    radius = _REACH * spacing.clamp(max=2 * float(spacing.median())) / 2**0.5
    normal = model.normals.double()
    # Any axis that is not along the normal.
    helper = torch.eye(3, dtype=torch.float64)[normal.abs().argmin(1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(normal, helper), dim=-1)
    second = torch.linalg.cross(normal, first)
    angle = 2 * math.pi * torch.arange(_CORNERS, dtype=torch.float64) / _CORNERS
    spokes = first[:, None] * angle.cos()[:, None] + second[:, None] * angle.sin()[:, None]
    corners = points[:, None] + radius[:, None, None] * spokes
    fan = torch.tensor([[0, i, i + 1] for i in range(1, _CORNERS - 1)])
    return corners[:, fan].flatten(0, 1).to(model.vertices_m)


def hull_points(triangles_m: Float[Tensor, "n 3 3"]) -> Float[Tensor, "m 3"]:
    """Give the corners of the convex hull: their picture's box is the whole object's."""
    points = triangles_m.reshape(-1, 3).double()
    try:
        return points[torch.from_numpy(ConvexHull(points.numpy()).vertices).long()]
    except (QhullError, ValueError):  # flat: every corner counts
        return points


MARGIN_PX = 8
"""Around the object: what lies behind it must be seen where a mask is too large."""
_JUMP = 0.02
"""Corners of a pixel whose depths differ by more than this share are not interpolated between."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """What is drawn of an object, about the middle of its bounding box.

    Attributes:
        triangles_m: in the model frame.
        hull_m: the corners of their convex hull, about the middle.
        middle_m: of the bounding box, in the model frame.
    """

    triangles_m: Float[Tensor, "n 3 3"]
    hull_m: Float[Tensor, "m 3"]
    middle_m: Float[Tensor, "3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class CleanView:
    """An object alone, without any error.

    Attributes:
        depth_m: of a window of the image; NaN beside the object.
        K: intrinsic matrix of the window.
        camera_from_model: the pose.
    """

    depth_m: Float[Tensor, "h w"]
    K: Float[Tensor, "3 3"]
    camera_from_model: Rigid


def make_shape(model: ObjectModel) -> Shape:
    """Prepare an object for many views."""
    triangles = drawn_triangles(model)
    corners = triangles.reshape(-1, 3).double()
    middle = (corners.amin(0) + corners.amax(0)) / 2
    return Shape(triangles_m=triangles, hull_m=hull_points(triangles) - middle, middle_m=middle)


def pose_of_middle(shape: Shape, R: Float[Tensor, "3 3"], middle_m: Float[Tensor, "3"]) -> Rigid:
    """Make the pose that turns the object by R and puts its middle at a place of the camera."""
    return Rigid(R, middle_m - R @ shape.middle_m)


def gaze(direction: Float[Tensor, "3"], roll_rad: float) -> Float[Tensor, "3 3"]:
    """Rotation that carries the optical axis to a direction, the shortest way, after a roll."""
    cosine, sine = math.cos(roll_rad), math.sin(roll_rad)
    roll = [[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]
    return turn_axis_to(direction) @ torch.tensor(roll, dtype=torch.float64)


def pixel_to_ray(K: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """Invert an intrinsic matrix without skew, in a tenth of the time of a general inverse."""
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    rows = [[1 / fx, 0, -cx / fx], [0, 1 / fy, -cy / fy], [0, 0, 1]]
    return torch.tensor(rows, dtype=torch.float64)


def window_of(
    shape: Shape, pose: Rigid, K: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, "3 3"], int, int]:
    """Cut the window in which an object lies, with a margin.

    Returns:
        Its intrinsic matrix, width and height.
    """
    corners = shape.hull_m @ pose.R.mT + (pose.t_m + pose.R @ shape.middle_m)
    pixels = (corners @ K.mT)[:, :2] / corners[:, 2:]
    left, top = (pixels.amin(0).floor() - MARGIN_PX).tolist()
    right, bottom = (pixels.amax(0).ceil() + MARGIN_PX).tolist()
    moved = K.clone()
    moved[0, 2] -= left
    moved[1, 2] -= top
    return moved, int(right - left) + 1, int(bottom - top) + 1


def draw_view(shape: Shape, pose: Rigid, K: Float[Tensor, "3 3"]) -> CleanView:
    """Draw an object, in the window around it."""
    moved, width, height = window_of(shape, pose, K)
    # float64 poses: the corners are rounded once.
    triangles = (shape.triangles_m.double() @ pose.R.mT + pose.t_m).float()
    raster = rasterize(triangles, moved, width, height, with_barycentric=False)
    return CleanView(depth_m=raster.depth_m, K=moved, camera_from_model=pose)


def turn_view(
    view: CleanView, turn: Float[Tensor, "3 3"], shape: Shape, K: Float[Tensor, "3 3"]
) -> CleanView:
    """See a view with the camera turned: ``x_new = turn @ x_old``.

    Args:
        view: drawn before.
        turn: ``new_from_old`` camera.
        shape: of the object, for the window.
        K: intrinsic matrix of the new image.
    """
    old = view.camera_from_model
    pose = Rigid(turn @ old.R, turn @ old.t_m)
    moved, width, height = window_of(shape, pose, K)
    # Homogeneous old pixels of the new grid, and how much longer the old ray is.
    ray_from_pixel = turn.mT @ pixel_to_ray(moved)
    (a, b, c), (d, e, f), (g, h, i) = (view.K @ ray_from_pixel).tolist()
    u, v = torch.arange(width)[None], torch.arange(height)[:, None]
    w = g * u + h * v + i
    stored = 1 / view.depth_m
    found = _interpolated(stored, (a * u + b * v + c) / w, (d * u + e * v + f) / w)
    return CleanView(depth_m=1 / (found * w), K=moved, camera_from_model=pose)


def silhouette_of(view: CleanView) -> Bool[Tensor, "h w"]:
    """Mark the pixels of the object."""
    return view.depth_m.isfinite()


def _interpolated(
    values: Float[Tensor, "h w"], u: Float[Tensor, "h2 w2"], v: Float[Tensor, "h2 w2"]
) -> Float[Tensor, "h2 w2"]:
    """Look up between pixels; at edges and beside the object the nearest pixel; NaN outside."""
    height, width = values.shape
    left, top = u.floor().clamp_(0, width - 2), v.floor().clamp_(0, height - 2)
    x, y = u - left, v - top
    index = (top * width + left).long()
    flat = values.reshape(-1)
    a, b = flat[index], flat[index + 1]
    c, d = flat[index + width], flat[index + width + 1]
    smooth = torch.lerp(torch.lerp(a, b, x), torch.lerp(c, d, x), y)
    nearest = torch.where(y < 0.5, torch.where(x < 0.5, a, b), torch.where(x < 0.5, c, d))
    # A comparison with NaN is false: where a corner sees nothing, the nearest decides.
    spread = torch.maximum(torch.maximum(a, b), torch.maximum(c, d)) - torch.minimum(
        torch.minimum(a, b), torch.minimum(c, d)
    )
    found = torch.where(spread < _JUMP * smooth, smooth, nearest)
    is_inside = (x - 0.5).abs().maximum((y - 0.5).abs()) <= 1
    return torch.where(is_inside, found, torch.nan)
