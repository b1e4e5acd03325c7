"""The order in which the objects of one image are picked: those that hide others go first."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from depthpose.pose.rendering import Rendering, render_surface
from depthpose.pose.surface import Surface
from depthpose.pose.types import PoseEstimate, ViewInput

_HIDDEN_SHARE = 0.02
"""Of a silhouette: where another object lies before more of it, that one is picked first."""


def rank_picks(
    estimates: Sequence[PoseEstimate], view: ViewInput, surfaces: Mapping[str, Surface]
) -> list[PoseEstimate]:
    """Rank the poses of one image by the order in which to pick the objects, 1 the first.

    The first is the object that no other hides with the greatest product of certainty and visible
    share; the next is chosen in the same way as if the first were gone.

    Args:
        estimates: of one image; one without a pose has no rank.
        view: the image.
        surfaces: of the objects, by their names.
    """
    # Every posed object, drawn into the image, and which others lie before it.
    drawings: dict[int, Rendering] = {}
    for number, estimate in enumerate(estimates):
        if estimate.camera_from_model is not None:
            surface = surfaces[estimate.object]
            pose = estimate.camera_from_model.double()
            drawings[number] = render_surface(surface, pose, view.K.double(), *view.depth_m.shape)
    occluders = _find_occluders(drawings, view.depth_m.shape)

    # The best of those that nothing hides, then the best of those that are left, and so on.
    ranks: dict[int, int] = {}
    remaining = set(drawings)
    while remaining:
        on_top = [k for k in remaining if not occluders[k] & remaining]
        # Where objects lie in a ring, each before the next, the best of all goes first.
        candidates = on_top or sorted(remaining)
        best = max(candidates, key=lambda k: (_weigh_certainty(estimates[k]), -k))
        ranks[best] = len(ranks) + 1
        remaining.remove(best)
    return [replace(estimate, pick_rank=ranks.get(k)) for k, estimate in enumerate(estimates)]


def _weigh_certainty(estimate: PoseEstimate) -> float:
    """Multiply certainty and visible share; 0 where one of them is not known."""
    return (estimate.certainty or 0.0) * (estimate.visible_share or 0.0)


def _find_occluders(
    drawings: Mapping[int, Rendering], shape: tuple[int, ...]
) -> dict[int, set[int]]:
    """Find for each drawn object those that lie before more of it than it does of them.

    Args:
        drawings: of the objects, in one image.
        shape: of the image.
    """
    occluders: dict[int, set[int]] = {number: set() for number in drawings}
    # One object at a time is drawn into the whole image, compared with all, and removed again.
    image_m = np.full(shape, np.nan)
    for other, other_drawing in drawings.items():
        image_m[other_drawing.window] = other_drawing.depth_m
        for number, drawing in drawings.items():
            gap_m = drawing.depth_m - image_m[drawing.window]
            hidden_px = (gap_m > 0).sum()
            hiding_px = (gap_m < 0).sum()
            drawn_px = np.isfinite(drawing.depth_m).sum()
            if hidden_px > max(hiding_px, _HIDDEN_SHARE * drawn_px):
                occluders[number].add(other)
        image_m[other_drawing.window] = np.nan
    return occluders
