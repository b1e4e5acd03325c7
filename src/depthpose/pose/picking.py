"""The order in which the objects of one image are picked: those that hide others go first."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from depthpose.pose.geometry.rendering import Rendering, render_surface
from depthpose.pose.geometry.surface import Surface
from depthpose.pose.types import PoseEstimate, ViewInput

_LEAST_HIDDEN_SHARE = 0.02
"""Share of a silhouette from which an object before it counts as hiding it."""


def rank_picks(
    estimates: Sequence[PoseEstimate], view: ViewInput, surfaces: Mapping[str, Surface]
) -> list[PoseEstimate]:
    """Return the estimates of one image with the order in which to pick the objects, 1 the first.

    The first is that with the greatest product of certainty and visible share among the objects
    that no other one hides; the next is chosen in the same way as if the first were gone.

    Args:
        estimates: of one image; one without a pose has no rank.
        view: the image.
        surfaces: of the objects, by their names.
    """
    # Every posed object, rendered into the image, and which others lie before it.
    renderings: dict[int, Rendering] = {}
    for number, estimate in enumerate(estimates):
        if estimate.camera_from_model is not None:
            surface = surfaces[estimate.object]
            pose = estimate.camera_from_model.double()
            renderings[number] = render_surface(surface, pose, view.K.double(), *view.depth_m.shape)
    occluders = _find_occluders(renderings, view.depth_m.shape)

    # The best of those that nothing hides, then the best of those that are left, and so on.
    ranks: dict[int, int] = {}
    remaining = set(renderings)
    while remaining:
        on_top = [k for k in remaining if not occluders[k] & remaining]
        # Where objects lie in a ring, each before the next, the best of all goes first.
        candidates = on_top or sorted(remaining)
        best = max(candidates, key=lambda k: (_score_pick(estimates[k]), -k))
        ranks[best] = len(ranks) + 1
        remaining.remove(best)
    return [replace(estimate, pick_rank=ranks.get(k)) for k, estimate in enumerate(estimates)]


def _score_pick(estimate: PoseEstimate) -> float:
    """Multiply certainty and visible share; 0 where one of them is not known."""
    return (estimate.certainty or 0.0) * (estimate.visible_share or 0.0)


def _find_occluders(
    renderings: Mapping[int, Rendering], shape: tuple[int, ...]
) -> dict[int, set[int]]:
    """Find the occluders of each object: those that hide more of it than it hides of them.

    Args:
        renderings: renderings of the objects in one image, by their numbers.
        shape: of the image.

    Returns:
        The numbers of the occluders of each object.
    """
    occluders: dict[int, set[int]] = {number: set() for number in renderings}
    # One object at a time is put into the whole image, compared with all, and removed again.
    image_m = np.full(shape, np.nan)
    for other, other_rendering in renderings.items():
        image_m[other_rendering.window] = other_rendering.depth_m
        for number, rendering in renderings.items():
            gap_m = rendering.depth_m - image_m[rendering.window]
            hidden_px = (gap_m > 0).sum()
            hiding_px = (gap_m < 0).sum()
            rendered_px = np.isfinite(rendering.depth_m).sum()
            if hidden_px > max(hiding_px, _LEAST_HIDDEN_SHARE * rendered_px):
                occluders[number].add(other)
        image_m[other_rendering.window] = np.nan
    return occluders
