"""The generator with the world around it: any size, [0, 1], test-time norm."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.devices import usable_device
from depthpose.depth.synthesis.generator import UNetGenerator

ROWS_SHARE = 0.03
"""Rows are stretched by this at most: no disparity depends on them."""

COLUMNS_SHARE = 0.01
"""Columns are stretched by this at most: depth is off by as much."""


class Synthesiser:
    """Draws the right view of images of any size.

    Norm and dropout follow ``config.test_mode``, which the weights record: ``running`` uses the
    statistics of training and no dropout; ``batch`` those of the image itself, as pix2pix tests,
    with dropout on.
    """

    def __init__(self, generator: UNetGenerator, device: torch.device | str = "cpu") -> None:
        self.device = usable_device(device)
        self.generator = generator.to(self.device).eval()
        if generator.config.test_mode == "batch":
            _keep_training(self.generator)

    @torch.no_grad()
    def synthesise(self, left: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
        """Draw right views; images are RGB in [0, 1]."""
        if self.generator.config.test_mode == "batch" and len(left) > 1:
            # The statistics are those of one image: company would change them.
            return torch.cat([self.synthesise(image[None]) for image in left])
        return draw_right(self.generator, left.to(self.device, torch.float32)).to(left.device)


def draw_right(
    generator: UNetGenerator, left: Float[Tensor, "b 3 h w"]
) -> Float[Tensor, "b 3 h w"]:
    """Draw right views of any size, RGB in [0, 1]; gradients flow.

    Sides close to a multiple of what the network takes are resized to it, others padded by
    reflection. Mirrored rows move the horizon's place in the image, which tells the ground's depth:
    193 rows padded to 256, where 192 were trained, drew views of 15 % too little disparity.
    """
    height, width = left.shape[-2:]
    multiple = generator.config.side_multiple_px
    rows = _near_multiple(height, multiple, ROWS_SHARE)
    columns = _near_multiple(width, multiple, COLUMNS_SHARE)
    padded = pad_to_multiple(2 * _resized(left, rows, columns) - 1, multiple)
    drawn = (generator(padded)[..., :rows, :columns] + 1) / 2
    return _resized(drawn, height, width)


def _near_multiple(side_px: int, multiple: int, share: float) -> int:
    nearest = max(round(side_px / multiple), 1) * multiple
    return nearest if abs(nearest - side_px) <= share * side_px else side_px


def _resized(
    image: Float[Tensor, "b 3 _ _"], height: int, width: int
) -> Float[Tensor, "b 3 {height} {width}"]:
    if image.shape[-2:] == (height, width):
        return image
    return F.interpolate(image, (height, width), mode="bilinear", antialias=True).clamp(0, 1)


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
