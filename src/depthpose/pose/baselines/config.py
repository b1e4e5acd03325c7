"""Settings of the baselines."""

from dataclasses import dataclass

from depthpose.core.config import check_settings


@dataclass(frozen=True, kw_only=True)
class DepthImageConfig:
    """A masked crop of the depth image, regressed to a pose."""

    classes: int = 1
    """Objects that one network knows."""

    crop_px: int = 128
    """Side of the crop that the network sees."""

    margin: float = 1.1
    """The crop is so many times as wide as the object's box."""

    contrast: float = 0.1
    """The crop is divided by its mean depth; this much more or less than the mean is 1 or -1."""

    widths: tuple[int, int, int, int] = (64, 128, 256, 512)
    """Channels of the encoder's stages: those of ResNet-18."""

    min_points: int = 16
    """Fewer masked pixels with a depth are refused, not posed."""

    def __post_init__(self) -> None:
        """Refuse sizes that the network cannot have."""
        counts = dict.fromkeys(("classes", "widths", "min_points"), "[1, inf)")
        check_settings(self, **counts, crop_px="[32, inf)", margin="[1, inf)", contrast="(0, inf)")


@dataclass(frozen=True, kw_only=True)
class PointNetConfig:
    """Size of a PointNet for segmentation (Qi et al. 2017) whose outputs are directions."""

    classes: int = 13
    """Objects that one network knows."""

    keypoints: int = 8
    """Keypoints of each object."""

    with_transforms: bool = True
    """The two T-Nets, which turn points (3x3) and features (64x64) before they go on."""

    with_confidence: bool = False
    """A fourth output beside each direction: the logit of how far to trust it."""

    unit_m: float = 0.1
    """Points are given to the network in units of so many metres: of order one for an object."""

    local: tuple[int, int] = (64, 64)
    """Channels of a point by itself."""

    pooled: tuple[int, int, int] = (64, 128, 1024)
    """Channels on the way to the maximum over all points."""

    head: tuple[int, int, int] = (512, 256, 128)
    """Channels of a point beside that maximum."""

    def __post_init__(self) -> None:
        """Refuse sizes that the network cannot have."""
        counts = ("classes", "keypoints", "local", "pooled", "head")
        check_settings(self, **dict.fromkeys(counts, "[1, inf)"), unit_m="(0, inf)")

    @property
    def components(self) -> int:
        """Numbers for each point and keypoint: a direction, and maybe a logit."""
        return 4 if self.with_confidence else 3

    @property
    def outputs(self) -> int:
        """Channels of the last layer."""
        return self.classes * self.keypoints * self.components


@dataclass(frozen=True, kw_only=True)
class FpfhConfig:
    """FPFH features, RANSAC and ICP of Open3D."""

    voxel_diameters: float = 0.03
    """Side of a voxel in diameters of the object."""

    iterations: int = 100_000
    """Of RANSAC, at most."""

    seed: int = 0
    """Of RANSAC."""

    def __post_init__(self) -> None:
        """Refuse voxels without a size, and no iteration."""
        check_settings(self, voxel_diameters="(0, inf)", iterations="[1, inf)")
