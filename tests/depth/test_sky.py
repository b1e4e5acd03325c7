"""The rule of thumb for sky: what it takes for sky, and what becomes of the confidence."""

from dataclasses import replace

import torch
from torch import Tensor

from depthpose import FakestereoNet
from depthpose.depth.config import StreetsConfig
from depthpose.depth.estimator.sky import SHARE, looks_like_sky, lower_in_sky
from depthpose.depth.streets import Streets


def picture() -> Tensor:
    """Pale blue above a dark wall, with a wire, and a white wall that begins in the middle."""
    image = torch.full((3, 40, 30), 0.2)
    image[:, :20] = torch.tensor([0.6, 0.8, 0.95])[:, None, None]
    image[:, 10, :10] = 0.1
    image[:, 30:] = 0.9
    return image


def test_sky_is_what_is_bright_and_plain_up_to_the_top() -> None:
    is_sky = looks_like_sky(picture())
    assert bool(is_sky[:9].all())
    assert bool(is_sky[:19, 12:].all())
    assert not bool(is_sky[10:, :10].any()), "below a wire nothing is said"
    assert not bool(is_sky[20:].any()), "a bright wall below is none"


def test_what_is_dark_or_has_texture_at_the_top_is_no_sky() -> None:
    noise = torch.rand(3, 40, 30, generator=torch.Generator().manual_seed(0))
    assert not bool(looks_like_sky(torch.full((3, 40, 30), 0.4)).any())
    assert float(looks_like_sky(0.5 + noise / 2).float().mean()) < 0.02


def test_confidence_is_lowered_there_and_nowhere_else() -> None:
    confidence = torch.full((40, 30), 0.8)
    lowered = lower_in_sky(confidence, picture())
    assert lowered is not None
    is_sky = looks_like_sky(picture())
    assert bool((lowered[is_sky] == SHARE * confidence[is_sky]).all())
    assert bool((lowered[~is_sky] == 0.8).all())
    assert lower_in_sky(None, picture()) is None


def test_one_image_of_a_street_is_not_sure_of_its_sky() -> None:
    """Before, half of the sky had a confidence above 0.77."""
    net = FakestereoNet.load("default")
    streets = Streets(StreetsConfig(seed=9, scale=0.5))
    in_sky, elsewhere = [], []
    for number in (1, 5):
        sample = streets[number]
        found = net.estimate_pair(replace(sample.input, right=None))
        assert found.confidence is not None
        assert sample.truth.depth_m is not None
        is_sky = sample.truth.depth_m.isnan()
        in_sky.append(found.confidence[is_sky])
        elsewhere.append(found.confidence[~is_sky])
    assert float(torch.cat(in_sky).median()) < 0.1
    assert float(torch.cat(in_sky).mean()) < 0.25
    assert float(torch.cat(elsewhere).mean()) > 0.65
