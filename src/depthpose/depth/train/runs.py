"""The stages of a training as commands run them: from a config to a trained weights file."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import nn

from depthpose.core.checkpoint import find_weights, refuse_other_network
from depthpose.core.errors import InputError
from depthpose.core.loop import (
    Task,
    TrainingRun,
    add_origin,
    format_last_validation,
    releases_folder,
    write_card,
)
from depthpose.core.processes import find_rank
from depthpose.depth.config import GeneratorConfig, PairsConfig, SelectionConfig
from depthpose.depth.datasets import FramePaths, refuse_shared_frames
from depthpose.depth.encoder import load_encoder
from depthpose.depth.generators import Generator, SelectionGenerator, UNetGenerator
from depthpose.depth.stereo import StereoNetwork
from depthpose.depth.train.config import (
    FinetuneTraining,
    SelectTraining,
    StereoTraining,
    ViewTraining,
)
from depthpose.depth.train.generator_tasks import FinetuneTask, ViewTask
from depthpose.depth.train.pairs import TrainingPairs
from depthpose.depth.train.selection_task import SelectionSamples, SelectTask
from depthpose.depth.train.stereo_task import StereoTask
from depthpose.depth.weights import MATCHERS, read_generator, read_matcher, write_depth_weights

_INDEPENDENT_OF_WEIGHTS = ("max_disparity_px", "with_street", "least_confidence")
"""Settings that may differ from those of the weights that a training begins with: a matcher
searches any disparities in the same way, and which images are refused is calibrated later."""
_ADDABLE = ("with_sky",)
"""Settings of parts that begin with next to no effect, so that weights without them can be trained
further with them."""


def copy_start(network: Generator | StereoNetwork, loaded: nn.Module, source: str) -> None:
    """Copy the weights that a training begins with into the network that it trains.

    Parts that the network has beyond them (``with_sky``) keep their initial weights.

    Args:
        network: the network that is trained.
        loaded: the network that holds the weights.
        source: their file, for errors.

    Raises:
        InputError: the networks differ in their kind, or in a setting on which weights depend.
    """
    # A part may be added, but none that the weights have may be left out.
    added = [name for name in _ADDABLE if getattr(network.config, name, False)]
    refuse_other_network(network, loaded, source, [*_INDEPENDENT_OF_WEIGHTS, *added])
    state = network.state_dict()
    common = {name: tensor for name, tensor in loaded.state_dict().items() if name in state}
    network.load_state_dict(state | common)


def make_matcher_network(config: StereoTraining) -> StereoNetwork:
    """Make the matcher network that a config trains, with its initial weights.

    Raises:
        InputError: the weights that the config names are of another network, or there is nothing
            to begin with for an encoder whose first layers are frozen.
    """
    matcher = MATCHERS[config.kind].network(config.network_config)
    if config.encoder is not None:
        if matcher.encoder is None:
            raise InputError(
                f"--encoder {config.encoder}: {type(matcher).__name__} has no encoder of its own "
                "kind; give the config the light network (kind: light), or leave it out."
            )
        load_encoder(matcher.encoder, find_weights(config.encoder))
    if matcher.encoder is not None:
        config.refuse_frozen_random()
    if config.start is not None:
        copy_start(matcher, read_matcher(find_weights(config.start)), config.start)
    return matcher


_StageConfig = ViewTraining | SelectTraining | StereoTraining | FinetuneTraining
_GeneratorTraining = TypeVar("_GeneratorTraining", ViewTraining, SelectTraining, FinetuneTraining)
_VALIDATION_TEXTS = {
    "view": "Drawn right views of pairs that were held out: mean difference (l1) and PSNR "
    "(dB) to the real ones.",
    "select": "Depth from left images that were held out: mean relative error (abs_rel), share "
    "within 25 % (d1), share of the sky that is missed.",
    "stereo": "Disparity of pairs that were held out: mean error (px), and the share of "
    "pixels off by more than 3 px and 5 % (d1); shares of the sky that is missed, and of the rest "
    "that is taken for sky.",
    "finetune": "Disparity from left images that were held out, by the drawn right view: "
    "mean error (px), and the share of pixels off by more than 3 px and 5 % (d1).",
}
"""What the numbers of each stage's validation are, for the card."""


def _open_held_out(config: PairsConfig | None, *, needs_truth: bool) -> TrainingPairs | None:
    """Open the pairs for validation, if there are any; all are measured, so the seed is any."""
    if config is None:
        return None
    return TrainingPairs(config, 0, needs_truth=needs_truth)


@releases_folder
def train_view(config: ViewTraining, run: TrainingRun) -> Path:
    """Train the U-Net generator; return the path of its weights."""
    torch.manual_seed(config.loop.seed)
    config = _with_virtual_focal(config, config.generator)
    baseline_m = config.generator.virtual_baseline_m
    pairs = TrainingPairs(config.pairs, config.loop.seed, needs_truth=False, baseline_m=baseline_m)
    held_out = _open_held_out(config.held_out, needs_truth=False)
    generator = UNetGenerator(config.generator)
    if config.start is not None:
        copy_start(generator, read_generator(find_weights(config.start)), config.start)
    facts, seconds = _run_stage(ViewTask(generator, config, held_out), pairs, config, run)
    return _write_weights(run, "view", facts, seconds, generator=generator)


@releases_folder
def train_select(config: SelectTraining, run: TrainingRun) -> Path:
    """Train the generator that selects; return the path of its weights."""
    config.refuse_frozen_random()
    torch.manual_seed(config.loop.seed)
    rig = config.generator
    seed = config.loop.seed
    config = _with_virtual_focal(config, rig)
    sources = [
        TrainingPairs(
            pairs, seed, needs_truth=True, is_mixed=True, baseline_m=rig.virtual_baseline_m
        )
        for pairs in (config.pairs, config.more)
        if pairs is not None
    ]
    samples = SelectionSamples(sources, config.more_share, config.degrade, seed)
    generator = SelectionGenerator(rig)
    if config.encoder is not None:
        load_encoder(generator.encoder, find_weights(config.encoder))
    if config.start is not None:
        copy_start(generator, read_generator(find_weights(config.start)), config.start)
    held_out = _open_held_out(config.held_out, needs_truth=True)
    task = SelectTask(generator, config, held_out)
    facts, seconds = _run_stage(task, samples, config, run)
    return _write_weights(run, "select", facts, seconds, generator=generator)


@releases_folder
def train_stereo(config: StereoTraining, run: TrainingRun) -> Path:
    """Train the matcher; return the path of its weights."""
    _refuse_wrong_gradients(config)
    torch.manual_seed(config.loop.seed)
    pairs = TrainingPairs(config.pairs, config.loop.seed, needs_truth=True)
    held_out = _open_held_out(config.held_out, needs_truth=True)
    matcher = make_matcher_network(config)
    facts, seconds = _run_stage(StereoTask(matcher, config, held_out), pairs, config, run)
    return _write_weights(run, "stereo", facts, seconds, matcher=matcher)


def _refuse_wrong_gradients(config: StereoTraining) -> None:
    """Refuse settings by which torch computes wrong gradients on a CPU.

    Raises:
        InputError: the precision is of 16 bits, and the search two planes deep at its coarsest.
    """
    # With torch 2.13, gradients of a 3x3x3 convolution over two planes in 16 bits are values near
    # 1e35 or NaN, while those over one, three or more planes agree with fp32 within 0.5 %.
    step_px = config.network_config.step_px
    is_two_deep = config.network_config.max_disparity_px == 2 * step_px
    if is_two_deep and config.loop.precision == "bf16" and not torch.cuda.is_available():
        raise InputError(
            f"max_disparity_px is {2 * step_px} and precision bf16: at its coarsest the volume is "
            "two planes deep, and a CPU's 16-bit gradients of its convolutions are wrong. Take "
            f"max_disparity_px {3 * step_px}, or precision fp32."
        )


@releases_folder
def train_finetune(config: FinetuneTraining, run: TrainingRun) -> Path:
    """Fine-tune the generator through the frozen matcher; return the path of both's weights."""
    torch.manual_seed(config.loop.seed)
    for setting in ("generator", "matcher"):
        if not getattr(config, setting):
            raise InputError(
                f"fine-tuning needs weights of a {setting} to begin with: --{setting} FILE (what "
                "'depth train view' and 'depth train stereo' wrote)."
            )
    generator = read_generator(find_weights(config.generator))
    if isinstance(generator, SelectionGenerator):
        # Which images are refused has to be calibrated anew.
        generator.config = replace(generator.config, least_confidence=0.0, with_street=False)
        generator.street = None
    matcher = read_matcher(find_weights(config.matcher))
    config = _with_virtual_focal(config, generator.config)
    baseline_m = generator.config.virtual_baseline_m
    pairs = TrainingPairs(config.pairs, config.loop.seed, needs_truth=True, baseline_m=baseline_m)
    held_out = _open_held_out(config.held_out, needs_truth=True)
    task = FinetuneTask(generator, matcher, config, held_out)
    facts, seconds = _run_stage(task, pairs, config, run)
    return _write_weights(run, "finetune", facts, seconds, generator=generator, matcher=matcher)


STAGES = {
    "view": (ViewTraining, train_view),
    "select": (SelectTraining, train_select),
    "stereo": (StereoTraining, train_stereo),
    "finetune": (FinetuneTraining, train_finetune),
}
"""Config and function of each stage, by its name on the command line."""


def _run_stage(
    task: Task,
    samples: TrainingPairs | SelectionSamples,
    config: _StageConfig,
    run: TrainingRun,
) -> tuple[dict[str, str], float]:
    """Claim the folder for this config, and train.

    Returns:
        The facts of the weights' card, and how long the training took [s].

    Raises:
        InputError: the folder belongs to another training, or held-out pairs are trained on too.
    """
    # Held-out pairs must not be trained on.
    sources = samples.sources if isinstance(samples, SelectionSamples) else [samples]
    frames = [frame for source in sources for frame in source.frames]
    held_out: TrainingPairs | None = getattr(task, "held_out", None)
    if held_out is not None:
        remedy = "give --held-out other pairs, or exclude these in the config"
        refuse_shared_frames(frames, held_out.frames, "pairs held out", remedy)

    # What the folder is claimed for beside the config: truths and frames.
    more: dict[str, Any] = {}
    if samples.truths:
        more["truth"] = list(samples.truths)
    if frames:
        more["frames_sha256"] = _hash_frames(frames)
    run.claim(config, ("generator", "matcher", "fakestereo"), more)
    return _describe_training(config, samples.truths), run.train(task, samples, config.loop)


def _describe_training(config: _StageConfig, truths: Sequence[str]) -> dict[str, str]:
    """Describe a training for the card of its weights, with the terms that bind them.

    Args:
        config: config of the stage.
        truths: the kinds of truth, as :class:`TrainingPairs` has them.
    """
    pair_configs = [config.pairs]
    if isinstance(config, SelectTraining) and config.more is not None:
        pair_configs.append(config.more)
    data = [Path(folder).name for pairs in pair_configs for folder in pairs.folders]
    if any(pairs.streets for pairs in pair_configs):
        data.append("synthetic streets")
    facts = {
        "trained_on": ", ".join(data),
        "licence": "not stated; that of the training data binds",
    }
    if truths:
        facts["truth"] = ", ".join(truths)
    return add_origin(facts, config)


def _hash_frames(frames: Sequence[FramePaths]) -> str:
    """Hash the names of frames and the sizes of their left images."""
    digest = sha256()
    for frame in frames:
        size = frame.left.stat().st_size if frame.left.is_file() else 0  # 0: in a shard
        digest.update(f"{frame.name} {size}\n".encode())
    return digest.hexdigest()


def _write_weights(
    run: TrainingRun,
    stage: str,
    facts: Mapping[str, str],
    seconds: float,
    *,
    generator: Generator | None = None,
    matcher: StereoNetwork | None = None,
) -> Path:
    """Write the weights and their card, by the process of rank 0; return the weights' path.

    They are called after what they hold: generator, matcher, or fakestereo for both.
    """
    if generator is not None and matcher is not None:
        name = "fakestereo"
    else:
        name = "generator" if matcher is None else "matcher"
    path = run.folder / f"{name}.safetensors"
    if find_rank().rank:
        return path  # the statistics of batch norm that count are those of rank 0

    write_depth_weights(path, generator=generator, matcher=matcher, facts=facts)
    measured = format_last_validation(run.folder, _VALIDATION_TEXTS[stage])
    write_card(path, f"depth train {stage}", seconds, facts, measured)
    return path


def _with_virtual_focal(
    config: _GeneratorTraining, generator: GeneratorConfig | SelectionConfig
) -> _GeneratorTraining:
    """Return the config with the focal length of the generator's rig for pairs without one.

    Raises:
        InputError: pairs have a focal length of their own, or a scale, from which the generator
            cannot learn.
    """
    focal_px = generator.virtual_focal_px
    pair_configs: dict[str, PairsConfig] = {}
    for name in ("pairs", "more", "held_out"):
        pairs = getattr(config, name, None)  # only SelectTraining has ``more``
        if pairs is not None:
            pair_configs[name] = pairs

    for name, pairs in pair_configs.items():
        # A generator that selects learns from any focal length, but is validated at its own.
        if isinstance(generator, SelectionConfig) and name != "held_out":
            continue
        if pairs.focal_px not in (None, focal_px):
            raise InputError(
                f"{name}.focal_px is {pairs.focal_px}, but the generator imitates a rig of "
                f"{focal_px} px (virtual_focal_px); leave {name}.focal_px out"
            )
        if pairs.augment.scale != (1.0, 1.0):
            raise InputError(
                f"augment.scale of {name} is {pairs.augment.scale}: another size is another focal "
                "length, and the generator imitates one; leave it out"
            )
    changed: dict[str, Any] = {
        name: replace(pairs, focal_px=pairs.focal_px or focal_px)
        for name, pairs in pair_configs.items()
    }
    return replace(config, **changed)
