"""Types of the pose package: input apart from truth, the object, and the estimate."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Bool, Float, Float64, Int, Int64
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.sensor import measure_shared_per_white

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
"""Whether there is a pose, or why there is none. Ambiguous: the pose fits, and so do others, which
are its alternatives. Unreadable: the input could not be read; the next run tries it again. No pose
found: registration leaves no point near the model. Votes do not meet, keypoints do not fit: of a
network's keypoints. Doubtful: the pose does not fit what the camera saw, or another size or the
mirror image fits better than the sensor explains."""

POSED: tuple[Status, ...] = ("ok", "ambiguous")  #: the statuses of an estimate with a pose


Tracking = Literal["tracked", "found", "lost"]
"""How an estimate of a sequence came about: followed from the frame before, found by a new search,
or neither."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CloudInput:
    """Input of a pose estimate. There is no truth here, so none can leak."""

    name: str  #: of the input, its results and their files
    #: the visible part of one object, in the camera frame (x right, y down, z forward).
    points_m: Float[Tensor, "n 3"]
    object: str  # name of the object; after "#:" the docs would take the builtin for it
    #: the depth image that the points are of, where there is one: where the camera saw through a
    #: posed model, that is evidence against the pose.
    view: "ViewInput | None" = None
    #: whether the points are exactly the object's; not where a search chose them.
    is_masked: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class VotingPoints:
    """Input of a network whose points vote: one or several clouds, one after the other."""

    points_m: Float[Tensor, "points 3"]  #: one for each voxel, from the camera, in the grid's axes
    coordinates: Int[Tensor, "points 4"]  #: (cloud, x, y, z) of their voxels
    features: Float[Tensor, "points c"]  #: of their voxels
    class_of_point: Int[Tensor, " points"]  #: number of the object that each belongs to


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseTruth:
    """The annotated pose of the object of a sample."""

    camera_from_model: Rigid  #: the pose
    visible_fraction: float | None = None  #: not occluded share of its silhouette, 0..1
    is_measured: bool = True  #: whether the pose was annotated, not itself fitted to the same depth


@dataclass(frozen=True, kw_only=True, eq=False)
class CloudSample:
    """A cloud of a dataset and its truth."""

    input: CloudInput  #: the cloud
    truth: PoseTruth  #: the true pose of its object


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

    name: str  #: of the input, its results and their files
    #: along the optical axis; NaN where there is no reading. May be a window of ``whole_m``.
    depth_m: Float[Tensor, "h w"]
    #: the object's pixels, as a segmentation gives them, with errors
    mask: Bool[Tensor, "mask_h mask_w"]
    K: Float[Tensor, "3 3"]  #: intrinsic matrix of this image (a window shifts the principal point)
    object: str  # name of the object
    color: ColorImage | None = None  #: of the same moment; None: depth alone
    #: whether the mask only limits where the object is, as a detector's box does: what lies in it
    #: and is not the object is no evidence against a pose.
    is_region: bool = False
    background: KnownBackground | None = None  #: of this view; None: it is not known
    #: the whole depth image, where this is a window of it: of its sensor it shows more.
    whole_m: Float[Tensor, "whole_h whole_w"] | None = None

    @cached_property
    def foreground(self) -> Bool[Tensor, "h w"]:
        """The pixels of the mask whose readings do not lie on the known background."""
        return self.mask if self.background is None else self.mask & ~self.background.is_seen

    @cached_property
    def shared_per_white(self) -> float:
        """Error that neighbouring readings share, over the noise of one reading."""
        return measure_shared_per_white(self.depth_m if self.whole_m is None else self.whole_m)


AnyInput = CloudInput | ViewInput


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewSample:
    """A view and its truth."""

    input: ViewInput  #: the view
    truth: PoseTruth  #: the true pose of its object


@dataclass(frozen=True, kw_only=True, eq=False)
class Axis:
    """A continuous symmetry: every rotation about this line leaves the object as it is."""

    direction: Float[Tensor, "3"]  #: unit vector in the model frame
    point_m: Float[Tensor, "3"]  #: a point that the axis goes through


_LEAST_SINE = 0.1  # of the angle from which two axes of revolution are not parallel


@dataclass(frozen=True, kw_only=True, eq=False)
class Symmetries:
    """Motions of the model frame that leave the object as it is, as in BOP's models_info."""

    #: ``model_from_model``, the identity not among them; None where there is none.
    discrete: Rigid | None = None
    continuous: tuple[Axis, ...] = ()  #: axes of revolution
    is_found: bool = False  #: whether found in the geometry, within a tolerance, and not declared

    @property
    def is_none(self) -> bool:
        """Whether there is no symmetry."""
        return self.discrete is None and not self.continuous

    @property
    def ball_centre_m(self) -> Float[Tensor, "3"] | None:
        """The centre of a ball, where two axes of revolution meet; None of any other object.

        Then every rotation about this point is a symmetry.
        """
        for other in self.continuous[1:]:
            first = self.continuous[0]
            sine = torch.linalg.cross(first.direction, other.direction).norm()
            if float(sine) <= _LEAST_SINE:
                continue

            # The point nearest to both lines, with directions a and points c: the solution of
            # sum (1 - a a^T) x = sum (1 - a a^T) c.
            eye = torch.eye(3).to(first.direction)
            projections = [eye - torch.outer(a.direction, a.direction) for a in (first, other)]
            points_m = torch.stack([first.point_m, other.point_m])
            projected_m = (torch.stack(projections) @ points_m[..., None]).sum(0)
            return torch.linalg.solve(projections[0] + projections[1], projected_m).squeeze(-1)
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
    """A known object, in metres: its surface, keypoints, symmetries and colours."""

    name: str  #: by which inputs and results refer to it
    number: int  #: BOP's ``obj_id``
    vertices_m: Float[Tensor, "v 3"]  #: points of the surface; all there is without ``faces``
    faces: Int64[Tensor, "f 3"]  #: three vertices each, counter-clockwise seen from outside
    #: unit normal of each vertex, outward where there are ``faces``, else to either side.
    normals: Float[Tensor, "v 3"]
    diameter_m: float  #: largest distance of two points
    keypoints_m: Float[Tensor, "k 3"]  #: points at which the network's directions aim
    symmetries: Symmetries = field(default_factory=Symmetries)  #: as declared or found
    colors: SurfaceColors | None = None  #: of its vertices or its texture; None: the file has none

    def __post_init__(self) -> None:
        if not self.diameter_m > 0:
            raise InputError(
                f"object {self.name!r} has a diameter of {self.diameter_m} m; it is a single "
                "point. Give a model with an extent."
            )

    @property
    def is_scan(self) -> bool:
        """Whether it was measured and not designed: points alone, or with colours."""
        return len(self.faces) == 0 or self.colors is not None


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
    """A pose fitted to voted keypoints or, by ICP, to points of the surface."""

    camera_from_model: Rigid  #: the pose
    #: of (rotation [rad], translation [m]), left perturbation in the camera frame: the true pose is
    #: ``R = exp(rotation) R_fit``, ``t = exp(rotation) t_fit + translation``. Local: it says how
    #: well the data fix the pose about this one, and nothing of other poses, such as a half-turn
    #: away, that explain the data as well.
    covariance: Float[Tensor, "*batch 6 6"]
    #: root mean square distance of the used keypoints, or of the used points from the surface,
    #: weighted; infinite where none is used.
    residual_m: Float[Tensor, "*batch"]
    inlier_share: Float[Tensor, "*batch"]  #: share of the keypoints or points that are used

    def __getitem__(self, index: int) -> "PoseFit":
        """Take one fit of a batch."""
        return PoseFit(
            camera_from_model=self.camera_from_model[index],
            covariance=self.covariance[index],
            residual_m=self.residual_m[index],
            inlier_share=self.inlier_share[index],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Alternative:
    """A competing pose that explains what was seen nearly as well."""

    camera_from_model: Rigid  #: the pose
    probability: float  #: that it is the right one, 0..1
    difference: str  #: from the estimate's own pose: "rotated by 180 degrees about the long axis"
    is_copy: bool = False  #: whether it is a near-symmetric copy of the estimate's pose

    def __str__(self) -> str:
        """Describe how it differs from the estimate's pose, and how likely it is."""
        return f"{self.difference}, {self.probability:.0%}"


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """How a posed model compares with a depth image, by :mod:`depthpose.pose.verify.evidence`.

    Areas are counted in independent patches of readings: neighbouring readings share their error.
    """

    visible: float  #: area of the model that the camera would see, edges left out
    supported: float  #: part of ``visible`` on which readings lie, within three deviations
    explained: float  #: area of the readings that lie on the model, those near its edges too
    unobserved: float  #: part of ``visible`` without a reading, or hidden by something nearer
    seen_through: float  #: patches behind which the camera saw: free-space violations
    bulging: float  #: patches of the object's own readings before the model
    beside: float  #: patches of the object's own readings beside the model's silhouette
    silhouette: float  #: length with readings on both sides, in patches; 0 with an exact mask
    continued: float  #: part of ``silhouette`` across which the surface goes on beyond it
    rms: float  #: root mean square residual of the supported part, in standard deviations
    noise_m: float  #: standard deviation of a reading on the object, estimated from the image

    @property
    def contradicted(self) -> float:
        """Area of the patches that contradict the pose."""
        return self.seen_through + self.bulging + self.beside

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
    """Whether what was posed is the object, and not one of another size or a mirrored one."""

    status: IdentityStatus  #: confirmed, not excluded or contradicted
    size: float | None = None  #: scale of the model that fits best; None: not measured
    size_deviation: float | None = None  #: standard deviation of ``size``
    #: by how much nearer, in diameters, the points lie to the mirror image of the model; negative
    #: where the model is nearer, None where both are one or none was measured.
    mirror_gain: float | None = None
    other: str | None = None  #: another known object that it may be, the likeliest; or None
    reason: str = ""  #: one sentence; empty where it is confirmed


_FREE_M = 1e-3  # of a model's origin: a free motion that moves it by less leaves it where it is
_FREE_RAD = 1e-2  # of a rotation: a free motion that changes it by less leaves it as it is


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseEstimate:
    """The pose of one object, or the reason why there is none."""

    name: str  #: that of the input
    object: str  # name of the object
    status: Status  #: ``ok``, ``ambiguous``, or the kind of refusal
    reason: str = ""  #: one sentence for people; empty where the status is ``ok``
    camera_from_model: Rigid | None = None  #: if ambiguous the likeliest pose; None if refused
    keypoints_m: Float[Tensor, "k 3"] | None = None  #: the voted keypoints in the camera frame
    #: in the order and frame of :class:`PoseFit`. Local: a pose that is a half-turn off may have a
    #: deviation of 0.2 degrees; such errors are covered by ``certainty``. Finite: the motions of
    #: ``free_motions`` are left out. Its rotation is about the camera's origin: deviations of the
    #: model are ``origin_std_mm`` and ``rotation_std_deg``.
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
        # No default may look like success: what has no pose, or several, has a reason.
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
        """Return the estimate with ``base_from_model``, by a hand-eye calibration in metres.

        A refusal stays as it is.
        """
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
        by_rotation_m = torch.linalg.cross(eye, t_m.expand(3, 3)).mT  # columns: axis x t
        derivatives = torch.cat([by_rotation_m, eye], 1)
        std_m = self._measure_std(derivatives, least=_FREE_M)
        return None if std_m is None else 1000 * std_m

    @property
    def rotation_std_deg(self) -> Float64[Tensor, "3"] | None:
        """Standard deviation of the rotation about the model's own x, y and z axes [degrees].

        Infinite about an axis about which a declared symmetry turns; None without a covariance.
        """
        if self.camera_from_model is None:
            return None
        R = self.camera_from_model.R.double()
        derivatives = torch.cat([R.mT, torch.zeros_like(R)], 1)
        std_rad = self._measure_std(derivatives, least=_FREE_RAD)
        return None if std_rad is None else std_rad.rad2deg()

    def _measure_std(
        self, derivatives: Float64[Tensor, "3 6"], least: float
    ) -> Float64[Tensor, "3"] | None:
        """Propagate the covariance to quantities; their deviations, None without a covariance.

        Args:
            derivatives: of the quantities by (rotation, translation), one a row.
            least: a quantity is free, and its deviation infinite, where a unit free motion changes
                it by more than this.
        """
        if self.covariance is None:
            return None
        variance = (derivatives @ self.covariance.double() @ derivatives.mT).diagonal()
        std = variance.clamp(min=0).sqrt()
        if self.free_motions is None or len(self.free_motions) == 0:
            return std
        is_free = (derivatives @ self.free_motions.double().mT).abs().amax(-1) > least
        return std.masked_fill(is_free, torch.inf)

    def __repr__(self) -> str:
        text = f"{self.object}: {self.status}"
        if self.camera_from_model is not None:
            at_m = (f"{metres:.4f}" for metres in self.camera_from_model.t_m.tolist())
            text += f", t_m=[{', '.join(at_m)}]"
        if self.certainty is not None:
            text += f", certainty {self.certainty:.3f}"
        return f"PoseEstimate({text}{f', {self.reason}' if self.reason else ''})"
