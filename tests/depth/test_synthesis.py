from typing import Literal

import pytest
import torch
from torch import Tensor, nn

from depthpose.core.errors import InputError
from depthpose.depth.config import GeneratorConfig
from depthpose.depth.generators import Discriminator, UNetGenerator
from depthpose.depth.synthesis import make_synthesiser, pad_to_multiple, synthesise_right


def parameters(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def small(levels: int = 4, **changes: object) -> UNetGenerator:
    torch.manual_seed(0)
    settings = {"width": 4, "levels": levels, **changes}
    return UNetGenerator(GeneratorConfig(**settings))


def test_parameters_are_the_published_ones() -> None:
    assert parameters(UNetGenerator()) == 54_413_955
    assert parameters(Discriminator("patch")) == 2_768_705
    assert parameters(Discriminator("pixel")) == 9_024


def test_widths_double_up_to_eight_times() -> None:
    with torch.device("meta"):
        convolutions = [level.get_submodule("conv") for level in UNetGenerator().down]
    found = [one.out_channels for one in convolutions if isinstance(one, nn.Conv2d)]
    assert found == [64, 128, 256, 512, 512, 512, 512, 512]


def test_dropout_stands_in_the_three_inner_blocks() -> None:
    inner = [len(list(level.children())) and isinstance(level.dropout, nn.Dropout)
             for level in UNetGenerator(GeneratorConfig(width=2)).up]  # fmt: skip
    assert inner == [False] * 4 + [True] * 3 + [False]
    assert not any(isinstance(m, nn.Dropout) for m in small(with_dropout=False).modules())


def test_norm_stands_everywhere_but_outermost_and_innermost() -> None:
    network = UNetGenerator(GeneratorConfig(width=2))
    down = [isinstance(level.norm, nn.BatchNorm2d) for level in network.down]
    up = [isinstance(level.norm, nn.BatchNorm2d) for level in network.up]
    assert down == [False] + [True] * 6 + [False]
    assert up == [False] + [True] * 7


def test_initial_weights_follow_pix2pix() -> None:
    network = UNetGenerator(GeneratorConfig(width=32, levels=5))
    conv = torch.cat([m.weight.detach().flatten() for m in network.modules()
                      if isinstance(m, nn.Conv2d | nn.ConvTranspose2d)])  # fmt: skip
    norm = torch.cat(
        [m.weight.detach() for m in network.modules() if isinstance(m, nn.BatchNorm2d)]
    )
    assert float(conv.mean()) == pytest.approx(0, abs=2e-4)
    assert float(conv.std()) == pytest.approx(0.02, rel=0.02)
    assert float(norm.mean()) == pytest.approx(1, abs=5e-3)
    assert float(norm.std()) == pytest.approx(0.02, rel=0.15)


@pytest.mark.parametrize(("kind", "field"), [("patch", 70), ("pixel", 1)])
def test_the_receptive_field_is_70_by_gradient(kind: Literal["patch", "pixel"], field: int) -> None:
    network = Discriminator(kind, 4).eval()
    left = torch.rand(1, 3, 256, 256, requires_grad=True)
    logits = network(left, torch.rand(1, 3, 256, 256))
    assert logits.shape[-1] == (30 if field == 70 else 256)
    row, column = (s // 2 for s in logits.shape[-2:])
    logits[0, 0, row, column].backward()
    assert left.grad is not None
    touched = left.grad.abs().sum((0, 1)) > 0
    rows, columns = touched.any(1).nonzero(), touched.any(0).nonzero()
    assert int(rows.max() - rows.min()) + 1 == field
    assert int(columns.max() - columns.min()) + 1 == field


def test_sides_must_be_multiples() -> None:
    with pytest.raises(InputError, match=r"multiples of 16 px, got 20x32"):
        small()(torch.zeros(1, 3, 20, 32))


@pytest.mark.parametrize("size", [(16, 32), (5, 7), (1, 1), (33, 100)])
def test_any_size_is_drawn_at_its_own_size(size: tuple[int, int]) -> None:
    right = make_synthesiser(small()).synthesise(torch.rand(1, 3, *size)).right[0]
    assert right.shape == (3, *size)
    assert float(right.min()) >= 0
    assert float(right.max()) <= 1


def test_padding_mirrors_and_leaves_the_image_alone() -> None:
    image = torch.arange(12.0).reshape(1, 1, 3, 4)
    padded = pad_to_multiple(image, 8)
    assert padded.shape == (1, 1, 8, 8)
    assert torch.equal(padded[..., :3, :4], image)
    assert padded[0, 0, 0].tolist() == [0, 1, 2, 3, 2, 1, 0, 1]
    assert padded[0, 0, :, 0].tolist() == [0, 4, 8, 4, 0, 4, 8, 4]


def test_drawing_is_differentiable_to_the_weights() -> None:
    network = small()
    synthesise_right(network, torch.rand(2, 3, 20, 24)).mean().backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in network.parameters())


def test_running_mode_is_deterministic_and_does_not_depend_on_neighbours() -> None:
    drawer = make_synthesiser(_warmed(small()))
    one, other = torch.rand(2, 1, 3, 16, 32)
    assert torch.equal(drawer.synthesise(one).right, drawer.synthesise(one).right)
    both = drawer.synthesise(torch.cat([one, other])).right
    torch.testing.assert_close(both[:1], drawer.synthesise(one).right)


def _warmed(network: UNetGenerator) -> UNetGenerator:
    """Give batch norm statistics of its own."""
    network.train()
    images: Tensor = torch.rand(2, 3, 128, 256)
    for _ in range(5):
        network(images)
    return network


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, r"width must be in \[1, inf\), got 0"),
        ({"levels": 1}, r"levels must be in \[2, 10\], got 1"),
        ({"virtual_focal_px": 0.0}, r"virtual_focal_px must be in \[1, 20000\], got 0.0"),
    ],
)
def test_bad_settings_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        GeneratorConfig(**changes)  # pyright: ignore[reportArgumentType]


def test_a_side_near_a_multiple_is_not_padded() -> None:
    """One row more than was trained must not add a whole block of mirrored rows."""
    torch.manual_seed(0)
    network = _warmed(small(6))
    image = torch.nn.functional.interpolate(torch.rand(1, 3, 8, 12), (192, 192), mode="bicubic")
    image = image.clamp(0, 1)
    taller = torch.nn.functional.interpolate(image, (193, 192), mode="bilinear")
    with torch.no_grad():
        drawn = synthesise_right(network.eval(), image)
        other = synthesise_right(network.eval(), taller)
    assert other.shape[-2] == 193
    back = torch.nn.functional.interpolate(other, (192, 192), mode="bilinear")
    assert float((back - drawn).abs().mean()) < 0.01
