"""Which sample of a posed surface a point of a cloud shows: what faces the camera alone is seen."""

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from depthpose.core.rigid import Rigid
from depthpose.pose.compiled import GRAZING, LOOKED_UP, ON_RAY, SLACK
from depthpose.pose.surface import Surface


def match(
    cloud_m: Float64[Tensor, "n 3"],
    pose: Rigid,
    surface: Surface,
    limit_m: float,
    how: int,
    before: Int64[Tensor, "*batch n"] | None = None,
) -> Int64[Tensor, "*batch n"]:
    """Give for each point the number of a sample of the surface that the camera may see, or -1.

    A sample is seen where its outer side faces the camera, or nearly; one without a known side
    always, and all where the camera is within a ball about the surface.

    Args:
        cloud_m: in the camera frame.
        pose: ``camera_from_model``, one or a batch.
        surface: of the model.
        limit_m: beyond it nothing is searched.
        how: ``LOOKED_UP``, by the table of boxes; ``SEARCHED``, the nearest; or ``ON_RAY``, the
            nearest to where the point's ray meets the plane of its sample ``before``.
        before: what was found a step earlier.
    """
    poses = Rigid(pose.R.reshape(-1, 3, 3), pose.t_m.reshape(-1, 3))
    local_m, eyes_m = poses.inverse().apply(cloud_m), poses.inverse().t_m[:, None]
    if how == LOOKED_UP:
        index = surface.boxes.look_up(local_m)
        index = torch.where(_is_seen(eyes_m, index, surface), index, surface.across[index])
        is_good = (index >= 0) & _is_seen(eyes_m, index, surface)
        return torch.where(is_good, index, -1).reshape(*pose.t_m.shape[:-1], -1)
    if how == ON_RAY and before is not None:
        own = before.reshape(local_m.shape[:2])
        ray_m, normal, point_m = local_m - eyes_m, surface.normals[own], surface.points_m[own]
        slope = (normal * ray_m).sum(-1, keepdim=True)
        share = (normal * (point_m - local_m)).sum(-1, keepdim=True) / slope
        is_met = slope.square() > GRAZING**2 * ray_m.square().sum(-1, keepdim=True)
        meet_m = torch.where(is_met, local_m + share * ray_m, point_m)
        local_m = torch.where(own[..., None] >= 0, meet_m, local_m)
    # Ask for ever more of the nearest samples until one is seen.
    count, total = 1, len(surface.points_m)
    index = torch.full(local_m.shape[:2], -1)
    which, place = (index < 0).nonzero(as_tuple=True)
    while len(which):
        asked = local_m[which, place].numpy()
        _, found = surface.tree.query(asked, k=range(1, count + 1), distance_upper_bound=limit_m)
        found = torch.from_numpy(found)
        is_some = found < total  # the tree's word for none within the limit
        found = found.clamp(max=total - 1)
        is_good = is_some & _is_seen(eyes_m[which, 0, None], found, surface)
        first, is_done = is_good.int().argmax(1), is_good.any(1)
        index[which[is_done], place[is_done]] = found[is_done, first[is_done]]
        is_left = ~is_done & is_some.all(1) & (count < total)
        which, place = which[is_left], place[is_left]
        count = min(8 * count, total)
    return index.reshape(*pose.t_m.shape[:-1], -1)


def _is_seen(
    eyes_m: Float64[Tensor, "b k 3"], index: Int64[Tensor, "b n"], surface: Surface
) -> Bool[Tensor, "b n"]:
    distance_m = (eyes_m - surface.ball_m[:3]).norm(dim=-1)
    toward_m = ((eyes_m - surface.points_m[index]) * surface.outward[index]).sum(-1)
    return (toward_m >= -SLACK * distance_m) | (distance_m <= surface.ball_m[3])
