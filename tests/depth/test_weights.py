from dataclasses import replace
from pathlib import Path

import pytest
import torch

from depthpose.core.checkpoint import Checkpoint, read_checkpoint, save_checkpoint
from depthpose.core.errors import InputError
from depthpose.depth.config import GeneratorConfig, PSMNetConfig, SelectionConfig
from depthpose.depth.generators import SelectionGenerator, UNetGenerator
from depthpose.depth.stereo import PSMNet
from depthpose.depth.weights import (
    read_depth_weights,
    read_generator,
    read_matcher,
    settings_of,
    write_depth_weights,
)

FACTS = {"trained_on": "nothing", "licence": "MIT"}


@pytest.fixture(scope="module")
def networks() -> tuple[UNetGenerator, PSMNet]:
    torch.manual_seed(0)
    generator = UNetGenerator(GeneratorConfig(width=2, levels=3, virtual_focal_px=100.0))
    matcher = PSMNet(PSMNetConfig(width=2, max_disparity_px=16, blocks=(1, 1, 1, 1), pools=(2,)))
    return generator, matcher


def assert_same(one: torch.nn.Module, other: torch.nn.Module, atol: float = 0) -> None:
    state = other.state_dict()
    for name, tensor in one.state_dict().items():
        torch.testing.assert_close(tensor, state[name], rtol=atol, atol=atol)


def test_both_networks_come_back_with_their_configs(
    networks: tuple[UNetGenerator, PSMNet], tmp_path: Path
) -> None:
    generator, matcher = networks
    path = tmp_path / "both.safetensors"
    write_depth_weights(path, generator=generator, matcher=matcher, facts=FACTS)
    found = read_depth_weights(path)
    assert read_checkpoint(path).kind == "fakestereo"
    assert found.facts["trained_on"] == "nothing"
    assert found.generator is not None
    assert found.matcher is not None
    assert found.generator.config == generator.config
    assert found.matcher.config == matcher.config
    assert not found.generator.training
    assert_same(found.generator, generator)
    assert_same(found.matcher, matcher)


def test_half_precision_halves_the_file_and_keeps_three_digits(
    networks: tuple[UNetGenerator, PSMNet], tmp_path: Path
) -> None:
    generator, _ = networks
    for name, half in (("full", False), ("half", True)):
        path = tmp_path / f"{name}.safetensors"
        write_depth_weights(path, generator=generator, facts=FACTS, with_half=half)
    sizes = [(tmp_path / f"{n}.safetensors").stat().st_size for n in ("half", "full")]
    assert sizes[0] < 0.8 * sizes[1]
    read = read_generator(tmp_path / "half.safetensors")
    assert isinstance(read, UNetGenerator)
    assert read.down[0].conv.weight.dtype == torch.float32  # pyright: ignore[reportAttributeAccessIssue]
    assert_same(read, generator, atol=1e-3)


def test_one_network_alone_says_what_it_lacks(
    networks: tuple[UNetGenerator, PSMNet], tmp_path: Path
) -> None:
    generator, matcher = networks
    write_depth_weights(tmp_path / "g.safetensors", generator=generator, facts=FACTS)
    write_depth_weights(tmp_path / "s.safetensors", matcher=matcher, facts=FACTS)
    assert_same(read_matcher(tmp_path / "s.safetensors"), matcher)
    with pytest.raises(InputError, match="holds no matcher, only a generator"):
        read_matcher(tmp_path / "g.safetensors")
    with pytest.raises(InputError, match="holds no generator, only a matcher"):
        read_generator(tmp_path / "s.safetensors")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("virtual_baseline_m", 1e308),
        ("virtual_baseline_m", 1e-30),
        ("virtual_focal_px", 1e300),
        ("virtual_focal_px", 1e-30),
    ],
)
def test_a_rig_that_no_camera_has_is_refused(
    networks: tuple[UNetGenerator, PSMNet], tmp_path: Path, name: str, value: float
) -> None:
    """Depth from it would be infinite, or 0."""
    path = tmp_path / "wild.safetensors"
    write_depth_weights(path, generator=networks[0], facts=FACTS)
    found = read_checkpoint(path)
    save_checkpoint(path, replace(found, config={**found.config, name: value}))
    with pytest.raises(InputError, match=f"{name} must be in "):
        read_generator(path)


@pytest.mark.parametrize("ends", [(1e-300, 88.0), (1.2, 1e308)])
def test_disparities_that_no_image_has_are_refused(ends: tuple[float, float]) -> None:
    with pytest.raises(InputError, match=r"disparity_px must be in \[0.01, 16384\]"):
        SelectionConfig(disparity_px=ends)


def test_weights_of_a_pose_network_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "pose.safetensors"
    save_checkpoint(path, Checkpoint(kind="geoposenet", config={}, state={"a": torch.zeros(1)}))
    with pytest.raises(InputError, match="kind 'geoposenet'; depth takes 'generator'"):
        read_depth_weights(path)
    with pytest.raises(InputError, match="kind 'geoposenet'; depth takes 'generator'"):
        settings_of(read_checkpoint(path), str(path))


def test_an_answer_is_that_of_the_file_whatever_the_use(tmp_path: Path) -> None:
    torch.manual_seed(0)
    config = SelectionConfig(encoder_width=0.1, widths=(4, 4, 4, 4), planes=6)
    matcher = PSMNet(PSMNetConfig(width=2, max_disparity_px=16, blocks=(1, 1, 1, 1), pools=(2,)))
    path = tmp_path / "both.safetensors"
    write_depth_weights(path, generator=SelectionGenerator(config), matcher=matcher, facts=FACTS)
    for answer in ("own", "matched"):
        pairs = read_depth_weights(path, use="pairs", answer=answer)
        assert (pairs.generator is None, pairs.matcher is None) == (True, False)
        images = read_depth_weights(path, use="images", answer=answer)
        assert images.generator is not None
        assert images.generator.config.answer == answer
        assert (images.matcher is None) == (answer == "own")
