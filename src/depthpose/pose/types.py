"""Types of the pose package: input apart from truth, the object, and the estimate."""

from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Float64, Int, Int64
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid

Status = Literal[
    "ok",
    "ambiguous",
    "unreadable",
    "unusable input",
    "too few points",
    "no pose found",
    "votes do not meet",
    "keypoints do not fit",
    "not observable",
    "doubtful",
]
"""An answer, or why there is none. Ambiguous: the pose fits, and so do others; it is given with
them. Unreadable: no input came; it is tried again by the next run. No pose found: registration
leaves no point near the model. Votes do not meet, keypoints do not fit: of a network's keypoints.
Doubtful: the pose does not fit what the camera saw, or another size or the mirror image fits better
than the sensor explains."""

POSED: tuple[Status, ...] = ("ok", "ambiguous")  #: with a pose


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """Why there is no pose."""

    status: Status  #: the kind of refusal
    reason: str  #: one sentence for people


Tracking = Literal["tracked", "found", "lost"]
"""How an estimate of a sequence came about: followed from the frame before, looked for anew, or
neither."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CloudInput:
    """Input of a pose estimate. There is no truth here, so none can leak."""

    name: str  #: what the files of its results are called
    #: the visible part of one object, in the camera frame (x right, y down, z forward).
    points_m: Float[Tensor, "n 3"]
    object: str  # as its ObjectModel is called; after "#:" the docs would take the builtin for it
    #: the depth image that the points are of, where there is one: what the camera saw through a
    #: pose is evidence against it.
    view: "ViewInput | None" = None
    #: the points are exactly the object's; not where a search chose them.
    is_masked: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class VotingPoints:
    """Input of a network whose points vote: one or several clouds, one after the other."""

    points_m: Float[Tensor, "points 3"]  #: one a voxel, in the axes of its grid about its camera
    coordinates: Int[Tensor, "points 4"]  #: (cloud, x, y, z) of its voxel
    features: Float[Tensor, "points c"]  #: of its voxel
    class_of_point: Int[Tensor, " points"]  #: which object each belongs to


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseTruth:
    """What is known about the object of a sample."""

    camera_from_model: Rigid  #: its pose
    visible_fraction: float | None = None  #: not occluded share of its silhouette, 0..1
    is_measured: bool = True  #: whether the pose was annotated, not itself fitted to the same depth


@dataclass(frozen=True, kw_only=True, eq=False)
class CloudSample:
    """One sample of a dataset."""

    input: CloudInput  #: the cloud
    truth: PoseTruth  #: its pose


@dataclass(frozen=True, kw_only=True, eq=False)
class ColorImage:
    """A colour image of a view, by the depth camera itself or by one beside it."""

    rgb: Float[Tensor, "3 h w"]  #: 0..1, as a screen shows it (sRGB)
    K: Float[Tensor, "3 3"]  #: intrinsic matrix of this image
    #: from the depth camera's frame; None: both images are of one frame.
    color_from_depth: Rigid | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownBackground:
    """What a camera sees without the objects: an empty bin or table, drawn or taken before."""

    depth_m: Float[Tensor, "h w"]  #: in the pixels of the view; NaN where it is not known
    is_seen: Bool[Tensor, "h w"]  #: whether the reading of the view lies on it


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewInput:
    """A depth image with the mask of one object: what a :class:`CloudInput` is lifted from."""

    name: str  #: what the files of its results are called
    #: along the optical axis; NaN where there is no reading. May be a window of a larger image.
    depth_m: Float[Tensor, "h w"]
    mask: Bool[Tensor, "h w"]  #: the object's pixels, as a segmentation gives them, with errors
    K: Float[Tensor, "3 3"]  #: intrinsic matrix of this image (a window shifts the principal point)
    object: str  # name of the object
    color: ColorImage | None = None  #: of the same moment; None: depth alone
    #: the mask only limits where the object is, as a detector's box does: what lies in it and is
    #: not the object is no evidence against a pose.
    is_region: bool = False
    #: without the objects; None: it is not known.
    background: KnownBackground | None = None


AnyInput = CloudInput | ViewInput


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewSample:
    """A view and its truth."""

    input: ViewInput  #: the view
    truth: PoseTruth  #: its pose


@dataclass(frozen=True, kw_only=True, eq=False)
class Axis:
    """A continuous symmetry: every turn about this line leaves the object as it is."""

    direction: Float[Tensor, "3"]  #: unit vector in the model frame
    point_m: Float[Tensor, "3"]  #: a point that the axis goes through


_OTHER_AXIS = 0.1  # sine of the angle from which two axes of revolution are two


@dataclass(frozen=True, kw_only=True, eq=False)
class Symmetries:
    """Motions of the model frame that leave the object as it is, as BOP's models_info says them."""

    #: ``model_from_model``, the identity not among them; None where there is none.
    discrete: Rigid | None = None
    continuous: tuple[Axis, ...] = ()  #: axes of revolution
    is_found: bool = False  #: found in the geometry, within a tolerance, and not declared

    @property
    def is_none(self) -> bool:
        """Whether the object looks alike from no two sides."""
        return self.discrete is None and not self.continuous

    @property
    def ball_centre_m(self) -> Float[Tensor, "3"] | None:
        """The point where two axes of revolution meet, about which any turn is one; else None."""
        for other in self.continuous[1:]:
            first = self.continuous[0]
            across = torch.linalg.cross(first.direction, other.direction)
            if float(across.norm()) <= _OTHER_AXIS:
                continue

            # The point nearest to both lines.
            eye = torch.eye(3).to(across)
            planes = [eye - torch.outer(a.direction, a.direction) for a in (first, other)]
            points_m = torch.stack([first.point_m, other.point_m])
            pulls = (torch.stack(planes) @ points_m[..., None]).sum(0)
            return torch.linalg.solve(planes[0] + planes[1], pulls).squeeze(-1)
        return None


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceColors:
    """Colours of a model at points spread evenly over its surface, whatever its mesh is."""

    points_m: Float[Tensor, "n 3"]  #: in the model frame
    normals: Float[Tensor, "n 3"]  #: outward unit normals
    rgb: Float[Tensor, "n 3"]  #: 0..1, as a screen shows them (sRGB)
    spacing_m: float  #: distance of neighbours; what is smaller is averaged in the colours


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectModel:
    """A known object: what its CAD file and the config say of it, in metres."""

    name: str  #: what samples call it
    number: int  #: BOP's ``obj_id``
    vertices_m: Float[Tensor, "v 3"]  #: points of the surface; all there is without ``faces``
    faces: Int64[Tensor, "f 3"]  #: three vertices each, counter-clockwise seen from outside
    normals: Float[Tensor, "v 3"]  #: outward unit normal of each vertex; of points, of unknown side
    diameter_m: float  #: largest distance of two points
    keypoints_m: Float[Tensor, "k 3"]  #: what the network's directions point at
    symmetries: Symmetries = field(default_factory=Symmetries)  #: as declared or found
    colors: SurfaceColors | None = None  #: of its vertices or its texture; None: the file has none

    def __post_init__(self) -> None:
        if not self.diameter_m > 0:
            raise InputError(
                f"object {self.name!r} has a diameter of {self.diameter_m} m; it is a single "
                "point. Give a model with an extent."
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class Vote:
    """Where the directions of many points meet, with leading batch axes."""

    keypoints_m: Float[Tensor, "*batch k 3"]  #: the meeting points, in the frame of the points
    covariance_m2: Float[Tensor, "*batch k 3 3"]  #: their covariance, from how well directions meet
    #: largest over smallest eigenvalue of the normal matrix; infinite where all lines are parallel.
    #: Above about 1000 the depth of the keypoint is a guess (figure 3-4).
    condition: Float[Tensor, "*batch k"]
    inlier_share: Float[Tensor, "*batch k"]  #: share of the weight that agrees with the point, 0..1


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseFit:
    """The rigid transform that carries the model's keypoints onto found ones."""

    camera_from_model: Rigid  #: the pose
    #: of (rotation [rad], translation [m]), left perturbation in the camera frame: the true pose is
    #: ``R = exp(rotation) R_found``, ``t = exp(rotation) t_found + translation``. Local: it says
    #: how well the data fix the pose about this answer, and nothing of other answers, such as a
    #: half-turn away, that explain the data as well.
    covariance: Float[Tensor, "*batch 6 6"]
    residual_m: Float[Tensor, "*batch"]  #: root mean square distance of the used keypoints


@dataclass(frozen=True, kw_only=True, eq=False)
class Alternative:
    """A competing pose that explains what was seen nearly as well."""

    camera_from_model: Rigid  #: the pose
    probability: float  #: that it is the right one, 0..1
    difference: str  #: from the estimate's own pose: "rotated by 180 degrees about the long axis"
    is_copy: bool = False  #: a near-symmetric copy of the estimate's pose, which looks nearly alike

    def __str__(self) -> str:
        """Describe how it differs from the pose, and how likely it is."""
        return f"{self.difference}, {self.probability:.0%}"


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """How a posed model compares with a depth image, as :mod:`depthpose.pose.evidence` measures.

    Areas are counted in independent patches of readings: neighbouring readings share their error.
    """

    visible: float  #: area of the model that the camera would see, edges left out
    supported: float  #: part of it on which readings lie, within three standard deviations
    explained: float  #: area of the readings that lie on the model, those near its edges too
    unobserved: float  #: part of it without a reading, or hidden by something nearer
    seen_through: float  #: patches behind which the camera saw: free-space violations
    bulging: float  #: patches of the object's own readings before the model
    beside: float  #: patches of the object's own readings beside the model's silhouette
    silhouette: float  #: length with readings on both sides, in patches; 0 with an exact mask
    continued: float  #: part of it across which the surface goes on: there the object does not end
    rms: float  #: root mean square residual of the supported part, in standard deviations
    noise_m: float  #: standard deviation of a reading on the object, estimated from the image

    @property
    def contradicted(self) -> float:
        """Patches that contradict the pose."""
        return self.seen_through + self.bulging + self.beside + self.continued

    @property
    def agreement(self) -> float:
        """Share of the compared area that supports the pose, 0..1."""
        compared = self.supported + self.contradicted
        return self.supported / compared if compared > 0 else 0.0

    @property
    def supported_share(self) -> float:
        """Share of the visible area whose readings support the pose, 0..1."""
        return self.supported / self.visible if self.visible > 0 else 0.0


IdentityStatus = Literal["confirmed", "not excluded", "contradicted"]
"""Confirmed: neither another size nor the mirror image fits, and no reading contradicts the model.
Not excluded: the size is not fixed, one of them fits as well, or something contradicts the model.
Contradicted: one of them fits better by more than the sensor explains. What was not tested has no
:class:`Identity` at all."""


@dataclass(frozen=True, kw_only=True)
class Identity:
    """Whether what was posed is the object, and not a copy of it or another thing."""

    status: IdentityStatus  #: confirmed, not excluded or contradicted
    size: float | None = None  #: that fits best, in sizes of the model; None: not measured
    size_deviation: float | None = None  #: standard deviation of it
    #: by how much nearer, in diameters, the points lie to the mirror image of the model; negative
    #: where the model is nearer, None where both are one or none was measured.
    mirror_gain: float | None = None
    other: str | None = None  #: another known object that it may be, the likeliest; or None
    reason: str = ""  #: one sentence; empty where it is confirmed


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseEstimate:
    """The pose of one object, or the reason why there is none."""

    name: str  #: that of the input
    object: str  # name of the object
    status: Status  #: ``ok``, ``ambiguous``, or the kind of refusal
    reason: str = ""  #: one sentence for people; empty where the status is ``ok``
    camera_from_model: Rigid | None = None  #: if ambiguous the likeliest pose; None if refused
    keypoints_m: Float[Tensor, "k 3"] | None = None  #: the found keypoints in the camera frame
    #: 6x6, order and frame as :class:`PoseFit` says. Local: a pose that is a half-turn off may have
    #: one of 0.2 degrees; such errors are covered by ``certainty``. Finite: it leaves out the
    #: motions of ``free_motions``. Its translation is of the camera's origin: ``origin_std_mm`` and
    #: ``rotation_std_deg`` say it of the model.
    covariance: Float[Tensor, "6 6"] | None = None
    #: unit vectors of (rotation, translation) along which a declared continuous symmetry makes the
    #: variance infinite; no row where there is none.
    free_motions: Float[Tensor, "m 6"] | None = None
    inlier_share: float | None = None  #: share of the votes that agree, 0..1
    #: root mean square distance: of keypoints, or of points to the surface after ICP.
    residual_m: float | None = None
    evidence: Evidence | None = None  #: the pose beside what the camera saw; None: not compared
    #: probability that the pose is right up to the near-symmetries of the model: that it or one of
    #: its copies is. It makes the status. None: not compared.
    certainty: float | None = None
    #: probability that this very pose is right, and none of its near-symmetric copies.
    copy_certainty: float | None = None
    #: whether it is this object; None where that was not tested: of a pose that was refused before,
    #: without ICP, of a frame that was tracked, or with ``max_size_error=1``.
    identity: Identity | None = None
    alternatives: tuple[Alternative, ...] = ()  #: competing poses, the likeliest first
    seconds: dict[str, float] = field(default_factory=dict)  #: time of each stage
    tracking: Tracking | None = None  #: how it came about, in a sequence; None elsewhere
    #: the pose in the frame of a robot's base, by :meth:`in_base`; None where no base is known.
    base_from_model: Rigid | None = None
    #: place in the order to pick what a search found, from 1: nothing that was found lies before
    #: it, or what does has a smaller rank. None elsewhere.
    pick_rank: int | None = None

    def __post_init__(self) -> None:
        # No default may look like success: an answer has a pose, all others have a reason.
        assert (self.camera_from_model is not None) == self.is_posed
        assert self.is_ok or self.reason

    @property
    def is_ok(self) -> bool:
        """Whether there is one pose, and no other is nearly as likely."""
        return self.status == "ok"

    @property
    def is_posed(self) -> bool:
        """Whether there is a pose, ok or ambiguous."""
        return self.status in POSED

    @property
    def visible_share(self) -> float | None:
        """Share of the surface facing the camera whose readings support the pose, 0..1, or None."""
        return None if self.evidence is None else self.evidence.supported_share

    def in_base(self, base_from_camera: Rigid) -> "PoseEstimate":
        """Add ``base_from_model`` by a hand-eye calibration in metres; a refusal has none."""
        if self.camera_from_model is None:
            return self
        pose = base_from_camera.double() @ self.camera_from_model.double()
        return replace(self, base_from_model=pose)

    @property
    def origin_std_mm(self) -> Float64[Tensor, "3"] | None:
        """Standard deviation of where the model's origin is, along the camera's x, y and z [mm].

        A turn about the camera moves an origin at t by ``rotation x t``, beside the translation.
        Infinite where a declared symmetry moves the origin; None without a covariance.
        """
        if self.camera_from_model is None:
            return None
        eye = torch.eye(3, dtype=torch.float64)
        t_m = self.camera_from_model.t_m.double()
        turned = torch.linalg.cross(eye, t_m.expand(3, 3)).mT
        std_m = self._measure_std_along(torch.cat([turned, eye], 1), 1e-3)
        return None if std_m is None else 1000 * std_m

    @property
    def rotation_std_deg(self) -> Float64[Tensor, "3"] | None:
        """Standard deviation of the rotation about the model's own x, y and z axes [degrees].

        Infinite about an axis about which a declared symmetry turns; None without a covariance.
        """
        if self.camera_from_model is None:
            return None
        R = self.camera_from_model.R.double()
        std = self._measure_std_along(torch.cat([R.mT, torch.zeros_like(R)], 1), 1e-2)
        return None if std is None else std.rad2deg()

    def _measure_std_along(self, rows: Float64[Tensor, "3 6"], least: float) -> Tensor | None:
        """Give standard deviations of linear functions of the motion, or None.

        Args:
            rows: the functions' derivatives by (rotation, translation).
            least: a function is free, and its deviation infinite, where a free motion moves it by
                more than this.
        """
        if self.covariance is None:
            return None
        std = (rows @ self.covariance.double() @ rows.mT).diagonal().clamp(min=0).sqrt()
        if self.free_motions is None or len(self.free_motions) == 0:
            return std
        is_free = (rows @ self.free_motions.double().mT).abs().amax(-1) > least
        return std.masked_fill(is_free, torch.inf)

    def __repr__(self) -> str:
        text = f"{self.object}: {self.status}"
        if self.camera_from_model is not None:
            at_m = (f"{metres:.4f}" for metres in self.camera_from_model.t_m.tolist())
            text += f", t_m=[{', '.join(at_m)}]"
        if self.certainty is not None:
            text += f", certainty {self.certainty:.3f}"
        return f"PoseEstimate({text}{f', {self.reason}' if self.reason else ''})"
