import atexit
import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import tests.typecheck  # noqa: F401  # loaded, since `make test TYPES=1` names it
import torch
from filelock import FileLock  # torch brings it
from hypothesis import settings


@pytest.fixture(scope="session")
def real() -> Path:
    """Folder of the real samples."""
    folder = os.environ.get("DEPTHPOSE_DATA")
    if not folder:
        pytest.skip("DEPTHPOSE_DATA names no folder of real samples")
    return Path(folder)


@pytest.fixture(scope="session")
def after_demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which ``depthpose demo`` has run: once for all processes, a copy for each."""
    from depthpose.cli import main

    folder = tmp_path_factory.mktemp("demo")
    home = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        home = home.parent
    with FileLock(home / "demo.lock"):
        made = home / "demo-made"
        if not (made / "out/demo/report.html").is_file():
            made.mkdir(exist_ok=True)
            with contextlib.chdir(made):
                assert main(["demo"]) == 0
    shutil.copytree(made, folder, dirs_exist_ok=True)
    return folder


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of an untrained Geo-PoseNet for the objects of the synthetic frames."""
    from tests.pose.synthetic_frames import frame_models
    from tests.pose.synthetic_objects import tiny_weights

    from depthpose.pose.weights import write_pose_weights

    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    write_pose_weights(path, tiny_weights(*frame_models()))
    return path


def _content(value: object) -> object:
    """What equals that of another value where both hold the same, tensors included."""
    if isinstance(value, torch.Tensor):
        return str(value.dtype), tuple(value.shape), value.contiguous().numpy().tobytes()
    if is_dataclass(value):
        return tuple(_content(getattr(value, field.name)) for field in fields(value))
    return tuple(map(_content, value)) if isinstance(value, list | tuple) else value


@pytest.fixture(scope="session", autouse=True)
def prepared_once() -> Iterator[None]:
    """What an estimator computes of a shape, and Git's answer, is computed once a process."""
    from depthpose.core import environment
    from depthpose.pose.verify import target_object

    made: dict[object, Any] = {}

    def once(compute: Callable[..., Any], key_of: Callable[..., object]) -> Callable[..., Any]:
        def give(*given: Any) -> Any:  # noqa: ANN401
            key = key_of(*given)
            if key not in made:
                made[key] = compute(*given), given  # kept, so that no other has their identity
            return made[key][0]

        return give

    with pytest.MonkeyPatch.context() as patch:
        surface = once(target_object.prepare_surface, lambda *given: _content(given))
        patch.setattr(target_object, "prepare_surface", surface)
        patch.setattr(target_object, "prepare_pairs", once(target_object.prepare_pairs, id))
        patch.setattr(environment, "_read_commit", cache(environment._read_commit))
        yield


# How long an example takes is the machine's, not the code's.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")

# Nothing of a test stays in the user's cache, nor comes from there. Processes of one run share what
# is computed of a model once: they inherit the folder of the one that starts them.
if "PYTEST_XDIST_WORKER" not in os.environ:
    os.environ["DEPTHPOSE_CACHE"] = tempfile.mkdtemp(prefix="depthpose-cache-")
    atexit.register(shutil.rmtree, os.environ["DEPTHPOSE_CACHE"], ignore_errors=True)

# One thread each, as 'make test' has it: sums of several threads are added in another order, and a
# short training may then end elsewhere. Programs that a test starts inherit it.
os.environ.setdefault("OMP_NUM_THREADS", "1")
torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
