"""Laws of the residual encoder and of the import of its published weights."""

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor

from depthpose.cli import main
from depthpose.core.checkpoint import read_checkpoint
from depthpose.core.errors import InputError
from depthpose.pose.networks.fcn import ENCODER_KIND, ResNet18, import_resnet18, normalise_colors


def norm_entries(name: str, width: int) -> dict[str, tuple[int, ...]]:
    parts = ("weight", "bias", "running_mean", "running_var")
    return {f"{name}.{part}": (width,) for part in parts}


def published_shapes() -> dict[str, tuple[int, ...]]:
    """Names and shapes of the published file, written down without our network."""
    shapes = {"conv1.weight": (64, 3, 7, 7), **norm_entries("bn1", 64)}
    for stage, width in enumerate((64, 128, 256, 512), 1):
        for block in (0, 1):
            into = width // 2 if block == 0 and stage > 1 else width
            home = f"layer{stage}.{block}"
            shapes[f"{home}.conv1.weight"] = (width, into, 3, 3)
            shapes |= norm_entries(f"{home}.bn1", width)
            shapes[f"{home}.conv2.weight"] = (width, width, 3, 3)
            shapes |= norm_entries(f"{home}.bn2", width)
            if into != width:
                shapes[f"{home}.downsample.0.weight"] = (width, into, 1, 1)
                shapes |= norm_entries(f"{home}.downsample.1", width)
    return shapes | {"fc.weight": (1000, 512), "fc.bias": (1000,)}


def published_state() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    state = {}
    for name, shape in published_shapes().items():
        value = torch.randn(shape, generator=generator)
        if name.endswith("running_var"):
            value = 0.5 + value.abs()
        elif len(shape) == 4:
            value = value / (shape[1] * shape[2] * shape[3]) ** 0.5
        state[name] = value
    return state


def plain_norm(state: dict[str, Tensor], name: str, x: Tensor) -> Tensor:
    weight, bias, mean, variance = (
        state[f"{name}.{part}"][:, None, None]
        for part in ("weight", "bias", "running_mean", "running_var")
    )
    return (x - mean) / (variance + 1e-5).sqrt() * weight + bias


def plain_forward(state: dict[str, Tensor], image: Tensor) -> list[Tensor]:
    """The network as the paper says it, from tensors alone."""
    x = F.conv2d(image, state["conv1.weight"], stride=2, padding=3)
    x = F.max_pool2d(plain_norm(state, "bn1", x).clamp(min=0), 3, 2, 1)
    stages = []
    for stage in (1, 2, 3, 4):
        for block in (0, 1):
            home = f"layer{stage}.{block}"
            stride = 2 if stage > 1 and block == 0 else 1
            y = F.conv2d(x, state[f"{home}.conv1.weight"], stride=stride, padding=1)
            y = plain_norm(state, f"{home}.bn1", y).clamp(min=0)
            y = plain_norm(state, f"{home}.bn2", F.conv2d(y, state[f"{home}.conv2.weight"],
                                                          padding=1))  # fmt: skip
            if f"{home}.downsample.0.weight" in state:
                x = F.conv2d(x, state[f"{home}.downsample.0.weight"], stride=stride)
                x = plain_norm(state, f"{home}.downsample.1", x)
            x = (x + y).clamp(min=0)
        stages.append(x)
    return stages[1:]


def test_the_encoder_has_the_published_number_of_parameters() -> None:
    # 11,689,512 of the classifier less 513,000 of its last layer.
    assert sum(p.numel() for p in ResNet18().parameters()) == 11_176_512


@torch.no_grad()
def test_published_weights_give_what_a_plain_computation_gives(tmp_path: Path) -> None:
    state = published_state()
    image = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(1))
    torch.save({f"module.{k}": v for k, v in state.items()}, tmp_path / "published.pth")
    import_resnet18(tmp_path / "published.pth", tmp_path / "ours.safetensors")
    network = ResNet18().eval()
    network.load_state_dict(read_checkpoint(tmp_path / "ours.safetensors", ENCODER_KIND).state)
    found = network(image)
    for ours, plain in zip(found, plain_forward(state, image), strict=True):
        torch.testing.assert_close(ours, plain, rtol=1e-4, atol=1e-4 * float(plain.abs().max()))
    assert [tuple(f.shape[1:]) for f in found] == [(128, 8, 12), (256, 4, 6), (512, 2, 3)]


def test_both_kinds_of_published_file_come_back_by_the_command(tmp_path: Path) -> None:
    state = published_state()
    torch.save(state, tmp_path / "resnet18.pth")
    save_file(state, tmp_path / "published.safetensors")
    for name in ("resnet18.pth", "published.safetensors"):
        out = tmp_path / f"ours_{name[0]}.safetensors"
        words = ["weights", "import", "resnet18", str(tmp_path / name), "--out", str(out)]
        assert main(words) == 0
        read = read_checkpoint(out, ENCODER_KIND).state
        assert torch.equal(read["layer3.0.downsample.0.weight"],
                           state["layer3.0.downsample.0.weight"])  # fmt: skip
        assert not any(key.startswith("fc") for key in read)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"layer2.0.conv1.weight": None}, "layer2.0.conv1.weight is missing"),
        ({"layer5.0.conv1.weight": torch.ones(1)}, "layer5.0.conv1.weight is unexpected"),
        ({"conv1.weight": torch.ones(64, 1, 7, 7)}, r"conv1.weight is \(64, 1, 7, 7\), not"),
    ],
)
def test_other_weights_are_refused_by_name(
    change: dict[str, Tensor | None], said: str, tmp_path: Path
) -> None:
    state = {**published_state(), **change}
    torch.save({k: v for k, v in state.items() if v is not None}, tmp_path / "other.pth")
    with pytest.raises(InputError, match=said):
        import_resnet18(tmp_path / "other.pth", tmp_path / "out.safetensors")


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    torch.save({"epoch": 3}, tmp_path / "log.pth")
    with pytest.raises(InputError, match=r"holds no tensors by name.*'epoch'"):
        import_resnet18(tmp_path / "log.pth", tmp_path / "out.safetensors")


def test_colors_of_imagenets_mean_become_zero() -> None:
    image = torch.tensor([0.485, 0.456, 0.406])[:, None, None].expand(3, 2, 2)
    assert torch.allclose(normalise_colors(image), torch.zeros(3, 2, 2), atol=1e-6)
