"""Settings of the pose geometry: frozen dataclasses that check their values."""

from dataclasses import dataclass
from typing import Literal

from depthpose.core.config import check_settings
from depthpose.core.errors import InputError, refuse_seed

VotingMethod = Literal["least squares", "ransac"]
InlierTest = Literal["angle", "distance"]


@dataclass(frozen=True, kw_only=True)
class MeshConfig:
    """What is taken from a model file."""

    keypoints: int = 8
    """Farthest points of the surface that the network's directions point at (4 to 20 usual)."""

    def __post_init__(self) -> None:
        """Refuse fewer keypoints than fix a pose."""
        check_settings(self, keypoints="[4, inf)")


@dataclass(frozen=True, kw_only=True)
class CloudConfig:
    """How a mask and a depth map become the cloud that the network sees."""

    voxel_m: float = 0.008
    """Side of a voxel; one point is kept in each. The published method takes 0.001."""

    with_sight_axis: bool = True
    """Turn the cloud so that it lies straight ahead before the grid is laid: what a camera sees of
    an object at the side of its image is then what it sees in the middle. The published method
    leaves the cloud as it is."""

    with_shape: bool = False
    """Give the network for each voxel where in it the points lie on average, how many they are, and
    the normal and curvature there; the published method gives a constant 1."""

    max_points: int | None = 1500
    """At most so many points, chosen at random before voxelising; None: all."""

    min_points: int = 16
    """Fewer points are refused, not posed."""

    max_offset_diameters: float = 1.0
    """Points farther from the median of the masked points are flying pixels, and dropped."""

    def __post_init__(self) -> None:
        """Refuse sizes that leave nothing or mean another unit."""
        if not 0 < self.voxel_m < 1:
            raise InputError(
                f"voxel_m is {self.voxel_m}, but a voxel is a positive part of a metre; 0.008 "
                "means 8 mm"
            )
        if self.min_points < 3:
            raise InputError(f"min_points is {self.min_points}, but 3 points are the least of a "
                             "pose; take 16")  # fmt: skip
        if self.max_points is not None and self.max_points < self.min_points:
            raise InputError(
                f"max_points is {self.max_points}, below min_points {self.min_points}: every cloud "
                "would be refused; raise it"
            )
        if not self.max_offset_diameters > 0:
            raise InputError(
                f"max_offset_diameters is {self.max_offset_diameters}, but no point is nearer than "
                "0; take 1"
            )

    @property
    def features(self) -> int:
        """Numbers that the network gets of each voxel."""
        return 9 if self.with_shape else 1


@dataclass(frozen=True, kw_only=True)
class VotingConfig:
    """How directions become keypoints, and keypoints a pose."""

    method: VotingMethod = "ransac"
    """``least squares`` trusts every direction; ``ransac`` only those that agree."""

    hypotheses: int = 128
    """Pairs of points tried for each keypoint (published practice 50; PVNet 128 a round)."""

    inlier_test: InlierTest = "angle"
    """``angle``: a direction misses the keypoint by a small angle, and points toward it.
    ``distance``: its line passes near."""

    min_cosine: float = 0.99
    """Inliers by angle: cosine between the direction and the way to the keypoint (8.1 degrees)."""

    max_distance_m: float = 0.0005
    """Inliers by distance: how far from its line the keypoint may lie."""

    refinements: int = 3
    """Steps from the point nearest to the lines to the most likely one under errors of angle.
    Noisy lines draw the nearest point toward the cloud: a direction that errs by an angle misses a
    far keypoint by more than a near one. 0: the published, biased answer."""

    max_condition: float = 1000.0
    """A keypoint whose normal matrix is worse conditioned does not count as found."""

    rigidity_diameters: float = 0.1
    """Distances between keypoints may differ from the model's by this share of its diameter."""

    seed: int = 0
    """Of the pairs: the same input gives the same answer."""

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_settings(
            self,
            hypotheses="[1, inf)",
            min_cosine="(0, 1)",
            max_distance_m="(0, 1)",
            refinements="[0, inf)",
            max_condition="(1, inf)",
            rigidity_diameters="(0, inf)",
        )
        refuse_seed(self.seed)


@dataclass(frozen=True, kw_only=True)
class IcpConfig:
    """How a pose is brought onto the cloud."""

    iterations: int = 30
    """At most so many exact steps from one start; half of them after the best of several."""

    start_distance_diameters: float = 0.1
    """Points farther from the surface have weight 0 in the first step."""

    end_distance_diameters: float = 0.05
    """The same in the last: the limit shrinks from step to step. Below the sensor's noise the
    answer grows worse (0.02 on a Kinect's cat: 2.7 % of the diameter, 0.05: 1.7 %)."""

    cloud_points: int = 500
    """At most so many points of the cloud, evenly taken: more are slower and no more exact."""

    surface_points: int = 10000
    """Points sampled on the model's surface."""

    starts: int = 7
    """From each fit of the keypoints so many: 1, it alone; up to 7, also turned by 15 degrees one
    way and the other about each axis of the camera (``bench/refine_starts.py``)."""

    def __post_init__(self) -> None:
        """Refuse limits that grow, and counts of nothing."""
        check_settings(
            self,
            starts="[1, 7]",
            iterations="[1, inf)",
            surface_points="[100, inf)",
            cloud_points="[100, inf)",
        )
        if not 0 < self.end_distance_diameters <= self.start_distance_diameters:
            raise InputError(
                f"the distances go from {self.start_distance_diameters} to "
                f"{self.end_distance_diameters} diameters, but the limit shrinks and stays "
                "positive; take 0.1 and 0.05"
            )
