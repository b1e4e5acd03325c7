"""Unit check: the commonest mistake with models and clouds, reported before anything runs."""

from jaxtyping import Float
from torch import Tensor

_FACTORS = {1000.0: "mm", 39.37: "inches"}
"""How many of a unit make a metre."""
_LARGEST_SHARE = 1.5
"""A cloud is part of its object; noise and a grown mask may make it somewhat larger."""
_SMALLEST_SHARE = 0.1
"""What is occluded to less than a tenth of the diameter cannot be posed anyway."""
_LIKELY_SHARE = 0.3
"""A cloud that is too large is taken for one of another unit if that makes it as long as this."""


def unit_advice(model_diameter_m: float, points_m: Float[Tensor, "n 3"]) -> str | None:
    """Say that the model and the cloud seem to be of different units; None where they agree.

    The size of a cloud is twice the distance from its median that 95 % of the points stay within:
    a few flying pixels do not change it.

    Args:
        model_diameter_m: of the model, in what was taken for metres.
        points_m: of the object, in what was taken for metres.
    """
    if len(points_m) < 2:
        return None
    distance_m = (points_m - points_m.median(0).values).norm(dim=-1)
    size_m = 2 * float(distance_m.kthvalue(1 + int(0.95 * (len(distance_m) - 1))).values)
    if size_m <= 0:
        return None
    share = size_m / model_diameter_m
    if _SMALLEST_SHARE <= share <= _LARGEST_SHARE:
        return None
    for factor, unit in _FACTORS.items():
        if _SMALLEST_SHARE <= share * factor <= _LARGEST_SHARE:
            return f"your model is {1 / share:.0f} times larger than the cloud: is it in {unit}?"
        # Five times too large is a mask of more than the object sooner than a sliver in inches.
        if _LIKELY_SHARE <= share / factor <= _LARGEST_SHARE:
            return f"your cloud is {share:.0f} times larger than the model: is it in {unit}?"
    relation = "larger" if share > 1 else "smaller"
    return (
        f"the cloud is {max(1 / share, share):.1f} times {relation} than the model: is this the "
        "right object, and does the mask fit it?"
    )
