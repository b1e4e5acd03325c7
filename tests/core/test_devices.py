"""What a caller has set (autocast, default dtype, a fork) changes no arithmetic of ours."""

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest
import torch

from depthpose import FakestereoNet
from depthpose.core.devices import force_float32, iterate_in_float32
from depthpose.core.errors import InputError
from depthpose.depth.stereo import CallableMatcher


@pytest.fixture
def foreign_arithmetic() -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            yield
    finally:
        torch.set_default_dtype(before)


def arithmetic() -> tuple[torch.dtype, torch.dtype]:
    return torch.zeros(1).dtype, (torch.ones(2, 2) @ torch.ones(2, 2)).dtype


def _refuse_others() -> None:
    assert arithmetic() == (torch.float32, torch.float32)
    raise InputError("as work may")


@pytest.mark.usefixtures("foreign_arithmetic")
def test_default_dtype_and_autocast_are_ours_inside_and_the_callers_after() -> None:
    assert arithmetic()[0] == torch.float64
    with pytest.raises(InputError), force_float32():
        _refuse_others()
    assert torch.get_default_dtype() == torch.float64
    assert torch.is_autocast_enabled("cpu")


@pytest.mark.usefixtures("foreign_arithmetic")
def test_a_generator_computes_in_ours_and_its_caller_does_not() -> None:
    def made() -> Iterator[tuple[torch.dtype, torch.dtype]]:
        yield arithmetic()
        yield arithmetic()

    for one in iterate_in_float32(made()):
        assert one == (torch.float32, torch.float32)
        assert torch.get_default_dtype() == torch.float64


@pytest.mark.usefixtures("foreign_arithmetic")
def test_an_estimator_matches_in_its_own_arithmetic() -> None:
    seen: list[tuple[torch.dtype, torch.dtype]] = []

    def answer(left: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
        seen.append(arithmetic())
        return torch.full(left.shape[1:], 4.0)

    picture = torch.rand(3, 20, 40, dtype=torch.float32)
    net = FakestereoNet(CallableMatcher(answer), with_check=False)
    found = net.estimate(picture, right=picture.roll(-4, -1))
    assert set(seen) == {(torch.float32, torch.float32)}
    assert found.disparity_px.dtype == torch.float32


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a system without fork")
def test_a_forked_process_waits_for_no_thread_of_its_parent() -> None:
    text = """
import os, torch
from depthpose.core.devices import force_float32
torch.set_num_threads(2)
a = torch.rand(600, 600)
with force_float32():
    a @ a, a.exp().sum()
child = os.fork()
if not child:
    with force_float32():
        (a @ a).exp().sum()
    os._exit(torch.get_num_threads())
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1
assert torch.get_num_threads() == 2
"""
    subprocess.run([sys.executable, "-c", text], check=True, timeout=60)
