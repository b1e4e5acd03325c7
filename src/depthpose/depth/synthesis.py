"""Right views synthesised from left images of any size, by one of the two generators.

A selecting generator estimates the disparity of both views too. Images are RGB in [0, 1]; they are
stretched or padded to sides that the network takes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
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
from depthpose.depth.types import Maps, Match, Views

_MAX_SHARE_OF_RANGE = 0.4
"""Share of the largest disparity of the planes up to which an estimate is trusted: above it
expectations come out too small, for trainings have few objects so near."""
_CONFIDENCE_RATIO = 1.15
"""The confidence is the probability of the disparities within this ratio of the expectation."""


@dataclass(frozen=True, eq=False)
class ViewEstimate:
    """Disparity, sky and confidence of one view, by a selecting generator."""

    disparity_px: Maps  #: exponential of the mean logarithm of disparity, without the sky
    sky: Maps  #: probability of the sky
    confidence: Maps  #: probability of disparities within 15 % of the mean, without the sky
    #: probability that the image shows a street; None where the weights do not say
    street_probability: Float[Tensor, " b"] | None = None


def average_sizes(estimates: Sequence[ViewEstimate], limits_px: Sequence[float]) -> ViewEstimate:
    """Average the estimates of one view that were made from the image at several sizes.

    A mean over sizes has the smaller error. The confidence stays that of the first size, which
    ranks these errors better than a mean of confidences (AUSE 0.34 and 0.41 of chance).

    Args:
        estimates: the estimates, resized to one size. Where the disparity of the first is near the
            limit of another, that other does not count.
        limits_px: the largest disparity that each can have, at that one size.
    """
    first = estimates[0]
    if len(estimates) == 1:
        return first
    is_within = [first.disparity_px < _MAX_SHARE_OF_RANGE * limit_px for limit_px in limits_px]
    is_counted = torch.stack(is_within)  # (sizes, b, h, w)
    is_counted[0] = True  # the first size counts everywhere
    weights = is_counted / is_counted.sum(0)
    log_px = torch.stack([estimate.disparity_px.log() for estimate in estimates])
    sky = torch.stack([estimate.sky for estimate in estimates])
    return ViewEstimate(
        disparity_px=(weights * log_px).sum(0).exp(),
        sky=(weights * sky).sum(0),
        confidence=first.confidence,
        street_probability=first.street_probability,
    )


def read_logits(logits: Logits, planes: Planes) -> tuple[Tensor, Tensor, Tensor]:
    """Compute log of disparity, probability of the sky, and confidence of the disparity.

    The log of disparity is the expected log over the planes: in the mean of disparity itself one
    plane at 88 px would outweigh many at 2 px. The confidence is the probability of planes within
    15 % of it. For both the sky is left out.

    Args:
        logits: those of the sky, then of each plane.
        planes: disparities of the planes [px].

    Returns:
        The natural logarithm of the disparity [px], the probability of the sky, and the confidence,
        0..1, each (b, rows, columns), of the size of the logits.
    """
    logits = logits.float()
    sky = logits.softmax(1)[:, 0]

    probabilities = logits[:, 1:].softmax(1)
    log_planes = planes.log()
    log_px = torch.einsum("bkhw,k->bhw", probabilities, log_planes)
    is_near = (log_planes[:, None, None] - log_px[:, None]).abs() <= math.log(_CONFIDENCE_RATIO)
    confidence = (probabilities * is_near).sum(1)
    return log_px, sky, confidence


def warp_left_to_right(left: Views, right_px: Maps) -> Views:
    """Synthesise the right view: sample ``left`` at ``x + disparity`` for each right pixel x.

    Beyond the border the border repeats. Compared with a mixture of shifts (:func:`mix_shifts`) the
    L1 error is larger, but nothing is seen twice, which no matcher can match.
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

    Used in training, since every shift gets a gradient.

    Args:
        left: the left views.
        logits: those of the right view, at the size of ``left``.
        planes: disparities of the planes, in pixels of ``left``.
    """
    width = left.shape[-1]
    max_shift_px = math.ceil(float(planes[-1])) + 1
    padded = F.pad(left, (0, max_shift_px, 0, 0), mode="replicate")
    probabilities = logits.softmax(1)
    mixed = probabilities[:, :1] * left  # class 0, the sky, is not shifted
    for class_index, shift_px in enumerate(planes.tolist(), 1):
        # Linear between the shifts by whole pixels.
        whole_px = math.floor(shift_px)
        fraction = shift_px - whole_px
        lower = padded[..., whole_px : whole_px + width]
        upper = padded[..., whole_px + 1 : whole_px + 1 + width]
        shifted = torch.lerp(lower, upper, fraction)
        mixed = mixed + probabilities[:, class_index : class_index + 1] * shifted
    return mixed


MAX_ROW_STRETCH = 0.03
"""Largest share by which rows are stretched to a side that a network takes: no disparity depends on
them."""

MAX_COLUMN_STRETCH = 0.01
"""Largest share by which columns are stretched to a side that a network takes: depth is off by as
much."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SynthesisedViews:
    """Right views of left images, and what a selecting generator estimates beside them."""

    right: Views  #: the right views, RGB in [0, 1]
    #: disparity, confidence and sky of each left view by the generator itself; None by a U-Net
    matches: list[Match] | None = None
    #: confidence in each image as a whole: the probability that it shows a street, or, where the
    #: weights do not say that, the mean confidence; None by a U-Net
    image_confidence: Float[Tensor, " b"] | None = None


class SelectionSynthesiser:
    """Synthesises right views by a selecting generator, and estimates the left view's disparity.

    At the speed ``fine`` an image is estimated at two sizes, 1 and 1.4 times that at the virtual
    focal length, and both are averaged; at ``quick`` at the first alone. ``scales`` says so.
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
    def synthesise(self, left: Views, *larger: Float[Tensor, "b 3 _ _"]) -> SynthesisedViews:
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

        # Both views as estimated from each size of the image, averaged over the sizes.
        size = (left.shape[-2], left.shape[-1])
        max_px = float(self.generator.planes[-1])
        limits_px = [max_px * size[1] / images.shape[-1] for images in on_device]
        by_size = [estimate_views(self.generator, images, size) for images in on_device]
        left_estimates, right_estimates = zip(*by_size, strict=True)
        left_estimate = average_sizes(left_estimates, limits_px)
        right_estimate = average_sizes(right_estimates, limits_px)

        right = _warp_by_estimate(on_device[0], right_estimate)
        is_sky = left_estimate.sky > 0.5
        disparity_confidence = left_estimate.confidence * (1 - left_estimate.sky)
        confidence = torch.where(is_sky, left_estimate.sky, disparity_confidence)
        image_confidence = left_estimate.street_probability
        if image_confidence is None:
            image_confidence = confidence.mean((1, 2))
        matches = [
            Match(disparity_px=disparity_px, confidence=sure, is_sky=sky)
            for disparity_px, sure, sky in zip(
                left_estimate.disparity_px.to(left.device),
                confidence.to(left.device),
                is_sky.to(left.device),
                strict=True,
            )
        ]
        return SynthesisedViews(
            right=right.to(left.device),
            matches=matches,
            image_confidence=image_confidence.to(left.device),
        )


class UNetSynthesiser:
    """Synthesises right views with pix2pix's U-Net.

    Batch norm uses the statistics of training, and there is no dropout.
    """

    scales = (1.0,)

    def __init__(self, generator: UNetGenerator, device: torch.device | str = "cpu") -> None:
        self.device = usable_device(device)
        self.generator = generator.to(self.device).eval()
        self.config = generator.config

    @torch.no_grad()
    def synthesise(self, left: Views, *larger: Float[Tensor, "b 3 _ _"]) -> SynthesisedViews:
        """Synthesise right views; images are RGB in [0, 1], and there are no ``larger`` ones.

        Raises:
            InputError: an image does not lie in [0, 1].
        """
        assert not larger, "it has one scale"
        for image in left:
            check_image(image, "the left image")
        right = synthesise_right(self.generator, left.to(self.device, torch.float32))
        return SynthesisedViews(right=right.to(left.device))


Synthesiser = SelectionSynthesiser | UNetSynthesiser
"""Synthesises right views of images of any size, at the baseline of the virtual rig."""


def make_synthesiser(
    generator: Generator, device: torch.device | str = "cpu", speed: Speed = "fine"
) -> Synthesiser:
    """Make the synthesiser of a generator, of either kind; a U-Net has one speed."""
    if isinstance(generator, SelectionGenerator):
        return SelectionSynthesiser(generator, device, speed)
    return UNetSynthesiser(generator, device)


def estimate_views(
    generator: SelectionGenerator, left: Views, size: tuple[int, int] | None = None
) -> tuple[ViewEstimate, ViewEstimate]:
    """Estimate disparity, sky and confidence of the left and of the right view, with gradients.

    Args:
        generator: the network.
        left: left views, RGB in [0, 1], of any size.
        size: rows and columns of the result, in whose pixels disparity is counted; None: those of
            ``left``.
    """
    height, width = left.shape[-2:]
    size = (height, width) if size is None else size
    multiple = generator.config.side_multiple_px
    # Stretched where a side is near a multiple, else padded. Sides are even, for logits have half
    # of the resolution.
    rows = _floor_to_even(_stretch_to_near_multiple(height, multiple, MAX_ROW_STRETCH))
    columns = _floor_to_even(_stretch_to_near_multiple(width, multiple, MAX_COLUMN_STRETCH))
    padded = pad_to_multiple(resize_image(left, rows, columns), multiple)

    # The logits of both views, without the padding.
    features = generator.encoder(padded)
    left_logits, right_logits = (
        logits[..., : rows // 2, : columns // 2] for logits in generator.decode(features)
    )

    planes = generator.planes * (size[1] / columns)
    left_estimate = _estimate_view(left_logits, planes, size)
    right_estimate = _estimate_view(right_logits, planes, size)
    street_probability = generator.street_probability(features[-1])
    return replace(left_estimate, street_probability=street_probability), right_estimate


def _estimate_view(logits: Logits, planes: Planes, size: tuple[int, int]) -> ViewEstimate:
    """Estimate one view from its logits, at ``size`` (rows and columns)."""
    log_px, sky, confidence = (
        F.interpolate(values[:, None], size, mode="bilinear")[:, 0]
        for values in read_logits(logits, planes)
    )
    return ViewEstimate(disparity_px=log_px.exp(), sky=sky, confidence=confidence)


def _warp_by_estimate(left: Views, right_estimate: ViewEstimate) -> Views:
    """Synthesise the right view by its estimated disparity; the sky is not shifted."""
    right_px = torch.where(right_estimate.sky > 0.5, 0.0, right_estimate.disparity_px)
    return warp_left_to_right(left, right_px)


def synthesise_right(generator: Generator, left: Views) -> Views:
    """Synthesise right views of images of any size, RGB in [0, 1], with gradients.

    Sides close to a multiple of what the network takes are resized to it, others are padded by
    reflection. Reflected rows move the horizon's place in the image, which gives the ground's
    depth: 193 rows padded to 256, where 192 were trained, gave views of 15 % too little disparity.
    """
    if isinstance(generator, SelectionGenerator):
        _, right_estimate = estimate_views(generator, left)
        return _warp_by_estimate(left, right_estimate)
    height, width = left.shape[-2:]
    multiple = generator.config.side_multiple_px
    rows = _stretch_to_near_multiple(height, multiple, MAX_ROW_STRETCH)
    columns = _stretch_to_near_multiple(width, multiple, MAX_COLUMN_STRETCH)
    padded = pad_to_multiple(2 * resize_image(left, rows, columns) - 1, multiple)
    right = (generator(padded)[..., :rows, :columns] + 1) / 2
    return resize_image(right, height, width)


def _stretch_to_near_multiple(side_px: int, multiple: int, share: float) -> int:
    """Round a side to the nearest multiple if that is within a share of it, else keep the side."""
    nearest = max(round(side_px / multiple), 1) * multiple
    return nearest if abs(nearest - side_px) <= share * side_px else side_px


def _floor_to_even(side_px: int) -> int:
    """Round a side down to an even number, for a logit stands for two rows and two columns."""
    return max(side_px // 2 * 2, 2)


def pad_to_multiple(
    image: Float[Tensor, "b c h w"], multiple: int
) -> Float[Tensor, "b c padded_h padded_w"]:
    """Pad the right and lower border by reflection until both sides are multiples of ``multiple``.

    A reflection is no longer than the image, so small images are padded several times.
    """
    while image.shape[-2] % multiple or image.shape[-1] % multiple:
        height, width = image.shape[-2:]
        rows_below = min(-height % multiple, max(height - 1, 1))
        columns_right = min(-width % multiple, max(width - 1, 1))
        mode = "reflect" if min(height, width) > 1 else "replicate"
        image = F.pad(image, (0, columns_right, 0, rows_below), mode=mode)
    return image
