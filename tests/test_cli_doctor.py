"""``depthpose doctor``."""

from importlib import metadata

import pytest
from tests.depth.constant_selection import sure_of

from depthpose import __version__
from depthpose.cli import main
from depthpose.core.errors import InputError
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.synthesis import make_synthesiser
from depthpose.pose.estimator import GeoPoseNet


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


@pytest.mark.parametrize(("plane", "code"), [(3, 0), (0, 1)])
def test_weights_without_a_matcher_are_tried_on_one_image(
    plane: int, code: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    net = FakestereoNet(None, make_synthesiser(sure_of(plane), speed="quick"))
    monkeypatch.setattr(FakestereoNet, "load", lambda _, **__: net)
    assert main(["doctor"]) == code
    said = capsys.readouterr()
    if plane:
        assert "depth: one image got a depth for 100% of its pixels, 15.0 m" in said.out
    else:
        assert "one image got a depth for 0% of its pixels" in said.err


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
