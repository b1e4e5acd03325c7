import dataclasses

import pytest
import torch

from depthpose.core.errors import InputError
from depthpose.depth.augment import degrade, through_jpeg
from depthpose.depth.config import DegradeConfig

NOTHING = DegradeConfig(
    color=0.0,
    hue_share=0.0,
    haze_share=0.0,
    glare_share=0.0,
    blur_share=0.0,
    noise_share=0.0,
    jpeg_share=0.0,
)
IMAGE = torch.rand(3, 24, 40, generator=torch.Generator().manual_seed(5))


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_nothing_asked_for_changes_nothing() -> None:
    torch.testing.assert_close(degrade(IMAGE, NOTHING, seeded()), IMAGE, rtol=0, atol=1e-6)


def test_the_generator_alone_decides() -> None:
    one, same, other = (degrade(IMAGE, DegradeConfig(), seeded(n)) for n in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


@pytest.mark.parametrize("share", ["hue", "haze", "glare", "blur", "noise", "jpeg"])
def test_each_change_alone_changes_the_picture_and_keeps_its_range(share: str) -> None:
    config = dataclasses.replace(NOTHING, **{f"{share}_share": 1.0})
    found = degrade(IMAGE, config, seeded(3))
    assert found.shape == IMAGE.shape
    assert float((found - IMAGE).abs().mean()) > 0.003
    assert 0 <= float(found.min()) <= float(found.max()) <= 1


def test_edges_stay_where_they_are() -> None:
    """What changes is colour and sharpness: the brightest column stays the brightest."""
    stripe = torch.full((3, 16, 64), 0.2)
    stripe[..., 40:44] = 0.6
    config = dataclasses.replace(DegradeConfig(), noise=0.01, glare_share=0.0)
    for seed in range(20):
        columns = degrade(stripe, config, seeded(seed)).mean((0, 1))
        assert 40 <= int(columns.argmax()) < 44


def test_jpeg_loses_more_at_lower_quality() -> None:
    errors = [float((through_jpeg(IMAGE, q) - IMAGE).abs().mean()) for q in (95, 40)]
    assert 0 < errors[0] < errors[1]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"blur_share": 1.5}, r"blur_share must be in \[0, 1\]"),
        ({"color": 1.0}, r"color must be in \[0, 1\)"),
        ({"noise": -1.0}, r"noise must be in \[0, inf\)"),
    ],
)
def test_shares_that_are_none_are_refused(changes: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        DegradeConfig(**changes)
