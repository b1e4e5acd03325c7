"""Right views synthesised from left images of any size, and what a selecting generator estimates.

Images are RGB in [0, 1]; they are stretched or padded to sides that the network takes. Networks use
the norm statistics of their training.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.core.devices import usable_device
from depthpose.core.files.images import check_image
from depthpose.depth.config import Speed
from depthpose.depth.disparity import resize_image
from depthpose.depth.generators import (
    Generator,
    Logits,
    Planes,
    SelectionGenerator,
    UNetGenerator,
)
from depthpose.depth.types import Maps, Views

_MAX_SHARE_OF_RANGE = 0.4
"""Largest usable share of the largest disparity that a size can have: above it expectations come
out too small, for trainings have few objects so near, and the shipped generators hardly give more
than half of it."""
_SURE_RATIO = 1.15
"""Disparities within this ratio of the expectation count as confidence in it."""


@dataclass(frozen=True, eq=False)
class Selected:
    """Disparity, sky and confidence of one view, by its distributions over disparities."""

    disparity_px: Maps  #: exponential of the mean logarithm of disparity, without the sky
    sky: Maps  #: probability of the sky
    confidence: Maps  #: probability of disparities within 15 % of the mean, without the sky
    #: probability that the image shows a street; None where the weights do not say
    street_probability: Float[Tensor, " b"] | None = None


def average_sizes(views: Sequence[Selected], limits_px: Sequence[float]) -> Selected:
    """Average the estimates of one view that were made from the image at several sizes.

    A mean over sizes has the smaller error. The confidence stays that of the first size, which
    ranks these errors better than a mean of confidences (AUSE 0.34 and 0.41 of chance).

    Args:
        views: the estimates, resized to one size. Where the disparity of the first is near the
            limit of another, that other does not count.
        limits_px: the largest disparity that each can have, at that one size.
    """
    first = views[0]
    if len(views) == 1:
        return first
    is_within = [first.disparity_px < _MAX_SHARE_OF_RANGE * limit_px for limit_px in limits_px]
    counts = torch.stack(is_within)
    counts[0] = True
    weights = counts / counts.sum(0)
    log_px = torch.stack([view.disparity_px.log() for view in views])
    sky = torch.stack([view.sky for view in views])
    return Selected(
        disparity_px=(weights * log_px).sum(0).exp(),
        sky=(weights * sky).sum(0),
        confidence=first.confidence,
        street_probability=first.street_probability,
    )


def read_logits(logits: Logits, planes: Planes) -> tuple[Tensor, Tensor, Tensor]:
    """Give the log of disparity, the probability of sky, and the confidence of the disparity.

    Each is (b, rows, columns), at the size of the logits. The log of disparity is the mean over the
    planes, because in the mean of disparity itself one plane at 88 px would outweigh many at 2 px.
    The confidence is the probability of planes near that mean. Both leave out the sky.
    """
    logits = logits.float()
    sky = logits.softmax(1)[:, 0]

    probabilities = logits[:, 1:].softmax(1)
    log_planes = planes.log()
    log_px = torch.einsum("bkhw,k->bhw", probabilities, log_planes)
    is_near = (log_planes[:, None, None] - log_px[:, None]).abs() <= math.log(_SURE_RATIO)
    confidence = (probabilities * is_near).sum(1)
    return log_px, sky, confidence


def warp_left_to_right(left: Views, right_px: Maps) -> Views:
    """Synthesise the right view: sample ``left`` at ``x + disparity`` for each right pixel x.

    Beyond the border the border repeats. Unlike a mixture of shifts (:func:`mix_shifts`), whose L1
    error is lower, it has no ghosts, which no matcher can match.
    """
    height, width = left.shape[-2:]
    columns = torch.arange(width, device=left.device) + right_px
    rows = torch.arange(height, device=left.device)[:, None].expand_as(columns)
    # grid_sample's coordinates: -1 and 1 are the outer borders of the image.
    x = (2 * columns + 1) / width - 1
    y = (2 * rows + 1) / height - 1
    grid = torch.stack([x, y], -1)
    return F.grid_sample(left, grid.to(left.dtype), padding_mode="border", align_corners=False)


def mix_shifts(left: Views, logits: Logits, planes: Planes) -> Views:
    """Synthesise the right view as the mean of shifted left images, weighted by probability.

    Used in training, since every shift gets a gradient. ``logits`` have the size of ``left``, and
    ``planes`` count its pixels.
    """
    width = left.shape[-1]
    max_shift = math.ceil(float(planes[-1])) + 1
    padded = F.pad(left, (0, max_shift, 0, 0), mode="replicate")
    probabilities = logits.softmax(1)
    mixed = probabilities[:, :1] * left  # the sky is not shifted
    for number, shift in enumerate(planes.tolist(), 1):
        whole = math.floor(shift)
        fraction = shift - whole
        lower = padded[..., whole : whole + width]
        upper = padded[..., whole + 1 : whole + 1 + width]
        shifted = torch.lerp(lower, upper, fraction)
        mixed = mixed + probabilities[:, number : number + 1] * shifted
    return mixed


ROWS_SHARE = 0.03
"""Largest share by which rows are stretched to a side that a network takes: no disparity depends on
them."""

COLUMNS_SHARE = 0.01
"""Largest share by which columns are stretched to a side that a network takes: depth is off by as
much."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SynthesisedViews:
    """Right views of left images; and maps of the left views where the generator estimates them."""

    right: Views  #: the right views, RGB in [0, 1]
    disparity_px: Maps | None = None  #: disparity of the left views, without the sky
    #: probability of disparities within 15 % of ``disparity_px``; in the sky that of the sky
    confidence: Maps | None = None
    is_sky: Bool[Tensor, "b h w"] | None = None  #: where the sky is more probable than not
    #: probability that an image shows a street; None where the weights do not say
    street_probability: Float[Tensor, " b"] | None = None


class SelectionSynthesiser:
    """Synthesises right views by a generator that selects; estimates the left view's disparity too.

    At the fine speed it averages the estimates of an image at 1 and at 1.4 times its size at the
    virtual focal length; at the quick speed it has the first alone.
    """

    def __init__(
        self,
        generator: SelectionGenerator,
        device: torch.device | str = "cpu",
        speed: Speed = "fine",
    ) -> None:
        self.device = usable_device(device)
        self.generator = generator.to(self.device).eval()
        self.config = generator.config
        self.scales = (1.0, 1.4) if speed == "fine" else (1.0,)

    @torch.no_grad()
    def draw(self, left: Views, *larger: Float[Tensor, "b 3 _ _"]) -> SynthesisedViews:
        """Synthesise right views; images are RGB in [0, 1].

        Args:
            left: images at the virtual focal length; the result has their size.
            larger: the same images, larger; disparity and sky are means over all sizes.

        Raises:
            InputError: an image does not lie in [0, 1].
        """
        inputs = (left, *larger)
        for images in inputs:
            for image in images:
                check_image(image, "the left image")
        on_device = [images.to(self.device, torch.float32) for images in inputs]

        # Estimates of both views by each size of the image, averaged.
        size = (left.shape[-2], left.shape[-1])
        max_px = float(self.generator.planes[-1])
        limits_px = [max_px * size[1] / images.shape[-1] for images in on_device]
        views_by_size = [select_views(self.generator, images, size) for images in on_device]
        lefts, rights = zip(*views_by_size, strict=True)
        left_view = average_sizes(lefts, limits_px)
        right_view = average_sizes(rights, limits_px)

        right = _warp_by_estimate(on_device[0], right_view)
        is_sky = left_view.sky > 0.5
        disparity_confidence = left_view.confidence * (1 - left_view.sky)
        confidence = torch.where(is_sky, left_view.sky, disparity_confidence)
        street_probability = left_view.street_probability
        if street_probability is not None:
            street_probability = street_probability.to(left.device)
        return SynthesisedViews(
            right=right.to(left.device),
            disparity_px=left_view.disparity_px.to(left.device),
            confidence=confidence.to(left.device),
            is_sky=is_sky.to(left.device),
            street_probability=street_probability,
        )


class UNetSynthesiser:
    """Synthesises right views of images of any size with pix2pix's U-Net.

    Batch norm uses the statistics of training, and there is no dropout.
    """

    scales = (1.0,)

    def __init__(self, generator: UNetGenerator, device: torch.device | str = "cpu") -> None:
        self.device = usable_device(device)
        self.generator = generator.to(self.device).eval()
        self.config = generator.config

    @torch.no_grad()
    def draw(self, left: Views, *larger: Float[Tensor, "b 3 _ _"]) -> SynthesisedViews:
        """Synthesise right views; images are RGB in [0, 1], and there are no ``larger`` ones.

        Raises:
            InputError: an image does not lie in [0, 1].
        """
        assert not larger, "it has one scale"
        for image in left:
            check_image(image, "the left image")
        drawn = draw_right(self.generator, left.to(self.device, torch.float32))
        return SynthesisedViews(right=drawn.to(left.device))


Synthesiser = SelectionSynthesiser | UNetSynthesiser
"""Synthesises right views of images of any size, as one rig would have taken them."""


def make_synthesiser(
    generator: Generator, device: torch.device | str = "cpu", speed: Speed = "fine"
) -> Synthesiser:
    """Make the synthesiser of a generator of either kind; a U-Net has one speed."""
    if isinstance(generator, SelectionGenerator):
        return SelectionSynthesiser(generator, device, speed)
    return UNetSynthesiser(generator, device)


def select_views(
    generator: SelectionGenerator, left: Views, size: tuple[int, int] | None = None
) -> tuple[Selected, Selected]:
    """Estimate disparity, sky and confidence of the left and of the right view, with gradients.

    Args:
        generator: the network.
        left: RGB in [0, 1], of any size.
        size: rows and columns of the result, in whose pixels disparity counts; None: those of
            ``left``.
    """
    height, width = left.shape[-2:]
    size = (height, width) if size is None else size
    multiple = generator.config.side_multiple_px
    # Stretched where a side is near a multiple, else padded. Sides are even, for logits have half
    # of the resolution.
    rows = _round_to_even(_stretch_to_near_multiple(height, multiple, ROWS_SHARE))
    columns = _round_to_even(_stretch_to_near_multiple(width, multiple, COLUMNS_SHARE))
    padded = pad_to_multiple(resize_image(left, rows, columns), multiple)

    # The logits of both views, without the padding.
    features = generator.encoder(padded)
    left_logits, right_logits = (
        logits[..., : rows // 2, : columns // 2] for logits in generator.decode(features)
    )

    planes = generator.planes * (size[1] / columns)
    left_view = _read_view(left_logits, planes, size)
    right_view = _read_view(right_logits, planes, size)
    street_probability = generator.street_probability(features[-1])
    return replace(left_view, street_probability=street_probability), right_view


def _read_view(logits: Logits, planes: Planes, size: tuple[int, int]) -> Selected:
    """Read the logits of one view, and resize what they give to rows and columns ``size``."""
    log_px, sky, confidence = (
        F.interpolate(values[:, None], size, mode="bilinear")[:, 0]
        for values in read_logits(logits, planes)
    )
    return Selected(disparity_px=log_px.exp(), sky=sky, confidence=confidence)


def _warp_by_estimate(left: Views, right_view: Selected) -> Views:
    """Synthesise the right view by its estimated disparity; the sky is not shifted."""
    right_px = torch.where(right_view.sky > 0.5, 0.0, right_view.disparity_px)
    return warp_left_to_right(left, right_px)


def draw_right(generator: Generator, left: Views) -> Views:
    """Synthesise right views of images of any size, RGB in [0, 1], with gradients.

    Sides close to a multiple of what the network takes are resized to it, others are padded by
    reflection. Reflected rows move the horizon's place in the image, which gives the ground's
    depth: 193 rows padded to 256, where 192 were trained, gave views of 15 % too little disparity.
    """
    if isinstance(generator, SelectionGenerator):
        return _warp_by_estimate(left, select_views(generator, left)[1])
    height, width = left.shape[-2:]
    multiple = generator.config.side_multiple_px
    rows = _stretch_to_near_multiple(height, multiple, ROWS_SHARE)
    columns = _stretch_to_near_multiple(width, multiple, COLUMNS_SHARE)
    padded = pad_to_multiple(2 * resize_image(left, rows, columns) - 1, multiple)
    right = (generator(padded)[..., :rows, :columns] + 1) / 2
    return resize_image(right, height, width)


def _stretch_to_near_multiple(side_px: int, multiple: int, share: float) -> int:
    """Round to the nearest multiple if it is within a share of the side, else keep the side."""
    nearest = max(round(side_px / multiple), 1) * multiple
    return nearest if abs(nearest - side_px) <= share * side_px else side_px


def _round_to_even(side_px: int) -> int:
    """Round a side down to an even number, for logits stand for two rows and two columns."""
    return max(side_px // 2 * 2, 2)


def pad_to_multiple(
    image: Float[Tensor, "b c h w"], multiple: int
) -> Float[Tensor, "b c padded_h padded_w"]:
    """Pad the right and lower border by reflection until both sides are multiples of ``multiple``.

    A reflection is as long as the image at most, so small images are padded several times.
    """
    while image.shape[-2] % multiple or image.shape[-1] % multiple:
        height, width = image.shape[-2:]
        rows_below = min(-height % multiple, max(height - 1, 1))
        columns_right = min(-width % multiple, max(width - 1, 1))
        mode = "reflect" if min(height, width) > 1 else "replicate"
        image = F.pad(image, (0, columns_right, 0, rows_below), mode=mode)
    return image
