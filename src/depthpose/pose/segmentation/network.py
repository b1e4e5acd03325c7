"""FCN (Long, Shelhamer and Darrell, CVPR 2015) on a residual encoder."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.pose.resnet import ResNet18
from depthpose.pose.segmentation.config import SegmentationConfig


class FCN(nn.Module):
    """An image to the logits of background and objects at each of its pixels.

    Each level scores classes by a 1x1 convolution; the coarse scores are enlarged twice by a
    learned convolution that begins bilinear, and added to the next finer ones, which begin at zero
    (section 4.1 of the paper). The last enlargement, to pixels, is bilinear and fixed.
    """

    def __init__(self, objects: int, config: SegmentationConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or SegmentationConfig()
        self.classes = classes = objects + 1
        self.encoder = ResNet18(widths=config.widths)
        levels = {8: 3, 16: 2, 32: 1}[config.stride]
        coarsest_first = config.widths[:0:-1][:levels]
        self.scores = nn.ModuleList(nn.Conv2d(width, classes, 1) for width in coarsest_first)
        self.enlarge = nn.ModuleList(_bilinear_twice(classes) for _ in range(levels - 1))
        for score in self.scores[1:]:
            for parameter in score.parameters():
                nn.init.zeros_(parameter)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b classes h w"]:
        """Give logits, background first; both sides of the image are multiples of 32.

        Colours have ImageNet's mean and spread taken off
        (``pose.resnet.normalise_colors``).
        """
        features = self.encoder(image)[::-1]
        found = self.scores[0](features[0])
        for enlarge, score, finer in zip(
            self.enlarge, self.scores[1:], features[1 : len(self.scores)], strict=True
        ):
            found = enlarge(found) + score(finer)
        size = (image.shape[-2], image.shape[-1])
        return F.interpolate(found, size, mode="bilinear", align_corners=False)


def _bilinear_twice(classes: int) -> nn.ConvTranspose2d:
    """Make a learned enlargement that begins as the bilinear one, each class by itself."""
    layer = nn.ConvTranspose2d(classes, classes, 4, 2, 1, bias=False)
    ramp = torch.tensor([0.25, 0.75, 0.75, 0.25])
    with torch.no_grad():
        layer.weight.zero_()
        every = torch.arange(classes)
        layer.weight[every, every] = ramp[:, None] * ramp
    return layer
