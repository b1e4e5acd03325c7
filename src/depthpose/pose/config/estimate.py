"""Settings of an estimate and of the metrics: when a pose is withheld, when it is right."""

from dataclasses import dataclass, field
from typing import ClassVar, Literal, get_args

from depthpose.core.config import check_settings
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
    """When an estimate is withheld. The limits are shares of what was seen, on any sensor."""

    RETIRED: ClassVar[frozenset[str]] = frozenset(
        {"max_risk", "bias", "slopes", "means", "max_scale_error"}
    )
    """Settings of a calibrated risk, in weights written before 2026-11-26; they are left out."""

    min_agreement: float = 0.8
    """Of the posed surface that the camera saw, so much must lie where it saw something: an edge
    of a real sensor takes a tenth, other objects leave a fifth and more."""

    max_beyond: float = 0.03
    """Of the object's readings so many may lie beside the posed silhouette, its border apart."""

    min_explained: float = 0.75
    """Of the object's readings so many must lie near the posed surface; the rest may be of what a
    loose mask takes in."""

    max_size_error: float = 0.03
    """The size of the model that fits best may differ from 1 by so much beyond what the sensor
    explains; 1: neither size nor mirror image is tested. Without ICP they are not."""

    candidate_slopes: dict[str, float] = field(default_factory=lambda: dict(_CANDIDATE_SLOPES))
    """Weight of each signal's logarithm as evidence against a pose among several that fit."""

    min_hold: float = 0.02
    """A motion that no symmetry allows must move the seen surface along its normals by this
    share of what it moves the object's points; one that moves it within itself (of a plane or
    ball) is not observable."""

    def __post_init__(self) -> None:
        """Refuse limits that are no share, or refuse everything."""
        check_settings(
            self,
            min_agreement="[0, 1]",
            max_beyond="[0, 1]",
            min_explained="[0, 1]",
            max_size_error="(0, 1]",
            min_hold="[0, 1)",
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

    min_certainty: float = 0.9
    """Below this certainty the status is ``ambiguous``, not ``ok``; pose and alternatives are given
    all the same. 0: the likeliest pose is always the answer."""

    up_to_symmetry: bool = False
    """Whether copies of the object that look nearly alike count as one answer: its certainty is
    then of them all, and they are not named as alternatives."""

    register_refused: bool = False
    """Whether what a network doubts is registered by its model alone: tenths of a second for each,
    and more answers where much is occluded. An answer whose ``seconds`` name registration is
    registration's, and so is its risk; it has no keypoints. Not used where an object is searched
    for, as in ``find``, because it may not be there."""

    rough_rigidity_diameters: float = 0.3
    """In place of ``voting.rigidity_diameters`` where ICP refines the votes: it corrects rough
    ones, and what does not fit then is refused. Where fewer than four keypoints agree all are
    fitted, and ICP begins at both fits."""

    max_cloud_points: int = 100_000
    """Of a larger cloud so many points are taken, evenly in their order, before anything else."""

    batch_voxels: int = 20_000
    """Voxels in one call of the network: many clouds at once, in bounded memory."""

    device: str = "cpu"
    """Where the network runs: cpu, cuda, cuda:1, ..."""

    def __post_init__(self) -> None:
        """Refuse counts of nothing, and a certainty that is none."""
        check_settings(self, min_certainty="[0, 1]")
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
