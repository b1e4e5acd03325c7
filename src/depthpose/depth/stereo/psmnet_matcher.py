"""PSMNet as a matcher: images of any size in, disparity and confidence out."""

from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from depthpose.depth.config import MatcherConfig
from depthpose.depth.stereo.matcher import check_pair
from depthpose.depth.stereo.psmnet import PSMNet
from depthpose.depth.stereo.weights import read_psmnet
from depthpose.depth.types import Match

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


def normalise(image: Float[Tensor, "*batch 3 h w"]) -> Float[Tensor, "*batch 3 h w"]:
    """RGB in [0, 1] to what the network was trained on: ImageNet's mean 0 and deviation 1."""
    mean = image.new_tensor(IMAGENET_MEAN)[:, None, None]
    return (image - mean) / image.new_tensor(IMAGENET_STD)[:, None, None]


def pad_top_right(image: Float[Tensor, "3 h w"], least: int) -> Float[Tensor, "3 h2 w2"]:
    """Pad a normalised image with zeros, top and right, to multiples of 16 of at least ``least``.

    Top and right, as the authors do: columns stay where they are, so disparity does too.
    """
    h, w = (max(least, -(-side // 16) * 16) for side in image.shape[-2:])
    return F.pad(image, (0, w - image.shape[-1], h - image.shape[-2], 0))


class PSMNetMatcher:
    """The network with the world around it: normalisation, padding, device, precision."""

    def __init__(self, network: PSMNet, config: MatcherConfig | None = None) -> None:
        self.config = config or MatcherConfig()
        self.network = network.to(self.config.device).eval()

    @torch.inference_mode()
    def match(self, left: Tensor, right: Tensor) -> Match:
        """Match one pair of any size.

        Raises:
            InputError: unusable images, or a memory bound that is too small for them.
        """
        check_pair(left, right)
        h, w = left.shape[-2:]
        device = self.config.device
        pair = [
            pad_top_right(normalise(i.to(device, torch.float32)), self.network.config.min_side_px)
            for i in (left, right)
        ]
        disparity_px = self.network(pair[0][None], pair[1][None])[-1][0, -h:, :w]
        return Match(disparity_px=disparity_px.to(left.device))


def load_psmnet(path: Path, config: MatcherConfig | None = None) -> PSMNetMatcher:
    """Read weights and make them a matcher.

    Raises:
        InputError: not weights of PSMNet.
    """
    return PSMNetMatcher(read_psmnet(path), config)
