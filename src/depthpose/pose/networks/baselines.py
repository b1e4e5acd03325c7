"""Baselines of the thesis: PointNet for directions, and a pose regressed from a depth image."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from depthpose.core.config import Settings
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import require_same_size
from depthpose.pose.geometry.grid import rotation_from_z_to
from depthpose.pose.networks.fcn import ResNet18
from depthpose.pose.networks.sparse import RowNorm
from depthpose.pose.types import ViewInput, VotingPoints


@dataclass(frozen=True, kw_only=True)
class DepthImageConfig(Settings):
    """Settings of the network that regresses a pose from a masked crop of the depth image."""

    classes: Annotated[int, "[1, inf)"] = 1
    """Objects that one network knows."""

    crop_px: Annotated[int, "[32, inf)"] = 128
    """Side of the crop that the network sees."""

    margin: Annotated[float, "[1, inf)"] = 1.1
    """Width of the crop over that of the object's bounding square."""

    contrast: Annotated[float, "(0, inf)"] = 0.1
    """A depth that differs by this share from the mean depth of the crop is 1 or -1."""

    widths: Annotated[tuple[int, int, int, int], "[1, inf)"] = (64, 128, 256, 512)
    """Channels of the encoder's stages: those of ResNet-18."""

    min_points: Annotated[int, "[1, inf)"] = 16
    """Fewer masked pixels with a depth are refused, not posed."""


@dataclass(frozen=True, kw_only=True)
class PointNetConfig(Settings):
    """Size of a PointNet for segmentation (Qi et al. 2017) whose outputs are directions."""

    classes: Annotated[int, "[1, inf)"] = 13
    """Objects that one network knows."""

    keypoints: Annotated[int, "[1, inf)"] = 8
    """Keypoints of each object."""

    unit_m: Annotated[float, "(0, inf)"] = 0.1
    """Unit in which points are given to the network [m]: an object is about one in size."""

    local: Annotated[tuple[int, int], "[1, inf)"] = (64, 64)
    """Channels of a point by itself."""

    pooled: Annotated[tuple[int, int, int], "[1, inf)"] = (64, 128, 1024)
    """Channels on the way to the maximum over all points."""

    head: Annotated[tuple[int, int, int], "[1, inf)"] = (512, 256, 128)
    """Channels of a point beside that maximum."""


EMPTY = -2.0  #: value of a pixel without the object; those of the object are -1 to 1


class DepthCrop(NamedTuple):
    """A crop of a depth image and its place; leading axes are of a batch."""

    #: ``(depth / mean depth - 1) / contrast``; ``EMPTY`` beside the object.
    image: Float[Tensor, "*b 1 size size"]
    #: ``camera_from_crop``: rotates the optical axis to the ray through the crop's middle. In this
    #: frame the rotation of an object does not depend on where in the image it is.
    R: Float[Tensor, "*b 3 3"]
    middle_m: Float[Tensor, "*b 3"]  #: the point of that ray at the mean depth, in the camera frame
    side_m: Float[Tensor, "*b"]  #: width of the crop at the mean depth


def cut_depth(
    view: ViewInput, config: DepthImageConfig, diameter_m: float | None = None
) -> DepthCrop | None:
    """Crop a view to its object; None where fewer than ``config.min_points`` pixels have a depth.

    Args:
        view: depth image and mask of the object.
        config: size, margin and contrast of the crop.
        diameter_m: of the object. Masked pixels whose depth differs by more than this from their
            median depth are left out; None: all are kept.

    Returns:
        The crop. Pixels are taken to be square: its width is computed by fx.

    Raises:
        InputError: mask and depth differ in size.
    """
    require_same_size(view.mask, view.depth_m)

    # The pixels of the object.
    depth_m = torch.where(view.mask, view.depth_m, torch.nan)
    is_seen = depth_m.isfinite() & (depth_m > 0)
    if diameter_m is not None and bool(is_seen.any()):
        is_seen &= (depth_m - depth_m[is_seen].median()).abs() <= diameter_m
    if int(is_seen.sum()) < config.min_points:
        return None

    # A square about them, and their depth about its mean.
    rows, columns = is_seen.nonzero(as_tuple=True)
    low_px = torch.stack([columns.min(), rows.min()]).float() - 0.5
    high_px = torch.stack([columns.max(), rows.max()]).float() + 0.5
    middle_px = (low_px + high_px) / 2
    side_px = config.margin * float((high_px - low_px).max())
    mean_m = depth_m[is_seen].mean()
    normalized_depth = ((depth_m / mean_m - 1) / config.contrast).clamp(-1, 1)
    normalized_depth = torch.where(is_seen, normalized_depth, EMPTY)

    # Resized by nearest neighbour, so that depth is not mixed across edges.
    offsets = (torch.arange(config.crop_px) + 0.5) / config.crop_px - 0.5  # in sides of the crop
    column = (middle_px[0] + side_px * offsets).round().long()
    row = (middle_px[1] + side_px * offsets).round().long()
    height, width = normalized_depth.shape
    is_inside = ((row >= 0) & (row < height))[:, None] & ((column >= 0) & (column < width))
    image = normalized_depth[row.clamp(0, height - 1)[:, None], column.clamp(0, width - 1)]

    # The ray through the middle, toward which the crop's axes are turned: K^-1 (u, v, 1).
    K = view.K.to(depth_m)
    pixel = torch.cat([middle_px, torch.ones(1)]).to(depth_m)
    ray = torch.linalg.solve(K, pixel)
    return DepthCrop(
        image=torch.where(is_inside, image, EMPTY)[None],
        R=rotation_from_z_to(ray).to(ray),
        middle_m=ray * mean_m,
        side_m=side_px * mean_m / K[0, 0],
    )


_OUTPUTS = 9  # of a class: two columns of a rotation, and an offset in widths of the crop


class DepthImageNet(nn.Module):
    """A network from a depth crop to nine outputs of each class (:func:`make_poses`).

    The encoder of ResNet-18 with one input channel, the mean of its features over the crop, and a
    linear layer.
    """

    def __init__(self, config: DepthImageConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or DepthImageConfig()
        self.encoder = ResNet18(inputs=1, widths=config.widths)
        self.heads = nn.Linear(config.widths[3], config.classes * _OUTPUTS)
        # Training begins near the identity, in the middle of the crop: small weights, and a bias of
        # the first two columns of the identity and no offset.
        with torch.no_grad():
            self.heads.weight.mul_(0.1)
            start = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 0])
            self.heads.bias.copy_(start.repeat(config.classes))

    def forward(
        self, image: Float[Tensor, "b 1 h w"], class_of_image: Int[Tensor, " b"]
    ) -> Float[Tensor, "b 9"]:
        """Compute the outputs of each crop for its own class."""
        features = self.encoder(image)[-1].mean((-2, -1))
        outputs = self.heads(features).view(len(image), self.config.classes, _OUTPUTS)
        return outputs[torch.arange(len(image), device=image.device), class_of_image]


def make_poses(outputs: Float[Tensor, "b 9"], crop: DepthCrop) -> Rigid:
    """Convert outputs of the network to poses ``camera_from_model``.

    The first six outputs are two columns of a rotation, which the Gram-Schmidt process makes
    orthonormal: a continuous representation, which none of three or four numbers is (Zhou et al.,
    CVPR 2019). It is undefined where the columns are parallel or zero. The last three are the
    offset of the object's origin from the middle of the crop, in widths of the crop (``side_m``).
    """
    first = F.normalize(outputs[:, :3], dim=-1)
    second = outputs[:, 3:6]
    along_first = (first * second).sum(-1, keepdim=True) * first
    second = F.normalize(second - along_first, dim=-1)
    crop_R_model = torch.stack([first, second, torch.linalg.cross(first, second)], -1)

    # From the frame of the crop to that of the camera.
    offset_m = crop.side_m[:, None] * outputs[:, 6:]
    t_m = crop.middle_m + (crop.R @ offset_m[..., None]).squeeze(-1)
    return Rigid(crop.R @ crop_R_model, t_m)


_TRANSFORM_POOLED = (64, 128, 1024)  # widths of the layers before the maximum over points
_TRANSFORM_HEAD = (512, 256)  # and after it


class PointNet(nn.Module):
    """A network from points to raw directions: PointNet for segmentation (Qi et al., CVPR 2017).

    A direction depends on the features of its point and on their maximum over the cloud. Clouds of
    any size are rows one after the other. Outputs have the shape of those of the sparse network, so
    that the same voting follows.
    """

    def __init__(self, config: PointNetConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or PointNetConfig()
        local_width = config.local[-1]
        self.turn_points = _TNet(3)
        self.local = _make_layers((3, *config.local))
        self.turn_features = _TNet(local_width)
        self.pooled = _make_layers((local_width, *config.pooled))
        self.head = _make_layers((local_width + config.pooled[-1], *config.head))
        self.final = nn.Linear(config.head[-1], config.classes * config.keypoints * 3)

    def forward(
        self, points_m: Float[Tensor, "points 3"], cloud: Int[Tensor, " points"]
    ) -> Float[Tensor, "points classes keypoints 3"]:
        """Compute the raw directions of each point to the keypoints of every class.

        Args:
            points_m: about the mean of their cloud.
            cloud: which cloud each belongs to, 0, 1, ..., ascending.
        """
        # Each point by itself; the coordinates and then the features are multiplied by a matrix
        # that is predicted for the cloud.
        x = points_m / self.config.unit_m
        sizes = torch.bincount(cloud).tolist()
        x = _multiply_by_cloud(x, self.turn_points(x, sizes), sizes)
        x = self.local(x)
        x = _multiply_by_cloud(x, self.turn_features(x, sizes), sizes)

        # Each point beside the maximum over its cloud.
        maximum = _take_maximum_by_cloud(self.pooled(x), sizes)
        outputs = self.final(self.head(torch.cat([x, maximum[cloud]], 1)))
        return outputs.view(len(outputs), self.config.classes, self.config.keypoints, 3)

    def directions(self, points: VotingPoints) -> Float[Tensor, "points keypoints 3"]:
        """Compute the raw directions of each point to the keypoints of its own class.

        The networks that vote share this method.
        """
        # The points about the mean of their cloud.
        points_m = points.points_m
        cloud = points.coordinates[:, 0].long()
        sizes = torch.bincount(cloud)
        sums_m = points_m.new_zeros(len(sizes), 3).index_add(0, cloud, points_m)
        means_m = sums_m / sizes[:, None]
        centred_m = points_m - means_m[cloud]

        of_every_class = self(centred_m, cloud)
        rows = torch.arange(len(points_m), device=points_m.device)
        return of_every_class[rows, points.class_of_point]


class _TNet(nn.Module):
    """PointNet's T-Net: predicts a square matrix for each cloud, the identity before training."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width
        self.pooled = _make_layers((width, *_TRANSFORM_POOLED))
        self.head = _make_layers((_TRANSFORM_POOLED[-1], *_TRANSFORM_HEAD))
        self.final = nn.Linear(_TRANSFORM_HEAD[-1], width * width)
        nn.init.zeros_(self.final.weight)
        nn.init.zeros_(self.final.bias)

    def forward(
        self, x: Float[Tensor, "points c"], sizes: Sequence[int]
    ) -> Float[Tensor, "clouds c c"]:
        """Predict the matrix of each cloud; clouds of ``sizes`` points are one after the other."""
        maximum = _take_maximum_by_cloud(self.pooled(x), sizes)
        eye = torch.eye(self.width, device=x.device, dtype=x.dtype)
        return self.final(self.head(maximum)).view(len(sizes), self.width, self.width) + eye


def _multiply_by_cloud(
    x: Float[Tensor, "points c"], matrices: Float[Tensor, "clouds c c"], sizes: Sequence[int]
) -> Float[Tensor, "points c"]:
    """Multiply the rows of each cloud, of ``sizes`` rows, by the matrix of the cloud."""
    clouds = x.split(list(sizes))
    return torch.cat([rows @ matrix for rows, matrix in zip(clouds, matrices, strict=True)])


def _take_maximum_by_cloud(
    x: Float[Tensor, "points c"], sizes: Sequence[int]
) -> Float[Tensor, "clouds c"]:
    """Take the maximum of each channel over each cloud, of ``sizes`` rows."""
    return torch.stack([rows.amax(0) for rows in x.split(list(sizes))])


def _make_layers(widths: Sequence[int]) -> nn.Sequential:
    """Build linear layers between successive widths, each followed by batch norm and ReLU."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs, bias=False), RowNorm(outputs), nn.ReLU()]
    return nn.Sequential(*layers)
