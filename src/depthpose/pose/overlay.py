"""A posed object over the picture that it was seen in, and beside the cloud."""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.camera import project
from depthpose.core.draw import draw_lines, draw_outline
from depthpose.core.files import Cloud
from depthpose.core.raster import rasterize
from depthpose.core.rigid import Rigid
from depthpose.pose.mesh import sample_surface
from depthpose.pose.objects import drawn_triangles
from depthpose.pose.types import ObjectModel

Color = tuple[float, float, float]
FOUND: Color = (0.15, 0.35, 1.0)
"""Of an estimate: blue."""
TRUE: Color = (0.1, 0.8, 0.2)
"""Of the truth: green."""
_SURFACE = 5000
_DASH_PX = 6.0


def draw_pose(
    image: Float[Tensor, "3 h w"],
    pose: Rigid,
    model: ObjectModel,
    K: Float64[Tensor, "3 3"],
    *,
    is_true: bool = False,
) -> Float[Tensor, "3 h w"]:
    """Draw the projected box of a posed object, and the border of its silhouette.

    Args:
        image: of the camera; it is not changed.
        pose: ``camera_from_model``.
        model: the object; one of points alone is drawn by small discs.
        K: intrinsic matrix of the image.
        is_true: draw the box alone, green and dashed, as the truth beside an estimate; an estimate
            is blue.
    """
    pose = Rigid(pose.R.double(), pose.t_m.double())
    ends_m = pose.apply(box_edges(model).double().flatten(0, 1))
    ends_px = project(ends_m, K).unflatten(0, (12, 2))
    if is_true:
        return draw_lines(image, ends_px, TRUE, dash_px=_DASH_PX)
    triangles = drawn_triangles(model).double()
    moved = pose.apply(triangles.flatten(0, 1)).unflatten(0, (-1, 3))
    seen = rasterize(moved, K, image.shape[2], image.shape[1], with_barycentric=False)
    return draw_lines(draw_outline(image, seen.depth_m.isfinite(), FOUND), ends_px, FOUND)


def box_edges(model: ObjectModel) -> Float[Tensor, "12 2 3"]:
    """Give both ends of the edges of the model's box, along its axes [m]."""
    low, high = model.vertices_m.amin(0), model.vertices_m.amax(0)
    corners = torch.cartesian_prod(*torch.stack([low, high], -1))
    pairs = [(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit]
    return corners[torch.tensor(pairs)]


def posed_cloud(cloud_m: Float[Tensor, "n 3"], pose: Rigid, model: ObjectModel) -> Cloud:
    """Put the posed surface beside the cloud: what was seen is grey, the model blue."""
    surface_m = pose.apply(sample_surface(model, _SURFACE)[0].to(pose.R))
    colors = [torch.full((len(cloud_m), 3), 0.6), torch.tensor(FOUND).expand(len(surface_m), 3)]
    return Cloud(points=torch.cat([cloud_m.float(), surface_m.float()]), color=torch.cat(colors))


def grey_depth(depth_m: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    """Show depth by its grey, near bright and far dark, black where nothing was read.

    From the 1st to the 99th percentile of the readings: a stray one does not set the scale.
    """
    seen = depth_m[depth_m.isfinite() & (depth_m > 0)].sort().values
    if len(seen) == 0:
        return torch.zeros(3, *depth_m.shape)
    last = len(seen) - 1
    low, high = float(seen[round(0.01 * last)]), float(seen[round(0.99 * last)])
    share = 1 - ((depth_m - low) / max(high - low, 1e-6)).clamp(0, 1)
    grey = torch.where(depth_m > 0, 0.15 + 0.85 * share, 0.0)
    return grey.nan_to_num(0.0).float().expand(3, -1, -1)
