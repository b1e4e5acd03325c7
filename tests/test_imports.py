import subprocess
import sys
from pathlib import Path

import pytest

import depthpose
from depthpose import core


def modules_after(statement: str) -> set[str]:
    code = f"{statement}; import sys; print(*sys.modules)"
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return set(answer.stdout.split())


def test_core_imports_neither_depth_nor_pose() -> None:
    names = [
        path.stem
        for path in Path(str(core.__file__)).parent.iterdir()
        if path.suffix in ("", ".py")
    ]
    names = [name for name in names if name[0] != "_"]
    loaded = modules_after("; ".join(f"import depthpose.core.{name}" for name in names))
    assert not {name for name in loaded if name.startswith(("depthpose.depth", "depthpose.pose"))}
    assert "cv2" not in loaded


def test_importing_the_package_loads_nothing_heavy() -> None:
    assert not {"torch", "numpy", "tyro", "PIL", "ray"} & modules_after("import depthpose")


def test_the_command_line_loads_nothing_heavy() -> None:
    assert not {"torch", "numpy", "PIL", "cv2", "ray", "fsspec"} & modules_after(
        "import depthpose.cli.depth, depthpose.cli.pose, depthpose.cli.train"
    )


def test_a_command_loads_its_own_networks_alone() -> None:
    loaded = modules_after("import depthpose.cli.depth, depthpose.cli.depth_predict")
    assert "depthpose.depth.estimator" in loaded
    assert not {name for name in loaded if name.startswith("depthpose.pose")}
    loaded = modules_after("import depthpose.cli.pose, depthpose.cli.pose_frames")
    assert "depthpose.pose.estimator" in loaded
    assert not {name for name in loaded if name.startswith("depthpose.depth")}


def test_loading_weights_imports_no_compiler() -> None:
    loaded = modules_after(
        "from depthpose import FakestereoNet, GeoPoseNet; FakestereoNet.load('default'); "
        "FakestereoNet.load('psmnet-compact'); GeoPoseNet.load('parts')"
    )
    assert "depthpose.pose.network" in loaded
    assert not {"torch._dynamo", "torch._inductor", "sympy", "numba"} & loaded


def test_an_estimator_is_imported_when_asked_for() -> None:
    assert depthpose.FakestereoNet.__name__ == "FakestereoNet"


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Fakestereo'"):
        getattr(depthpose, "Fakestereo")  # noqa: B009


def test_the_public_names_are_listed() -> None:
    assert {"FakestereoNet", "GeoPoseNet", "pipeline"} <= set(dir(depthpose))
    assert "torch" not in modules_after("import depthpose; dir(depthpose)")
