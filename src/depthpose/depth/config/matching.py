"""Settings of the stereo matchers, and the names of the baselines."""

from dataclasses import dataclass
from typing import Literal

from depthpose.core.config import check_settings
from depthpose.core.errors import InputError

BaselineName = Literal["rows", "nearest"]
"""The best constant depth of each image row; the depth of the training image most alike."""


Speed = Literal["quick", "fine"]
"""How much time a match may take: see :class:`MatcherConfig`."""


@dataclass(frozen=True, kw_only=True)
class PSMNetConfig:
    """Size and conventions of the stereo network (Chang and Chen 2018, stacked hourglass)."""

    max_disparity_px: int = 192
    """Disparities 0 .. max_disparity_px - 1 are considered; a multiple of 16."""

    width: int = 32
    """Channels of the first layers; all others are 1, 2 or 4 times it."""

    blocks: tuple[int, int, int, int] = (3, 16, 3, 3)
    """Residual blocks of the four stages of the feature extractor."""

    pools: tuple[int, ...] = (64, 32, 16, 8)
    """Windows of the spatial pyramid, in quarter-size pixels, largest first."""

    align_corners: bool = True
    """How the weights expect maps to be enlarged: True for the published KITTI 2015 weights."""

    work_focal_px: float | None = None
    """Pairs are brought to this focal length before matching [px]; None: matched as they are."""

    def __post_init__(self) -> None:
        """Refuse sizes that the network cannot have."""
        check_settings(
            self,
            max_disparity_px="[16, 16384]",
            width="[1, inf)",
            blocks="[1, 1000]",
            pools="[1, 1024]",
            work_focal_px="(0, inf)",
        )
        if self.max_disparity_px % 16:
            raise InputError(
                "max_disparity_px must be a multiple of 16 (the volume is a quarter of it and is "
                f"halved twice), got {self.max_disparity_px}; take 192"
            )
        if not 1 <= len(self.pools) <= 16:
            raise InputError(f"pools must hold 1 to 16 windows, got {self.pools}")

    @property
    def step_px(self) -> int:
        """Sides of images and ``max_disparity_px`` are multiples of this [px]."""
        return 16

    @property
    def min_side_px(self) -> int:
        """Smallest image side that the network takes [px]: its largest pool sees one window."""
        return max(16, -(-4 * max(self.pools) // 16) * 16)


@dataclass(frozen=True, kw_only=True)
class LightConfig:
    """Size and conventions of the light stereo network."""

    max_disparity_px: int = 192
    """Disparities below this are considered; a multiple of 32."""

    groups: int = 8
    """Channels of the correlation volume: features are correlated in so many groups."""

    width: int = 48
    """Features of each pixel that is matched; a multiple of ``groups``."""

    volume_widths: tuple[int, int, int, int] = (8, 16, 32, 48)
    """Channels of the volume at 1/4, 1/8, 1/16 and 1/32 of the image's sides."""

    candidates: int = 2
    """Disparities of the highest scores whose mean is the answer."""

    encoder_width: float = 1.0
    """Channels of the encoder as a share of EfficientNet-Lite0's; ImageNet's weights need 1."""

    with_agreement: bool = False
    """Whether the upsampling compares both views, at half size, under the disparities it chooses
    from; weights without it can be trained on with it."""

    with_refinement: bool = False
    """Whether both views are compared once more, at half size, around the disparity found, which
    is corrected; weights without it can be trained on with it."""

    with_sky: bool = False
    """Whether the sky is a class of its own, beside the disparities; weights without it can be
    trained on with it."""

    work_focal_px: float | None = None
    """Pairs are brought to this focal length before matching [px]; None: matched as they are."""

    def __post_init__(self) -> None:
        """Refuse sizes that the network cannot have."""
        check_settings(
            self,
            max_disparity_px="[32, 16384]",
            groups="[1, inf)",
            width="[1, inf)",
            volume_widths="[1, inf)",
            candidates=f"[1, {self.max_disparity_px // 4}]",
            encoder_width="(0, 4]",
            work_focal_px="(0, inf)",
        )
        if self.max_disparity_px % 32:
            raise InputError(
                "max_disparity_px must be a multiple of 32 (the volume is a quarter of it and is "
                f"halved three times), got {self.max_disparity_px}; take 192"
            )
        if self.width % self.groups:
            raise InputError(
                f"width must be a multiple of groups, got width={self.width} and "
                f"groups={self.groups}; take 48 and 8"
            )

    @property
    def step_px(self) -> int:
        """Sides of images and ``max_disparity_px`` are multiples of this [px]."""
        return 32

    @property
    def min_side_px(self) -> int:
        """Smallest image side that the network takes [px]."""
        return 32


@dataclass(frozen=True, kw_only=True)
class MatcherConfig:
    """How a stereo network is run on a pair of images."""

    device: str = "cpu"
    """Where to compute: cpu, cuda, cuda:1, ..."""

    precision: Literal["fp32", "bf16"] = "fp32"
    """fp32 is exact; bf16 is faster and halves the memory, at some hundredths of a pixel. A
    processor without bf16 (AVX-512, AMX) takes fp32."""

    speed: Speed = "fine"
    """Of one image: quick looks at it once, fine at all ``scales`` of a generator that selects.
    Of pairs of a known camera: quick matches at the focal length that the weights were trained at;
    fine, where that is more, at up to 280,000 pixels and never enlarged (PSMNet), or at up to
    650,000 and 1.5 times the images' sides (light), and through up to 1.5 (PSMNet) or 1.75 times
    the disparities: for KITTI 3 to 5 times the time. Weights that match pairs as they are have one
    speed."""

    max_memory_bytes: int | None = None
    """Bound on the memory of activations, exact (no tiles); None: no bound."""

    tile_px: tuple[int, int] | None = None
    """Rows and columns of tiles that are matched one by one and blended: approximate."""

    tile_overlap_px: int = 64
    """Overlap of neighbouring tiles, beyond the disparity range to the left of each."""

    with_confidence: bool = True
    """Say for each pixel how sure the match is."""

    with_left_right_check: bool = False
    """Match the mirrored pair too and lower the confidence where both disagree: twice the time."""

    with_compile: bool = False
    """Compile the feature extractor: pays after many images of one size."""

    def __post_init__(self) -> None:
        """Refuse values that no run can have."""
        check_settings(
            self, max_memory_bytes="[1, inf)", tile_px="[1, inf)", tile_overlap_px="[0, inf)"
        )


@dataclass(frozen=True, kw_only=True)
class SGBMConfig:
    """Semi-global block matching of OpenCV (Hirschmueller 2008), with the settings of our tables.

    The names follow OpenCV's documentation of ``StereoSGBM``.
    """

    num_disparities: int = 192
    """Disparities 0 .. num_disparities - 1 are considered; a multiple of 16."""

    block_size: int = 3
    """Side of the matched window [px], odd."""

    p1: int = 8 * 3 * 9
    """Penalty of a disparity step of 1 between neighbours."""

    p2: int = 32 * 3 * 9
    """Penalty of a larger step; more than p1."""

    disp12_max_diff: int = 1
    """Largest difference allowed in the left-right check [px]."""

    pre_filter_cap: int = 63
    """Bound of the horizontal gradient that is matched."""

    uniqueness_ratio: int = 10
    """Percent by which the best cost must beat the second."""

    speckle_window_size: int = 100
    """Islands of at most so many pixels are dropped."""

    speckle_range: int = 2
    """Disparity step inside an island [px]."""

    mode: Literal["sgbm", "hh", "sgbm_3way", "hh4"] = "sgbm_3way"
    """Directions of aggregation: 5, 8, 3 or 4."""

    with_filled_holes: bool = False
    """Fill pixels without an answer as the KITTI devkit does: the smaller neighbour of the row."""

    def __post_init__(self) -> None:
        """Refuse values that OpenCV would misread."""
        check_settings(self, num_disparities="[16, inf)", block_size="[1, inf)")
        if self.num_disparities % 16:
            raise InputError(
                f"num_disparities must be a multiple of 16, got {self.num_disparities}"
            )
        if self.block_size % 2 == 0:
            raise InputError(f"block_size must be odd, got {self.block_size}")
        if not 0 < self.p1 < self.p2:
            raise InputError(f"p1 and p2 must be 0 < p1 < p2, got p1={self.p1}, p2={self.p2}")
