"""Training the generator that selects: its samples, what moves, what is learnt."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from tests.depth.small_training import LOOP, folder, held_folder, pairs, snapshot

from depthpose.core.checkpoint import Checkpoint, save_checkpoint
from depthpose.core.errors import InputError
from depthpose.core.loop import AdamConfig, TrainingRun, read_metrics
from depthpose.depth.config import (
    AugmentConfig,
    DegradeConfig,
    PairsConfig,
    PSMNetConfig,
    SelectionConfig,
    StreetsConfig,
)
from depthpose.depth.disparity import warp_right_to_left
from depthpose.depth.encoder import LiteEncoder
from depthpose.depth.generators import SelectionGenerator
from depthpose.depth.stereo import PSMNet
from depthpose.depth.train import (
    FinetuneTask,
    SelectTask,
    TrainingPairs,
    train_finetune,
    train_select,
)
from depthpose.depth.train.config import FinetuneTraining, SelectTraining
from depthpose.depth.train.selection_task import SelectionSample, SelectionSamples
from depthpose.depth.weights import read_depth_weights, read_generator, write_depth_weights

__all__ = ["folder", "held_folder", "pairs"]  # fixtures
TINY = SelectionConfig(
    encoder_width=0.1,
    widths=(8, 8, 8, 8),
    planes=6,
    disparity_px=(1.0, 32.0),
    virtual_focal_px=130.0,
    virtual_baseline_m=0.54,
)


def samples(*sources: PairsConfig, share: float = 0.5) -> SelectionSamples:
    opened = [TrainingPairs(pairs, 0, needs_truth=True, is_mixed=True) for pairs in sources]
    return SelectionSamples(opened, share, DegradeConfig(), 0)


def batch(source: SelectionSamples, count: int = 2) -> SelectionSample:
    parts = zip(*(source[index] for index in range(count)), strict=True)
    return SelectionSample(*(torch.stack(part) for part in parts))


def test_only_the_input_is_degraded(pairs: PairsConfig) -> None:
    sample = samples(pairs)[0]
    assert not torch.equal(sample.degraded, sample.left)
    error = (warp_right_to_left(sample.right, sample.left_px) - sample.left).abs()
    assert float(error.nanmedian()) < 0.06
    assert bool(sample.has_right)


def test_a_share_of_the_samples_comes_from_the_second_source(
    folder: Path, pairs: PairsConfig
) -> None:
    """Street samples have sky (0), which a plain folder does not know."""
    synthetic = PairsConfig(
        streets=StreetsConfig(frames=1, scale=0.2, jpeg_share=0.0),
        focal_px=130.0,
        with_cache=True,
        augment=AugmentConfig(crop_px=(70, 200)),
    )
    found = [
        bool((sample.left_px == 0).any())
        for sample in map(samples(pairs, synthetic, share=0.25).__getitem__, range(8))
    ]
    assert found == [False, False, False, True] * 2


def test_an_image_without_a_right_view_teaches_disparity_alone(
    folder: Path, tmp_path: Path, pairs: PairsConfig
) -> None:
    alone = tmp_path / "alone"
    for part in ("left", "disp_occ"):
        (alone / part).mkdir(parents=True)
        name = "00.png"
        (alone / part / name).write_bytes((folder / part / name).read_bytes())
    (alone / "calib.txt").write_text((folder / "calib.txt").read_text())
    config = dataclasses.replace(pairs, folders=(str(alone),))
    with pytest.raises(InputError, match="no frame has a right view and a truth"):
        TrainingPairs(config, 0, needs_truth=True)
    source = samples(config)
    for index in range(4):  # mirrored ones too
        sample = source[index]
        assert not bool(sample.has_right)
        assert torch.equal(sample.left, sample.right)
        assert bool((sample.left_px > 0).any())
    torch.manual_seed(0)
    task = SelectTask(SelectionGenerator(TINY), SelectTraining(generator=TINY), None)
    (turn,) = task.step(batch(source))
    assert float(turn.facts["view"]) == 0.0
    assert float(turn.facts["left"]) > 0.0


def test_a_pair_without_truth_teaches_by_its_view(
    folder: Path, tmp_path: Path, pairs: PairsConfig
) -> None:
    bare = tmp_path / "bare"
    for part in ("left", "right"):
        (bare / part).mkdir(parents=True)
        (bare / part / "00.png").write_bytes((folder / part / "00.png").read_bytes())
    (bare / "calib.txt").write_text((folder / "calib.txt").read_text())
    source = samples(dataclasses.replace(pairs, folders=(str(bare),)))
    torch.manual_seed(0)
    task = SelectTask(SelectionGenerator(TINY), SelectTraining(generator=TINY), None)
    (turn,) = task.step(batch(source))
    assert float(turn.facts["left"]) == 0.0
    assert float(turn.facts["view"]) > 0.0
    turn.loss.backward()
    gradients = [p.grad for p in task.generator.parameters() if p.grad is not None]
    assert all(bool(gradient.isfinite().all()) for gradient in gradients)


def test_early_layers_and_statistics_of_the_encoder_stay(pairs: PairsConfig) -> None:
    torch.manual_seed(0)
    network = SelectionGenerator(TINY)
    task = SelectTask(network, SelectTraining(generator=TINY), None)
    before = snapshot(network)
    given = batch(samples(pairs))
    optimizer, _ = task.optimizers["generator"]
    for _ in range(3):
        (turn,) = task.step(given)
        turn.loss.backward()
        optimizer.step()
        optimizer.zero_grad()
    after = snapshot(network)
    moved = {name for name in before if not torch.equal(before[name], after[name])}
    fixed = ("encoder.stem.", "encoder.blocks.0.", "encoder.blocks.1.", "encoder.blocks.2.")
    assert not any(name.startswith(fixed) for name in moved)
    assert not any("running_" in name for name in moved if name.startswith("encoder."))
    assert "encoder.blocks.3.project.conv.weight" in moved
    assert "decoder.0.1.running_mean" in moved
    free = SelectTask(SelectionGenerator(TINY), SelectTraining(with_frozen_stem=False), None)
    assert all(p.requires_grad for p in free.generator.parameters())
    assert all(m.training for m in free.generator.modules())


def test_the_encoder_learns_at_its_own_rate(pairs: PairsConfig) -> None:
    config = SelectTraining(generator=TINY, encoder_rate=0.25)
    optimizer, adam = SelectTask(SelectionGenerator(TINY), config, None).optimizers["generator"]
    assert isinstance(optimizer, torch.optim.AdamW)
    assert [group.get("rate", 1.0) for group in optimizer.param_groups] == [0.25, 1.0]
    assert optimizer.param_groups[1]["weight_decay"] == adam.weight_decay == 1e-2


@pytest.mark.slow
def test_it_learns_disparity_and_view(held_folder: str, tmp_path: Path, pairs: PairsConfig) -> None:
    config = SelectTraining(
        generator=TINY,
        with_frozen_stem=False,
        encoder_rate=1.0,
        adam=AdamConfig(learning_rate=4e-3),
        pairs=dataclasses.replace(pairs, with_cache=True),
        held_out=dataclasses.replace(pairs, folders=(held_folder,), limit=1),
        degrade=DegradeConfig(color=0.0, hue_share=0.0, haze_share=0.0, glare_share=0.0),
        loop=dataclasses.replace(LOOP, steps=80, log_every_steps=10),
    )
    path = train_select(config, TrainingRun(folder=tmp_path))
    rows = read_metrics(tmp_path)
    logged = [row for row in rows if "generator/left" in row]
    assert logged[-1]["generator/left"] < 0.65 * logged[0]["generator/left"]
    assert logged[-1]["generator/view"] < 0.9 * logged[0]["generator/view"]
    assert rows[-1]["held_out/abs_rel"] < 0.5
    assert list((tmp_path / "pictures").glob("*.png"))
    card = path.with_suffix(".md").read_text()
    assert "`depthpose depth train select --config config.yaml --out " in card
    assert "| abs_rel | " in card


def test_held_out_pairs_are_measured_at_the_focal_length_of_the_generator(
    pairs: PairsConfig, held_folder: str, tmp_path: Path
) -> None:
    held_out = dataclasses.replace(pairs, folders=(held_folder,))
    config = SelectTraining(
        generator=TINY, with_frozen_stem=False, pairs=pairs, loop=dataclasses.replace(LOOP, steps=1)
    )
    found = []
    for focal_px in (130.0, None):
        given = dataclasses.replace(held_out, focal_px=focal_px)
        train_select(
            dataclasses.replace(config, held_out=given),
            TrainingRun(folder=tmp_path / str(focal_px)),
        )
        found.append(read_metrics(tmp_path / str(focal_px))[-1]["held_out/abs_rel"])
    assert found[0] == found[1]
    other = dataclasses.replace(config, held_out=dataclasses.replace(held_out, focal_px=200.0))
    with pytest.raises(InputError, match=r"leave held_out\.focal_px out"):
        train_select(other, TrainingRun(folder=tmp_path / "other"))


def test_pairs_may_be_trained_on_at_another_focal_length(
    pairs: PairsConfig, tmp_path: Path
) -> None:
    crops = AugmentConfig(crop_px=(96, 128), scale=(0.5, 1.0), jitter=0.0)
    larger = dataclasses.replace(pairs, focal_px=260.0, augment=crops)
    config = SelectTraining(
        generator=TINY,
        with_frozen_stem=False,
        pairs=larger,
        loop=dataclasses.replace(LOOP, steps=1),
    )
    path = train_select(config, TrainingRun(folder=tmp_path))
    assert "focal_px: 260.0" in (tmp_path / "config.yaml").read_text()
    assert read_generator(path).config.virtual_focal_px == 130.0


@pytest.mark.slow
def test_it_begins_with_the_encoder_and_goes_on_from_its_weights(
    pairs: PairsConfig, tmp_path: Path
) -> None:
    torch.manual_seed(3)
    encoder = LiteEncoder()
    file = tmp_path / "lite0.safetensors"
    facts = {"licence": "Apache-2.0"}
    save_checkpoint(
        file,
        Checkpoint(kind="efficientnet-lite0", config={}, state=encoder.state_dict(), facts=facts),
    )
    still = AdamConfig(learning_rate=1e-30)
    loop = dataclasses.replace(LOOP, steps=1)
    full = dataclasses.replace(TINY, encoder_width=1.0)
    config = SelectTraining(generator=full, encoder=str(file), adam=still, pairs=pairs, loop=loop)
    first = train_select(config, TrainingRun(folder=tmp_path / "first"))
    found = read_depth_weights(first).generator
    assert isinstance(found, SelectionGenerator)
    for name, tensor in encoder.state_dict().items():
        torch.testing.assert_close(found.encoder.state_dict()[name], tensor)
    again = dataclasses.replace(config, encoder=None, start=str(first))
    second = read_depth_weights(
        train_select(again, TrainingRun(folder=tmp_path / "second"))
    ).generator
    assert isinstance(second, SelectionGenerator)
    torch.testing.assert_close(second.head.weight, found.head.weight)


def test_a_start_may_refuse_unlike_images_and_what_comes_of_it_does_not_yet(
    pairs: PairsConfig, tmp_path: Path
) -> None:
    """What tells streets, and its limit, are found after a training: the start's say nothing."""
    start = tmp_path / "start.safetensors"
    careful = SelectionGenerator(dataclasses.replace(TINY, least_confidence=0.5, with_street=True))
    write_depth_weights(start, generator=careful, facts={})
    loop = dataclasses.replace(LOOP, steps=1)
    config = SelectTraining(generator=TINY, start=str(start), pairs=pairs, loop=loop)
    config = dataclasses.replace(config, adam=AdamConfig(learning_rate=1e-30))
    found = read_depth_weights(train_select(config, TrainingRun(folder=tmp_path / "run"))).generator
    assert isinstance(found, SelectionGenerator)
    assert found.config == TINY
    torch.testing.assert_close(found.head.weight, careful.head.weight)


def test_it_is_tuned_through_the_matcher(pairs: PairsConfig, tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = SelectionGenerator(TINY)
    matcher = PSMNet(PSMNetConfig(width=4, max_disparity_px=32, blocks=(1, 1, 1, 1), pools=(4, 2)))
    source = TrainingPairs(pairs, 0, needs_truth=True)
    (turn,) = FinetuneTask(network, matcher, FinetuneTraining(), None).step(
        type(source[0])(*(torch.stack(part) for part in zip(source[0], source[1], strict=True)))
    )
    turn.loss.backward()
    head = network.head.weight.grad
    assert head is not None
    assert float(head[TINY.planes + 1 :].abs().sum()) > 0
    write_depth_weights(tmp_path / "generator.safetensors", generator=network, facts={})
    write_depth_weights(tmp_path / "matcher.safetensors", matcher=matcher, facts={})
    config = FinetuneTraining(
        generator=str(tmp_path / "generator.safetensors"),
        matcher=str(tmp_path / "matcher.safetensors"),
        pairs=pairs,
        loop=dataclasses.replace(LOOP, steps=1),
    )
    both = read_depth_weights(train_finetune(config, TrainingRun(folder=tmp_path / "tune")))
    assert isinstance(both.generator, SelectionGenerator)
    assert both.generator.config == TINY
    assert both.matcher is not None


def test_zoom_is_for_the_generator_that_selects(pairs: PairsConfig, tmp_path: Path) -> None:
    zoom = dataclasses.replace(pairs.augment, scale=(1.0, 1.3))
    config = SelectTraining(
        generator=TINY,
        with_frozen_stem=False,
        pairs=dataclasses.replace(pairs, augment=zoom),
        loop=LOOP,
    )
    assert train_select(config, TrainingRun(folder=tmp_path)).is_file()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"more_share": 1.5}, r"more_share must be in \[0, 1\], got 1.5"),
        ({"view_weight": -1.0}, r"view_weight must be in \[0, inf\), got -1"),
    ],
)
def test_weights_that_are_none_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        SelectTraining(**changes)


def test_fixed_layers_need_something_to_begin_with(pairs: PairsConfig, tmp_path: Path) -> None:
    config = SelectTraining(generator=TINY, pairs=pairs, loop=LOOP)
    with pytest.raises(InputError, match="nothing says what they begin with: give --encoder"):
        train_select(config, TrainingRun(folder=tmp_path))


@pytest.mark.parametrize(
    "change", [{"per_view": DegradeConfig()}, {"erased_share": 0.1}, {"misaligned_px": 1.0}]
)
def test_views_changed_each_on_its_own_are_refused(change: dict[str, Any]) -> None:
    """A lone image, which stands for both views, would become a pair."""
    pairs = PairsConfig(augment=AugmentConfig(**change))
    with pytest.raises(InputError, match="changes each view on its own"):
        SelectTraining(generator=TINY, pairs=pairs)
    with pytest.raises(InputError, match="changes each view on its own"):
        SelectTraining(generator=TINY, more=pairs)
