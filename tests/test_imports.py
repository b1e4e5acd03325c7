import subprocess
import sys
from pathlib import Path

import pytest

import depthpose
from depthpose import core


def modules_after(*statements: str) -> list[set[str]]:
    """What is loaded after each statement, of one process that runs them in turn."""
    code = "import sys\n" + "".join(f"{one}\nprint(*sys.modules)\n" for one in statements)
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return [set(line.split()) for line in answer.stdout.splitlines()]


def of(loaded: set[str], package: str) -> set[str]:
    return {name for name in loaded if name.startswith(f"depthpose.{package}")}


def test_core_imports_neither_depth_nor_pose_and_a_depth_command_no_pose() -> None:
    names = [
        path.stem
        for path in Path(str(core.__file__)).parent.iterdir()
        if path.suffix in ("", ".py")
    ]
    names = [name for name in names if name[0] != "_"]
    loaded, then = modules_after(
        "; ".join(f"import depthpose.core.{name}" for name in names),
        "import depthpose.cli.depth.commands, depthpose.cli.depth.predict",
    )
    assert not of(loaded, "depth")
    assert not of(loaded, "pose")
    assert "cv2" not in loaded
    assert "depthpose.depth.estimator" in then
    assert not of(then, "pose")


def test_importing_the_package_loads_nothing_heavy() -> None:
    (loaded,) = modules_after("import depthpose")
    assert not {"torch", "numpy", "tyro", "PIL", "ray"} & loaded


def test_the_command_line_loads_nothing_heavy() -> None:
    (loaded,) = modules_after(
        "import depthpose.cli.depth.commands, depthpose.cli.pose.commands, depthpose.cli.train"
    )
    assert not {"torch", "numpy", "PIL", "cv2", "ray", "fsspec"} & loaded


def test_a_pose_command_loads_no_depth_and_loading_weights_no_compiler() -> None:
    loaded, then = modules_after(
        "import depthpose.cli.pose.commands, depthpose.cli.pose.search, depthpose.cli.pose.track",
        "from depthpose import FakestereoNet, GeoPoseNet; FakestereoNet.load('default'); "
        "FakestereoNet.load('psmnet-compact'); GeoPoseNet.load('parts')",
    )
    assert "depthpose.pose.estimator" in loaded
    assert not of(loaded, "depth")
    assert "depthpose.pose.networks.resunet" in then
    assert not {"torch._dynamo", "torch._inductor", "sympy", "numba"} & then


def test_an_estimator_is_imported_when_asked_for() -> None:
    assert depthpose.FakestereoNet.__name__ == "FakestereoNet"


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Fakestereo'"):
        getattr(depthpose, "Fakestereo")  # noqa: B009


def test_the_public_names_are_listed() -> None:
    assert {"FakestereoNet", "GeoPoseNet", "pipeline"} <= set(dir(depthpose))
    assert "torch" not in modules_after("import depthpose; dir(depthpose)")[0]
