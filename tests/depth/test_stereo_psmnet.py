"""Laws of the stereo network as it is trained, and of the import of published weights."""

from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from depthpose.core.checkpoint import read_torch_file
from depthpose.core.errors import InputError
from depthpose.core.files import read_depth_png, read_image
from depthpose.depth.config import MatcherConfig, PSMNetConfig
from depthpose.depth.metrics import sparsification_area
from depthpose.depth.stereo import PSMNet, PSMNetMatcher, normalise, psmnet_from_published
from depthpose.depth.stereo.psmnet import concatenation_volume, soft_argmin

TINY = PSMNetConfig(max_disparity_px=32, width=4, blocks=(1, 1, 1, 1), pools=(4, 2))


def published_state() -> dict[str, Tensor]:
    """Random weights under the names of the published file."""
    with torch.random.fork_rng():
        network = PSMNet()
    names = {"stem.0": "firstconv.0", "stem.1": "firstconv.2", "stem.2": "firstconv.4"}
    parts = ["down1", "same1", "down2", "same2", "up2", "up1"]
    state = {}
    for ours, value in network.state_dict().items():
        words = ours.replace(".conv.", ".0.").replace(".norm.", ".1.").split(".")
        if words[0] == "features":
            name = ".".join(words[1:])
            for a, b in names.items():
                name = name.replace(a, b)
            for i in range(4):
                name = name.replace(f"stages.{i}.", f"layer{i + 1}.")
                name = name.replace(f"pyramid.{i}.", f"branch{i + 1}.1.")
            name = name.replace(".first.", ".conv1.0.").replace(".second.", ".conv2.")
            name = name.replace("shortcut", "downsample").replace("fuse", "lastconv.0")
            name = "feature_extraction." + name.replace("project", "lastconv.2")
        elif words[0] == "hourglasses":
            number = str(1 + parts.index(words[2]))
            inner = "" if number in "256" else "0."
            name = f"dres{int(words[1]) + 2}.conv{number}.{inner}{'.'.join(words[3:])}"
        elif words[0] == "heads":
            layer = "0" if words[2] == "hidden" else "2"
            name = f"classif{int(words[1]) + 1}.{layer}.{'.'.join(words[3:])}"
        else:
            name = f"{words[0]}.{2 * int(words[1])}.{'.'.join(words[2:])}"
        state["module." + name] = value
    return state


def test_default_network_has_the_papers_number_of_parameters() -> None:
    assert sum(p.numel() for p in PSMNet().parameters()) == 5_224_768


def test_training_answers_three_maps_and_evaluation_the_last() -> None:
    pair = torch.rand(2, 2, 3, 32, 64)
    network = PSMNet(TINY)
    maps = network(*pair)
    assert [tuple(m.shape) for m in maps] == [(2, 32, 64)] * 3
    assert all(bool(((m >= 0) & (m <= 31)).all()) for m in maps)
    assert len(network.eval()(*pair)) == 1


@pytest.mark.parametrize("size", [(33, 64), (32, 60), (16, 64)])
def test_network_says_which_sizes_it_takes(size: tuple[int, int]) -> None:
    config = PSMNetConfig(width=2, blocks=(1, 1, 1, 1), pools=(8, 2))
    with pytest.raises(InputError, match=r"multiples of 16 and at least 32 px, got"):
        PSMNet(config)(*torch.rand(2, 1, 3, *size))


def test_gradients_are_finite_and_reach_every_weight() -> None:
    network = PSMNet(TINY)
    maps = network(*torch.rand(2, 2, 3, 32, 64))
    torch.stack([m.mean() for m in maps]).sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert bool(torch.isfinite(parameter.grad).all()), name


def test_network_overfits_one_toy_pair() -> None:
    torch.manual_seed(0)
    texture = torch.rand(1, 3, 64, 160)
    # The right view shows left column x at x - 8.
    left, right = texture[..., 40:136], texture[..., 48:144]
    truth_px = torch.full((1, 64, 96), 8.0)
    network = PSMNet(TINY)
    optimiser = torch.optim.Adam(network.parameters(), 1e-2)
    losses = []
    for _ in range(25):
        maps = network(left, right)
        loss = sum(
            w * F.smooth_l1_loss(m, truth_px) for w, m in zip((0.5, 0.7, 1), maps, strict=True)
        )
        assert isinstance(loss, Tensor)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0] / 5


def test_volume_pairs_each_pixel_with_its_match() -> None:
    left, right = torch.rand(2, 1, 2, 3, 5)
    volume = concatenation_volume(left, right, 7)
    for d, y, x in [(0, 0, 0), (2, 1, 4), (4, 2, 4), (3, 0, 2), (6, 1, 4)]:
        expected = (
            torch.cat([left[0, :, y, x], right[0, :, y, x - d]]) if x >= d else torch.zeros(4)
        )
        assert torch.equal(volume[0, :, d, y, x], expected)


def test_soft_argmin_of_a_certain_cost_is_its_bin() -> None:
    cost = torch.zeros(1, 1, 8, 2, 2)
    cost[:, :, 3] = 1000
    disparity_px = soft_argmin(cost, (32, 8, 8), align_corners=False)
    # Bin 3 of quarter size is centred between samples 13 and 14 of the enlarged axis.
    assert torch.allclose(disparity_px, torch.full((1, 8, 8), 13.5), atol=1e-3)


def test_convolutions_start_as_the_authors_drew_them() -> None:
    torch.manual_seed(0)
    weight = PSMNet().dres0[0].get_parameter("conv.weight")
    assert float(weight.detach().std()) == pytest.approx((2 / (27 * 32)) ** 0.5, rel=0.02)


def test_published_names_are_understood_with_and_without_their_prefix() -> None:
    state = published_state()
    assert len(state) == 514
    network = psmnet_from_published(state, align_corners=False)
    assert not network.training
    assert not network.config.align_corners
    value = network.state_dict()["hourglasses.1.up2.conv.weight"]
    assert torch.equal(value, state["module.dres3.conv5.0.weight"])
    bare = {name.removeprefix("module."): value for name, value in state.items()}
    again = psmnet_from_published(bare, align_corners=False).state_dict()
    assert all(torch.equal(value, again[name]) for name, value in network.state_dict().items())


def test_published_weights_need_no_count_of_batches() -> None:
    state = {n: v for n, v in published_state().items() if not n.endswith("num_batches_tracked")}
    psmnet_from_published(state, align_corners=True)


def test_import_names_what_is_missing_unknown_and_misshaped() -> None:
    state = published_state()
    del state["module.dres0.0.0.weight"]
    state["module.stranger"] = torch.zeros(1)
    state["module.classif1.2.weight"] = torch.zeros(1, 32, 1, 1, 1)
    with pytest.raises(InputError) as caught:
        psmnet_from_published(state, align_corners=True)
    text = str(caught.value)
    assert "dres0.0.conv.weight is missing" in text
    assert "stranger is unexpected" in text
    assert "heads.0.cost.weight is (1, 32, 1, 1, 1), not (1, 32, 3, 3, 3)" in text
    assert "state_dict" in text


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"max_disparity_px": 100}, "multiple of 16.*got 100; take 192"),
        ({"max_disparity_px": 0}, r"max_disparity_px must be in \[16, 16384\], got 0"),
        ({"width": 0}, r"width must be in \[1, inf\), got 0"),
        ({"blocks": (1, 0, 1, 1)}, r"blocks must be in \[1, 1000\]"),
        ({"pools": ()}, "pools must hold 1 to 16 windows"),
    ],
)
def test_network_config_refuses_nonsense(settings: dict, text: str) -> None:
    with pytest.raises(InputError, match=text):
        PSMNetConfig(**settings)


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"max_memory_bytes": 0}, "max_memory_bytes must be in"),
    ],
)
def test_matcher_config_refuses_nonsense(settings: dict, text: str) -> None:
    with pytest.raises(InputError, match=text):
        MatcherConfig(**settings)


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("with_matcher", [True, False])
def test_published_weights_give_the_published_disparity(real: Path, with_matcher: bool) -> None:
    weights = real / "reference/psmnet/published_kitti2015.tar"
    with np.load(real / "reference/psmnet/kitti2015_000046_10.npz") as reference:
        top, left_column = int(reference["top"]), int(reference["left"])
        expected = torch.from_numpy(reference["disparity"])
    crop = (slice(None), slice(top, top + 256), slice(left_column, left_column + 512))
    folder = "depth/kitti_2015/training"
    left = read_image(real / f"{folder}/image_2/000046_10.png")[crop]
    right = read_image(real / f"{folder}/image_3/000046_10.png")[crop]
    network = psmnet_from_published(read_torch_file(weights)["state_dict"], align_corners=True)
    if with_matcher:
        found = PSMNetMatcher(network).match(left, right).disparity_px
    else:
        with torch.no_grad():
            found = network(normalise(left)[None], normalise(right)[None])[-1][0]
    assert float((found - expected).abs().max()) < 1e-3


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(("align_corners", "epe_px"), [(True, 0.27), (False, 1.17)])
def test_whole_frame_error_shows_which_corners_the_weights_want(
    real: Path, align_corners: bool, epe_px: float
) -> None:
    weights = real / "reference/psmnet/published_kitti2015.tar"
    folder = "depth/kitti_2015/training"
    left = read_image(real / f"{folder}/image_2/000046_10.png")
    right = read_image(real / f"{folder}/image_3/000046_10.png")
    truth_px = read_depth_png(real / f"{folder}/disp_occ_0/000046_10.png")
    state = read_torch_file(weights)["state_dict"]
    matcher = PSMNetMatcher(psmnet_from_published(state, align_corners=align_corners))
    found = matcher.match(left, right)
    known = torch.isfinite(truth_px) & (truth_px > 0)
    error_px = (found.disparity_px - truth_px)[known].abs()
    assert float(error_px.mean()) == pytest.approx(epe_px, abs=0.01)
    if align_corners:
        assert found.confidence is not None
        chance = torch.rand(len(error_px), generator=torch.Generator().manual_seed(0))
        area = sparsification_area(error_px, found.confidence[known])
        assert area < 0.8 * sparsification_area(error_px, chance)
