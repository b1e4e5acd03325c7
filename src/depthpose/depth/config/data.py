"""Settings of training data: pairs on disk, their random changes, synthetic streets."""

from dataclasses import dataclass, field
from typing import Literal

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
        for name in ("hue", "haze", "glare", "blur", "noise", "jpeg"):
            share = getattr(self, f"{name}_share")
            if not 0 <= share <= 1:
                raise InputError(f"{name}_share must be from 0 to 1, got {share}")
        if not 0 <= self.colour < 1:
            raise InputError(f"colour must be in [0, 1), got {self.colour}")
        if self.blur_px < 0.3 or self.noise < 0:
            raise InputError(
                f"blur_px must be 0.3 or more and noise 0 or more, got {self.blur_px} and "
                f"{self.noise}"
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
        if min(self.crop_px) < 1:
            raise InputError(f"crop_px must be two positive sizes, got {self.crop_px}")
        if not 0 < self.scale[0] <= self.scale[1] <= 10:
            raise InputError(f"scale must be a range of positive sizes to 10, got {self.scale}")
        if not 0 <= self.jitter < 1:
            raise InputError(f"jitter must be in [0, 1), got {self.jitter}; the thesis takes 0.2")
        if not 0 <= self.flip_share <= 1:
            raise InputError(f"flip_share must be in [0, 1], got {self.flip_share}")
        if not 0 <= self.erased_share <= 1:
            raise InputError(f"erased_share must be in [0, 1], got {self.erased_share}")
        if not 0 <= self.misaligned_px < 10:
            raise InputError(f"misaligned_px must be in [0, 10), got {self.misaligned_px}")


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
        for name, value in (("seed", self.seed), ("frames", self.frames)):
            if value < 0:
                raise InputError(f"{name} must be 0 or more, got {value}")
        if self.rigs not in ("kitti", "varied"):
            raise InputError(f"rigs must be 'kitti' or 'varied', got {self.rigs!r}")
        if not 0.02 <= self.scale <= 4:
            raise InputError(f"scale must be from 0.02 to 4, got {self.scale}; 1 is full size")
        if self.crop is not None and min(self.crop) < 1:
            raise InputError(f"crop must be two positive sizes, got {self.crop}; None: no crop")
        self._refuse_shares()
        if not 0 <= self.rectification_error_px < 10:
            raise InputError(
                f"rectification_error_px must be from 0 to 10, got {self.rectification_error_px}"
            )

    def _refuse_shares(self) -> None:
        for name, share in (("jpeg_share", self.jpeg_share), ("clutter_share", self.clutter_share)):
            if not 0 <= share <= 1:
                raise InputError(f"{name} must be from 0 to 1, got {share}")


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
        if self.limit is not None and self.limit < 1:
            raise InputError(f"limit must be 1 pair or more, got {self.limit}")
        if self.focal_px is not None and not 0 < self.focal_px <= _MOST_FOCAL_PX:
            raise InputError(
                f"focal_px must be positive pixels, at most {_MOST_FOCAL_PX}, got {self.focal_px}"
            )
