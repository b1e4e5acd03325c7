"""Every knob of the pose room's measures."""

from dataclasses import dataclass
from typing import Literal, get_args

from depthpose.core.errors import InputError, refuse_unknown

DiameterTable = Literal["bop", "pvnet"]
SymmetryRule = Literal["declared", "all"]


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """How estimates are held against the truth."""

    diameters: DiameterTable = "bop"
    """Whose diameters a success is a tenth of: those that the data set declares (``bop``), or
    PVNet's of LineMOD, which differ by up to 16 %."""

    adds: SymmetryRule = "declared"
    """Which objects are measured by ADD-S: those declared symmetric (of LineMOD eggbox and glue),
    or ``all``, as for YCB's, whose symmetries geometry alone cannot tell."""

    with_vsd: bool = True
    """Draw both poses for VSD, and so for BOP's average recall: the slowest of the errors."""

    vsd_delta_m: float = 0.015
    """How far a surface may lie behind the measured one and count as visible (ITODD: 0.005)."""

    def __post_init__(self) -> None:
        """Refuse other words, and a tolerance that is none."""
        refuse_unknown("diameters", self.diameters, get_args(DiameterTable))
        refuse_unknown("adds", self.adds, get_args(SymmetryRule))
        if not 0 < self.vsd_delta_m < 1:
            raise InputError(
                f"vsd_delta_m is {self.vsd_delta_m}, but it is a positive part of a metre; BOP "
                "takes 0.015"
            )
