"""Settings of training data: pairs on disk, their random changes, synthetic streets."""

from dataclasses import dataclass, field
from typing import Literal

from depthpose.core.config import check_settings
from depthpose.core.errors import InputError

TruthKind = Literal["scan", "annotated", "disparity"]
"""scan: one LiDAR scan, drawn into the left image; annotated: a depth map of the left image
(KITTI's annotated maps, filled-in LiDAR of object frames); disparity: the left image's own."""

_MOST_FOCAL_PX = 20_000
"""Of pairs: several times that of the largest images; beyond it they would fill the memory."""


@dataclass(frozen=True, kw_only=True)
class DegradeConfig:
    """Augmentation of the input image alone, for transfer from synthetic to real images."""

    colour: float = 0.35
    """Exposure, contrast, saturation, gamma are scaled by 1 +- this, channels by a third of it."""

    hue_share: float = 0.1
    """Share of images whose channels are exchanged."""

    haze_share: float = 0.2
    """Share of images with haze."""

    glare_share: float = 0.2
    """Share of images with a light in them."""

    blur_share: float = 0.4
    """Share of images that are blurred."""

    blur_px: float = 1.2
    """Largest standard deviation of the blur [px]."""

    noise_share: float = 0.6
    """Share of images with noise."""

    noise: float = 0.04
    """Largest standard deviation of the noise; white is 1."""

    jpeg_share: float = 0.3
    """Share of images that go through JPEG."""

    def __post_init__(self) -> None:
        """Refuse shares that are none."""
        shares = [f"{name}_share" for name in ("hue", "haze", "glare", "blur", "noise", "jpeg")]
        check_settings(
            self,
            **dict.fromkeys(shares, "[0, 1]"),
            colour="[0, 1)",
            blur_px="[0.3, inf)",
            noise="[0, inf)",
        )


@dataclass(frozen=True, kw_only=True)
class AugmentConfig:
    """Random changes of a training pair (thesis, 2.4.2)."""

    crop_px: tuple[int, int] = (256, 512)
    """Rows and columns of the crop."""

    scale: tuple[float, float] = (1.0, 1.0)
    """Range of the size at which a pair is seen. A pair smaller than the crop is padded with black
    on the right and below, never enlarged: another size would be another focal length."""

    jitter: float = 0.2
    """Brightness, contrast and saturation are each scaled by 1 +- this."""

    flip_share: float = 0.5
    """Share of pairs that are mirrored and swapped."""

    per_view: DegradeConfig | None = None
    """Changes of each view on its own, as two cameras differ; None: none."""

    erased_share: float = 0.0
    """Share of pairs with a patch of the right view in one colour: what only one camera sees."""

    misaligned_px: float = 0.0
    """Rows of the right view are off by up to this at either border, as after a worn calibration
    [px]."""

    def __post_init__(self) -> None:
        """Refuse changes that would break a pair."""
        check_settings(
            self,
            crop_px="[1, inf)",
            scale="(0, 10]",
            jitter="[0, 1)",
            flip_share="[0, 1]",
            erased_share="[0, 1]",
            misaligned_px="[0, 10)",
        )
        if self.scale[0] > self.scale[1]:
            raise InputError(f"scale must be a range, the lower end first, got {self.scale}")


@dataclass(frozen=True, kw_only=True)
class StreetsConfig:
    """What synthetic street scenes are like."""

    seed: int = 0
    """Another seed, other streets."""

    frames: int = 100_000
    """How many there are; each is rendered on demand."""

    rigs: Literal["kitti", "varied"] = "kitti"
    """kitti: the five rigs of KITTI's recording days; varied: half of the frames with others."""

    scale: float = 1.0
    """Size of the pictures as a share of the rig's: 0.5 draws half as many rows and columns."""

    crop: tuple[int, int] | None = None
    """Rows and columns of a window that alone is drawn, somewhere in each frame; None: all."""

    clutter_share: float = 0.0
    """Share of the scenes that are clutter in place of a street: shapes of all kinds and surfaces,
    floating before a ground, a wall or in a box."""

    with_antialiasing: bool = True
    """Four samples in pixels where edges show."""

    with_lidar: bool = False
    """Scan each scene with a LiDAR too."""

    jpeg_share: float = 0.5
    """Share of the pairs that went through JPEG."""

    rectification_error_px: float = 0.1
    """Deviation of the rows by which the right view is off, as after a real calibration."""

    def __post_init__(self) -> None:
        """Refuse what cannot be drawn."""
        check_settings(
            self,
            seed="[0, inf)",
            frames="[0, inf)",
            scale="[0.02, 4]",
            crop="[1, inf)",
            jpeg_share="[0, 1]",
            clutter_share="[0, 1]",
            rectification_error_px="[0, 10)",
        )


@dataclass(frozen=True, kw_only=True)
class PairsConfig:
    """Which pairs a training sees, and how."""

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

    limit: int | None = None
    """Take so many pairs of each folder, and so many streets, spread evenly; None: all."""

    focal_px: float | None = None
    """Bring every pair to this focal length [px]; None: that of the generator, or sizes as they
    are. Before ``augment.scale``: give the largest focal length that it is to make, and scales up
    to 1, and no image is enlarged."""

    with_cache: bool = False
    """Keep decoded pairs in memory (8 bit): for sets that fit."""

    augment: AugmentConfig = field(default_factory=AugmentConfig)
    """Random changes."""

    def __post_init__(self) -> None:
        """Refuse what selects nothing."""
        check_settings(self, limit="[1, inf)", focal_px=f"(0, {_MOST_FOCAL_PX}]")
