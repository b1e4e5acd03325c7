"""The depth image regressed by a 2D network: the first baseline of table 3.1."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from depthpose.core.rigid import Rigid, turn_axis_to
from depthpose.pose.baselines.config import DepthImageConfig
from depthpose.pose.resnet import ResNet18
from depthpose.pose.types import ViewInput

EMPTY = -2.0
"""Of a pixel without the object: below all that a depth can be, -1 to 1."""


class DepthCrop(NamedTuple):
    """A crop, and where it lies; batched with leading axes.

    Attributes:
        image: depth over its mean, less one, over the contrast; ``EMPTY`` beside the object.
        R: ``camera_from_crop``: turns the optical axis onto the ray through the crop's middle. An
            object looks alike in the crop wherever in the image it is, if its rotation is said in
            this frame.
        middle_m: the point of that ray at the mean depth, in the camera frame.
        side_m: width of the crop at the mean depth.
    """

    image: Float[Tensor, "*b 1 size size"]
    R: Float[Tensor, "*b 3 3"]
    middle_m: Float[Tensor, "*b 3"]
    side_m: Float[Tensor, "*b"]


def cut_depth(
    view: ViewInput, config: DepthImageConfig, diameter_m: float | None = None
) -> DepthCrop | None:
    """Cut the object out of a view; None where fewer pixels than ``min_points`` have a depth.

    Args:
        view: depth and mask.
        config: size, margin, contrast.
        diameter_m: pixels farther than this from the median depth belong to something else; None
            keeps all.
    """
    depth_m = torch.where(view.mask, view.depth_m, torch.nan)
    is_seen = depth_m.isfinite() & (depth_m > 0)
    if diameter_m is not None and bool(is_seen.any()):
        is_seen &= (depth_m - depth_m[is_seen].median()).abs() <= diameter_m
    if int(is_seen.sum()) < config.min_points:
        return None
    rows, columns = is_seen.nonzero(as_tuple=True)
    low = torch.stack([columns.min(), rows.min()]).float() - 0.5
    high = torch.stack([columns.max(), rows.max()]).float() + 0.5
    middle_px, side_px = (low + high) / 2, config.margin * float((high - low).max())
    mean_m = depth_m[is_seen].mean()
    relief = ((depth_m / mean_m - 1) / config.contrast).clamp(-1, 1)
    relief = torch.where(is_seen, relief, EMPTY)
    # Resized by nearest neighbour: depth is not mixed over edges.
    steps = (torch.arange(config.crop_px) + 0.5) / config.crop_px - 0.5
    column, row = ((middle_px[axis] + side_px * steps).round().long() for axis in (0, 1))
    height, width = relief.shape
    is_inside = ((row >= 0) & (row < height))[:, None] & ((column >= 0) & (column < width))
    image = relief[row.clamp(0, height - 1)[:, None], column.clamp(0, width - 1)]
    K = view.K.to(depth_m)
    ray = torch.linalg.solve(K, torch.cat([middle_px, torch.ones(1)]))
    return DepthCrop(
        image=torch.where(is_inside, image, EMPTY)[None],
        R=turn_axis_to(ray).to(ray),
        middle_m=ray * mean_m,
        side_m=side_px * mean_m / K[0, 0],
    )


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
    shift = crop.side_m[:, None] * outputs[:, 6:]
    t_m = crop.middle_m + (crop.R @ shift[..., None]).squeeze(-1)
    return Rigid(crop.R @ rotation_from_6d(outputs[:, :6]), t_m)


def rotation_from_6d(numbers: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 3 3"]:
    """Make a rotation of its first two columns, not yet of unit length nor orthogonal.

    By Gram and Schmidt: continuous, as no form of three or four numbers is (Zhou et al., CVPR
    2019). Undefined where the columns are parallel or zero.
    """
    first = F.normalize(numbers[..., :3], dim=-1)
    second = numbers[..., 3:]
    second = F.normalize(second - (first * second).sum(-1, keepdim=True) * first, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], -1)
