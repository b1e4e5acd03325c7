"""Units of length of files and users."""

from typing import Literal

from depthpose.core.errors import refuse_unknown

Unit = Literal["m", "cm", "mm"]
"""Unit of the lengths in a model, a cloud, a depth image or a calibration."""

METRES: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Length of each unit [m]."""


def metres_of(unit: str) -> float:
    """Return the length of a unit [m].

    Raises:
        InputError: ``unit`` is none of m, cm and mm.
    """
    if unit not in METRES:
        refuse_unknown("unit", unit, METRES)
    return METRES[unit]
