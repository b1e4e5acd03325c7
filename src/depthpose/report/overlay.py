"""A posed object over the picture that it was seen in, and beside the cloud, flat and in 3D."""

import math

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import project
from depthpose.core.draw import draw_lines, draw_outline
from depthpose.core.files import Cloud, read_depth_png, read_image
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid
from depthpose.pose.datasets import Instance
from depthpose.pose.mesh import sample_surface
from depthpose.pose.synthetic import drawn_triangles
from depthpose.pose.types import ObjectModel, PoseEstimate
from depthpose.report.scene import Layer, colored_lines, frame_axes

Color = tuple[float, float, float]
FOUND: Color = (0.15, 0.35, 1.0)
"""Of an estimate: blue."""
TRUE: Color = (0.1, 0.8, 0.2)
"""Of the truth: green."""
VOTED: Color = (1.0, 0.55, 0.1)
"""Of keypoints as voted: orange."""
OTHER: Color = (0.6, 0.3, 0.85)
"""Of an alternative: violet."""
_SURFACE = 5000
_BEND = math.radians(30)
_CROSS = 0.04
"""Half of the mark of a keypoint, in diameters of the object."""
_VOTES = 40
"""Points whose votes are drawn."""
_DASH_PX = 6.0


def picture_of(instance: Instance) -> Float[Tensor, "3 h w"]:
    """Read the picture of an instance, or its depth in grey where there is none."""
    if instance.rgb is not None:
        return read_image(instance.rgb)
    return grey_depth(read_depth_png(instance.depth, instance.depth_unit_m))


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
    pose = pose.double()
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


def crease_edges(model: ObjectModel) -> Float[Tensor, "n 2 3"]:
    """Give both ends of the edges where the surface ends, or bends by more than 30 degrees [m]."""
    # By place, not by number: STL repeats the points of every face.
    places_m, place = torch.unique(model.vertices_m, dim=0, return_inverse=True)
    corners = place[model.faces]
    side = torch.cat([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]).sort(-1).values
    edges, which, count = torch.unique(side, dim=0, return_inverse=True, return_counts=True)
    a, b, c = model.triangles_m.double().unbind(1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    total = normal.new_zeros(len(edges), 3).index_add_(0, which, normal.repeat(3, 1))
    # Two unit normals at an angle have a mean as long as the cosine of half of it.
    is_bent = total.norm(dim=-1) / count < math.cos(_BEND / 2)
    return places_m[edges[is_bent | (count == 1)]]


def pose_layers(
    pose: Rigid, model: ObjectModel, *, is_true: bool = False, with_box: bool = False
) -> list[Layer]:
    """Show a posed object in space: surface, edges, box and axes; the truth by edges and box.

    Args:
        pose: ``camera_from_model``.
        model: the object.
        is_true: draw it as the truth beside an estimate.
        with_box: whether an estimate's box is seen at first; that of a truth is.
    """
    pose = pose.double()

    def posed(ends_m: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n 2 3"]:
        return pose.apply(ends_m.double().flatten(0, 1)).unflatten(0, (-1, 2)).float()

    box_m = posed(box_edges(model))
    edges_m = posed(crease_edges(model)) if len(model.faces) else None
    if is_true:
        layers = [Layer(name="true box", shape=colored_lines(box_m, TRUE))]
        if edges_m is not None:
            layers.append(Layer(name="true edges", shape=colored_lines(edges_m, TRUE)))
        return layers
    layers = [Layer(name="posed model", shape=posed_cloud(torch.empty(0, 3), pose, model))]
    if edges_m is not None:
        layers.append(Layer(name="its edges", shape=colored_lines(edges_m, FOUND)))
    axes = frame_axes(pose.t_m, pose.R, model.diameter_m / 2)
    box = Layer(name="its box", shape=colored_lines(box_m, FOUND), is_shown=with_box)
    return [*layers, box, Layer(name="its axes (x red, y green, z blue)", shape=axes)]


def alternative_layers(found: PoseEstimate, model: ObjectModel) -> list[Layer]:
    """Show each alternative by its axes and its box, not shown at first."""
    layers: list[Layer] = []
    for other in found.alternatives:
        pose = other.camera_from_model.double()
        ends_m = pose.apply(box_edges(model).double().flatten(0, 1)).unflatten(0, (12, 2)).float()
        said = f"{other.difference}, {other.probability:.0%}"
        box = colored_lines(ends_m, OTHER)
        layers.append(Layer(name=f"box if {said}", shape=box, is_shown=False))
        axes = frame_axes(pose.t_m, pose.R, model.diameter_m / 2)
        layers.append(Layer(name=f"axes if {said}", shape=axes, is_shown=False))
    return layers


def keypoint_layers(
    voted_m: Float[Tensor, "k 3"], pose: Rigid | None, model: ObjectModel
) -> list[Layer]:
    """Show the keypoints as voted, and as the posed model has them.

    Args:
        voted_m: in the camera frame.
        pose: ``camera_from_model``; None where it was refused.
        model: the object.
    """
    half_m = _CROSS * model.diameter_m
    marks = colored_lines(_crosses(voted_m, half_m), VOTED)
    layers = [Layer(name="keypoints, voted", shape=marks)]
    if pose is not None:
        own_m = pose.apply(model.keypoints_m.to(pose.R))
        own = colored_lines(_crosses(own_m, half_m), FOUND)
        layers.append(Layer(name="keypoints, of the posed model", shape=own))
    return layers


def vote_layer(
    points_m: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n k 3"],
    voted_m: Float[Tensor, "k 3"],
) -> Layer:
    """Show votes: from some points, along the direction, to where it passes its keypoint.

    Args:
        points_m: that vote.
        directions: to each keypoint, of any length.
        voted_m: the voted keypoints.
    """
    from_m, toward = take_evenly(points_m, _VOTES), take_evenly(directions, _VOTES)
    toward = torch.nn.functional.normalize(toward, dim=-1)
    way_m = ((voted_m - from_m[:, None]) * toward).sum(-1, keepdim=True).clamp(min=0)
    starts_m = from_m[:, None].expand_as(toward)
    ends_m = torch.stack([starts_m, starts_m + way_m * toward], -2).flatten(0, 1)
    return Layer(name="votes", shape=colored_lines(ends_m.float(), VOTED), is_shown=False)


def _crosses(at_m: Float[Tensor, "k 3"], half_m: float) -> Float[Tensor, "n 2 3"]:
    arms_m = half_m * torch.eye(3).to(at_m)
    ends_m = torch.stack([at_m[:, None] - arms_m, at_m[:, None] + arms_m], 2)
    return ends_m.flatten(0, 1).float()


def posed_cloud(cloud_m: Float[Tensor, "n 3"], pose: Rigid | None, model: ObjectModel) -> Cloud:
    """Put the posed surface beside the cloud: what was seen is grey, the model blue.

    Without a pose, the cloud alone.
    """
    if pose is None:
        return Cloud(points=cloud_m.float(), color=torch.full((len(cloud_m), 3), 0.6))
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
