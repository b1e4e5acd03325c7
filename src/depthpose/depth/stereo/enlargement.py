"""From disparities at 1/4 size to the image's: the light matcher's upsampling and refinement."""

from itertools import product
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.depth.stereo.network_matcher import Maps
from depthpose.depth.stereo.psmnet import Shape, conv_norm_2d

Features = Float[Tensor, "b _ _ _"]
Quarter = Float[Tensor, "b h4 w4"]

STEM = 16
"""Channels at half size."""
_OFFSETS = (-2, -1, 0, 1, 2)
"""Where the refinement compares the views: so many pixels at half size from the disparity."""
LEAST_PX = 0.01
"""Of a corrected disparity in use: depth stays finite. It is what a pair without a rig has in the
sky."""
_REFINED = 32
"""Channels of the refinement at half size."""


class ViewFeatures(NamedTuple):
    """Features of a view.

    Attributes:
        half: at 1/2 of the image's sides.
        levels: at 1/4, 1/8, 1/16 and 1/32.
    """

    half: Features
    levels: tuple[Features, ...]


class Seen(NamedTuple):
    """Inputs of the upsampling.

    Attributes:
        left: features of the left view.
        right_half: of the right view at 1/2 of its sides, where both are compared.
    """

    left: ViewFeatures
    right_half: Features | None


class ConvexUpsampling(nn.Module):
    """Weights of the nine neighbours at 1/4 size, for each pixel of the image.

    With agreement, the weights also depend on how alike both views are under the disparity of each
    neighbour: where two surfaces meet, this says which one a pixel belongs to. That part is
    initialised to zero.
    """

    def __init__(self, width: int, *, with_agreement: bool) -> None:
        super().__init__()
        self.hidden = conv_norm_2d(STEM + width, 32)
        self.weights = nn.Conv2d(32, 4 * 9, 1)
        self.compared = conv_norm_2d(STEM, STEM) if with_agreement else None
        self.agreement = nn.Conv2d(9, 32, 3, 1, 1, bias=False) if with_agreement else None
        if self.agreement is not None:
            nn.init.zeros_(self.agreement.weight)

    def forward(self, seen: Seen, quarter_px: Quarter) -> Float[Tensor, "b 9 4 h2 w2"]:
        """Answer weights that sum to one, for the four pixels of each one at half size."""
        left, right_half = seen
        wide = F.interpolate(left.levels[0], scale_factor=2.0, mode="nearest")
        x = self.hidden(torch.cat([left.half, wide], 1))
        if self.compared is not None and self.agreement is not None:
            assert right_half is not None
            both = self.compared(left.half), self.compared(right_half)
            alike = agreement_of_neighbours(*both, quarter_px.detach())
            x = x + self.agreement(alike.to(x))
        x = F.relu(x)
        b, _, h, w = x.shape
        return self.weights(x).float().reshape(b, 9, 4, h, w).softmax(1)


def agreement_of_neighbours(
    left: Float[Tensor, "b c h2 w2"], right: Float[Tensor, "b c h2 w2"], quarter_px: Quarter
) -> Float[Tensor, "b 9 h2 w2"]:
    """Give the cosine of features at half size under the disparity of each of nine neighbours."""
    near, far = (F.normalize(x.float(), dim=1, eps=1e-3) for x in (left, right))
    shifts = (_neighbours(quarter_px) / 2).unbind(1)
    return torch.stack([(near * _moved(far, shift)).sum(1) for shift in shifts], 1)


def agreement_around(
    left: Float[Tensor, "b c h2 w2"],
    right: Float[Tensor, "b c h2 w2"],
    half_px: Float[Tensor, "b h2 w2"],
    groups: int,
) -> Float[Tensor, "b _ h2 w2"]:
    """Give the cosine of each group of features at half size at five disparities about one [px]."""
    near, far = unit_groups(left, groups), unit_groups(right, groups).flatten(1, 2)
    moved = (_moved(far, half_px + offset) for offset in _OFFSETS)
    return torch.cat([(near * m.unflatten(1, near.shape[1:3])).sum(2) for m in moved], 1)


def _moved(
    right: Float[Tensor, "b c h2 w2"], shift: Float[Tensor, "b h2 w2"]
) -> Float[Tensor, "b c h2 w2"]:
    """Give each pixel of the left view what lies ``shift`` to the left of it in the right one."""
    h, w = right.shape[2:]
    columns, lines = (torch.arange(n, device=right.device).float() for n in (w, h))
    # The last index as a tensor: the exporter to ONNX takes no quotient of unknown sizes.
    rows = (2 * lines / lines[-1:] - 1)[:, None]
    x = 2 * (columns - shift) / columns[-1:] - 1
    return F.grid_sample(right, torch.stack([x, rows.expand_as(x)], -1), align_corners=True)


class Refinement(nn.Module):
    """A correction of the disparity of each pixel, from both views compared around it.

    Its output is initialised to zero.
    """

    def __init__(self, groups: int = 4) -> None:
        super().__init__()
        self.groups = groups
        self.compared = conv_norm_2d(STEM, STEM)
        seen = groups * len(_OFFSETS) + STEM + 4
        self.layers = nn.ModuleList(
            [
                conv_norm_2d(seen, _REFINED),
                conv_norm_2d(_REFINED, _REFINED, Shape(dilation=2)),
                conv_norm_2d(_REFINED, _REFINED),
            ]
        )
        self.correction = nn.Conv2d(_REFINED, 4, 1)
        nn.init.zeros_(self.correction.weight)
        assert self.correction.bias is not None
        nn.init.zeros_(self.correction.bias)

    def forward(self, seen: Seen, found_px: Maps) -> Maps:
        """Correct a disparity of the left view [px]."""
        assert seen.right_half is not None
        four = F.pixel_unshuffle(found_px.detach()[:, None], 2) / 2
        middle = four.mean(1)
        left, right = self.compared(seen.left.half), self.compared(seen.right_half)
        alike = agreement_around(left.float(), right.float(), middle, self.groups)
        x = torch.cat([alike, seen.left.half.float(), four - middle[:, None]], 1).to(left)
        for layer in self.layers:
            x = F.relu(layer(x))
        correction_px = F.pixel_shuffle(self.correction(x).to(found_px), 2)[:, 0]
        corrected = found_px.detach() + correction_px
        return corrected if self.training else corrected.clamp_min(LEAST_PX)


def _neighbours(quarter: Quarter) -> Float[Tensor, "b 9 h2 w2"]:
    """Give the nine neighbours at 1/4 of each pixel at half size."""
    h, w = quarter.shape[1:]
    padded = F.pad(quarter[:, None], (1, 1, 1, 1), mode="replicate")
    near = [padded[:, :, y : y + h, x : x + w] for y, x in product(range(3), repeat=2)]
    return F.interpolate(torch.cat(near, 1), scale_factor=2.0, mode="nearest")


def enlarge(quarter: Quarter, weights: Float[Tensor, "b 9 4 h2 w2"]) -> Float[Tensor, "b h w"]:
    """Bring a map to full size: each pixel is a mean of nine neighbours, weighed."""
    wide = _neighbours(quarter)
    return F.pixel_shuffle((weights * wide[:, :, None]).sum(1), 2)[:, 0]


def unit_groups(features: Float[Tensor, "b c h w"], groups: int) -> Float[Tensor, "b g k h w"]:
    """Bring each group of features to length 1."""
    b, c, h, w = features.shape
    grouped = features.contiguous().view(b, groups, c // groups, h, w)
    return grouped * (grouped.square().sum(2, keepdim=True) + 1e-6).rsqrt()
