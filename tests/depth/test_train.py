"""The three stages on small synthetic pairs: what moves, what stays, what is refused."""

import dataclasses
import shutil
from pathlib import Path

import pytest
import torch
from tests.depth.small_training import LOOP, folder, held_folder, pairs, snapshot
from tests.synthetic_street import make_street
from torch import Tensor

from depthpose.core.camera import StereoRig
from depthpose.core.checkpoint import LicenceNotice
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.core.loop import AdamConfig, LoopConfig, TrainingRun, read_metrics
from depthpose.depth.augment import TrainingPair
from depthpose.depth.config import (
    AugmentConfig,
    GeneratorConfig,
    LightConfig,
    PairsConfig,
    PSMNetConfig,
    StreetsConfig,
)
from depthpose.depth.disparity import warp_right_to_left
from depthpose.depth.generators import UNetGenerator
from depthpose.depth.stereo import LightStereo, PSMNet
from depthpose.depth.train import (
    FinetuneTask,
    StereoTask,
    TrainingPairs,
    ViewTask,
    train_finetune,
    train_stereo,
    train_view,
)
from depthpose.depth.train.config import FinetuneTraining, StereoTraining, ViewTraining
from depthpose.depth.weights import read_depth_weights, read_matcher, write_depth_weights

__all__ = ["folder", "held_folder", "pairs"]  # fixtures
GENERATOR = GeneratorConfig(width=4, levels=4, virtual_focal_px=130.0, virtual_baseline_m=0.54)
LIGHT = LightConfig(
    max_disparity_px=32, groups=2, width=8, volume_widths=(4, 4, 4, 4), encoder_width=0.25
)
MATCHER = PSMNetConfig(width=4, max_disparity_px=32, blocks=(1, 1, 1, 1), pools=(4, 2))
MATCHER_SETTINGS = config_to_dict(MATCHER)


def batch(pairs: PairsConfig, count: int = 2) -> TrainingPair:
    samples = TrainingPairs(pairs, 0, needs_truth=True)
    parts = zip(*(samples[index] for index in range(count)), strict=True)
    return TrainingPair(*(torch.stack(part) for part in parts))


def take_step(task: ViewTask | StereoTask | FinetuneTask, given: TrainingPair) -> list[str]:
    names = []
    for turn in task.step(given):
        names.append(turn.optimizer)
        optimizer, _ = task.optimizers[turn.optimizer]
        turn.loss.backward()
        optimizer.step()
        for module in task.modules.values():
            module.zero_grad()
    return names


def test_a_view_step_updates_first_the_discriminator_then_the_generator(pairs: PairsConfig) -> None:
    config = ViewTraining(generator=GENERATOR, discriminator_width=4)
    task = ViewTask(UNetGenerator(GENERATOR), config, None)
    before = {name: snapshot(module) for name, module in task.modules.items()}
    names = []
    for turn in task.step(batch(pairs)):
        names.append(turn.optimizer)
        moved = [n for n, m in task.modules.items()
                 if not torch.equal(_weight(before[n]), _weight(snapshot(m)))]  # fmt: skip
        assert moved == ([] if turn.optimizer == "discriminator" else ["discriminator"])
        turn.loss.backward()
        task.optimizers[turn.optimizer][0].step()
    assert names == ["discriminator", "generator"]
    assert not torch.equal(_weight(before["generator"]), _weight(snapshot(task.generator)))


def _weight(state: dict[str, Tensor]) -> Tensor:
    return next(tensor for name, tensor in state.items() if name.endswith("weight"))


def test_l1_alone_has_no_discriminator(pairs: PairsConfig) -> None:
    config = ViewTraining(generator=GENERATOR, discriminator="none")
    task = ViewTask(UNetGenerator(GENERATOR), config, None)
    assert take_step(task, batch(pairs)) == ["generator"]
    assert list(task.modules) == ["generator"]


def any_matcher(kind: str) -> PSMNet | LightStereo:
    torch.manual_seed(0)
    return PSMNet(MATCHER) if kind == "psmnet" else LightStereo(LIGHT)


@pytest.mark.parametrize("kind", ["psmnet", "light"])
def test_fine_tuning_moves_the_generator_alone(pairs: PairsConfig, kind: str) -> None:
    """Neither the matcher's weights move nor its batch norm statistics."""
    matcher = any_matcher(kind)
    generator = UNetGenerator(GENERATOR)
    task = FinetuneTask(generator, matcher, FinetuneTraining(), None)
    before, matcher_before = snapshot(generator), snapshot(matcher)
    for _ in range(3):
        assert take_step(task, batch(pairs)) == ["generator"]
    after = snapshot(matcher)
    assert all(torch.equal(tensor, after[name]) for name, tensor in matcher_before.items())
    moved = {name for name, p in generator.named_parameters() if not torch.equal(p, before[name])}
    assert moved == {name for name, _ in generator.named_parameters()}


@pytest.mark.parametrize("kind", ["psmnet", "light"])
def test_gradients_reach_the_whole_generator_through_the_matcher(
    pairs: PairsConfig, kind: str
) -> None:
    matcher = any_matcher(kind)
    generator = UNetGenerator(GENERATOR)
    (turn,) = FinetuneTask(generator, matcher, FinetuneTraining(), None).step(batch(pairs))
    turn.loss.backward()
    assert all(p.grad is not None and float(p.grad.abs().sum()) > 0 for p in generator.parameters())
    assert all(p.grad is None for p in matcher.parameters())


def test_the_three_stages_run_and_their_weights_estimate(
    folder: Path, held_folder: str, tmp_path: Path
) -> None:
    pairs = PairsConfig(
        folders=(str(folder),),
        focal_px=130.0,
        with_cache=True,
        augment=AugmentConfig(crop_px=(48, 96)),
    )
    held_out = dataclasses.replace(pairs, folders=(held_folder,), limit=1)
    view = ViewTraining(
        generator=GENERATOR, discriminator_width=4, pairs=pairs, held_out=held_out, loop=LOOP
    )
    generator = train_view(view, TrainingRun(folder=tmp_path / "view"))
    stereo = StereoTraining(network=MATCHER_SETTINGS, pairs=pairs, held_out=held_out, loop=LOOP)
    matcher = train_stereo(stereo, TrainingRun(folder=tmp_path / "stereo"))
    tune = FinetuneTraining(
        generator=str(generator), matcher=str(matcher), pairs=pairs, held_out=held_out, loop=LOOP
    )
    both = train_finetune(tune, TrainingRun(folder=tmp_path / "tune"))
    found = read_depth_weights(both)
    assert found.generator is not None
    assert found.matcher is not None
    trained = read_depth_weights(matcher).matcher
    assert trained is not None
    for name, tensor in trained.state_dict().items():
        assert torch.equal(tensor, found.matcher.state_dict()[name])
    for stage, number in (("view", "l1"), ("stereo", "epe_px"), ("tune", "epe_px")):
        last = read_metrics(tmp_path / stage)[-1]
        assert last["step"] == 3
        assert last[f"held_out/{number}"] > 0
        assert list((tmp_path / stage / "pictures").glob("*.png"))
    for path, word in ((generator, "view"), (matcher, "stereo"), (both, "finetune")):
        card = path.with_suffix(".md").read_text()
        assert f"- **Trained on**: {folder.name}\n" in card
        assert f"`depthpose depth train {word} --config config.yaml --out " in card
        assert "- **Time**: 3 steps in " in card
        assert ("| l1 | " if word == "view" else "| epe_px | ") in card
    assert "FinetuneTraining" in (tmp_path / "tune" / "run.json").read_text()


def test_the_generator_learns_the_held_out_view(folder: Path, tmp_path: Path) -> None:
    pairs = PairsConfig(
        folders=(str(folder),),
        focal_px=130.0,
        with_cache=True,
        augment=AugmentConfig(crop_px=(64, 128), jitter=0.0),
    )
    config = ViewTraining(
        generator=dataclasses.replace(GENERATOR, width=8),
        discriminator="none",
        generator_adam=AdamConfig(learning_rate=2e-3, beta1=0.5),
        pairs=pairs,
        loop=dataclasses.replace(LOOP, steps=60, log_every_steps=5),
    )
    train_view(config, TrainingRun(folder=tmp_path))
    l1 = [row["generator/l1"] for row in read_metrics(tmp_path)]
    assert l1[-1] < 0.4 * l1[0]


def test_pairs_are_brought_to_the_focal_length(pairs: PairsConfig) -> None:
    samples = TrainingPairs(dataclasses.replace(pairs, focal_px=100.0), 0, needs_truth=True)
    pair = samples.read(0)
    street = make_street(0.2)
    assert isinstance(street.input.camera, StereoRig)
    share = 100.0 / float(street.input.camera.K[0, 0])
    assert pair.left.shape[-1] == round(street.input.camera.width * share)
    error = (warp_right_to_left(pair.right, pair.left_px) - pair.left).abs()
    assert float(error.nanmedian()) < 0.05


def test_a_cached_pair_is_the_pair(pairs: PairsConfig) -> None:
    plain = TrainingPairs(pairs, 0, needs_truth=True)
    cached = TrainingPairs(dataclasses.replace(pairs, with_cache=True), 0, needs_truth=True)
    for _ in range(2):
        for one, other in zip(plain.read(1), cached.read(1), strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=0.51 / 255, equal_nan=True)


def test_a_limit_spreads_over_the_folder(folder: Path, pairs: PairsConfig) -> None:
    limited = TrainingPairs(dataclasses.replace(pairs, limit=2), 0, needs_truth=True)
    assert len(limited) == 2
    whole = TrainingPairs(pairs, 0, needs_truth=True)
    torch.testing.assert_close(limited.read(1).left, whole.read(2).left)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"folders": ()}, "nothing to train on: name a folder"),
        ({"exclude": ("99",)}, r"exclude names \['99'\], which no folder holds"),
        ({"exclude": ("00", "01", "02")}, "no frame has a right view and a truth"),
        ({"limit": 0}, r"limit must be in \[1, inf\)"),
        ({"focal_px": -1.0}, "focal_px must be in"),
        ({"focal_px": 1e9}, r"focal_px must be in \(0, 20000\], got 1000000000.0"),
    ],
)
def test_pairs_that_cannot_train_are_refused(
    pairs: PairsConfig, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        TrainingPairs(
            dataclasses.replace(pairs, **changes),
            0,
            needs_truth=True,
        )


def test_another_rig_than_the_generators_is_refused(pairs: PairsConfig) -> None:
    synthetic = PairsConfig(streets=StreetsConfig(frames=3))
    for config in (pairs, synthetic):
        with pytest.raises(InputError, match=r"imitates one rig of 0\.3 m"):
            TrainingPairs(config, 0, needs_truth=False, baseline_m=0.3)


def test_another_focal_length_than_the_generators_is_refused(
    pairs: PairsConfig, tmp_path: Path
) -> None:
    run = TrainingRun(folder=tmp_path)
    config = ViewTraining(generator=GENERATOR, pairs=pairs, loop=LOOP)
    other = dataclasses.replace(config, pairs=dataclasses.replace(pairs, focal_px=99.0))
    with pytest.raises(InputError, match=r"pairs\.focal_px is 99\.0, but the generator imitates"):
        train_view(other, run)
    zoom = dataclasses.replace(pairs.augment, scale=(0.9, 1.2))
    zoomed = dataclasses.replace(config, pairs=dataclasses.replace(pairs, augment=zoom))
    with pytest.raises(InputError, match="another size is another focal length"):
        train_view(zoomed, run)


def test_a_start_of_another_network_names_the_setting(pairs: PairsConfig, tmp_path: Path) -> None:
    config = ViewTraining(generator=GENERATOR, discriminator="none", pairs=pairs, loop=LOOP)
    first = train_view(config, TrainingRun(folder=tmp_path / "first"))
    wider = dataclasses.replace(GENERATOR, width=6)
    other = dataclasses.replace(config, generator=wider, start=str(first))
    with pytest.raises(InputError, match="was trained with width = 4, but the config says 6"):
        train_view(other, TrainingRun(folder=tmp_path / "second"))


def test_a_matcher_may_start_from_one_of_another_range(pairs: PairsConfig, tmp_path: Path) -> None:
    config = StereoTraining(network=MATCHER_SETTINGS, pairs=pairs, loop=LOOP)
    first = train_stereo(config, TrainingRun(folder=tmp_path / "first"))
    farther = MATCHER_SETTINGS | {"max_disparity_px": 48}
    other = dataclasses.replace(config, network=farther, start=str(first))
    second = read_matcher(train_stereo(other, TrainingRun(folder=tmp_path / "second")))
    assert config_to_dict(second.config) == farther


def test_fine_tuning_asks_for_both_weights(pairs: PairsConfig, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="needs weights of a generator to begin with"):
        train_finetune(FinetuneTraining(pairs=pairs), TrainingRun(folder=tmp_path))


def test_other_settings_do_not_share_a_run(
    folder: Path, pairs: PairsConfig, tmp_path: Path
) -> None:
    config = ViewTraining(generator=GENERATOR, discriminator="none", pairs=pairs, loop=LOOP)
    train_view(config, TrainingRun(folder=tmp_path))
    other = dataclasses.replace(config, l1_weight=10.0)
    with pytest.raises(InputError, match=r"l1_weight = 100\.0, but now it is 10\.0"):
        train_view(other, TrainingRun(folder=tmp_path, resume=True))


def test_a_run_does_not_go_on_with_other_frames(pairs: PairsConfig, tmp_path: Path) -> None:
    home = tmp_path / "pairs"
    shutil.copytree(pairs.folders[0], home)
    config = ViewTraining(
        generator=GENERATOR,
        discriminator="none",
        pairs=dataclasses.replace(pairs, folders=(str(home),)),
        loop=LOOP,
    )
    train_view(config, TrainingRun(folder=tmp_path / "run"))
    train_view(config, TrainingRun(folder=tmp_path / "run", resume=True))
    (home / "left/02.png").unlink()
    with pytest.raises(InputError, match="frames_sha256"):
        train_view(config, TrainingRun(folder=tmp_path / "run", resume=True))


def test_what_is_trained_on_is_not_held_out(pairs: PairsConfig, tmp_path: Path) -> None:
    config = ViewTraining(
        generator=GENERATOR,
        discriminator="none",
        pairs=dataclasses.replace(pairs, exclude=("00",)),
        held_out=dataclasses.replace(pairs, limit=3),
        loop=LOOP,
    )
    with pytest.raises(InputError, match="2 of the pairs held out are trained on too, 01 first"):
        train_view(config, TrainingRun(folder=tmp_path))


def test_a_warm_start_begins_with_the_given_weights(pairs: PairsConfig, tmp_path: Path) -> None:
    config = ViewTraining(generator=GENERATOR, discriminator="none", pairs=pairs, loop=LOOP)
    first = train_view(config, TrainingRun(folder=tmp_path / "first"))
    frozen = AdamConfig(learning_rate=1e-30)
    again = dataclasses.replace(config, start=str(first), generator_adam=frozen)
    second = train_view(again, TrainingRun(folder=tmp_path / "second"))
    one, other = (read_depth_weights(p).generator for p in (first, second))
    assert one is not None
    assert other is not None
    for name, parameter in one.named_parameters():
        torch.testing.assert_close(parameter, dict(other.named_parameters())[name])


def terms_and_card(weights: Path) -> tuple[str | None, str]:
    return read_depth_weights(weights).facts.get("terms"), weights.with_suffix(".md").read_text()


def test_terms_of_what_a_training_begins_with_bind_what_comes_of_it(
    pairs: PairsConfig, tmp_path: Path
) -> None:
    generator, matcher = tmp_path / "g.safetensors", tmp_path / "s.safetensors"
    write_depth_weights(generator, generator=UNetGenerator(GENERATOR), facts={"terms": "Cite us."})
    write_depth_weights(matcher, matcher=PSMNet(MATCHER), facts={"terms": "For research alone."})
    loop = dataclasses.replace(LOOP, steps=1)
    view = ViewTraining(
        generator=GENERATOR, discriminator="none", pairs=pairs, loop=loop, start=str(generator)
    )
    with pytest.warns(LicenceNotice, match="Cite us"):
        drawn = train_view(view, TrainingRun(folder=tmp_path / "view"))
    stereo = StereoTraining(network=MATCHER_SETTINGS, pairs=pairs, loop=loop, start=str(matcher))
    with pytest.warns(LicenceNotice, match="For research alone"):
        matched = train_stereo(stereo, TrainingRun(folder=tmp_path / "stereo"))
    tune = FinetuneTraining(generator=str(drawn), matcher=str(matched), pairs=pairs, loop=loop)
    with pytest.warns(LicenceNotice, match="Cite us. For research alone"):
        both = train_finetune(tune, TrainingRun(folder=tmp_path / "tune"))
    for path, terms in (
        (drawn, "Cite us."),
        (matched, "For research alone."),
        (both, "Cite us. For research alone."),
    ):
        found, card = terms_and_card(path)
        assert found == terms
        assert f"- **Terms**: {terms}\n" in card
    assert read_depth_weights(both).facts["began_with"] == "generator, matcher"
    free = train_view(dataclasses.replace(view, start=None), TrainingRun(folder=tmp_path / "free"))
    found, card = terms_and_card(free)
    assert found is None
    assert "Terms" not in card


def test_streets_are_rendered_while_training() -> None:
    synthetic = StreetsConfig(frames=2, scale=0.2, jpeg_share=0.0)
    config = PairsConfig(
        streets=synthetic, focal_px=130.0, augment=AugmentConfig(crop_px=(48, 96), jitter=0.0)
    )
    samples = TrainingPairs(config, 0, needs_truth=True, baseline_m=0.5327)
    assert len(samples) == 2
    for index in range(4):
        pair = samples[index]
        error = (warp_right_to_left(pair.right, pair.left_px) - pair.left).abs()
        assert float(error.nanmedian()) < 0.06


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU computes these gradients itself")
def test_gradients_that_a_cpu_gets_wrong_are_refused(pairs: PairsConfig, tmp_path: Path) -> None:
    config = StereoTraining(
        network={"max_disparity_px": 32},
        pairs=pairs,
        loop=LoopConfig(steps=1, precision="bf16"),
    )
    with pytest.raises(InputError, match=r"max_disparity_px 48, or precision fp32"):
        train_stereo(config, TrainingRun(folder=tmp_path))
