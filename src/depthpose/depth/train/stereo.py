"""Stage 2: the matcher from pairs with truth."""

from collections.abc import Callable, Iterator

import torch
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.draw import draw_disparity
from depthpose.core.loop import Evidence, Turn, make_adam
from depthpose.depth.augment import TrainingPair
from depthpose.depth.losses import heads_loss, valid_disparity
from depthpose.depth.stereo import PSMNet
from depthpose.depth.stereo.psmnet_matcher import normalise, pad_top_right
from depthpose.depth.train.config import StereoTraining
from depthpose.depth.train.pairs import TrainingPairs


class StereoTask:
    """Smooth L1 on the three heads (eq. 2.6)."""

    def __init__(
        self, matcher: PSMNet, config: StereoTraining, held_out: TrainingPairs | None
    ) -> None:
        self.config, self.held_out = config, held_out
        self.matcher = matcher.train()
        self.modules: dict[str, nn.Module] = {"matcher": matcher}
        self.optimizers = {"matcher": (make_adam(matcher.parameters(), config.adam), config.adam)}

    def step(self, batch: TrainingPair) -> Iterator[Turn]:
        """One turn: match and compare."""
        heads = self.matcher(normalise(batch.left), normalise(batch.right))
        reach = self.matcher.config.max_disparity_px
        heads = tuple(head.float() for head in heads)
        loss = heads_loss(heads, batch.left_px, reach, with_sky=self.config.with_sky)
        yield Turn("matcher", loss, {"epe": mean_error_px(heads[-1], batch.left_px, reach)})

    def validate(self) -> Evidence:
        """Match held-out pairs: mean error and the share of bad pixels; the first as a picture."""
        if self.held_out is None:
            return Evidence()
        self.matcher.eval()
        evidence = held_out_evidence(self.matcher, self.held_out)
        self.matcher.train()
        return evidence


def held_out_evidence(
    matcher: PSMNet, held_out: TrainingPairs, draw: Callable[[Tensor], Tensor] | None = None
) -> Evidence:
    """Disparity error of a matcher on held-out pairs, or on right views that ``draw`` draws."""
    errors, bad, pictures = [], [], {}
    for index in range(len(held_out)):
        pair = held_out.read(index)
        right = pair.right if draw is None else draw(pair.left)
        found = match_whole(matcher, pair.left, right)
        is_known = valid_disparity(pair.left_px[None], matcher.config.max_disparity_px)[0]
        if index == 0:
            views = [pair.left, right, draw_disparity(found)]
            pictures["left_right_disparity"] = torch.cat(views, 1)
        if not bool(is_known.any()):
            continue
        error = (found - pair.left_px)[is_known].abs()
        errors.append(float(error.mean()))
        is_bad = (error > 3) & (error > 0.05 * pair.left_px[is_known])
        bad.append(float(is_bad.float().mean()))
    count = max(len(errors), 1)
    numbers = {"held_out/epe_px": sum(errors) / count, "held_out/d1": sum(bad) / count}
    return Evidence(numbers=numbers, pictures=pictures)


@torch.no_grad()
def match_whole(
    matcher: PSMNet, left: Float[Tensor, "3 h w"], right: Float[Tensor, "3 h w"]
) -> Float[Tensor, "h w"]:
    """Match one pair of any size with the network as it stands."""
    device = next(matcher.parameters()).device
    height, width = left.shape[-2:]
    least = matcher.config.min_side_px
    padded = [pad_top_right(normalise(v.to(device)), least)[None] for v in (left, right)]
    return matcher(*padded)[-1][0, -height:, :width].float().cpu()


@torch.no_grad()
def mean_error_px(
    found_px: Float[Tensor, "b h w"], truth_px: Float[Tensor, "b h w"], max_px: int
) -> Float[Tensor, ""]:
    """Mean absolute disparity error over the pixels with truth [px]."""
    is_valid = valid_disparity(truth_px, max_px)
    error = torch.where(is_valid, (found_px - truth_px.nan_to_num(0.0)).abs(), 0.0)
    return error.sum() / is_valid.sum().clamp(min=1)
