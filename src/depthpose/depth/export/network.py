"""The networks in operations that bake no size in: what the exporter is given."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.depth.stereo.expectation import WINDOW_PX, interpolation_matrix, linear_taps
from depthpose.depth.stereo.psmnet import PSMNet
from depthpose.depth.synthesis import SelectionGenerator
from depthpose.depth.synthesis.selection import read_logits

Maps = Float[Tensor, "b rows columns"]


class SizelessPSMNet(nn.Module):
    """PSMNet with its soft arg-min, in eval mode.

    Disparities are few and fixed, so their interpolation is a matrix; rows and columns are resized.
    """

    matrix: Tensor

    def __init__(self, network: PSMNet) -> None:
        super().__init__()
        self.network = network
        config = network.config
        self.bins = config.max_disparity_px // 4
        taps = linear_taps(
            self.bins, config.max_disparity_px, torch.zeros(1), align_corners=config.align_corners
        )
        self.register_buffer("matrix", interpolation_matrix(taps, self.bins)[..., None, None])

    def forward(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> tuple[Float[Tensor, "b h w"], Float[Tensor, "b h w"]]:
        """Give disparity [px] and confidence of normalised images."""
        near, far = self.network.features(left), self.network.features(right)
        cost = self.network.costs_of(gathered_volume(near, far, self.bins))[-1][:, 0]
        align = self.network.config.align_corners
        wide = F.interpolate(cost, left.shape[-2:], mode="bilinear", align_corners=align)
        probability = F.conv2d(wide, self.matrix).softmax(1)
        steps_px = torch.arange(self.network.config.max_disparity_px).to(cost)[:, None, None]
        disparity_px = (probability * steps_px).sum(1)
        is_near = (steps_px - disparity_px[:, None]).abs() <= WINDOW_PX
        return disparity_px, (probability * is_near).sum(1).clamp(0, 1)


class SizelessSelection(nn.Module):
    """The generator that selects, and what its logits say, at half of the image's sides."""

    def __init__(self, generator: SelectionGenerator) -> None:
        super().__init__()
        self.generator = generator

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Maps, Maps, Maps, Maps, Maps]:
        """Give log of disparity, sky and confidence of the left view; the first two of the right.

        Disparity is counted in pixels of the image's width.
        """
        left, right = (
            read_logits(logits, self.generator.planes) for logits in self.generator(image)
        )
        return *left, *right[:2]


def gathered_volume(
    left: Float[Tensor, "b c h w"], right: Float[Tensor, "b c h w"], bins: int
) -> Float[Tensor, "b c2 {bins} h w"]:
    """Make ``concatenation_volume`` by one gather in place of a copy a disparity."""
    column = torch.arange(left.shape[-1]) - torch.arange(bins)[:, None]
    is_inside = (column >= 0).to(left.dtype)
    sides = [left[..., None, :] * is_inside, right[..., column.clamp(min=0)] * is_inside]
    return torch.cat(sides, 1).transpose(2, 3)
