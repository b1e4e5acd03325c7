"""The task that trains a matcher (thesis, 2.4.2), and its validation."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.draw import draw_disparity
from depthpose.core.loop import Update, ValidationResult, make_adam
from depthpose.depth import generators, losses, synthesis
from depthpose.depth.augment import TrainingPair
from depthpose.depth.config import NetworkConfig
from depthpose.depth.metrics import measure
from depthpose.depth.stereo import StereoNetwork, normalise
from depthpose.depth.stereo.network_matcher import pad_top_right
from depthpose.depth.train.config import StereoTraining
from depthpose.depth.train.pairs import TrainingPairs
from depthpose.depth.types import Map, Maps, Mask, View


def freeze_norm_statistics(module: nn.Module) -> None:
    """Set batch norms to eval mode, so that small batches do not spoil their statistics."""
    for part in module.modules():
        if isinstance(part, nn.BatchNorm2d | nn.BatchNorm3d):
            part.eval()


def group_parameters(
    network: nn.Module, encoder: nn.Module, encoder_rate: float
) -> list[dict[str, Any]]:
    """Group a network's parameters for the optimiser: those of its encoder, and the rest.

    ``encoder_rate``: learning rate of the encoder, as a share of the rest's.
    """
    encoder_parameters = set(encoder.parameters())
    rest = [p for p in network.parameters() if p not in encoder_parameters]
    trained = [p for p in encoder.parameters() if p.requires_grad]
    return [{"params": trained, "rate": encoder_rate}, {"params": rest}]


class StereoTask:
    """Trains the matcher: smooth L1 on all heads (eq. 2.6), and cross entropy of the sky."""

    def __init__(
        self, matcher: StereoNetwork, config: StereoTraining, held_out: TrainingPairs | None
    ) -> None:
        self.config = config
        self.held_out = held_out
        self.matcher = matcher
        self.modules: dict[str, nn.Module] = {"matcher": matcher}

        # Parts that stay as they are: the encoder's stem, norms, or all but the head of the sky.
        self._with_frozen_norms: list[nn.Module] = []
        if config.with_frozen_stem and matcher.encoder is not None:
            matcher.encoder.freeze_early()
            self._with_frozen_norms.append(matcher.encoder)
        if config.with_frozen_norms:
            self._with_frozen_norms.append(matcher)
        self._only_trained = matcher.sky if config.sky_alone else None
        if self._only_trained is not None:
            matcher.requires_grad_(False)
            self._only_trained.requires_grad_(True)
        self._set_train_mode()

        groups: list[dict[str, Any]]
        if self._only_trained is None and matcher.encoder is not None:
            groups = group_parameters(matcher, matcher.encoder, config.encoder_rate)
        else:
            groups = [{"params": [p for p in matcher.parameters() if p.requires_grad]}]
        self.optimizers = {"matcher": (make_adam(groups, config.adam), config.adam)}

    def _set_train_mode(self) -> None:
        """Set the matcher to train mode, except for norms and parts that stay as they are."""
        self.matcher.train()
        for module in self._with_frozen_norms:
            freeze_norm_statistics(module)
        if self._only_trained is not None:
            for part in self.matcher.children():
                part.train(part is self._only_trained)

    def step(self, batch: TrainingPair) -> Iterator[Update]:
        """Match a batch, and yield the one update of the matcher, by ``losses.stereo_loss``."""
        max_disparity_px = self.matcher.config.max_disparity_px
        left = normalise(batch.left)
        right = normalise(batch.right)
        heads_px, sky = self.matcher.forward_with_sky(left, right)
        heads_px = tuple(head_px.float() for head_px in heads_px)
        if sky is not None:
            sky = sky.float()
        loss = losses.stereo_loss(
            heads_px, sky, batch.left_px, max_disparity_px, self.config.sky_weight
        )
        facts = {"epe": end_point_error(heads_px[-1], batch.left_px, max_disparity_px)}
        if loss.sky is not None:
            facts["sky"] = loss.sky.detach()
        yield Update("matcher", loss.total, facts)

    def validate(self) -> ValidationResult:
        """Match held-out pairs, and measure them by ``validate_pairs``."""
        if self.held_out is None:
            return ValidationResult()
        self.matcher.eval()
        result = validate_pairs(self.matcher, self.held_out)
        self._set_train_mode()
        return result


def end_point_error(predicted_px: Maps, truth_px: Maps, max_disparity_px: int) -> Float[Tensor, ""]:
    """Average the absolute error [px] over pixels with truth, without a gradient.

    It is 0 where no pixel has truth. Truth from ``max_disparity_px`` on does not count.
    """
    is_valid = (truth_px > 0) & (truth_px < max_disparity_px)
    error_px = (predicted_px.detach() - truth_px.nan_to_num(0.0)).abs()
    return error_px.where(is_valid, 0.0).sum() / is_valid.sum().clamp(min=1)


@torch.no_grad()
def validate_pairs(
    matcher: StereoNetwork, held_out: TrainingPairs, generator: generators.Generator | None = None
) -> ValidationResult:
    """Measure a matcher in eval mode on held-out pairs.

    Args:
        matcher: the network.
        held_out: the pairs.
        generator: synthesises the right views, in place of the real ones.

    Returns:
        Means over pairs: end-point error [px] and share of bad pixels; for a matcher that knows
        the sky, shares of the sky that is missed and of the rest that is taken for sky. Pixels
        taken for sky have a disparity of 0. The picture is of the first pair.
    """
    measured: list[dict[str, float]] = []
    pictures: dict[str, Tensor] = {}
    device = next(matcher.parameters()).device
    for index in range(len(held_out)):
        pair = held_out.read(index)
        right = pair.right
        if generator is not None:
            right = synthesis.synthesise_right(generator, pair.left[None].to(device))[0].cpu()
        predicted_px, is_sky = _match(matcher, pair.left, right)
        if is_sky is not None:
            predicted_px = torch.where(is_sky, 0.0, predicted_px)
        if index == 0:
            views = [pair.left, right, draw_disparity(predicted_px)]
            pictures["left_right_disparity"] = torch.cat(views, 1)
        truth_px = pair.left_px
        measured.append(_measure_match(predicted_px, is_sky, truth_px, matcher.config))

    # Without any truth the error is 0, as there is none.
    means = {"held_out/epe_px": 0.0, "held_out/d1_all": 0.0} | average_metrics(measured)
    return ValidationResult(numbers=means, pictures=pictures)


def _measure_match(
    predicted_px: Map, is_sky: Mask | None, truth_px: Map, config: NetworkConfig
) -> dict[str, float]:
    """Measure the disparity of one pair: its metrics, of those that its truth allows.

    Args:
        predicted_px: disparity, 0 in what is taken for sky.
        is_sky: what is taken for sky, of a matcher that recognises it.
        truth_px: true disparity; 0 in the sky, NaN where it is unknown.
        config: config of the matcher, whose search ends at ``max_disparity_px``.
    """
    metrics: dict[str, float] = {}
    has_truth = (truth_px > 0) & (truth_px < config.max_disparity_px)
    if bool(has_truth.any()):
        errors = measure("disparity", predicted_px[has_truth], truth_px[has_truth])
        metrics["epe_px"] = errors["epe_px"]
        metrics["d1_all"] = errors["d1_all"]

    is_true_sky = truth_px == 0
    if is_sky is not None and bool(is_true_sky.any()):
        metrics["sky_missed"] = float((~is_sky[is_true_sky]).float().mean())
    if is_sky is not None and bool(has_truth.any()):
        metrics["sky_false"] = float(is_sky[has_truth].float().mean())
    return metrics


def average_metrics(measured: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Average each metric over the pairs that have it, under the name ``held_out/METRIC``."""
    values_of: dict[str, list[float]] = {}
    for metrics in measured:
        for name, value in metrics.items():
            values_of.setdefault(f"held_out/{name}", []).append(value)
    return {name: sum(values) / len(values) for name, values in values_of.items()}


def _match(matcher: StereoNetwork, left: View, right: View) -> tuple[Map, Mask | None]:
    """Match one pair of any size: disparity of the left view [px], and its sky where recognised."""
    device = next(matcher.parameters()).device
    padded_left = pad_top_right(normalise(left.to(device)), matcher.config)
    padded_right = pad_top_right(normalise(right.to(device)), matcher.config)
    heads_px, sky = matcher.forward_with_sky(padded_left[None], padded_right[None])

    # Without the padding, which is at the top and on the right.
    height, width = left.shape[-2:]
    disparity_px = heads_px[-1][0, -height:, :width].float().cpu()
    is_sky = None if sky is None else sky[0, -height:, :width].cpu() > 0.5
    return disparity_px, is_sky
