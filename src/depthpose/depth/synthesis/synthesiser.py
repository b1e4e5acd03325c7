"""The generators with pre- and post-processing: any size, [0, 1], test-time norm."""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from depthpose.core.arrays import check_image
from depthpose.core.devices import usable_device
from depthpose.depth.config import GeneratorConfig, SelectionConfig, Speed
from depthpose.depth.disparity import resize_image
from depthpose.depth.synthesis.networks import (
    Selected,
    SelectionGenerator,
    UNetGenerator,
    average,
    select,
    shift_left,
)

Generator = UNetGenerator | SelectionGenerator
"""A network that draws right views."""

ROWS_SHARE = 0.03
"""Rows are stretched by this at most: no disparity depends on them."""

COLUMNS_SHARE = 0.01
"""Columns are stretched by this at most: depth is off by as much."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SynthesisedViews:
    """What a generator answers for left images.

    Attributes:
        right: the right views, RGB in [0, 1].
        disparity_px: the generator's own disparity of the left view, finite in the sky too; None
            where it has none.
        confidence: 0 (guess) to 1 (sure) of that.
        is_sky: where the left view shows the sky.
        street: probability that the left view shows a street; None where the generator cannot say.
    """

    right: Float[Tensor, "b 3 h w"]
    disparity_px: Float[Tensor, "b h w"] | None = None
    confidence: Float[Tensor, "b h w"] | None = None
    is_sky: Bool[Tensor, "b h w"] | None = None
    street: Float[Tensor, " b"] | None = None


@runtime_checkable
class Synthesiser(Protocol):
    """Draws the right view of images of any size, as one rig would have seen it."""

    @property
    def config(self) -> GeneratorConfig | SelectionConfig:
        """The network's settings, and its rig."""
        ...

    @property
    def scales(self) -> tuple[float, ...]:
        """Sizes at which it looks at an image, as shares of the first, which is the rig's."""
        ...

    def draw(
        self, left: Float[Tensor, "b 3 h w"], *larger: Float[Tensor, "b 3 _ _"]
    ) -> SynthesisedViews:
        """Draw right views; images are RGB in [0, 1], and perhaps the same at other sizes."""
        ...


def make_synthesiser(
    generator: Generator, device: torch.device | str = "cpu", speed: Speed = "fine"
) -> Synthesiser:
    """Put a generator of either kind to use; one that generates colours has one speed."""
    if isinstance(generator, SelectionGenerator):
        return SelectionSynthesiser(generator, device, speed)
    return UNetSynthesiser(generator, device)


class SelectionSynthesiser:
    """Looks the right view up in the left one, and answers the left view's disparity too.

    At the fine speed it looks at an image at all ``config.scales``, and averages.
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
        self.scales = self.config.scales if speed == "fine" else self.config.scales[:1]

    @torch.no_grad()
    def draw(
        self, left: Float[Tensor, "b 3 h w"], *larger: Float[Tensor, "b 3 _ _"]
    ) -> SynthesisedViews:
        """Draw right views; images are RGB in [0, 1].

        Args:
            left: images at the virtual focal length, of whose size the answer is.
            larger: the same images, larger; disparity and sky are means over all sizes.

        Raises:
            InputError: an image is no such.
        """
        for image in (image for images in (left, *larger) for image in images):
            check_image(image, "the left image")
        sizes = [images.to(self.device, torch.float32) for images in (left, *larger)]
        size = (left.shape[-2], left.shape[-1])
        most_px = float(self.generator.planes[-1])
        limits_px = [most_px * size[1] / images.shape[-1] for images in sizes]
        lefts: list[Selected] = []
        rights: list[Selected] = []
        for images in sizes:
            of_left, of_right = select_views(self.generator, images, size)
            lefts.append(of_left)
            rights.append(of_right)
        seen = average(lefts, limits_px)
        home = left.device
        return SynthesisedViews(
            right=shift_left(sizes[0], average(rights, limits_px).shift_px).to(home),
            disparity_px=seen.disparity_px.to(home),
            confidence=seen.confidence.to(home),
            is_sky=seen.is_sky.to(home),
            street=None if seen.street is None else seen.street.to(home),
        )


class UNetSynthesiser:
    """Synthesises the right view of images of any size with pix2pix's U-Net.

    Norm and dropout follow ``config.test_mode``, which the weights record: ``running`` uses the
    statistics of training and no dropout; ``batch`` those of the image itself, as pix2pix tests,
    with dropout on.
    """

    scales = (1.0,)

    def __init__(self, generator: UNetGenerator, device: torch.device | str = "cpu") -> None:
        self.device = usable_device(device)
        self.generator = generator.to(self.device).eval()
        self.config = generator.config
        if generator.config.test_mode == "batch":
            _keep_training(self.generator)

    @torch.no_grad()
    def draw(
        self, left: Float[Tensor, "b 3 h w"], *larger: Float[Tensor, "b 3 _ _"]
    ) -> SynthesisedViews:
        """Draw right views; images are RGB in [0, 1], at one size.

        Raises:
            InputError: an image is no such.
        """
        assert not larger, "it has one scale"
        for image in left:
            check_image(image, "the left image")
        images = left.to(self.device, torch.float32)
        # The statistics of test mode 'batch' are those of one image: a batch would change them.
        groups = images.split(1) if self.config.test_mode == "batch" else [images]
        drawn = [draw_right(self.generator, part) for part in groups]
        return SynthesisedViews(right=torch.cat(drawn).to(left.device))


def select_views(
    generator: SelectionGenerator,
    left: Float[Tensor, "b 3 h w"],
    size: tuple[int, int] | None = None,
) -> tuple[Selected, Selected]:
    """Answer disparity, sky and confidence of the left and of the right view, with gradients."""
    height, width = left.shape[-2:]
    size = (height, width) if size is None else size
    multiple = generator.config.side_multiple_px
    # Even, since logits stand for two rows and two columns.
    rows = max(_near_multiple(height, multiple, ROWS_SHARE) // 2 * 2, 2)
    columns = max(_near_multiple(width, multiple, COLUMNS_SHARE) // 2 * 2, 2)
    padded = pad_to_multiple(resize_image(left, rows, columns), multiple)
    features = generator.encoder(padded)
    kept = (logits[..., : rows // 2, : columns // 2] for logits in generator.decode(features))
    planes = generator.planes * (size[1] / columns)
    first, second = (select(logits, planes, size) for logits in kept)
    return replace(first, street=generator.find_street(features[-1])), second


def draw_right(generator: Generator, left: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Draw right views of any size, RGB in [0, 1], with gradients.

    Sides close to a multiple of what the network takes are resized to it, others padded by
    reflection. Mirrored rows move the horizon's place in the image, which gives the ground's depth:
    193 rows padded to 256, where 192 were trained, drew views of 15 % too little disparity.
    """
    if isinstance(generator, SelectionGenerator):
        return shift_left(left, select_views(generator, left)[1].shift_px)
    height, width = left.shape[-2:]
    multiple = generator.config.side_multiple_px
    rows = _near_multiple(height, multiple, ROWS_SHARE)
    columns = _near_multiple(width, multiple, COLUMNS_SHARE)
    padded = pad_to_multiple(2 * resize_image(left, rows, columns) - 1, multiple)
    drawn = (generator(padded)[..., :rows, :columns] + 1) / 2
    return resize_image(drawn, height, width)


def _near_multiple(side_px: int, multiple: int, share: float) -> int:
    nearest = max(round(side_px / multiple), 1) * multiple
    return nearest if abs(nearest - side_px) <= share * side_px else side_px


def pad_to_multiple(
    image: Float[Tensor, "b c h w"], multiple: int
) -> Float[Tensor, "b c padded_h padded_w"]:
    """Mirror the right and lower border until both sides are multiples of ``multiple``.

    A mirror is as long as the image at most, so small images are mirrored several times.
    """
    while image.shape[-2] % multiple or image.shape[-1] % multiple:
        height, width = image.shape[-2:]
        down = min(-height % multiple, max(height - 1, 1))
        right = min(-width % multiple, max(width - 1, 1))
        mode = "reflect" if min(height, width) > 1 else "replicate"
        image = F.pad(image, (0, right, 0, down), mode=mode)
    return image


def _keep_training(module: nn.Module) -> None:
    """Batch norm by the image's own statistics, without touching the stored ones; dropout on."""
    for part in module.modules():
        if isinstance(part, nn.BatchNorm2d):
            part.train()
            part.track_running_stats = False
        elif isinstance(part, nn.Dropout):
            part.train()
