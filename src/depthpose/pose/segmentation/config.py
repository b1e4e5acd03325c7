"""Every knob of segmentation."""

from dataclasses import dataclass
from typing import Literal

from depthpose.core.errors import InputError


@dataclass(frozen=True, kw_only=True)
class SegmentationConfig:
    """The network, how an image is brought to it, and what becomes of its answer."""

    stride: Literal[8, 16, 32] = 8
    """FCN-8s, 16s or 32s: size in pixels of the finest features that have a say."""

    widths: tuple[int, int, int, int] = (64, 128, 256, 512)
    """Channels of the encoder's stages; published weights have these."""

    long_side_px: int = 640
    """Images are brought to this long side before the network, up or down, and the answer is
    brought back."""

    with_one_instance: bool = True
    """An image shows each object once: the largest connected part is kept, the others are errors.
    Else each connected part is an instance."""

    min_share: float = 0.0005
    """Parts below this share of the image's pixels are no object (150 pixels of 640x480)."""

    def __post_init__(self) -> None:
        """Refuse sizes that the network cannot have."""
        if min(self.widths) < 1:
            raise InputError(f"widths must be 1 or more, got {self.widths}")
        if self.long_side_px < 32:
            raise InputError(
                f"long_side_px is {self.long_side_px}, but the coarsest feature is 32 pixels wide; "
                "take 640"
            )
        if not 0 <= self.min_share < 1:
            raise InputError(
                f"min_share is {self.min_share}, but it is a share of the image; take 0.0005"
            )
