"""Settings of the two view synthesis networks: a U-Net (pix2pix), and selection (Deep3D)."""

from dataclasses import dataclass
from typing import Literal

from depthpose.core.errors import InputError

Answer = Literal["own", "matched", "joined"]
"""Where depth of one image comes from: the generator's own disparity, that of the matcher on left
and drawn right view, or both, weighed by their confidence."""


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

    virtual_focal_px: float = 493.0
    """Focal length of the imitated rig [px]; by default that at which KITTI's images have the 256
    rows of the thesis's crops: with fewer of the rows a network must guess the horizon."""

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
        _check_rig(self.virtual_focal_px, self.virtual_baseline_m)

    @property
    def widths(self) -> tuple[int, ...]:
        """Channels after each level of the encoder."""
        return tuple(self.width * min(2**level, 8) for level in range(self.levels))

    @property
    def answer(self) -> Answer:
        """Where depth comes from: this network has no disparity of its own."""
        return "matched"

    @property
    def side_multiple_px(self) -> int:
        """Both sides of an image are multiples of this [px]."""
        return 2**self.levels


@dataclass(frozen=True, kw_only=True)
class SelectionConfig:
    """Size and conventions of the network that selects the right view, and its rig.

    It answers, for each pixel of either view, a distribution over disparities and the sky. As with
    :class:`GeneratorConfig`, an image is brought to ``virtual_focal_px`` before.
    """

    encoder_kind: Literal["efficientnet-lite0"] = "efficientnet-lite0"
    """The encoder."""

    encoder_width: float = 1.0
    """Channels of the encoder as a share of Lite0's; ImageNet's weights are of 1."""

    widths: tuple[int, int, int, int] = (96, 64, 48, 32)
    """Channels of the decoder at strides 16, 8, 4 and 2."""

    planes: int = 32
    """Disparities that are distinguished, evenly spaced in their logarithm."""

    disparity_px: tuple[float, float] = (1.2, 88.0)
    """Least and largest disparity at the virtual rig [px]: 165 to 2.25 m at the default rig."""

    answer: Answer = "own"
    """Where depth comes from: the distribution of the left view; the matcher on left and drawn
    right view; or both, weighed by their confidence."""

    with_street: bool = False
    """Has a layer that reads off the encoder's features how surely the image shows a street."""

    least_confidence: float = 0.0
    """Probability of a street below which an image is out of distribution, or mean confidence where
    ``with_street`` is false; 0: not checked. 'depthpose depth calibrate' finds it."""

    virtual_focal_px: float = 372.0
    """Focal length of the imitated rig [px]: half of KITTI's, as wide as 640 columns."""

    virtual_baseline_m: float = 0.5327
    """Baseline of the imitated rig [m]."""

    scales: tuple[float, ...] = (1.0, 1.4)
    """Sizes at which the fine speed looks at an image, as shares of that at the virtual focal
    length, 1 the first; it averages. The quick speed looks once."""

    def __post_init__(self) -> None:
        """Refuse sizes that the network cannot have."""
        if not 0 < self.encoder_width <= 4:
            raise InputError(f"encoder_width must be above 0, at most 4; got {self.encoder_width}")
        if self.encoder_kind != "efficientnet-lite0":
            raise InputError(f"encoder_kind must be efficientnet-lite0, got {self.encoder_kind!r}")
        if min(self.widths) < 1 or self.planes < 2:
            raise InputError(
                f"widths must be 1 or more channels and planes 2 or more, got {self.widths} and "
                f"{self.planes}"
            )
        if not 0 < self.disparity_px[0] < self.disparity_px[1]:
            raise InputError(
                f"disparity_px must be a range of positive disparities, got {self.disparity_px}"
            )
        if self.answer not in ("own", "matched", "joined"):
            raise InputError(f"answer must be own, matched or joined, got {self.answer!r}")
        if not 0 <= self.least_confidence < 1:
            raise InputError(
                f"least_confidence must be from 0 to below 1, got {self.least_confidence}"
            )
        if self.scales[:1] != (1.0,) or not all(1 <= scale <= 4 for scale in self.scales):
            raise InputError(
                "scales must begin with 1, the others from 1 to 4; take (1.0, 1.4), got "
                f"{self.scales}"
            )
        _check_rig(self.virtual_focal_px, self.virtual_baseline_m)

    @property
    def side_multiple_px(self) -> int:
        """Both sides of an image are multiples of this [px]."""
        return 32


def _check_rig(focal_px: float, baseline_m: float) -> None:
    if focal_px <= 0 or baseline_m <= 0:
        raise InputError(
            f"the virtual rig needs a positive focal length and baseline, got {focal_px} px and "
            f"{baseline_m} m"
        )
