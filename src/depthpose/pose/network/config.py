"""Every knob of the sparse ResUNet."""

from dataclasses import dataclass
from typing import Literal

from depthpose.core.errors import InputError

Widths = tuple[int, int, int, int]


@dataclass(frozen=True, kw_only=True)
class ResUNetConfig:
    """Size of the network (FCGF's ResUNetBN2C, Choy et al. ICCV 2019, figure 3-3 of the thesis)."""

    classes: int = 13
    """Objects that one network knows; the segmentation says which of them a cloud is."""

    keypoints: int = 8
    """Keypoints of each object."""

    with_confidence: bool = False
    """A fourth output beside each direction: the logit of how far to trust it."""

    norm: Literal["batch", "none"] = "batch"
    """batch trains within hundreds of steps and is folded for use; none is the published network,
    which barely leaves the start, though its residual branches begin scaled down."""

    with_bias: bool = False
    """A bias for each inner convolution, as folding batch norm leaves one."""

    first_kernel: int = 7
    """Size of the first convolution's kernel, in voxels: 3, 5 or 7."""

    encoder: Widths = (32, 64, 128, 256)
    """Channels of the levels going down, finest first."""

    decoder: Widths = (64, 64, 64, 128)
    """Channels of the levels coming up, finest first; the first are the features of a point."""

    inputs: int = 1
    """Features of a voxel that are given: the number 1 alone, or its shape too (9)."""

    descriptor: int | None = None
    """Outputs that are no directions, for FCGF's published descriptors; None: directions."""

    def __post_init__(self) -> None:
        """Refuse sizes that the network cannot have."""
        sizes = {
            "classes": self.classes,
            "keypoints": self.keypoints,
            "inputs": self.inputs,
            "encoder": min(self.encoder),
            "decoder": min(self.decoder),
            "descriptor": 1 if self.descriptor is None else self.descriptor,
        }
        for name, size in sizes.items():
            if size < 1:
                raise InputError(f"{name} must be 1 or more, got {getattr(self, name)}")
        if self.first_kernel not in (1, 3, 5, 7):
            raise InputError(
                f"first_kernel must be 1, 3, 5 or 7 (an odd kernel has a centre), got "
                f"{self.first_kernel}; take 7"
            )

    @property
    def components(self) -> int:
        """Numbers for each point and keypoint: a direction, and maybe a logit."""
        return 4 if self.with_confidence else 3

    @property
    def outputs(self) -> int:
        """Channels of the last layer."""
        return self.descriptor or self.classes * self.keypoints * self.components
