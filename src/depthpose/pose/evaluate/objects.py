"""What a success means for an object: which diameter, and which of the two ADDs."""

from depthpose.core.errors import InputError
from depthpose.pose.config import EvaluationConfig
from depthpose.pose.types import ObjectModel

PVNET_DIAMETERS_M = {
    1: 0.097430, 2: 0.286908, 4: 0.171593, 5: 0.193416, 6: 0.152633, 8: 0.259425, 9: 0.107131,
    10: 0.176364, 11: 0.164857, 12: 0.148204, 13: 0.303153, 14: 0.285155, 15: 0.208394,
}  # fmt: skip
"""Of LineMOD's 13 objects by BOP's number, as PVNet's published evaluation has them."""

_OTHER_DATA_SET = 0.25


def diameter_of(model: ObjectModel, config: EvaluationConfig) -> float:
    """Give the diameter [m] that the thresholds are shares of.

    Raises:
        InputError: PVNet's table is asked for an object that it does not have.
    """
    if config.diameters == "bop":
        return model.diameter_m
    printed_m = PVNET_DIAMETERS_M.get(model.number, 0.0)
    if abs(printed_m / model.diameter_m - 1) > _OTHER_DATA_SET:
        raise InputError(
            f"object {model.number} ({model.name}) has a diameter of {model.diameter_m:.3f} m, "
            "which is no object of PVNet's table of LineMOD; take the data set's diameters, bop"
        )
    return printed_m


def is_adds(model: ObjectModel, config: EvaluationConfig) -> bool:
    """Whether an object is measured by ADD-S."""
    return config.adds == "all" or not model.symmetries.is_none
