"""A matcher gets used to pairs without truth: what pulls it, what holds it, what is refused."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from tests.synthetic_street import make_street, write_pairs
from torch import Tensor, nn

from depthpose.cli import main
from depthpose.core.errors import InputError
from depthpose.core.loop import AdamConfig, LoopConfig, Run
from depthpose.depth.augment import TrainingPair
from depthpose.depth.config import AugmentConfig, DegradeConfig, MatcherConfig, PairsConfig
from depthpose.depth.config import PSMNetConfig as Config
from depthpose.depth.datasets import open_dataset
from depthpose.depth.labels import LabelConfig, is_consistent
from depthpose.depth.losses import photometric_error, smoothness_loss
from depthpose.depth.stereo import CallableMatcher, PSMNet, PSMNetMatcher, StereoNetwork
from depthpose.depth.train import train_adapt
from depthpose.depth.train.config import AdaptTraining
from depthpose.depth.train.runs import (
    AdaptationCheck,
    AdaptMetrics,
    fine_focal_px,
    label_folders,
    refuse_worse,
    split_pairs,
)
from depthpose.depth.train.stages import AdaptTask
from depthpose.depth.weights import read_matcher, write_depth_weights

TRUE_PX = 6.0
SIZE = (48, 96)
SAME = AdaptMetrics(photometric=0.1, disagreeing=0.2, street_d1=0.05, street_epe_px=1.0)


class OneDisparity(StereoNetwork):
    """A matcher whose one weight is the disparity of everything."""

    def __init__(self, px: float) -> None:
        super().__init__()
        self.px = nn.Parameter(torch.tensor(px))
        self.config = SimpleNamespace(max_disparity_px=32)

    def forward(self, left: Tensor, _: Tensor) -> tuple[Tensor]:
        return (self.px.expand(left.shape[0], *left.shape[2:]),)


def plane() -> TrainingPair:
    """Two views of a smooth plane that lies :data:`TRUE_PX` apart; nothing is known of it."""
    noise = torch.rand(1, 3, 12, 26, generator=torch.Generator().manual_seed(0))
    wide = F.interpolate(noise, (SIZE[0], SIZE[1] + 8), mode="bicubic").clamp(0, 1)
    shift = int(TRUE_PX)
    unknown = torch.full((1, *SIZE), torch.nan)
    return TrainingPair(
        wide[..., : SIZE[1]], wide[..., shift : shift + SIZE[1]], unknown, unknown.clone()
    )


def pull(start_px: float, config: AdaptTraining, labels_px: float = torch.nan) -> float:
    """Where the one disparity ends."""
    matcher = OneDisparity(start_px)
    task = AdaptTask(matcher, config)
    optimizer = torch.optim.Adam(matcher.parameters(), 0.1)
    pair = plane()
    pair = pair._replace(left_px=torch.full_like(pair.left_px, labels_px))
    for _ in range(60):
        (turn,) = task.step(pair)
        optimizer.zero_grad()
        turn.loss.backward()
        optimizer.step()
    return float(matcher.px.detach())


def test_photometric_error_is_zero_of_the_same_and_one_at_most() -> None:
    image = torch.rand(1, 3, 20, 30)
    assert float(photometric_error(image, image).max()) < 1e-5
    other = photometric_error(image, 1 - image)
    assert 0.3 < float(other.mean()) <= 1.0
    shifted = [
        float(photometric_error(plane().left, plane().left.roll(k, -1)).mean()) for k in (1, 3)
    ]
    assert shifted[0] < shifted[1]


def test_smoothness_counts_less_where_the_image_changes() -> None:
    disparity_px = torch.zeros(1, 8, 8)
    disparity_px[..., 4:] = 2.0
    flat, edged = torch.zeros(1, 3, 8, 8), torch.zeros(1, 3, 8, 8)
    edged[..., 4:] = 1.0
    assert float(smoothness_loss(disparity_px, flat)) == pytest.approx(2 / 7, rel=1e-4)
    assert float(smoothness_loss(disparity_px, edged)) < 0.01


@pytest.mark.parametrize("start_px", [4.5, 7.5])
def test_views_alone_pull_disparity_to_the_truth(start_px: float) -> None:
    alone = AdaptTraining(label_weight=0.0, smooth_weight=0.0)
    assert pull(start_px, alone) == pytest.approx(TRUE_PX, abs=0.2)


def test_labels_hold_disparity_where_views_say_nothing() -> None:
    labels = AdaptTraining(photometric_weight=0.0, smooth_weight=0.0, label_weight=1.0)
    assert pull(7.0, labels, labels_px=9.0) == pytest.approx(9.0, abs=0.2)


def test_views_agree_where_both_see_a_point() -> None:
    left_px, limits = torch.full((4, 40), 10.0), LabelConfig()
    agrees = is_consistent(left_px, left_px, limits)
    assert bool(agrees[:, 10:].all())
    assert not bool(agrees[:, :10].any()), "outside the right view"
    assert not bool(is_consistent(left_px, left_px + 3, limits).any())


def test_batch_norm_keeps_its_statistics() -> None:
    torch.manual_seed(0)
    matcher = PSMNet(Config(width=4, max_disparity_px=48, blocks=(1, 1, 1, 1), pools=(4, 2)))
    before = {name: buffer.clone() for name, buffer in matcher.named_buffers()}
    (turn,) = AdaptTask(matcher, AdaptTraining()).step(plane())
    turn.loss.backward()
    assert all(torch.equal(before[name], buffer) for name, buffer in matcher.named_buffers())
    assert any(p.grad is not None and bool(p.grad.any()) for p in matcher.parameters())


def test_the_last_fifth_of_the_pairs_is_held_out(tmp_path: Path) -> None:
    folder = write_pairs(tmp_path / "pairs", (0.15,) * 6)
    assert split_pairs(str(folder), None, 0.2)[1:] == ([0, 1, 2, 3, 4], [5])
    assert split_pairs(str(folder), None, 0.34)[1:] == ([0, 1, 2, 3], [4, 5])
    assert split_pairs(str(folder), None, 0.01)[2] == [5], "one at least is held out"
    assert split_pairs(str(folder), None, 0.99)[1] == [0], "one at least is trained on"
    last = split_pairs(str(folder), None, 0.2)[0].frames[5].name
    assert split_pairs(str(folder), None, 0.2, [last])[1:] == ([0, 1, 2, 3], [4]), "neither"
    lone = write_pairs(tmp_path / "lone", (0.15,))
    with pytest.raises(InputError, match="two at least are needed"):
        split_pairs(str(lone), None, 0.2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({}, "fit no better"),
        ({"photometric": 0.0999, "disagreeing": 0.1999}, "fit no better"),
        ({"photometric": 0.09, "disagreeing": 0.21}, "fit no better"),
        ({"photometric": torch.nan, "disagreeing": 0.1}, "fit no better"),
        ({"photometric": 0.11, "disagreeing": 0.2}, "fit no better"),
        ({"photometric": 0.05, "street_d1": 0.056}, "synthetic streets are matched worse"),
    ],
)
def test_what_became_worse_is_refused(change: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        refuse_worse(SAME, dataclasses.replace(SAME, **change))


@pytest.mark.parametrize("change", [{"photometric": 0.09}, {"disagreeing": 0.19}])
def test_what_became_better_is_kept(change: dict[str, float]) -> None:
    refuse_worse(SAME, dataclasses.replace(SAME, **change, street_d1=0.054))
    refuse_worse(
        dataclasses.replace(SAME, street_d1=None),
        dataclasses.replace(SAME, **change, street_d1=None),
    )


def test_the_guard_tells_a_worse_matcher(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that finds the truth against one that is 5 px off."""
    street = make_street(0.2)
    truth_px = street.truth.disparity_px
    assert truth_px is not None

    class Fixed(StereoNetwork):
        def __init__(self, off_px: float) -> None:
            super().__init__()
            self.off_px = off_px

    def matcher_of(network: Fixed, _: MatcherConfig) -> object:
        return CallableMatcher(lambda *_: truth_px + network.off_px)

    monkeypatch.setattr("depthpose.depth.train.runs.make_matcher", matcher_of)
    guard = AdaptationCheck([street.input], 0, MatcherConfig())
    good, bad = guard.measure(Fixed(0.0)), guard.measure(Fixed(5.0))
    assert good.photometric < bad.photometric
    assert good.street_d1 is None, "no streets were asked for"


@pytest.fixture
def start(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    network = PSMNet(
        Config(width=4, max_disparity_px=48, blocks=(1, 1, 1, 1), pools=(4, 2), work_focal_px=100.0)
    )
    path = tmp_path / "start.safetensors"
    write_depth_weights(path, matcher=network.eval(), facts={"licence": "MIT"})
    return path


def config_of(tmp_path: Path, start: Path, rate: float) -> AdaptTraining:
    folder = write_pairs(tmp_path / "pairs", (0.2, 0.2, 0.25))
    return AdaptTraining(
        start=str(start),
        validation_share=0.34,
        streets=1,
        adam=AdamConfig(learning_rate=rate),
        pairs=PairsConfig(
            folders=(str(folder),), augment=AugmentConfig(crop_px=(32, 64), jitter=0.0)
        ),
        loop=LoopConfig(steps=2, batch_size=1, device="cpu", log_every_steps=1),
    )  # fmt: skip


def test_a_matcher_that_changes_nothing_is_not_written(tmp_path: Path, start: Path) -> None:
    config = dataclasses.replace(config_of(tmp_path, start, 1e-12), streets=0)
    with pytest.raises(InputError, match="fit no better"):
        train_adapt(config, Run(folder=tmp_path / "out"))
    assert not (tmp_path / "out/matcher.safetensors").exists()
    before, after = json.loads((tmp_path / "out/adapt.json").read_text())
    for name in ("photometric", "disagreeing"):
        assert before[name] == pytest.approx(after[name], rel=1e-5)


def test_pairs_are_adapted_to_at_the_size_of_a_fine_match(
    tmp_path: Path, start: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Never enlarged; large ones are reduced to what a fine match takes."""
    network = read_matcher(start)
    config = config_of(tmp_path, start, 1e-3)
    camera = open_dataset(tmp_path / "pairs").read_input(2).camera  # held out
    assert camera is not None
    own_px = float(camera.K[0, 0])
    assert fine_focal_px(config, network) == pytest.approx(own_px)
    monkeypatch.setattr(PSMNetMatcher, "fine_pixels", camera.width * camera.height / 1.1)
    assert fine_focal_px(config, network) == pytest.approx(own_px / 1.1**0.5)


@pytest.mark.parametrize("streets", [1, 0])
def test_an_adapted_matcher_carries_its_card(
    streets: int, tmp_path: Path, start: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[AdaptMetrics] = []
    monkeypatch.setattr("depthpose.depth.train.runs.refuse_worse", lambda *both: seen.extend(both))
    config = dataclasses.replace(config_of(tmp_path, start, 1e-3), streets=streets)
    path = train_adapt(config, Run(folder=tmp_path / "out"))
    assert seen[0] != seen[1]
    one, other = (read_matcher(file).state_dict() for file in (start, path))
    assert any(not torch.equal(one[name], other[name]) for name in one)
    card = path.with_suffix(".md").read_text()
    assert f"| photometric | {seen[0].photometric:.4g} | {seen[1].photometric:.4g} |" in card
    assert ("| street_d1 |" in card) == (streets > 0)
    assert "depth train adapt" in card
    labelled = tmp_path / "out/labels/0-pairs/disp_occ"
    assert [path.stem for path in sorted(labelled.iterdir())] == ["00", "01"], "02 is held out"


def test_views_that_are_changed_apart_are_refused() -> None:
    changed = PairsConfig(augment=AugmentConfig(per_view=DegradeConfig()))
    with pytest.raises(InputError, match="changes each view on its own"):
        AdaptTraining(pairs=changed)
    with pytest.raises(InputError, match=r"validation_share must be in \(0, 1\), got 1.0"):
        AdaptTraining(validation_share=1.0)
    with pytest.raises(InputError, match="one above 0"):
        AdaptTraining(photometric_weight=0.0, smooth_weight=0.0, label_weight=0.0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "name a folder of the rig's pairs"),
        (["--held-out", "."], "has no meaning for 'adapt'"),
        (["--generator", "default"], "--generator has no meaning for 'adapt'"),
    ],
)
def test_what_adapt_cannot_use_is_refused(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["depth", "train", "adapt", "--out", str(tmp_path / "out"), *words]) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_frames_that_are_excluded_are_neither_labelled_nor_missed(
    tmp_path: Path, start: Path
) -> None:
    config = config_of(tmp_path, start, 1e-3)
    (tmp_path / "pairs/right/00.png").unlink()
    for names, labelled in (((), ["01"]), (("00",), ["01"])):
        given = dataclasses.replace(config, pairs=dataclasses.replace(config.pairs, exclude=names))
        pairs, kept = label_folders(given, tmp_path / "labels")
        assert [frame.name for frame in open_dataset(pairs.folders[0]).frames] == labelled
        assert [pair.name for pair in kept] == ["02"]
