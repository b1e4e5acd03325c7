"""Settings of depth: frozen dataclasses that refuse unusable values."""

from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from depthpose.core.config import ASCENDING, Settings
from depthpose.core.errors import InputError

TruthKind = Literal["scan", "annotated", "disparity"]
"""scan: one LiDAR scan, drawn into the left image; annotated: a depth map of the left image
(KITTI's annotated maps, filled-in LiDAR of object frames); disparity: the left image's own."""

COLOR_RANGE_M = (3.0, 80.0)
"""Depths of the first and the last colour, the same for all pictures, so that they compare."""

_MAX_FOCAL_PX = 20_000
"""Largest focal length that pairs are brought to: several times that of the largest images. Beyond
it images would fill the memory."""
_FOCAL_PX = f"[1, {_MAX_FOCAL_PX}]"
_BASELINE_M = "[0.0001, 1000]"
_DISPARITY_PX = "[0.01, 16384]"
"""Ranges of the rigs of weights, within which depth is finite and above 0."""


@dataclass(frozen=True, kw_only=True)
class DegradeConfig(Settings):
    """Augmentation of the input image alone, for transfer from synthetic to real images."""

    color: Annotated[float, "[0, 1)"] = 0.35
    """Exposure, contrast, saturation and gamma are each scaled by up to 1 +- this, each channel by
    up to 1 +- a third of it."""

    hue_share: Annotated[float, "[0, 1]"] = 0.1
    """Share of images whose channels are exchanged."""

    haze_share: Annotated[float, "[0, 1]"] = 0.2
    """Share of images with haze."""

    glare_share: Annotated[float, "[0, 1]"] = 0.2
    """Share of images with glare, which fades from one place on."""

    blur_share: Annotated[float, "[0, 1]"] = 0.4
    """Share of images that are blurred."""

    blur_px: Annotated[float, "[0.3, inf)"] = 1.2
    """Largest standard deviation of the blur [px]."""

    noise_share: Annotated[float, "[0, 1]"] = 0.6
    """Share of images with noise."""

    noise: Annotated[float, "[0, inf)"] = 0.04
    """Largest standard deviation of the noise; white is 1."""

    jpeg_share: Annotated[float, "[0, 1]"] = 0.3
    """Share of images that go through JPEG."""


@dataclass(frozen=True, kw_only=True)
class AugmentConfig(Settings):
    """Random changes of a training pair (thesis, 2.4.2)."""

    crop_px: Annotated[tuple[int, int], "[1, inf)"] = (256, 512)
    """Rows and columns of the crop."""

    scale: Annotated[tuple[float, float], "(0, 10]", ASCENDING] = (1.0, 1.0)
    """Range of the factor by which a pair is resized. A pair smaller than the crop is padded with
    black on the right and below, never enlarged: another size would be another focal length."""

    jitter: Annotated[float, "[0, 1)"] = 0.2
    """Brightness, contrast and saturation are each scaled by 1 +- this."""

    flip_share: Annotated[float, "[0, 1]"] = 0.5
    """Share of pairs that are mirrored and swapped."""

    per_view: DegradeConfig | None = None
    """Changes of each view on its own, as two cameras differ; None: none."""

    erased_share: Annotated[float, "[0, 1]"] = 0.0
    """Share of pairs with a patch of the right view in one colour: what only one camera sees."""

    misaligned_px: Annotated[float, "[0, 10)"] = 0.0
    """Rows of the right view are off by up to this at either border, as after a worn calibration
    [px]."""


@dataclass(frozen=True, kw_only=True)
class StreetsConfig(Settings):
    """Settings of synthetic street scenes, seen by the five rigs of KITTI's recording days."""

    seed: Annotated[int, "[0, inf)"] = 0
    """Another seed, other streets."""

    frames: Annotated[int, "[0, inf)"] = 100_000
    """How many there are; each is rendered on demand."""

    scale: Annotated[float, "[0.02, 4]"] = 1.0
    """Size of the pictures as a share of the rig's: 0.5 draws half as many rows and columns."""

    clutter_share: Annotated[float, "[0, 1]"] = 0.0
    """Share of the scenes that are clutter in place of a street: shapes of all kinds and surfaces,
    floating before a ground, a wall or in a box."""

    with_lidar: bool = False
    """Scan each scene with a LiDAR too."""

    jpeg_share: Annotated[float, "[0, 1]"] = 0.5
    """Share of the pairs that went through JPEG."""

    rectification_error_px: Annotated[float, "[0, 10)"] = 0.1
    """Deviation of the rows by which the right view is off, as after a real calibration."""


@dataclass(frozen=True, kw_only=True)
class NearConfig(Settings):
    """Settings of synthetic near scenes: rooms, tables, bins, shelves, walls with things."""

    seed: Annotated[int, "[0, inf)"] = 0
    """Another seed, other scenes."""

    columns_px: Annotated[tuple[float, float], "[64, 4096]", ASCENDING] = (448.0, 800.0)
    """Range of the width of the pictures."""

    largest_share: Annotated[float, "[0.02, 0.9]"] = 0.5
    """Largest disparity of the nearest thing as a share of the width; the least is 8 px."""

    plain_share: Annotated[float, "[0, 1]"] = 0.45
    """Share of the walls, floors and table tops that show next to no texture."""

    infrared_share: Annotated[float, "[0, 1]"] = 0.3
    """Share of the pairs that infrared cameras take."""

    dots_share: Annotated[float, "[0, 1]"] = 0.5
    """Share of these pairs in which a projector adds a pattern of dots."""

    grey_share: Annotated[float, "[0, 1]"] = 0.15
    """Share of the other pairs that grey cameras take."""

    border_share: Annotated[float, "[0, 1]"] = 0.15
    """Share of the pairs with black borders, as a rectification leaves them."""

    jpeg_share: Annotated[float, "[0, 1]"] = 0.3
    """Share of the pairs that went through JPEG."""

    rectification_error_px: Annotated[float, "[0, 10)"] = 0.15
    """Deviation of the rows by which the right view is off, as after a real calibration."""


@dataclass(frozen=True, kw_only=True)
class PairsConfig(Settings):
    """Settings of the pairs that a training sees: which ones, and how they are changed."""

    folders: tuple[str, ...] = ()
    """Datasets on disk: KITTI raw, object, 2015, Middlebury, plain folders (see ``--data``)."""

    streets: StreetsConfig | None = None
    """Streets that are rendered while training, each on demand; beside the folders' pairs."""

    split: str | None = None
    """Name or file of a split, for the first folder."""

    exclude: tuple[str, ...] = ()
    """Names of frames to leave out."""

    truth: TruthKind | None = None
    """Which truth of the folders is learnt from, one kind alone; frames without it are left out.
    None: the one kind that a folder has; a folder with several is refused. Streets that are
    rendered while training have exact disparity, whatever this says."""

    limit: Annotated[int | None, "[1, inf)"] = None
    """Largest number of pairs of each folder, and of streets, spread evenly; None: all."""

    focal_px: Annotated[float | None, f"(0, {_MAX_FOCAL_PX}]"] = None
    """Bring every pair to this focal length [px]; None: that of the generator, or sizes as they
    are. Before ``augment.scale``: give the largest focal length that it is to make, and scales up
    to 1, and no image is enlarged."""

    with_cache: bool = False
    """Keep decoded pairs in memory (8 bit): for sets that fit."""

    augment: AugmentConfig = field(default_factory=AugmentConfig)
    """Random changes."""


BaselineName = Literal["rows", "nearest"]
"""The best constant depth of each image row; the depth of the training image most alike."""


Speed = Literal["quick", "fine"]
"""How much time a match may take: see :class:`MatcherConfig`."""


@dataclass(frozen=True, kw_only=True)
class NetworkConfig(Settings):
    """Settings that every stereo network has."""

    max_disparity_px: int = 192
    """Disparities below this are considered; a multiple of ``step_px``."""

    work_focal_px: Annotated[float | None, _FOCAL_PX] = None
    """Pairs are brought to this focal length before matching [px]; None: matched as they are."""

    with_sky: ClassVar[bool] = False
    """Whether the sky is a class of its own, beside the disparities."""

    step_px: ClassVar[int] = 16
    """Sides of images and ``max_disparity_px`` are multiples of this [px]."""

    min_side_px: ClassVar[int] = 16
    """Smallest image side that the network takes [px]."""


@dataclass(frozen=True, kw_only=True)
class PSMNetConfig(NetworkConfig):
    """Size and conventions of the stereo network (Chang and Chen 2018, stacked hourglass)."""

    max_disparity_px: Annotated[int, "[16, 16384]", 16] = 192
    """Disparities 0 .. max_disparity_px - 1 are considered; a multiple of 16, for the volume is a
    quarter of it and is halved twice."""

    width: Annotated[int, "[1, inf)"] = 32
    """Channels of the first layers; all others are 1, 2 or 4 times it."""

    blocks: Annotated[tuple[int, int, int, int], "[1, 1000]"] = (3, 16, 3, 3)
    """Residual blocks of the four stages of the feature extractor."""

    pools: Annotated[tuple[int, ...], "[1, 1024]"] = (64, 32, 16, 8)
    """Windows of the spatial pyramid, in quarter-size pixels, largest first."""

    align_corners: bool = True
    """How the weights expect maps to be enlarged: True for the published KITTI 2015 weights."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= len(self.pools) <= 16:
            raise InputError(f"pools must hold 1 to 16 windows, got {self.pools}")

    @property
    def min_side_px(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Smallest image side that the network takes [px]: its largest pool sees one window."""
        return max(16, -(-4 * max(self.pools, default=0) // 16) * 16)


@dataclass(frozen=True, kw_only=True)
class LightConfig(NetworkConfig):
    """Size and conventions of the light stereo network."""

    max_disparity_px: Annotated[int, "[32, 16384]", 32] = 192
    """Disparities below this are considered; a multiple of 32: the volume is halved three times."""

    groups: Annotated[int, "[1, inf)"] = 8
    """Channels of the correlation volume: the groups in which features are correlated."""

    width: Annotated[int, "[1, inf)"] = 48
    """Features of each pixel that is matched; a multiple of ``groups``."""

    volume_widths: Annotated[tuple[int, int, int, int], "[1, inf)"] = (8, 16, 32, 48)
    """Channels of the volume at 1/4, 1/8, 1/16 and 1/32 of the image's sides."""

    encoder_width: Annotated[float, "(0, 4]"] = 1.0
    """Channels of the encoder as a share of EfficientNet-Lite0's; ImageNet's weights need 1."""

    with_sky: bool = False  # pyright: ignore[reportIncompatibleVariableOverride]
    """Whether the sky is a class of its own, beside the disparities; weights without it can be
    trained on with it."""

    step_px: ClassVar[int] = 32
    min_side_px: ClassVar[int] = 32


@dataclass(frozen=True, kw_only=True)
class MatcherConfig(Settings):
    """Settings by which networks are run on pairs and images."""

    device: str = "cpu"
    """Where to compute: cpu, cuda, cuda:1, ..."""

    precision: Literal["fp32", "bf16"] = "fp32"
    """fp32 is exact; bf16 is faster and halves the memory, at some hundredths of a pixel. A
    processor without bf16 (AVX-512, AMX) takes fp32."""

    speed: Speed = "fine"
    """With one image, quick looks at it once, fine in two sizes, if the generator selects.
    With pairs of a known camera, quick matches at the focal length of the weights' training;
    fine, where that is more, at up to 280,000 pixels and never enlarged (PSMNet), or at up to
    650,000 and 1.5 times the images' sides (light), and through up to 1.5 (PSMNet) or 1.75 times
    the disparities: for KITTI 3 to 5 times the time. Weights that match pairs as they are have one
    speed."""

    max_disparity_px: Annotated[float | None, "(0, inf)"] = None
    """Largest disparity of real pairs, in their own pixels; None: it is measured (light network).
    What lies beyond it is named, and has a confidence of 0."""

    max_memory_bytes: Annotated[int | None, "[1, inf)"] = None
    """Bound on the memory of activations; None: no bound."""

    with_confidence: bool = True
    """Say for each pixel how sure the match is."""

    with_left_right_check: bool = False
    """Match the mirrored pair too and lower the confidence where both disagree: twice the time."""


@dataclass(frozen=True, kw_only=True)
class SGBMConfig(Settings):
    """OpenCV's semi-global block matching (Hirschmueller 2008), with the settings of our tables."""

    num_disparities: Annotated[int, "[16, inf)", 16] = 192
    """Disparities 0 .. num_disparities - 1 are considered; a multiple of 16.

    Where the principal points of a rig differ by ``d = cx_right - cx_left``, its views are first
    moved by this difference, so disparities grow by d: for a range given of the images as they are
    (Middlebury's ``ndisp``), take d more."""

    with_filled_holes: bool = False
    """Fill pixels without an answer as the KITTI devkit does: the smaller neighbour of the row."""


Answer = Literal["own", "matched"]
"""Where the disparity of one image comes from. own: the generator, which estimates disparity beside
the right view (no matcher runs). matched: the matcher, on the image and the right view that the
generator drew."""


@dataclass(frozen=True, kw_only=True)
class GeneratorConfig(Settings):
    """Size and conventions of the view synthesis network (pix2pix's U-Net), and its rig.

    The generator draws what one rig would have seen, so its weights carry that rig: an image is
    brought to ``virtual_focal_px`` before, and depth is virtual focal x baseline / disparity.
    """

    width: Annotated[int, "[1, inf)"] = 64
    """Channels of the first level; they double up to eight times it."""

    levels: Annotated[int, "[2, 10]"] = 8
    """Halvings down to the bottleneck; image sides are padded to multiples of 2 ** levels."""

    with_dropout: bool = True
    """Dropout of 0.5 in the inner decoder blocks while training."""

    virtual_focal_px: Annotated[float, _FOCAL_PX] = 493.0
    """Focal length of the imitated rig [px]; by default that at which KITTI's images have the 256
    rows of the thesis's crops: with fewer of the rows a network must guess the horizon."""

    virtual_baseline_m: Annotated[float, _BASELINE_M] = 0.5327
    """Baseline of the imitated rig [m]."""

    answer: ClassVar[Answer] = "matched"
    """Where depth comes from: this network has no disparity of its own."""

    depth_std: ClassVar[float] = 0.12
    road_tilt_off_deg: ClassVar[float] = -0.4
    """As in :class:`SelectionConfig`; of this network they were not measured."""

    @property
    def side_multiple_px(self) -> int:
        """Both sides of an image are multiples of this [px]."""
        return 2**self.levels


@dataclass(frozen=True, kw_only=True)
class SelectionConfig(Settings):
    """Size and conventions of the network that selects the right view, and its rig.

    It answers, for each pixel of either view, a distribution over disparities and the sky. As with
    :class:`GeneratorConfig`, an image is brought to ``virtual_focal_px`` before.
    """

    encoder_width: Annotated[float, "(0, 4]"] = 1.0
    """Channels of the encoder as a share of Lite0's; ImageNet's weights are of 1."""

    widths: Annotated[tuple[int, int, int, int], "[1, inf)"] = (96, 64, 48, 32)
    """Channels of the decoder at strides 16, 8, 4 and 2."""

    planes: Annotated[int, "[2, inf)"] = 32
    """Disparities that are distinguished, evenly spaced in their logarithm."""

    disparity_px: Annotated[tuple[float, float], _DISPARITY_PX, ASCENDING] = (1.2, 88.0)
    """Least and largest disparity at the virtual rig [px]: 165 to 2.25 m at the default rig."""

    answer: Answer = "own"
    """Where depth of one image comes from; see ``Answer``."""

    with_street: bool = False
    """Has a layer that reads off the encoder's features how surely the image shows a street."""

    least_confidence: Annotated[float, "[0, 1)"] = 0.0
    """Probability of a street below which an image is out of distribution, or mean confidence where
    ``with_street`` is false; 0: not checked. 'depthpose depth calibrate' finds it."""

    virtual_focal_px: Annotated[float, _FOCAL_PX] = 372.0
    """Focal length of the imitated rig [px]: half of KITTI's, as wide as 640 columns."""

    virtual_baseline_m: Annotated[float, _BASELINE_M] = 0.5327
    """Baseline of the imitated rig [m]."""

    depth_std: Annotated[float, "(0, 1]"] = 0.12
    """Deviation of the logarithm of depth, by which it is weighed against where the ground is."""

    road_tilt_off_deg: Annotated[float, "[-10, 10]"] = -0.4
    """Tilt of a road in the estimated depth against the true one: negative where its far end is too
    near. -0.5 degrees by `default` on KITTI, -0.2 on synthetic streets."""

    side_multiple_px: ClassVar[int] = 32
    """Both sides of an image are multiples of this [px]."""
