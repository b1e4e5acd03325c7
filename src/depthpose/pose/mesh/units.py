"""Unit check: the commonest mistake with models and clouds, reported before anything runs."""

import math

from jaxtyping import Float
from torch import Tensor

_PER_METRE = {"mm": 1000.0, "cm": 100.0, "inches": 39.37}
_MM = {"cm": 10.0, "inches": 25.4}
_LARGEST_SHARE = 1.5
"""A cloud is part of its object; noise and a grown mask may make it somewhat larger."""
_SMALLEST_SHARE = 0.1
"""What is occluded to less than a tenth of the diameter cannot be posed anyway."""
_LIKELY_SHARE = 0.3
"""A cloud that is too large is taken for one of another unit if that makes it as long as this."""
_USUAL_SHARE, _AS_LIKELY = 0.7, 0.3
"""What is seen of an object is about so long; of units that give it within 35 % all are named."""


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
    more, larger, smaller = max(share, 1 / share), "model", "cloud"
    if share > 1:
        larger, smaller = smaller, larger
    # Five times too large is a mask of more than the object sooner than a sliver in inches.
    least = _LIKELY_SHARE if share > 1 else _SMALLEST_SHARE
    fits = {unit: share * factor if share < 1 else share / factor
            for unit, factor in _PER_METRE.items()}  # fmt: skip
    likely = {abs(math.log(fit / _USUAL_SHARE)): unit for unit, fit in fits.items()
              if least <= fit <= _LARGEST_SHARE}  # fmt: skip
    if likely:
        best = min(likely)
        units = " or ".join(unit for off, unit in likely.items() if off < best + _AS_LIKELY)
        return f"your {larger} is {more:.0f} times larger than the {smaller}: is it in {units}?"
    units = " or ".join(
        unit for unit, mm in _MM.items()
        if _LIKELY_SHARE <= (share * mm if share < 1 else share / mm) <= _LARGEST_SHARE
    )  # fmt: skip
    relation = "larger" if share > 1 else "smaller"
    return (
        f"the cloud is {more:.1f} times {relation} than the model: is this the right object, and "
        f"does the mask fit it?{f' Or is the {smaller} in {units}?' if units else ''}"
    )
