"""The sparse ResUNet: published numbers, exact folding, equal answers under renaming and order."""

import dataclasses
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from depthpose.core.errors import InputError
from depthpose.pose.networks.kernel_map import unpack
from depthpose.pose.networks.resunet import (
    ResUNet,
    ResUNetConfig,
    fold_norms,
    unfold_norms,
)
from depthpose.pose.networks.sparse import Voxels
from depthpose.pose.types import VotingPoints

TINY = ResUNetConfig(
    classes=3, keypoints=4, first_kernel=3, encoder=(4, 6, 8, 10), decoder=(5, 6, 7, 8)
)
NORMS: tuple[Literal["batch", "none"], ...] = ("batch", "none")
REFERENCE = "reference/minkowski_resunet/slim.npz"


def surface(points: int = 2000, side: float = 12.0, seed: int = 0) -> Tensor:
    """Voxels of two spheres' surfaces, clouds 0 and 1."""
    generator = torch.Generator().manual_seed(seed)
    direction = torch.randn(points, 3, generator=generator)
    xyz = (direction / direction.norm(dim=1, keepdim=True) * side).floor().long()
    number = torch.randint(0, 2, (points, 1), generator=generator)
    return torch.unique(torch.cat([number, xyz], 1), dim=0)


def tiny(**changes: object) -> ResUNet:
    torch.manual_seed(0)
    return ResUNet(dataclasses.replace(TINY, **changes)).eval()


def trained(network: ResUNet) -> ResUNet:
    """Give every norm statistics, scales and shifts that are not the ones it begins with."""
    generator = torch.Generator().manual_seed(1)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d):
            given = (module.running_mean, module.running_var, module.weight.data, module.bias.data)
            for tensor in given:
                assert tensor is not None
                tensor.copy_(torch.rand(tensor.shape, generator=generator) + 0.5)
    return network.double().eval()


def double_voxels(coordinates: Tensor) -> Voxels:
    return Voxels.from_points(coordinates, torch.ones(len(coordinates), 1, dtype=torch.float64))


def load_published(network: ResUNet, published: dict[str, Tensor]) -> None:
    """Load weights that FCGF's names are given to (Choy et al., ICCV 2019)."""
    state = {}
    for ours, tensor in network.state_dict().items():
        name = ours.replace("mix.", "conv1_tr.").replace(".first.conv.", ".conv1.")
        name = name.replace(".second.conv.", ".conv2.").replace(".weight", ".kernel")
        for i in range(4):
            name = name.replace(f"down.{i}.conv", f"conv{i + 1}")
            name = name.replace(f"down_blocks.{i}", f"block{i + 1}")
            name = name.replace(f"up.{i}.conv", f"conv{4 - i}_tr")
            name = name.replace(f"up_blocks.{i}", f"block{4 - i}_tr")
        state[ours] = published[name].reshape(tensor.shape)
    network.load_state_dict(state)


def test_parameters_are_the_published_ones() -> None:
    network = ResUNet(ResUNetConfig(norm="none"))
    assert sum(p.numel() for p in network.parameters()) == 8_774_168


@pytest.mark.data
def test_reproduces_minkowski_engine(real: Path) -> None:
    content = np.load(real / REFERENCE)
    config = ResUNetConfig(
        classes=1, norm="none", encoder=(8, 16, 32, 64), decoder=(16, 16, 16, 32)
    )
    network = ResUNet(config).eval()
    load_published(
        network,
        {n[7:]: torch.from_numpy(content[n]) for n in content if n.startswith("weight.")},
    )
    assert sum(p.numel() for p in network.parameters()) == 549_584
    coordinates = torch.from_numpy(content["coordinates"]).long()
    with torch.no_grad():
        found = network(Voxels.from_points(coordinates)).flatten(1)
    expected = torch.from_numpy(content["output"])
    assert found.shape == expected.shape
    assert float((found - expected).abs().max() / expected.abs().max()) < 1e-6


@pytest.mark.parametrize("with_bias", [False, True])
def test_folding_the_norms_changes_no_answer(with_bias: bool) -> None:
    network = trained(tiny(with_bias=with_bias))
    folded = fold_norms(network)
    assert not any(isinstance(m, nn.BatchNorm1d) for m in folded.modules())
    assert folded.config == dataclasses.replace(network.config, norm="none", with_bias=True)
    voxels = double_voxels(surface())
    torch.testing.assert_close(folded(voxels), network(voxels), rtol=1e-11, atol=1e-11)
    assert fold_norms(folded) is folded


def test_a_folded_network_learns_on_with_norms() -> None:
    voxels = double_voxels(surface())
    folded = fold_norms(trained(tiny(norm="batch")))
    network = tiny(norm="batch").double()
    unfold_norms(folded, network, voxels)
    torch.testing.assert_close(network(voxels), folded(voxels), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(network.train()(voxels), folded(voxels), rtol=1e-9, atol=1e-9)


def test_a_network_of_other_classes_gives_all_but_the_last_layer() -> None:
    voxels = double_voxels(surface())
    folded = fold_norms(trained(tiny(norm="batch")))
    network = tiny(norm="batch", classes=1).double()
    last = network.final.weight.clone()
    unfold_norms(folded, network, voxels)
    torch.testing.assert_close(
        network.features(voxels).at_points(), folded.features(voxels).at_points()
    )
    assert torch.equal(network.final.weight, last)


def test_answers_stand_by_point_in_the_order_given() -> None:
    coordinates, network = surface(), tiny()
    order = torch.randperm(len(coordinates), generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        straight = network(Voxels.from_points(coordinates))
        shuffled = network(Voxels.from_points(coordinates[order]))
    assert straight.shape == (len(coordinates), 3, 4, 3)
    assert torch.equal(straight[order], shuffled)


def test_moving_a_cloud_by_eight_voxels_changes_no_bit() -> None:
    coordinates, network = surface(), tiny()
    moved = coordinates + torch.tensor([0, -24, 8, 40])
    assert torch.equal(network(Voxels.from_points(coordinates)), network(Voxels.from_points(moved)))


def test_one_class_alone_answers_as_among_all() -> None:
    network, voxels = tiny(), Voxels.from_points(surface())
    outputs = network(voxels)
    assert outputs.shape[1:] == (3, 4, 3)
    features = network.features(voxels).at_points()
    rows = torch.arange(len(outputs))
    for classes in (rows * 0, rows * 0 + 1, rows * 0 + 2, rows % 3):
        seen = VotingPoints(
            points_m=torch.zeros(len(rows), 3),
            coordinates=surface(),
            features=torch.ones(len(rows), 1),
            class_of_point=classes,
        )
        torch.testing.assert_close(network.directions(seen), outputs[rows, classes])
    assert features.shape[1] == TINY.decoder[0]


@pytest.mark.parametrize("norm", NORMS)
def test_both_kinds_begin_with_answers_of_a_sensible_size_and_learn(
    norm: Literal["batch", "none"],
) -> None:
    torch.manual_seed(0)
    config = ResUNetConfig(classes=1, keypoints=2, norm=norm, encoder=(16, 32, 64, 64),
                           decoder=(32, 32, 32, 64))  # fmt: skip
    network, voxels = ResUNet(config), Voxels.from_points(surface())
    assert 0.1 < float(network.features(voxels).at_points().detach().std()) < 3
    truth = torch.nn.functional.normalize(-unpack(voxels.cache.keys(0))[:, 1:].float(), dim=1)
    optimiser, losses = torch.optim.Adam(network.parameters(), 2e-3), []
    for _ in range(12):
        loss = (network(voxels) - truth[:, None, None]).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.6 * losses[0]


@pytest.mark.parametrize("points", [0, 1, 5])
def test_few_voxels_train_too(points: int) -> None:
    """A level of one voxel has no variance to divide by."""
    network = tiny().train()
    outputs = network(Voxels.from_points(surface(5)[:points]))
    outputs.square().sum().backward()
    assert outputs.shape == (points, 3, 4, 3)
    assert all(p.grad is None or bool(p.grad.isfinite().all()) for p in network.parameters())


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"classes": 0}, r"classes must be in \[1, inf\), got 0"),
        ({"encoder": (32, 0, 1, 1)}, "encoder must be in"),
        ({"first_kernel": 4}, "first_kernel must be 1, 3, 5 or 7"),
    ],
)
def test_sizes_that_cannot_be_are_refused(values: dict, text: str) -> None:
    with pytest.raises(InputError, match=text):
        ResUNetConfig(**values)
