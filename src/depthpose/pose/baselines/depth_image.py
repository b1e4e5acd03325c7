"""The depth image regressed by a 2D network: the first baseline of table 3.1."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from depthpose.core.rigid import Rigid
from depthpose.pose.baselines.config import DepthImageConfig
from depthpose.pose.baselines.crop import DepthCrop, camera_from_crop
from depthpose.pose.resnet import ResNet18

KIND = "depth-image"
_NUMBERS = 9


class DepthImageNet(nn.Module):
    """A crop to nine numbers of each class: two columns of a rotation, and an offset.

    The encoder of ResNet-18 with one channel in, its mean over the crop, and a linear layer.
    """

    def __init__(self, config: DepthImageConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or DepthImageConfig()
        self.encoder = ResNet18(inputs=1, widths=config.widths)
        self.heads = nn.Linear(config.widths[3], config.classes * _NUMBERS)
        with torch.no_grad():  # begin at the identity, in the middle of the crop
            self.heads.weight.mul_(0.1)
            start = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 0])
            self.heads.bias.copy_(start.repeat(config.classes))

    def forward(
        self, image: Float[Tensor, "b 1 h w"], number: Int[Tensor, " b"]
    ) -> Float[Tensor, "b 9"]:
        """Answer for each crop's own class."""
        features = self.encoder(image)[-1].mean((-2, -1))
        every = self.heads(features).view(len(image), self.config.classes, _NUMBERS)
        return every[torch.arange(len(image), device=image.device), number]


def poses_of(outputs: Float[Tensor, "b 9"], crop: DepthCrop) -> Rigid:
    """Turn what the network says of crops into poses ``camera_from_model``."""
    return camera_from_crop(crop, rotation_from_6d(outputs[:, :6]), outputs[:, 6:])


def rotation_from_6d(numbers: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 3 3"]:
    """Make a rotation of its first two columns, not yet of unit length nor orthogonal.

    By Gram and Schmidt: continuous, as no form of three or four numbers is (Zhou et al., CVPR
    2019). Undefined where the columns are parallel or zero.
    """
    first = F.normalize(numbers[..., :3], dim=-1)
    second = numbers[..., 3:]
    second = F.normalize(second - (first * second).sum(-1, keepdim=True) * first, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], -1)
