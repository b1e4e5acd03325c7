"""``depthpose doctor``."""

from importlib import metadata

import pytest
import torch

from depthpose import __version__
from depthpose.cli import main
from depthpose.core.errors import InputError
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.stereo import CallableMatcher
from depthpose.pose.network_pose import GeoPoseNet


@pytest.mark.slow
def test_doctor_names_what_is_here_and_tries_depth_and_pose(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    version = metadata.version

    def without_open3d(name: str) -> str:
        if name == "open3d":
            raise metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(metadata, "version", without_open3d)
    assert main(["doctor"]) == 0
    said = capsys.readouterr().out
    assert f"depthpose: {__version__}" in said
    assert "extra open3d: lacks open3d\n" in said
    assert said.count("pip install -e '.[EXTRA]'") == 1
    assert "extra train: installed" in said
    assert "extra dev" not in said
    assert "weights default: fakestereo, MIT" in said
    assert "weights parts: geoposenet, MIT" in said
    assert "depth: a pair shifted by 12 px was matched at 1" in said
    assert "pose: a synthetic flange was posed " in said


def test_a_match_without_a_disparity_fails(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def miss(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        disparity_px = torch.full(left.shape[1:], 12.0)
        disparity_px[50, 50] = torch.nan
        return disparity_px

    net = FakestereoNet(CallableMatcher(miss), with_check=False)
    monkeypatch.setattr(FakestereoNet, "load", lambda *_, **__: net)
    monkeypatch.setattr("depthpose.cli.doctor._try_pose", lambda: "posed")
    assert main(["doctor"]) == 1
    assert "depth: failed: RuntimeError: a pair shifted by 12 px was" in capsys.readouterr().err


def test_the_check_that_fails_is_named_and_the_other_is_tried(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(name: str) -> GeoPoseNet:
        raise InputError(f"weights {name!r}: damaged")

    monkeypatch.setattr(GeoPoseNet, "load", refuse)
    assert main(["doctor"]) == 1
    said = capsys.readouterr()
    assert "depth: a pair" in said.out
    assert "pose: failed: InputError: weights 'parts': damaged" in said.err
