"""The generator that selects: its distributions, the views drawn of them, its encoder."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.depth.config import SelectionConfig
from depthpose.depth.encoder import LiteEncoder, MixedStyle, import_encoder, load_encoder
from depthpose.depth.generators import SelectionGenerator
from depthpose.depth.synthesis import (
    make_synthesiser,
    mix_shifts,
    read_logits,
    synthesise_right,
    warp_left_to_right,
)
from depthpose.depth.train.config import SelectTraining
from depthpose.depth.train.selection_task import SelectTask

TINY = SelectionConfig(
    encoder_width=0.1,
    widths=(8, 8, 8, 8),
    planes=6,
    disparity_px=(1.0, 32.0),
    virtual_focal_px=130.0,
)
PLANES = torch.tensor([1.0, 2.0, 4.0, 8.0])


def tiny(seed: int = 0) -> SelectionGenerator:
    torch.manual_seed(seed)
    return SelectionGenerator(TINY).eval()


def one_hot(classes: Tensor, count: int) -> Tensor:
    """Logits (1, count, h, w) that are sure of the classes (h, w)."""
    return (F.one_hot(classes, count).movedim(-1, 0)[None] * 60.0).float()


def test_parameters_are_those_of_lite0_without_its_classifier() -> None:
    """4,652,008 published, less 320 x 1280 + 2 x 1280 of the last layer, 1281 x 1000 of classes."""
    counted = sum(p.numel() for p in LiteEncoder().parameters())
    assert counted == 4_652_008 - 320 * 1280 - 2 * 1280 - 1281 * 1000
    assert LiteEncoder().channels == [16, 24, 40, 112, 320]


def test_features_and_logits_have_their_strides() -> None:
    network, image = tiny(), torch.rand(2, 3, 64, 96)
    sizes = [tuple(f.shape[2:]) for f in network.encoder(image)]
    assert sizes == [(32, 48), (16, 24), (8, 12), (4, 6), (2, 3)]
    left, right = network(image)
    assert left.shape == right.shape == (2, 7, 32, 48)
    with pytest.raises(InputError, match=r"multiples of 32 px, got 60x96"):
        network(torch.rand(1, 3, 60, 96))


def test_convolutions_of_stride_two_pad_below_and_to_the_right() -> None:
    """TensorFlow's SAME: of 4 pixels, a 3x3 kernel of stride 2 sees 0..2 and 2..4."""
    first = LiteEncoder(1 / 32).stem
    conv, norm = first.get_submodule("conv"), first.get_submodule("norm")
    assert isinstance(conv, torch.nn.Conv2d)
    torch.nn.init.ones_(conv.weight)
    image = torch.zeros(1, 3, 4, 4)
    image[..., 0, 0] = 1.0
    found = conv(F.pad(image, (0, 1, 0, 1)))
    torch.testing.assert_close(first(image), norm(found))
    assert found[0, 0].tolist() == [[3.0, 0.0], [0.0, 0.0]]


def test_planes_are_even_in_the_logarithm() -> None:
    planes = SelectionGenerator(replace(TINY, planes=4, disparity_px=(1.0, 8.0))).planes
    torch.testing.assert_close(planes, PLANES)


def test_the_expectation_is_that_of_the_logarithm_without_the_sky() -> None:
    shares = torch.tensor([0.5, 0.0, 0.25, 0.0, 0.25])  # sky, 1, 2, 4, 8 px
    logits = shares.clamp(min=1e-30).log().reshape(1, 5, 1, 1)
    found = read_logits(logits, PLANES)[0]
    assert float(found) == pytest.approx((math.log(2) + math.log(8)) / 2, rel=1e-5)


def test_a_sure_answer_is_read_off() -> None:
    log_px, sky, sure = read_logits(one_hot(torch.tensor([[0, 3], [0, 3]]), 5), PLANES)
    torch.testing.assert_close(log_px[0, :, 1], torch.full((2,), 4.0).log())
    torch.testing.assert_close(sky[0], torch.tensor([[1.0, 0.0], [1.0, 0.0]]))
    torch.testing.assert_close(sure[0, :, 1], torch.ones(2))


def test_an_even_distribution_is_no_confidence() -> None:
    _, sky, sure = read_logits(torch.zeros(1, 5, 1, 1), PLANES)
    assert float((sure * (1 - sky)).max()) < 0.3


def test_one_shift_a_pixel_looks_to_the_right_and_repeats_the_border() -> None:
    left = torch.arange(6.0).expand(1, 3, 1, 6)
    drawn = warp_left_to_right(left, torch.full((1, 1, 6), 2.0))
    assert drawn[0, 0, 0].tolist() == pytest.approx([2, 3, 4, 5, 5, 5])
    half = warp_left_to_right(left, torch.full((1, 1, 6), 0.5))
    assert half[0, 0, 0].tolist() == pytest.approx([0.5, 1.5, 2.5, 3.5, 4.5, 5.0])


@pytest.mark.parametrize("scale", [1.0, 0.7])
def test_a_sure_mixture_is_one_shift(scale: float) -> None:
    torch.manual_seed(0)
    left, classes = torch.rand(1, 3, 5, 20), torch.randint(0, 5, (5, 20))
    mixed = mix_shifts(left, one_hot(classes, 5), PLANES * scale)
    shifts = torch.cat([torch.zeros(1), PLANES * scale])[classes][None]
    torch.testing.assert_close(mixed, warp_left_to_right(left, shifts), rtol=0, atol=1e-5)


@pytest.mark.parametrize("size", [(64, 96), (50, 70), (33, 31), (5, 7)])
def test_any_size_is_answered_at_its_own_size(size: tuple[int, int]) -> None:
    drawn = make_synthesiser(tiny()).synthesise(torch.rand(2, 3, *size))
    assert drawn.right.shape == (2, 3, *size)
    assert drawn.matches is not None
    assert len(drawn.matches) == 2
    for match in drawn.matches:
        for part in (match.disparity_px, match.confidence, match.is_sky):
            assert part is not None
            assert part.shape == size
        assert bool((match.disparity_px > 0).all())


def test_neighbours_in_a_batch_change_nothing() -> None:
    drawer, images = make_synthesiser(tiny()), torch.rand(2, 3, 64, 64)
    both, alone = drawer.synthesise(images), drawer.synthesise(images[:1])
    torch.testing.assert_close(both.right[:1], alone.right, rtol=0, atol=1e-5)


def test_gradients_reach_the_right_view_through_the_drawn_one() -> None:
    network = tiny().train()
    synthesise_right(network, torch.rand(1, 3, 64, 64)).square().mean().backward()
    head = network.head.weight.grad
    assert head is not None
    assert float(head[TINY.planes + 1 :].abs().sum()) > 0


def test_style_is_the_statistics_of_channels_and_nothing_else() -> None:
    torch.manual_seed(0)
    features = torch.randn(4, 6, 9, 11) * torch.rand(4, 6, 1, 1) + torch.randn(4, 6, 1, 1)
    style = MixedStyle()
    style.share = 1.0
    changed = style(features)
    difference = changed.mean((2, 3)) - features.mean((2, 3))
    assert float(difference.abs().max()) > 0.1

    def normalised(x: Tensor) -> Tensor:
        return (x - x.mean((2, 3), keepdim=True)) / x.std((2, 3), keepdim=True)

    torch.testing.assert_close(normalised(changed), normalised(features), rtol=0, atol=1e-3)
    assert style.eval()(features) is features
    style.train().share = 0.0
    assert style(features) is features


def test_a_generator_is_trained_in_other_styles_and_estimates_in_none() -> None:
    generator = tiny()
    image = torch.rand(2, 3, 32, 64)
    SelectTask(generator, SelectTraining(generator=TINY, style_share=1.0), None)
    first, second = (generator(image)[0] for _ in range(2))
    assert not torch.equal(first, second)
    generator.eval()
    assert torch.equal(generator(image)[0], generator(image)[0])


def published_names(encoder: LiteEncoder) -> dict[str, Tensor]:
    """State dict of the encoder under the names that its publisher uses, with a classifier."""
    state = {}
    for name, tensor in encoder.state_dict().items():
        if name.startswith("stem."):
            state[name.replace("stem.conv", "_conv_stem").replace("stem.norm", "_bn0")] = tensor
            continue
        _, number, part, kind, rest = re.split(r"\.", name, maxsplit=4)
        norm = {"expand": "_bn0", "depthwise": "_bn1", "project": "_bn2"}[part]
        state[f"_blocks.{number}.{f'_{part}_conv' if kind == 'conv' else norm}.{rest}"] = tensor
    extra = {
        "_conv_head.weight": (1280, encoder.channels[-1], 1, 1),
        "_bn1.weight": (1280,),
        "_fc.bias": (1000,),
    }
    return state | {name: torch.zeros(shape) for name, shape in extra.items()}


def test_the_published_encoder_is_imported_whole(tmp_path: Path) -> None:
    torch.manual_seed(1)
    encoder = LiteEncoder()
    torch.save(published_names(encoder), tmp_path / "lite0.pth")
    import_encoder(tmp_path / "lite0.pth", tmp_path / "lite0.safetensors")
    found = LiteEncoder()
    load_encoder(found, tmp_path / "lite0.safetensors")
    for name, tensor in encoder.state_dict().items():
        assert torch.equal(found.state_dict()[name], tensor), name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.pop("_blocks.3._bn1.bias"), "blocks.3.depthwise.norm.bias"),
        (lambda state: state.update(odd=torch.zeros(1)), "odd"),
        (lambda state: state.update(epoch=3), "holds no tensors by name"),
    ],
)
def test_another_checkpoint_is_no_encoder(tmp_path: Path, change, message: str) -> None:  # noqa: ANN001
    state = published_names(LiteEncoder())
    change(state)
    torch.save(state, tmp_path / "lite0.pth")
    with pytest.raises(InputError, match=message):
        import_encoder(tmp_path / "lite0.pth", tmp_path / "lite0.safetensors")
    assert not (tmp_path / "lite0.safetensors").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"encoder_width": 0.0}, r"encoder_width must be in \(0, 4\], got 0.0"),
        ({"planes": 1}, r"planes must be in \[2, inf\), got 1"),
        ({"disparity_px": (4.0, 2.0)}, "disparity_px must be a range, the lower end first"),
        ({"virtual_focal_px": 0.0}, r"virtual_focal_px must be in \[1, 20000\], got 0.0"),
    ],
)
def test_sizes_that_cannot_be_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        SelectionConfig(**changes)
