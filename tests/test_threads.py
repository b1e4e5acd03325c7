"""One estimator, several threads of a service: the answers are those of one thread."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from depthpose import FakestereoNet, GeoPoseNet, Registration
from depthpose.core.devices import map_in_threads
from depthpose.core.errors import InputError
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.synthetic import SyntheticViews, make_part
from depthpose.pose.types import CloudInput, PoseEstimate

Estimate = Callable[[int], list[torch.Tensor]]


def _pose_numbers(found: PoseEstimate) -> list[torch.Tensor]:
    pose = found.camera_from_model
    return [] if pose is None else [pose.R, pose.t_m]


def _depth() -> Estimate:
    net = FakestereoNet.load("default", allow_ood=True)
    images = [torch.rand(3, 96, 160, generator=torch.Generator().manual_seed(k)) for k in range(3)]
    return lambda k: [net.estimate(images[k % 3], focal_px=200.0).disparity_px]


def _poses(net: GeoPoseNet | Registration) -> Estimate:
    views = SyntheticViews([make_part("connector")], ObjectsConfig(views=None, seed=5))
    given = [views[k].input for k in range(3)]
    inputs = [CloudInput(name=g.name, points_m=g.points_m, object="connector") for g in given]
    return lambda k: _pose_numbers(net.estimate_many([inputs[k % 3]])[0])


@pytest.mark.parametrize("kind", ["depth", "network", "registration"])
def test_an_estimator_may_be_shared_by_threads(kind: str) -> None:
    """The first estimates too, which prepare what is kept of an object."""
    make: dict[str, Callable[[], Estimate]] = {
        "depth": _depth,
        "network": lambda: _poses(GeoPoseNet.load("parts")),
        "registration": lambda: _poses(Registration([make_part("connector")])),
    }
    shared, own = make[kind](), make[kind]()
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(shared, range(6)))
    alone = [own(k) for k in range(3)]
    assert any(alone)
    for k, found in enumerate(together):
        for one, other in zip(found, alone[k % 3], strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)


def test_threads_keep_the_order_and_raise_what_is_raised() -> None:
    assert list(map_in_threads(lambda k: k * k, iter(range(7)), 3)) == [k * k for k in range(7)]

    def broken(k: int) -> int:
        if k == 3:
            raise InputError("three")
        return k

    found: list[int] = []
    cores = torch.get_num_threads()
    with pytest.raises(InputError, match="three"):
        found.extend(map_in_threads(broken, iter(range(100)), 2))
    assert torch.get_num_threads() == cores
