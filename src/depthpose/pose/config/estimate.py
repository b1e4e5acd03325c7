"""Settings of an estimate and of the metrics: when a pose is withheld, when it is right."""

from dataclasses import dataclass, field
from typing import Literal, get_args

from depthpose.core.errors import InputError, refuse_unknown
from depthpose.pose.config.geometry import IcpConfig, VotingConfig

_CANDIDATE_SLOPES = {
    "tilt": 1.52,
    "gap": 0.78,
    "far": 2.02,
    "front": 1.43,
    "unseen": 0.75,
    "disagree": 0.77,
}
"""Of a conditional logit on synthetic views of all shipped objects, regularised by a ridge
(``bench/pose_candidates.py``): how likely each of several poses is that fit."""


@dataclass(frozen=True, kw_only=True)
class RefusalConfig:
    """When an estimate is withheld: one risk of being wrong, from signals that need no truth."""

    max_risk: float = 0.5
    """An estimate of a larger risk is refused; chosen on data by ``calibrate_refusal``. 1: none is,
    as calibration needs it."""

    bias: float = 0.0
    """Log odds of being wrong where every signal is 0.99, its logarithm 0."""

    slopes: dict[str, float] = field(default_factory=dict)
    """How much the logarithm of each signal adds to the log odds; none: no estimate is refused for
    its risk. That of ``rough`` may be negative: it says how much tilted normals mean."""

    means: dict[str, float] = field(default_factory=dict)
    """Of each signal's logarithm over right answers: a refusal names the signal that lies farthest
    above its mean, weighed by its slope. That of 0 where there is none."""

    candidate_slopes: dict[str, float] = field(default_factory=lambda: dict(_CANDIDATE_SLOPES))
    """Weight of each signal's logarithm as evidence against a pose among several that fit."""

    min_hold: float = 0.02
    """A motion that no symmetry allows must move the seen surface along its normals by this
    share of what it moves the object's points; one that moves it within itself (of a plane or
    ball) is not observable."""

    max_scale_error: float = 0.03
    """The scale of the model that fits the cloud best may differ from 1 by so much, beside two of
    its standard deviations; 1: it is not measured. Without ICP it is not."""

    @property
    def is_calibrated(self) -> bool:
        """Whether a risk is known, or is about to be learnt from all answers."""
        return bool(self.slopes) or self.max_risk == 1

    def __post_init__(self) -> None:
        """Refuse a risk that is no probability, and limits that refuse everything."""
        if not 0 <= self.max_risk <= 1:
            raise InputError(
                f"max_risk is {self.max_risk}, but a risk lies between 0 and 1; 0.5 refuses "
                "what is more likely wrong than right"
            )
        if not 0 < self.max_scale_error <= 1:
            raise InputError(
                f"max_scale_error is {self.max_scale_error}, but it is a share above 0 up to 1 "
                "(any size is taken); take 0.03"
            )
        if not 0 <= self.min_hold < 1:
            raise InputError(
                f"min_hold is {self.min_hold}, but it is a share from 0 (refuse no view for its "
                "shape) to 1; take 0.02"
            )


@dataclass(frozen=True, kw_only=True)
class EstimateConfig:
    """How a cloud becomes a pose."""

    voting: VotingConfig = field(default_factory=VotingConfig)
    """Directions to keypoints."""

    icp: IcpConfig = field(default_factory=IcpConfig)
    """How ICP refines the voted pose."""

    with_icp: bool = True
    """Whether it does; without, the voted pose is the answer."""

    up_to_symmetry: bool = False
    """Whether copies of the object that look nearly alike count as one answer: its certainty is
    then of them all, and they are not named as alternatives."""

    register_refused: bool = False
    """Whether what a network doubts is registered by its model alone: tenths of a second for each,
    and more answers where much is occluded. An answer whose ``seconds`` name registration is
    registration's, and so is its risk; it has no keypoints. Not used where an object is searched
    for, as in ``find``, because it may not be there."""

    rough_rigidity_diameters: float = 0.3
    """In place of ``voting.rigidity_diameters`` where a calibrated risk decides: ICP
    corrects rough votes, and the risk detects those that stay wrong. Nothing is refused for it
    then: where fewer than four keypoints agree all are fitted, and ICP begins at both fits."""

    max_cloud_points: int = 100_000
    """Of a larger cloud so many points are taken, evenly in their order, before anything else."""

    batch_voxels: int = 20_000
    """Voxels in one call of the network: many clouds at once, in bounded memory."""

    device: str = "cpu"
    """Where the network runs: cpu, cuda, cuda:1, ..."""

    def __post_init__(self) -> None:
        """Refuse counts of nothing."""
        if self.rough_rigidity_diameters < self.voting.rigidity_diameters:
            raise InputError(
                f"rough_rigidity_diameters is {self.rough_rigidity_diameters}, but the strict one, "
                f"voting.rigidity_diameters, is {self.voting.rigidity_diameters}; take 0.3"
            )
        if self.register_refused and not self.with_icp:
            raise InputError(
                "registration refines by ICP; omit --no-icp (with_icp=False) or "
                "--register-refused (register_refused=True)"
            )
        if self.max_cloud_points < 100 or self.batch_voxels < 1:
            raise InputError(
                f"max_cloud_points is {self.max_cloud_points} and batch_voxels "
                f"{self.batch_voxels}; take 100 and 1 at least"
            )


DiameterTable = Literal["bop", "pvnet"]
SymmetryRule = Literal["declared", "all"]


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """How estimates are measured against the truth."""

    diameters: DiameterTable = "bop"
    """Whose diameters a success is a tenth of: those that the data set declares (``bop``), or
    PVNet's of LineMOD, which differ by up to 16 %."""

    adds: SymmetryRule = "declared"
    """Which objects are measured by ADD-S: those declared symmetric (of LineMOD eggbox and glue),
    or ``all``, as for YCB's, whose symmetries geometry alone cannot show."""

    with_vsd: bool = True
    """Draw both poses for VSD, and so for BOP's average recall: the slowest of the errors."""

    vsd_delta_m: float = 0.015
    """How far a surface may lie behind the measured one and count as visible (ITODD: 0.005)."""

    def __post_init__(self) -> None:
        """Refuse unknown names, and a tolerance out of range."""
        refuse_unknown("diameters", self.diameters, get_args(DiameterTable))
        refuse_unknown("adds", self.adds, get_args(SymmetryRule))
        if not 0 < self.vsd_delta_m < 1:
            raise InputError(
                f"vsd_delta_m is {self.vsd_delta_m}, but it is a positive part of a metre; BOP "
                "takes 0.015"
            )
