"""The light matcher: its parts against oracles, inference against the plain network, learning."""

import dataclasses
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tests.depth.random_norms import with_random_norms

from depthpose.core.camera import Camera
from depthpose.core.checkpoint import Checkpoint, save_checkpoint
from depthpose.core.config import config_to_dict, read_config, write_config
from depthpose.core.errors import InputError
from depthpose.core.loop import LoopConfig, TrainingRun
from depthpose.depth.augment import TrainingPair
from depthpose.depth.config import (
    LightConfig,
    MatcherConfig,
    PairsConfig,
    PSMNetConfig,
    StreetsConfig,
)
from depthpose.depth.encoder import LiteEncoder, load_encoder
from depthpose.depth.stereo import (
    LightMatcher,
    LightStereo,
    PSMNet,
    match_in_usual_range,
    normalise,
)
from depthpose.depth.stereo.light import confidence_near, light_bytes
from depthpose.depth.stereo.light_layers import (
    HALF_CHANNELS,
    ConvexUpsampling,
    Refinement,
    correlation_volume,
    unit_groups,
)
from depthpose.depth.stereo.network_matcher import pad_top_right
from depthpose.depth.train import StereoTask
from depthpose.depth.train.config import StereoTraining
from depthpose.depth.train.runs import make_matcher_network, train_stereo
from depthpose.depth.weights import make_matcher, read_matcher, write_depth_weights

SMALL = LightConfig(
    max_disparity_px=32,
    groups=2,
    width=8,
    volume_widths=(4, 4, 4, 4),
    encoder_width=0.25,
    with_sky=True,
)


def random_network(config: LightConfig = SMALL) -> LightStereo:
    """A network in eval mode whose batch norms do something."""
    torch.manual_seed(0)
    network = with_random_norms(LightStereo(config))
    if network.enlargement.agreement is not None:
        torch.nn.init.normal_(network.enlargement.agreement.weight)
    if network.refinement is not None:
        torch.nn.init.normal_(network.refinement.correction.weight)
    return network


def shifted_pair(height: int, width: int, shift: int) -> tuple[torch.Tensor, torch.Tensor]:
    wide = torch.rand(3, height, width + shift, generator=torch.Generator().manual_seed(3))
    return wide[..., :width].contiguous(), wide[..., shift:].contiguous()


@pytest.mark.parametrize("width", [3, 8, 20])
def test_the_volume_holds_the_cosine_of_each_group(width: int) -> None:
    seeded = torch.Generator().manual_seed(0)
    left, right = torch.randn(2, 2, 6, 4, width, generator=seeded).unbind()
    found = correlation_volume(unit_groups(left, 3), unit_groups(right, 3), 8)
    assert found.shape == (2, 3, 8, 4, width)
    for d in range(8):
        for x in range(width):
            group = [view.unflatten(1, (3, 2)) for view in (left, right)]
            expected = torch.zeros(2, 3, 4)
            if x >= d:
                expected = torch.cosine_similarity(group[0][..., x], group[1][..., x - d], dim=2)
            torch.testing.assert_close(found[:, :, d, :, x], expected, atol=2e-3, rtol=0)


def test_disparity_is_the_mean_over_the_two_best() -> None:
    network = random_network(replace(SMALL, with_sky=False))
    scores = torch.full((1, 8, 8, 16), -50.0)
    scores[:, 2], scores[:, 3], scores[:, 7] = 1.0, 1.0, 0.5
    network.aggregation.forward = lambda *_: scores  # pyright: ignore[reportAttributeAccessIssue]
    for parameter in network.refinement.correction.parameters():
        torch.nn.init.zeros_(parameter)
    pair = torch.randn(2, 1, 3, 32, 64).unbind()
    torch.testing.assert_close(network(*pair)[0], torch.full((1, 32, 64), 10.0))
    every = (torch.tensor([2, 3, 7.0]) * torch.tensor([1.0, 1, 0.5]).softmax(0)).sum() * 4
    torch.testing.assert_close(network.train()(*pair)[0], every.expand(1, 32, 64))


def test_confidence_is_the_probability_near_the_answer() -> None:
    certain = torch.full((1, 8, 1, 1), -200.0)
    certain[0, 3] = 0.0
    at_px = torch.full((1, 1, 1), 12.0)
    assert float(confidence_near(certain, at_px)) == pytest.approx(1.0)
    assert float(confidence_near(certain, at_px + 9)) == pytest.approx(0.0, abs=1e-6)
    # 29 whole disparities from 0 to 28; three of them, and 0.3 of two more, within 15 % of 12 px.
    flat = torch.zeros(1, 8, 1, 1)
    assert float(confidence_near(flat, at_px)) == pytest.approx(3.6 / 29)


def test_a_map_is_enlarged_by_its_nine_neighbours() -> None:
    quarter, upsampling = torch.arange(12.0).view(1, 1, 3, 4), ConvexUpsampling(8)
    half, features = torch.randn(1, HALF_CHANNELS, 6, 8), torch.randn(1, 8, 3, 4)
    torch.nn.init.zeros_(upsampling.weights.weight)
    bias = upsampling.weights.bias
    assert bias is not None
    with torch.no_grad():
        logits = torch.full((9, 4), -100.0)
        logits[4] = 100.0  # the pixel itself
        bias.copy_(logits.flatten())
        nearest = quarter.repeat_interleave(4, 2).repeat_interleave(4, 3)
        assert torch.equal(upsampling(quarter, half, features, half), nearest)
        logits[5, 3] = 300.0  # of the lower right pixel in each 2x2: the neighbour to the right
        bias.copy_(logits.flatten())
        found = upsampling(quarter, half, features, half)[:, 0]
    assert found[0, 1, 1] == quarter[0, 0, 0, 1]
    assert found[0, 0, 0] == 0


def test_views_agree_under_the_disparity_that_is_right() -> None:
    chance = torch.Generator().manual_seed(0)
    left, right = torch.randn(2, 1, HALF_CHANNELS, 8, 16, generator=chance).unbind()
    right[..., :-3] = left[..., 3:]
    quarter_px = torch.full((1, 1, 4, 8), 2.0)
    quarter_px[..., 5:] = 6.0  # three pixels at half size
    upsampling = ConvexUpsampling(8)
    upsampling.compared = torch.nn.Identity()  # pyright: ignore[reportAttributeAccessIssue]
    seen: list[torch.Tensor] = []
    upsampling.agreement.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    upsampling(quarter_px, left, torch.randn(1, 8, 4, 8), right)
    found = seen[0]
    assert found.shape == (1, 9, 8, 16)
    # Column 10 at half size lies in column 5 at a quarter: itself and its right neighbour fit.
    torch.testing.assert_close(found[0, [1, 2, 4, 5, 7, 8], :, 10], torch.ones(6, 8))
    assert float(found[0, [0, 3, 6], :, 10].max()) < 0.99
    for k, shift in ((3, 1), (4, 3)):
        expected = torch.cosine_similarity(left[..., 10], right[..., 10 - shift], dim=1)
        torch.testing.assert_close(found[:, k, :, 10], expected)
    assert float(found[..., 0].abs().max()) < 1e-6  # beyond the right image


def test_weights_without_the_sky_are_trained_on_with_it(tmp_path: Path) -> None:
    plain = dataclasses.replace(SMALL, with_sky=False)
    start = tmp_path / "plain.safetensors"
    network = random_network(plain)
    facts = {"licence": "MIT", "trained_on": "nothing"}
    write_depth_weights(start, matcher=network, facts=facts)
    config = StereoTraining(
        kind="light", network=config_to_dict(SMALL), start=str(start), sky_weight=0.5
    )
    found = make_matcher_network(config)
    assert isinstance(found, LightStereo)
    pair = torch.randn(2, 1, 3, 32, 64).unbind()
    with torch.no_grad():
        assert torch.equal(found.eval()(*pair)[-1], network(*pair)[-1])
    write_depth_weights(start, matcher=found, facts=facts)
    with pytest.raises(InputError, match="with_sky = True, but the config says False"):
        make_matcher_network(dataclasses.replace(config, network=config_to_dict(plain)))


def test_the_refinement_compares_the_views_around_a_disparity() -> None:
    left = torch.randn(1, HALF_CHANNELS, 4, 16, generator=torch.Generator().manual_seed(0))
    right = left.roll(-3, -1)  # right[x - 3] is left[x]
    refinement = Refinement()
    refinement.compared = torch.nn.Identity()  # pyright: ignore[reportAttributeAccessIssue]
    seen: list[torch.Tensor] = []
    refinement.layers[0].register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    refinement(torch.full((1, 8, 32), 6.0), left, right)
    found = seen[0][:, :20].unflatten(1, (5, 4))
    inside = slice(5, -2)
    for k, offset in enumerate((-2, -1, 0, 1, 2)):
        groups = [view.unflatten(1, (4, 4)) for view in (left, right.roll(3 + offset, -1))]
        expected = torch.cosine_similarity(*groups, dim=2)
        torch.testing.assert_close(
            found[:, k, ..., inside], expected[..., inside], atol=1e-4, rtol=0
        )
    torch.testing.assert_close(found[:, 2, ..., inside], torch.ones(1, 4, 4, 9), atol=1e-4, rtol=0)


def test_what_the_refinement_corrects_learns_by_a_loss_of_its_own() -> None:
    torch.manual_seed(0)
    refinement = Refinement().train()
    torch.nn.init.normal_(refinement.correction.weight)
    half = torch.randn(2, 16, 16, 32)
    found_px = torch.rand(2, 32, 64, requires_grad=True)
    refinement(found_px, half, half.flip(-1)).square().sum().backward()
    assert found_px.grad is None
    gradient = refinement.get_parameter("compared.conv.weight").grad
    assert gradient is not None
    assert bool(gradient.any())
    with torch.no_grad():
        corrected = refinement.eval()(torch.zeros(2, 32, 64), half, half.flip(-1))
    assert float(corrected.min()) == pytest.approx(0.01), "depth is finite and positive"
    assert float(corrected.max()) > 0.01


@pytest.mark.parametrize("size", [(32, 64), (70, 101)])
def test_inference_equals_the_plain_network(size: tuple[int, int]) -> None:
    network = random_network()
    left, right = shifted_pair(*size, 5)
    found = match_in_usual_range(LightMatcher(network), left, right)
    pair = [pad_top_right(normalise(view), network.config)[None] for view in (left, right)]
    with torch.no_grad():
        expected = network(*pair)[-1][0, -size[0] :, : size[1]]
    assert expected.std() > 0.1
    # Where two scores tie, a last bit decides between candidates.
    assert float(((found.disparity_px - expected).abs() > 1e-2).float().mean()) < 0.01
    assert found.confidence is not None
    assert found.confidence.shape == size
    assert 0 <= found.confidence.min() <= found.confidence.max() <= 1


def test_training_further_does_not_change_a_matcher() -> None:
    network = random_network()
    left, right = shifted_pair(32, 64, 5)
    matcher = LightMatcher(network)
    before = matcher.match(left, right).disparity_px
    for parameter in network.parameters():
        parameter.data.zero_()
    assert torch.equal(matcher.match(left, right).disparity_px, before)


def test_it_is_a_matcher_of_cameras() -> None:
    network = random_network(dataclasses.replace(SMALL, work_focal_px=80.0))
    left, right = shifted_pair(64, 128, 5)
    K = torch.tensor([[160.0, 0, 64], [0, 160, 32], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(width=128, height=64, K=K)
    quick = make_matcher(network, MatcherConfig(speed="quick"))
    fine = make_matcher(network, MatcherConfig())
    assert isinstance(quick, LightMatcher)
    assert isinstance(fine, LightMatcher)
    assert quick.work_size(camera) == (32, 64)
    assert fine.work_size(camera) == (96, 192), "small images are enlarged 1.5 times"
    K = torch.tensor([[721.5, 0, 610], [0, 721.5, 173], [0, 0, 1]], dtype=torch.float64)
    height, width = fine.work_size(Camera(width=1242, height=375, K=K))
    assert 0.99 < height * width / 650_000 < 1.01, "KITTI's as far as the pixels go"
    for matcher in (quick, fine):
        one = matcher.match(left, right, camera)
        other = matcher.match(right, left, camera)
        assert one.disparity_px.shape == (64, 128)
        assert not torch.equal(one.disparity_px, other.disparity_px)


def test_some_rows_at_a_time_give_the_same_numbers() -> None:
    network = random_network()
    left, right = torch.randn(2, 2, 3, 96, 64, generator=torch.Generator().manual_seed(0))
    scores: list[torch.Tensor] = []
    network.aggregation.register_forward_hook(lambda *given: scores.append(given[-1]))
    with torch.no_grad():
        found = network(left, right)[-1]
        for rows in (2, 6, 16, 24, 100):
            network.rows = rows
            network(left, right)
            torch.testing.assert_close(scores[-1], scores[0], atol=1e-4, rtol=1e-4)
            difference = (network(left, right)[-1] - found).abs()  # equal scores may change places
            assert float((difference > 1e-2).float().mean()) < 0.01


def test_a_bound_on_memory_is_met_or_refused() -> None:
    left, right = shifted_pair(64, 96, 5)
    network = random_network()
    least = light_bytes(SMALL, SMALL.max_disparity_px, 64, 96, torch.float32)
    bound = LightMatcher(network, MatcherConfig(max_memory_bytes=least))
    match_in_usual_range(bound, left, right)
    tight = LightMatcher(network, MatcherConfig(max_memory_bytes=least - 1))
    with pytest.raises(InputError, match=f"too small for images of 64x96.*takes {least}"):
        match_in_usual_range(tight, left, right)


def test_weights_come_back(tmp_path: Path) -> None:
    network, path = random_network(), tmp_path / "light.safetensors"
    write_depth_weights(path, matcher=network, facts={"licence": "MIT", "trained_on": "nothing"})
    found = read_matcher(path)
    assert isinstance(found, LightStereo)
    assert found.config == network.config
    pair = torch.randn(2, 1, 3, 32, 64).unbind()
    with torch.no_grad():
        assert torch.equal(found(*pair)[-1], network(*pair)[-1])


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"max_disparity_px": 48}, "multiple of 32"),
        ({"width": 10, "groups": 4}, "multiple of groups"),
        ({"volume_widths": (8, 0, 8, 8)}, "volume_widths must be in"),
        ({"encoder_width": 0.0}, "encoder_width"),
        ({"work_focal_px": -1.0}, "work_focal_px must be in"),
    ],
)
def test_sizes_that_no_network_has_are_refused(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        LightStereo(LightConfig(**settings))


def test_images_of_another_size_are_refused() -> None:
    with pytest.raises(InputError, match="multiples of 32, got 32x48"):
        random_network()(*torch.zeros(2, 1, 3, 32, 48).unbind())


def training_batch() -> TrainingPair:
    """Two pairs whose whole scene lies at one disparity each."""
    pairs = [shifted_pair(64, 96, shift) for shift in (6, 14)]
    left, right = (torch.stack(list(views)) for views in zip(*pairs, strict=True))
    left_px = torch.tensor([6.0, 14.0])[:, None, None].expand(2, 64, 96).clone()
    return TrainingPair(left, right, left_px, left_px, torch.full((2,), torch.nan))


def stereo_task(**settings: Any) -> StereoTask:  # noqa: ANN401
    torch.manual_seed(0)
    return StereoTask(
        LightStereo(SMALL),
        StereoTraining(kind="light", network=config_to_dict(SMALL), sky_weight=0.5, **settings),
        None,
    )


def test_it_learns_and_every_part_gets_gradients() -> None:
    task = stereo_task(with_frozen_stem=False, encoder_rate=1.0)
    network, batch = task.matcher, training_batch()
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    losses = []
    for _ in range(25):
        (turn,) = task.step(batch)
        optimizer.zero_grad()
        turn.loss.backward()
        optimizer.step()
        losses.append(float(turn.loss.detach()))
    without = [
        name
        for name, parameter in network.named_parameters()
        if parameter.grad is None or not bool(parameter.grad.isfinite().all())
    ]
    assert not without
    for part in (
        "features.encoder.stem.conv",
        "enlargement.weights",
        "enlargement.agreement",
        "refinement.correction",
        "describe",
    ):
        gradient = network.get_parameter(f"{part}.weight").grad
        assert gradient is not None
        assert bool(gradient.any()), part
    assert sum(losses[-3:]) / 3 < 0.6 * losses[0]


def test_frozen_norms_keep_their_statistics_while_the_rest_learns() -> None:
    task = stereo_task(with_frozen_stem=False, encoder_rate=1.0, with_frozen_norms=True)
    network = task.matcher
    before = {name: values.clone() for name, values in network.state_dict().items()}
    (turn,) = task.step(training_batch())
    turn.loss.backward()
    after = network.state_dict()
    statistics = [name for name in before if "running" in name]
    assert any("aggregation" in name for name in statistics)
    assert all(torch.equal(before[name], after[name]) for name in statistics)
    gradient = network.get_parameter("aggregation.score.weight").grad
    assert gradient is not None
    assert bool(gradient.any())


def test_a_fixed_start_keeps_what_imagenet_taught() -> None:
    task = stereo_task()
    encoder = task.matcher.encoder
    assert isinstance(encoder, LiteEncoder)
    before = {name: tensor.clone() for name, tensor in encoder.state_dict().items()}
    (turn,) = task.step(training_batch())
    turn.loss.backward()
    task.optimizers["matcher"][0].step()
    after = encoder.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before if "running" in name)
    assert torch.equal(before["stem.conv.weight"], after["stem.conv.weight"])
    assert not torch.equal(
        before["blocks.9.project.conv.weight"], after["blocks.9.project.conv.weight"]
    )


def test_an_encoder_takes_a_file_as_far_as_it_reaches(tmp_path: Path) -> None:
    torch.manual_seed(0)
    whole, path = LiteEncoder(), tmp_path / "lite0.safetensors"
    save_checkpoint(
        path, Checkpoint(kind="efficientnet-lite0", config={}, state=whole.state_dict(), facts={})
    )
    short = LiteEncoder(levels=4)
    load_encoder(short, path)
    image = torch.rand(1, 3, 32, 64)
    with torch.no_grad():
        expected, found = whole.eval()(image)[:4], short.eval()(image)
    assert len(found) == 4
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))
    with pytest.raises(InputError, match="this encoder is narrower"):
        load_encoder(LiteEncoder(0.5, levels=4), path)


def test_beginnings_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    pairs = PairsConfig(streets=StreetsConfig(frames=2, scale=0.1))
    run, loop = TrainingRun(folder=tmp_path / "run"), LoopConfig(steps=1)
    with pytest.raises(InputError, match="give --encoder"):
        train_stereo(
            StereoTraining(
                kind="light", network=config_to_dict(SMALL), sky_weight=0.5, pairs=pairs, loop=loop
            ),
            run,
        )
    with pytest.raises(InputError, match="give the config the light network"):
        train_stereo(StereoTraining(encoder="x.safetensors", pairs=pairs, loop=loop), run)
    other = tmp_path / "psmnet.safetensors"
    tiny = PSMNetConfig(width=2, max_disparity_px=16, blocks=(1, 1, 1, 1), pools=(2,))
    facts = {"licence": "MIT", "trained_on": "nothing"}
    write_depth_weights(other, matcher=PSMNet(tiny), facts=facts)
    with pytest.raises(InputError, match="weights of PSMNet, but the config trains LightStereo"):
        train_stereo(
            StereoTraining(
                kind="light",
                network=config_to_dict(SMALL),
                sky_weight=0.5,
                start=str(other),
                pairs=pairs,
                loop=loop,
            ),
            run,
        )
    two_deep = dataclasses.replace(SMALL, max_disparity_px=64)
    loop = LoopConfig(steps=1, precision="bf16")
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match="max_disparity_px 96, or precision fp32"):
            train_stereo(
                StereoTraining(
                    kind="light",
                    network=config_to_dict(two_deep),
                    sky_weight=0.5,
                    pairs=pairs,
                    loop=loop,
                ),
                run,
            )


def test_a_run_records_every_setting_of_its_network(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("kind: light\nnetwork: {width: 8}\n")
    light = read_config(path, StereoTraining)
    assert light.network_config == LightConfig(width=8)
    write_config(path, light)
    assert "volume_widths" in path.read_text()
    assert read_config(path, StereoTraining) == light, "as a resumed run reads it"
    path.write_text("kind: lite\n")
    with pytest.raises(InputError, match="light"):
        read_config(path, StereoTraining)
    path.write_text("kind: light\nnetwork: {blocks: [1, 1, 1, 1]}\n")
    with pytest.raises(InputError, match="unknown key 'blocks'"):
        read_config(path, StereoTraining)
    path.write_text("with_frozen_stem: false\n")
    with pytest.raises(InputError, match="encoder of the light network, which PSMNet does not"):
        read_config(path, StereoTraining)
