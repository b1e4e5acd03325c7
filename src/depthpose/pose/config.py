"""Settings of pose estimation: clouds, meshes, refusal, estimates, synthetic objects."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, get_args

from depthpose.core.config import ASCENDING, Seed, Settings
from depthpose.core.errors import InputError

VotingMethod = Literal["least squares", "ransac"]  #: see ``VotingConfig.method``
InlierTest = Literal["angle", "distance"]  #: see ``VotingConfig.inlier_test``


@dataclass(frozen=True, kw_only=True)
class MeshConfig(Settings):
    """What is taken from a model file."""

    keypoints: Annotated[int, "[4, inf)"] = 8
    """Farthest points of the surface that the network's directions point at (4 to 20 usual)."""


SHAPE_FEATURES = 9  #: features of a voxel for the network with its shape; without, the number 1


@dataclass(frozen=True, kw_only=True)
class CloudConfig(Settings):
    """How a mask and a depth map become the points of an object, and the voxels of a network."""

    voxel_m: Annotated[float, "(0, 1)"] = 0.008
    """Side of a voxel; one point is kept in each. The published method takes 0.001."""

    with_sight_axis: bool = True
    """Turn the cloud so that it lies straight ahead before the grid is laid: what a camera sees of
    an object at the side of its image is then what it sees in the middle. The published method
    leaves the cloud as it is."""

    with_shape: bool = False
    """Give the network for each voxel where in it the points lie on average, how many they are, and
    the normal and curvature there; the published method gives a constant 1."""

    max_points: Annotated[int | None, "[3, inf)"] = 1500
    """Largest number of points, chosen at random before voxelising; None: all."""

    min_points: Annotated[int, "[3, inf)"] = 16
    """Fewer points are refused, not posed."""

    max_offset_diameters: Annotated[float, "(0, inf)"] = 1.0
    """Points farther from the median of the masked points are flying pixels, and dropped."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_points is not None and self.max_points < self.min_points:
            raise InputError(
                f"max_points is {self.max_points}, below min_points {self.min_points}: every cloud "
                "would be refused; raise it"
            )


@dataclass(frozen=True, kw_only=True)
class VotingConfig(Settings):
    """How directions become keypoints, and keypoints a pose."""

    method: VotingMethod = "ransac"
    """``least squares`` trusts every direction; ``ransac`` only those that agree."""

    hypotheses: Annotated[int, "[1, inf)"] = 128
    """Pairs of points tried for each keypoint (published practice 50; PVNet 128 a round)."""

    inlier_test: InlierTest = "angle"
    """``angle``: a direction misses the keypoint by a small angle, and points toward it.
    ``distance``: its line passes near."""

    min_cosine: Annotated[float, "(0, 1)"] = 0.99
    """Inliers by angle: cosine between the direction and the way to the keypoint (8.1 degrees)."""

    max_distance_m: Annotated[float, "(0, 1)"] = 0.0005
    """Inliers by distance: how far from its line the keypoint may lie."""

    refinements: Annotated[int, "[0, inf)"] = 3
    """Steps from the point nearest to the lines to the most likely one under errors of angle.
    Noisy lines draw the nearest point toward the cloud: a direction that errs by an angle misses a
    far keypoint by more than a near one. 0: the published, biased estimate."""

    max_condition: Annotated[float, "(1, inf)"] = 1000.0
    """A keypoint whose normal matrix is worse conditioned does not count as found."""

    rigidity_diameters: Annotated[float, "(0, inf)"] = 0.1
    """Distances between keypoints may differ from the model's by this share of its diameter."""

    seed: Seed = 0
    """Seed of the random pairs: with the same seed an input has the same pose on every run."""


@dataclass(frozen=True, kw_only=True)
class IcpConfig(Settings):
    """How a pose is brought onto the cloud."""

    iterations: Annotated[int, "[1, inf)"] = 15
    """Largest number of exact steps, which follow rough ones."""

    start_distance_diameters: float = 0.1
    """Points farther from the surface have weight 0 in the first step."""

    end_distance_diameters: float = 0.05
    """The same in the last: the limit shrinks from step to step. Below the sensor's noise the
    pose grows worse (0.02 on a Kinect's cat: 2.7 % of the diameter, 0.05: 1.7 %)."""

    cloud_points: Annotated[int, "[100, inf)"] = 500
    """Largest number of points of the cloud, evenly taken: more are slower and no more exact."""

    surface_points: Annotated[int, "[100, inf)"] = 10000
    """Points sampled on the model's surface."""

    sensor_offset_m: Annotated[float, "[0, 1]"] = 0.004
    """Standard deviation of an offset of all readings along the ray, which no residual shows: it is
    added to the covariance of a pose. Depth cameras are off by 3 to 6 mm as a whole
    (``bench/sensors.py``); 0 where yours is calibrated at the distance of the object."""

    starts: Annotated[int, "[1, 7]"] = 7
    """Starts from each fit of the keypoints: 1 is the fit alone; up to 7 are also turned by 15
    degrees one way and the other about each axis of the camera (``docs/experiments.md``)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.end_distance_diameters <= self.start_distance_diameters:
            raise InputError(
                f"the distances go from {self.start_distance_diameters} to "
                f"{self.end_distance_diameters} diameters, but the limit shrinks and stays "
                "positive; take 0.1 and 0.05"
            )


@dataclass(frozen=True, kw_only=True)
class RefusalConfig(Settings):
    """When a pose is withheld."""

    min_probability: Annotated[float, "[0, 1]"] = 0.5
    """The best pose must be right with this probability, by what contradicts it in the image."""

    max_size_error: Annotated[float, "(0, 1]"] = 0.03
    """The size of the model that fits best may differ from 1 by so much beyond what the sensor
    explains; 1: neither size nor mirror image is tested. Without ICP they are not."""

    min_observability: Annotated[float, "[0, 1)"] = 0.02
    """A motion that no symmetry allows must move the visible surface along its normals by this
    share of what it moves the object's points; one that moves it within itself (of a plane or
    ball) is not observable."""


@dataclass(frozen=True, kw_only=True)
class EstimateConfig(Settings):
    """How a cloud becomes a pose."""

    voting: VotingConfig = VotingConfig()
    """Directions to keypoints."""

    icp: IcpConfig = IcpConfig()
    """How ICP refines the voted pose."""

    with_icp: bool = True
    """Whether ICP refines the voted pose; else that pose is returned as it is."""

    min_certainty: Annotated[float, "[0, 1]"] = 0.9
    """Below this certainty the status is ``ambiguous``, not ``ok``; pose and alternatives are given
    all the same. 0: the likeliest pose is always ``ok``."""

    refusal: RefusalConfig | None = None
    """When a pose is withheld. None: by the limits that a network's weights hold; of models alone
    by the usual ones."""

    object_deviation_m: Annotated[float, "[0, 1]"] | None = None
    """Standard deviation of the real surface from the model: some tenths of a millimetre for a
    machined part, two and more for a scan, a casting or a carton. None: 2 mm where the model has
    colours or is points alone, as scans are, and else 1 mm."""

    register_refused: bool = False
    """Whether what a network doubts is registered by its model alone: tenths of a second for each,
    and more answers where much is occluded. An answer whose ``seconds`` name registration is
    registration's, and so is its risk; it has no keypoints. Not used where an object is searched
    for, as in ``find``, because it may not be there."""

    rough_rigidity_diameters: float = 0.3
    """In place of ``voting.rigidity_diameters`` where ICP refines the votes: it corrects rough
    ones, and what does not fit then is refused. Where fewer than four keypoints agree all are
    fitted, and ICP begins at both fits."""

    max_cloud_points: Annotated[int, "[100, inf)"] = 100_000
    """A larger cloud is first thinned to this number of points, evenly in their order."""

    batch_voxels: Annotated[int, "[1, inf)"] = 20_000
    """Voxels in one call of the network: many clouds at once, in bounded memory."""

    device: str = "cpu"
    """Where the network runs: cpu, cuda, cuda:1, ..."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.with_icp and self.rough_rigidity_diameters < self.voting.rigidity_diameters:
            raise InputError(
                f"rough_rigidity_diameters is {self.rough_rigidity_diameters}, but the strict one, "
                f"voting.rigidity_diameters, is {self.voting.rigidity_diameters}; take 0.3"
            )
        if self.register_refused and not self.with_icp:
            raise InputError(
                "registration refines by ICP; omit --no-icp (with_icp=False) or "
                "--register-refused (register_refused=True)"
            )

    @property
    def limits(self) -> RefusalConfig:
        """The limits that ``refusal`` sets, or the usual ones."""
        return self.refusal or RefusalConfig()


DiameterTable = Literal["bop", "pvnet"]  #: see ``EvaluationConfig.diameters``
SymmetryRule = Literal["declared", "all"]  #: see ``EvaluationConfig.adds``


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig(Settings):
    """How estimates are measured against the truth."""

    diameters: DiameterTable = "bop"
    """Whose diameters a success is a tenth of: those that the dataset declares (``bop``), or
    PVNet's of LineMOD, which differ by up to 16 %."""

    adds: SymmetryRule = "declared"
    """Which objects are measured by ADD-S: those declared symmetric (of LineMOD eggbox and glue),
    or ``all``, as for YCB's, whose symmetries geometry alone cannot show."""

    with_vsd: bool = True
    """Draw both poses for VSD, and so for BOP's average recall: the slowest of the errors."""

    vsd_delta_m: Annotated[float, "(0, 1)"] = 0.015
    """How far a surface may lie behind the measured one and count as visible (ITODD: 0.005)."""


SensorKind = Literal["structured light", "active stereo", "time of flight", "laser", "none"]
"""What measures depth, and so what its errors look like."""
_LINEMOD_PX = (640, 480)  # size of the images of LineMOD's Kinect
_LINEMOD_CENTRE_PX = (325.2611, 242.04899)  # principal point of LineMOD's Kinect
OCCLUSIONS = "[0, 0.95]"  #: limits of the share of a silhouette that something occludes


@dataclass(frozen=True, kw_only=True)
class SyntheticSensorConfig(Settings):
    """The errors of a depth sensor. Ranges are of what each sample draws."""

    kinds: tuple[SensorKind, ...] = ("structured light",)
    """One of these measures each sample. ``structured light``: disparity in steps of 1/8 px, noise
    that grows with the squared distance (Nguyen et al. 2012), the projector's shadow. ``active
    stereo``: finer steps, edges displaced by the window that is matched, a shadow on the other
    side. ``time of flight``: mixed readings where depth jumps. ``laser``: little noise. ``none``:
    no error."""

    noise: Annotated[tuple[float, float], "[0, 20]", ASCENDING] = (0.5, 1.5)
    """Times the noise of the kind."""

    noise_correlation_px: Annotated[tuple[float, float] | None, "[0, 30]", ASCENDING] = None
    """Correlation length of the noise (deviation of the Gaussian that smooths it), in pixels of the
    full image; None: 3 to 6 for ``active stereo``, else every pixel has its own. Measured on planes
    by ``bench/sensors.py``: a Kinect 3, a RealSense 5."""

    missing: Annotated[tuple[float, float], "[0, 0.9]", ASCENDING] = (0.0, 0.1)
    """Share of readings lost beside those of shadows and grazing surfaces; half in patches."""

    offset_m: Annotated[tuple[float, float], "[-0.1, 0.1]", ASCENDING] = (-0.005, 0.005)
    """Added to all readings of a view alike: real sensors are off by 3 to 6 mm as a whole. Not of
    ``none``."""

    def __post_init__(self) -> None:
        if not self.kinds:
            raise InputError(f"kinds is (); name one or more of {', '.join(get_args(SensorKind))}")
        super().__post_init__()


@dataclass(frozen=True, kw_only=True)
class ObjectsConfig(Settings):
    """Synthetic views of known objects. Ranges are of what each sample draws."""

    INSTEAD: ClassVar[dict[str, str]] = {"image_px": "centre_px"}
    """A config file that gives another image has that one's middle, not the default's."""

    number: Annotated[int, "[1, inf)"] = 1000
    """Samples; sample i shows object i modulo their number."""

    seed: Seed = 0
    """Another seed, other samples."""

    views: Annotated[int | None, "[1, inf)"] = 2000
    """Renderings of each object, rendered at first use and then kept; a sample turns the camera of
    one of them at random, which shows the same surface. None: each sample is a rendering of its
    own, for evaluation."""

    distance_m: Annotated[tuple[float, float], "[0.05, 20]", ASCENDING] = (0.6, 1.1)
    """From the camera to the middle of the object."""

    image_px: Annotated[tuple[int, int], "(0, inf)"] = (640, 480)
    """Width and height of the sensor's image; the object lies somewhere in it."""

    focal_px: Annotated[tuple[float, float], "(0, inf)"] = (572.4114, 573.57043)
    """fx and fy; LineMOD's Kinect."""

    centre_px: tuple[float, float] | None = None
    """Principal point, within the image; None: the middle of the image, or that of LineMOD's Kinect
    in an image of 640x480. It is always known once the settings are made."""

    resolution: Annotated[tuple[float, float], "[0.05, 4]", ASCENDING] = (0.4, 0.8)
    """Factors by which the sides of the image are scaled: coarser pictures are faster."""

    occluded_share: Annotated[float, "[0, 1]"] = 0.7
    """Share of samples in which something occludes the object."""

    occlusion: Annotated[tuple[float, float], OCCLUSIONS, ASCENDING] = (0.0, 0.5)
    """Share of the silhouette that it occludes."""

    with_background: bool = True
    """Whether there is something behind and beside the object, which wrong masks take in."""

    mask_error_px: Annotated[int, "[0, 20]"] = 3
    """Largest growth or shrinkage of the mask [pixels of the full image]."""

    mask_shift_px: Annotated[int, "[0, 20]"] = 2
    """Largest shift of the mask along each axis [the same], as a predicted mask is shifted."""

    sensor: SyntheticSensorConfig = SyntheticSensorConfig()
    """What measures the depth."""

    frame_objects: Annotated[tuple[int, int], "[1, inf)", ASCENDING] = (2, 6)
    """Objects of a whole frame, no more than there are models."""

    frame_clutter: Annotated[tuple[int, int], "[0, inf)", ASCENDING] = (0, 4)
    """Boxes, balls and cans of no model among them."""

    frame_pile: Annotated[int, "[0, 200]"] = 0
    """Number of copies of one model that a frame shows, dropped onto each other, in place of
    ``frame_objects`` and ``frame_clutter``; 0: no pile."""

    def __post_init__(self) -> None:
        super().__post_init__()
        width, height = self.image_px
        default = ((width - 1) / 2, (height - 1) / 2)
        if self.image_px == _LINEMOD_PX:
            default = _LINEMOD_CENTRE_PX
        x, y = default if self.centre_px is None else self.centre_px
        object.__setattr__(self, "centre_px", (x, y))
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            raise InputError(
                f"centre_px is {(x, y)}, but the principal point lies within the image, and "
                f"image_px is {self.image_px}; leave it out for the default, {default}"
            )
