"""The sky in pairs: a class of the light network, from its loss to the files of an estimate."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.depth.short_encoder import short_encoder
from tests.depth.test_stereo_light import SMALL, random_network, shifted_pair, training_batch
from tests.synthetic_street import make_street

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.config import config_to_dict
from depthpose.core.draw import draw_disparity
from depthpose.core.errors import InputError
from depthpose.depth.augment import TrainingPair
from depthpose.depth.config import LightConfig, MatcherConfig
from depthpose.depth.disparity import resize_match
from depthpose.depth.estimator import FakestereoNet, single_image
from depthpose.depth.export import make_export
from depthpose.depth.labels import LabelConfig, label_pair
from depthpose.depth.losses import sky_loss
from depthpose.depth.predictions import read_estimate, write_estimate
from depthpose.depth.stereo import (
    LightMatcher,
    LightStereo,
    StereoNetwork,
    light,
    match_from_infinity,
    match_in_usual_range,
    normalise,
)
from depthpose.depth.stereo.network_matcher import lower_where_disagreeing
from depthpose.depth.train import StereoTask
from depthpose.depth.train.config import StereoTraining
from depthpose.depth.train.pairs import TrainingPairs
from depthpose.depth.train.stereo_task import validate_pairs
from depthpose.depth.triangulation import estimate_from_pair
from depthpose.depth.types import DepthEstimate, DepthInput, Match
from depthpose.depth.weights import DepthWeights

PLAIN = replace(SMALL, with_sky=False)


def partly_sky(config: LightConfig = SMALL) -> LightStereo:
    """A random network that takes some pixels of random images for sky, and not others."""
    network = random_network(config)
    assert network.sky is not None
    torch.nn.init.normal_(network.sky.logit.weight)
    assert network.sky.logit.bias is not None
    with torch.no_grad():
        pair = torch.randn(2, 1, 3, 64, 96, generator=torch.Generator().manual_seed(1)).unbind()
        _, sky = network.forward_with_sky(*pair)
        assert sky is not None
        network.sky.logit.bias -= sky.logit(1e-6).median()
    return network


class UpperHalf:
    """A matcher that finds 4 px everywhere and the sky in the upper half of a view."""

    def match(self, left: torch.Tensor, right: torch.Tensor, camera: Camera | None = None) -> Match:
        return match_from_infinity(self.match_from_zero, left, right, camera)

    def match_from_zero(self, left: torch.Tensor, right: torch.Tensor) -> Match:  # noqa: ARG002
        is_sky = torch.zeros(left.shape[1:], dtype=torch.bool)
        is_sky[: left.shape[1] // 2] = True
        disparity_px = torch.full(left.shape[1:], 4.0)
        return Match(disparity_px=disparity_px, confidence=torch.ones_like(left[0]), is_sky=is_sky)


def rig(height: int, width: int, apart_px: float = 0.0) -> StereoRig:
    K = torch.tensor([[100.0, 0, width / 2], [0, 100, height / 2], [0, 0, 1]], dtype=torch.float64)
    return StereoRig(
        width=width, height=height, K=K, baseline_m=0.5, cx_right_minus_left_px=apart_px
    )


def estimated(apart_px: float = 0.0) -> DepthEstimate:
    image = torch.rand(3, 20, 30, generator=torch.Generator().manual_seed(0))
    net = FakestereoNet(UpperHalf(), with_check=False)
    return net.estimate(image, rig(20, 30, apart_px), right=image)


def test_the_sky_is_as_sure_as_it_was_where_the_right_view_matches_it_otherwise() -> None:
    """Of a plain sky the two views never agree on a disparity, which says nothing against it."""
    found = UpperHalf().match(torch.zeros(3, 4, 30), torch.zeros(3, 4, 30))
    checked = lower_where_disagreeing(found, torch.full((4, 30), 14.0))
    assert checked.confidence is not None
    assert bool((checked.confidence[:2] == 1).all())
    assert bool((checked.confidence[2:] < 0.6).all())


def test_the_loss_is_the_cross_entropy_where_the_sky_is_known() -> None:
    probability = torch.tensor([[[0.8, 0.3, 0.9, 0.5]]], requires_grad=True)
    truth_px = torch.tensor([[[0.0, 7.0, torch.nan, 0.0]]])
    loss = sky_loss(probability, truth_px)
    expected = -(np.log(0.8001) + np.log(0.7001) + np.log(0.5001)) / 3
    assert float(loss.detach()) == pytest.approx(expected, rel=1e-5)
    (gradient,) = torch.autograd.grad(loss, probability)
    assert float(gradient[0, 0, 2]) == 0
    assert float(sky_loss(torch.zeros(1, 1, 1), truth_px[..., 2:3])) == 0
    certain = torch.zeros(1, 1, 1, requires_grad=True)
    (gradient,) = torch.autograd.grad(sky_loss(certain, truth_px[..., :1]), certain)
    assert bool(gradient.isfinite())


def test_the_sky_is_learnt_as_a_class_and_not_as_a_disparity() -> None:
    torch.manual_seed(0)
    config = StereoTraining(
        kind="light",
        network=config_to_dict(SMALL),
        with_frozen_stem=False,
        encoder_rate=1.0,
        sky_weight=1.0,
    )
    task = StereoTask(LightStereo(SMALL), config, None)
    batch = training_batch()
    for view in (batch.left, batch.right):
        view[:, :, :24] = 1.0
    batch.left_px[:, :24] = 0.0
    optimizer = torch.optim.Adam(task.matcher.parameters(), lr=5e-3)
    for _ in range(18):
        (turn,) = task.step(batch)
        optimizer.zero_grad()
        turn.loss.backward()
        optimizer.step()
    (turn,) = task.step(batch)
    assert set(turn.facts) == {"epe", "sky"}
    assert float(turn.facts["sky"]) < 0.3
    with torch.no_grad():
        views = normalise(batch.left), normalise(batch.right)
        heads, sky = task.matcher.forward_with_sky(*views)
    assert sky is not None
    assert len(heads) == 3
    is_sky = batch.left_px == 0
    assert float(sky[is_sky].mean()) > float(sky[~is_sky].mean()) + 0.3
    assert float(heads[-1][is_sky].mean()) > 1, "its disparity is not taught"


def test_the_match_says_where_the_sky_is() -> None:
    network = partly_sky()
    left, right = shifted_pair(40, 70, 5)
    found = match_in_usual_range(LightMatcher(network), left, right)
    assert found.is_sky is not None
    assert found.is_sky.shape == (40, 70)
    assert 0.05 < float(found.is_sky.float().mean()) < 0.95
    assert found.confidence is not None
    assert float(found.confidence[found.is_sky].min()) > 0.5, "its probability"
    plain = LightMatcher(network, MatcherConfig(with_confidence=False))
    unsure = match_in_usual_range(plain, left, right)
    assert unsure.is_sky is not None
    assert unsure.confidence is None
    assert float((unsure.is_sky != found.is_sky).float().mean()) < 0.001
    checked = MatcherConfig(with_left_right_check=True)
    other = match_in_usual_range(LightMatcher(network, checked), left, right)
    assert other.is_sky is not None
    assert other.is_sky.shape == (40, 70)
    assert bool(other.is_sky.any())


@pytest.mark.parametrize(
    ("confidence", "is_training", "with_sky"),
    [(0.5, False, True), (0.98, False, False), (0.98, True, True)],
)
def test_what_is_surely_matched_is_not_the_sky(
    confidence: float, is_training: bool, with_sky: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = partly_sky().train(is_training)
    left, right = torch.randn(2, 2, 3, 64, 96, generator=torch.Generator().manual_seed(1)).unbind()
    for where, name, value in (
        (light, "confidence_near", confidence),
        (network.sky, "forward", 0.97),
    ):
        monkeypatch.setattr(
            where, name, lambda *given, value=value, **_: torch.full_like(given[1], value)
        )
    with torch.no_grad():
        read = network.match_views(left, right, SMALL.max_disparity_px, with_confidence=True)
    assert read.sky is not None
    assert bool((read.sky > 0.5).all()) == with_sky
    assert bool((read.sky > 0.5).any()) == with_sky


def test_another_size_has_the_same_sky() -> None:
    left = torch.rand(3, 20, 30)
    found = resize_match(UpperHalf().match(left, left), 40, 90)
    assert found.is_sky is not None
    assert torch.equal(found.is_sky, torch.arange(40)[:, None].expand(40, 90) < 20)
    assert torch.equal(found.disparity_px, torch.full((40, 90), 12.0)), "beside the sky too"


@pytest.mark.parametrize("apart_px", [0.0, 6.0])
def test_an_estimate_has_no_depth_in_the_sky(apart_px: float) -> None:
    found = estimated(apart_px)
    assert found.is_sky is not None
    assert found.depth_m is not None
    assert torch.equal(found.depth_m.isnan(), found.is_sky)
    assert torch.equal(found.is_sky, torch.arange(20)[:, None].expand(20, 30) < 10)
    expected_px = torch.where(found.is_sky, 100 * 0.5 / 10_000, 4.0) - apart_px
    torch.testing.assert_close(found.disparity_px, expected_px)
    assert "sky 50%" in repr(found)
    assert len(found.cloud().points) == 300


def test_a_few_pixels_of_sky_are_none() -> None:
    """They keep what was matched; in a garage they were infinitely far."""
    pair = DepthInput(name="a", left=torch.rand(3, 100, 100), right=None, camera=rig(100, 100))
    is_sky = torch.zeros(100, 100, dtype=torch.bool)
    is_sky[0, :15] = True
    match = Match(disparity_px=torch.full((100, 100), 4.0), is_sky=is_sky)
    found = estimate_from_pair(pair, match)
    assert found.depth_m is not None
    assert bool(found.depth_m.isfinite().all())
    assert bool((found.disparity_px == 4).all())
    is_sky[:2] = True
    assert estimate_from_pair(pair, match).is_sky is not None
    assert torch.equal(estimate_from_pair(pair, match).is_sky, is_sky)  # pyright: ignore[reportArgumentType]


def test_without_a_rig_the_disparity_of_the_sky_is_next_to_nothing() -> None:
    image = torch.rand(3, 20, 30)
    found = FakestereoNet(UpperHalf(), with_check=False).estimate(image, right=image)
    assert found.is_sky is not None
    assert float(found.disparity_px[found.is_sky].max()) == pytest.approx(0.01)


def test_held_out_pairs_measure_the_sky() -> None:
    """Of the sky a third is missed, and half of the rest is taken for it."""

    class Seen(StereoNetwork):
        def __init__(self) -> None:
            super().__init__()
            self.weight = torch.nn.Parameter(torch.zeros(1))
            self.config = SMALL

        def forward_with_sky(self, left, right):  # noqa: ANN001, ANN202, ARG002
            sky = torch.zeros(1, 32, 64)
            sky[:, :8] = sky[:, 12:22] = 0.9
            return (torch.full((1, 32, 64), 5.0),), sky

    truth_px = torch.full((32, 64), 5.0)
    truth_px[:12] = 0.0
    view = torch.rand(3, 32, 64)
    pair = TrainingPair(view, view, truth_px, truth_px, torch.tensor(torch.nan))

    class OnePair(TrainingPairs):
        def __init__(self) -> None:
            pass

        def __len__(self) -> int:
            return 1

        def read(self, index: int) -> TrainingPair:  # noqa: ARG002
            return pair

    found = validate_pairs(Seen(), OnePair()).numbers
    assert found == pytest.approx(
        {
            "held_out/epe_px": 2.5,
            "held_out/d1_all": 0.5,
            "held_out/sky_missed": 1 / 3,
            "held_out/sky_false": 0.5,
        }
    )


def test_a_class_that_would_not_be_learnt_is_refused() -> None:
    with pytest.raises(InputError, match="the sky would not be learnt; set sky_weight"):
        StereoTraining(kind="light", network=config_to_dict(SMALL))


def test_a_disparity_is_drawn_grey_in_the_sky() -> None:
    drawn = draw_disparity(torch.zeros(2, 2), is_sky=torch.tensor([[True, False]] * 2))
    nothing = draw_disparity(torch.full((2, 2), torch.nan))
    assert torch.equal(drawn[..., 0], nothing[..., 0])
    assert not torch.equal(drawn[..., 1], nothing[..., 1])


def test_labels_leave_the_sky_out() -> None:
    image = torch.rand(3, 20, 30)
    pair = replace(make_street(0.1).input, left=image, right=image, camera=rig(20, 30))
    known_px = label_pair(FakestereoNet(UpperHalf(), with_check=False), pair, LabelConfig())
    assert bool(known_px[:10].isnan().all())
    assert float(known_px[10:, 4:].min()) == 4.0


def test_a_lamp_that_is_no_sky_has_no_confidence_of_a_sky() -> None:
    """A few pixels that surely look like sky keep a disparity that nobody measured."""
    image = torch.rand(3, 100, 100)
    is_sky = torch.zeros(100, 100, dtype=torch.bool)
    is_sky[50, 40:50] = True
    confidence = torch.where(is_sky, 0.95, 0.1)
    match = Match(disparity_px=torch.full((100, 100), 8.0), confidence=confidence, is_sky=is_sky)
    pair = DepthInput(name="a", left=image, right=image, camera=rig(100, 100))
    found = estimate_from_pair(pair, match)
    assert found.is_sky is not None
    assert found.confidence is not None
    assert not bool(found.is_sky.any())
    assert float(found.confidence[is_sky].max()) < 0.06
    # What the search doubts stays doubted.
    doubted = replace(match, confidence=torch.zeros(100, 100))
    found = estimate_from_pair(pair, doubted)
    assert found.confidence is not None
    assert float(found.confidence.max()) == 0


def test_the_sky_of_a_matched_image_has_the_generator_s_confidence() -> None:
    """A matcher knows no sky: its confidence there is that of a disparity."""
    sky = torch.zeros(4, 6, dtype=torch.bool)
    sky[:2] = True
    by_matcher = Match(disparity_px=torch.ones(4, 6), confidence=torch.full((4, 6), 0.05))
    by_generator = Match(
        disparity_px=torch.ones(4, 6), confidence=torch.full((4, 6), 0.9), is_sky=sky
    )
    joined = single_image._take_sky(by_matcher, by_generator)
    assert joined.is_sky is sky
    assert joined.confidence is not None
    torch.testing.assert_close(joined.confidence, torch.where(sky, 0.9, 0.05))


def test_the_sky_is_written_beside_the_depth(tmp_path: Path) -> None:
    found = estimated()
    write_estimate(tmp_path, found)
    written = read_estimate(tmp_path, found.input).is_sky
    assert written is not None
    assert found.is_sky is not None
    assert torch.equal(written, found.is_sky)


def test_a_network_without_the_class_says_nothing_of_the_sky() -> None:
    network: StereoNetwork = random_network(PLAIN)
    left, right = shifted_pair(32, 64, 5)
    with torch.no_grad():
        heads, sky = network.forward_with_sky(left[None], right[None])
    assert sky is None
    assert len(heads) == 1
    assert LightMatcher(random_network(PLAIN)).match(left, right).is_sky is None


@pytest.mark.slow
def test_the_graph_of_a_pair_gives_disparity_and_sky_at_every_size() -> None:
    """Of a random network, a few pixels lie on the border of a decision or of two candidates."""
    onnxruntime = pytest.importorskip("onnxruntime")
    with short_encoder():
        network = partly_sky(replace(SMALL, work_focal_px=90.0))
    export = make_export(DepthWeights(generator=None, matcher=network, facts={}), "pair", {})
    session = onnxruntime.InferenceSession(export.graph().model({}).SerializeToString())
    names = [output.name for output in session.get_outputs()]
    assert sorted(names) == ["confidence", "disparity_px", "is_sky"]
    shares = []
    for case in export.cases():
        found = dict(zip(names, session.run(None, dict(case.inputs)), strict=True))
        expected = case.expected["is_sky"]
        shares.append(float(expected.mean()))
        assert found["is_sky"].dtype == bool
        assert float((found["is_sky"] != expected).mean()) < 0.02
        assert set(found["disparity_px"][found["is_sky"]]) <= {np.float32(0.01)}
        is_seen = ~(found["is_sky"] | expected)
        error_px = np.abs(found["disparity_px"] - case.expected["disparity_px"])[is_seen]
        assert float((error_px > 0.01).mean()) < 0.02
        assert case.expected["disparity_px"][is_seen].std() > 1
    assert 0.01 < max(shares) < 0.99
