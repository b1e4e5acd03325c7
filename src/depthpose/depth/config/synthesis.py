"""Knobs of the view synthesis network."""

from dataclasses import dataclass
from typing import Literal

from depthpose.core.errors import InputError


@dataclass(frozen=True, kw_only=True)
class GeneratorConfig:
    """Size and conventions of the view synthesis network (pix2pix's U-Net), and its rig.

    The generator draws what one rig would have seen, so its weights carry that rig: an image is
    brought to ``virtual_focal_px`` before, and depth is virtual focal x baseline / disparity.
    """

    width: int = 64
    """Channels of the first level; they double up to eight times it."""

    levels: int = 8
    """Halvings down to the bottleneck; image sides are padded to multiples of 2 ** levels."""

    with_dropout: bool = True
    """Dropout of 0.5 in the inner decoder blocks while training."""

    test_mode: Literal["running", "batch"] = "running"
    """Norm at test: the statistics of training without dropout, or the image's own with it."""

    virtual_focal_px: float = 721.5377
    """Focal length of the imitated rig [px]; KITTI's by default."""

    virtual_baseline_m: float = 0.5327
    """Baseline of the imitated rig [m]."""

    def __post_init__(self) -> None:
        """Refuse sizes that the network cannot have."""
        if self.width < 1:
            raise InputError(f"width must be 1 or more channels, got {self.width}; take 64")
        if not 2 <= self.levels <= 10:
            raise InputError(f"levels must be 2 .. 10, got {self.levels}; take 8")
        if self.test_mode not in ("running", "batch"):
            raise InputError(f"test_mode must be 'running' or 'batch', got {self.test_mode!r}")
        if self.virtual_focal_px <= 0 or self.virtual_baseline_m <= 0:
            raise InputError(
                f"the virtual rig needs a positive focal length and baseline, got "
                f"{self.virtual_focal_px} px and {self.virtual_baseline_m} m"
            )

    @property
    def widths(self) -> tuple[int, ...]:
        """Channels after each level of the encoder."""
        return tuple(self.width * min(2**level, 8) for level in range(self.levels))

    @property
    def side_multiple_px(self) -> int:
        """Both sides of an image are multiples of this [px]."""
        return 2**self.levels
