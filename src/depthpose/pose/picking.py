"""In which order the objects of one image are picked: what lies before another goes first."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from depthpose.pose.evidence import draw_surface
from depthpose.pose.surface import Surface
from depthpose.pose.types import PoseEstimate, ViewInput

_HIDES = 0.02
"""Of a silhouette: where another object lies before so much of it, that one is to go first."""

_Drawing = tuple[np.ndarray, tuple[slice, slice]]


def with_pick_ranks(
    estimates: Sequence[PoseEstimate], view: ViewInput, surfaces: Mapping[str, Surface]
) -> list[PoseEstimate]:
    """Rank the poses of one image: visible, on top, sure.

    First of all is the object of the greatest product of certainty and visible share before which
    no other lies; the next is chosen in the same way as if the first were gone.

    Args:
        estimates: of one image; what has no pose has no rank.
        view: the image.
        surfaces: of the objects, by their names.
    """
    drawings: dict[int, _Drawing] = {}
    for number, estimate in enumerate(estimates):
        if estimate.camera_from_model is not None:
            surface = surfaces[estimate.object]
            pose = estimate.camera_from_model.double()
            drawn_m, _, window = draw_surface(surface, pose, view.K.double(), *view.depth_m.shape)
            drawings[number] = drawn_m, window
    hidden_by = _hidden_by(drawings, view.depth_m.shape)
    ranks: dict[int, int] = {}
    remaining = set(drawings)
    while remaining:
        # Of a ring of objects, each of which lies before the next, the best may go first.
        on_top = [k for k in remaining if not hidden_by[k] & remaining] or sorted(remaining)
        best = max(on_top, key=lambda k: (_promise(estimates[k]), -k))
        ranks[best] = len(ranks) + 1
        remaining.remove(best)
    return [replace(estimate, pick_rank=ranks.get(k)) for k, estimate in enumerate(estimates)]


def _promise(estimate: PoseEstimate) -> float:
    """Certainty times visible share; 0 where one of them is not known."""
    return (estimate.certainty or 0.0) * (estimate.visible_share or 0.0)


def _hidden_by(drawings: Mapping[int, _Drawing], shape: tuple[int, ...]) -> dict[int, set[int]]:
    """Give for each drawn object those that lie before more of it than it does of them.

    Args:
        drawings: depth, NaN where nothing is drawn, and its rows and columns in the image.
        shape: of the image.
    """
    hidden_by: dict[int, set[int]] = {number: set() for number in drawings}
    image_m = np.full(shape, np.nan)
    for other, (other_m, other_window) in drawings.items():
        image_m[other_window] = other_m
        for number, (drawn_m, window) in drawings.items():
            gap_m = drawn_m - image_m[window]
            before_px = (gap_m > 0).sum()
            behind_px = (gap_m < 0).sum()
            if before_px > max(behind_px, _HIDES * np.isfinite(drawn_m).sum()):
                hidden_by[number].add(other)
        image_m[other_window] = np.nan
    return hidden_by
