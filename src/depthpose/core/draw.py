"""Maps as pictures. A picture is for eyes only: values are read from the NPY beside it."""

import math
from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.errors import InputError

# From near to far: a warm, bright end and a dark, cold one, of falling lightness, so that the order
# survives a grey-scale print and colour blindness.
_NEAR_TO_FAR = (
    (1.00, 0.97, 0.70), (0.99, 0.76, 0.35), (0.94, 0.49, 0.28), (0.80, 0.26, 0.38),
    (0.57, 0.16, 0.47), (0.33, 0.12, 0.45), (0.14, 0.08, 0.30), (0.02, 0.02, 0.10),
)  # fmt: skip
_INVALID = (0.5, 0.5, 0.5)


def draw_depth(
    depth_m: Float[Tensor, "h w"], near_m: float = 3.0, far_m: float = 80.0
) -> Float[Tensor, "3 h w"]:
    """Colour depth by its logarithm, near bright and far dark, on a scale fixed by the arguments.

    A fixed scale makes two pictures comparable and a video steady; grey marks invalid pixels.
    """
    return draw_share((depth_m / near_m).log() / math.log(far_m / near_m))


def find_range_m(
    depths_m: Iterable[Float[Tensor, "_ _"]], left_out: float = 0.02
) -> tuple[float, float]:
    """Find the near and far end of a scale for all frames of a video, from a few of them.

    Given to :func:`draw_depth` with every frame, it keeps a colour the same metres throughout.

    Args:
        depths_m: depth of some frames, NaN where invalid.
        left_out: share of the pixels left out at either end: a single stray pixel moves no colour.

    Raises:
        InputError: no frame has a valid pixel.
    """
    valid_m = torch.cat([depth[torch.isfinite(depth)] for depth in depths_m] or [torch.empty(0)])
    if len(valid_m) == 0:
        raise InputError("find_range_m: no frame has a valid depth; give frames that have one.")
    sorted_m = valid_m.sort().values
    last = len(sorted_m) - 1
    near_m, far_m = (float(sorted_m[round(share * last)]) for share in (left_out, 1 - left_out))
    return near_m, max(far_m, 1.01 * near_m)  # one depth everywhere still makes a scale


def draw_disparity(
    disparity_px: Float[Tensor, "h w"], largest_px: float = 96.0
) -> Float[Tensor, "3 h w"]:
    """Colour disparity, large (near) bright, on the fixed scale 0..``largest_px``."""
    return draw_share(1 - disparity_px / largest_px)


def draw_share(share: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    """Colour numbers in 0 (bright) to 1 (dark); NaN becomes grey."""
    anchors = torch.tensor(_NEAR_TO_FAR, dtype=torch.float32)
    position = share.nan_to_num(0.0).clamp(0, 1) * (len(anchors) - 1)
    below = position.long().clamp(max=len(anchors) - 2)
    color = torch.lerp(anchors[below], anchors[below + 1], (position - below)[..., None].float())
    color[~torch.isfinite(share)] = torch.tensor(_INVALID)
    return color.permute(2, 0, 1)


def draw_points(
    image: Float[Tensor, "3 h w"],
    depth_m: Float[Tensor, "h w"],
    far_m: float = 80.0,
    radius_px: int = 1,
) -> Float[Tensor, "3 h w"]:
    """Lay sparse depth (LiDAR) over a darkened image, each point grown to a square.

    Its side is ``2 radius_px + 1`` pixels; where squares overlap the nearest point is seen.
    """
    side = 2 * radius_px + 1
    nearest_m = -F.max_pool2d(-depth_m.nan_to_num(torch.inf)[None], side, 1, radius_px)[0]
    grown_m = torch.where(torch.isfinite(nearest_m), nearest_m, torch.nan)
    return torch.where(torch.isnan(grown_m), 0.35 * image, draw_depth(grown_m, far_m=far_m))
