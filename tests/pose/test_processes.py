"""An estimator that was used is sent to other processes, however these are started."""

import os
import subprocess
import sys
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

import numpy as np
import pytest
import torch

from depthpose import Registration
from depthpose.pose.geometry.surface import prepare_surface
from depthpose.pose.synthetic import make_part

# In a process of its own: an array that points at freed memory kills whoever reads it. The worker
# is killed too, and a pool waits for its answer without end.
_PROGRAM = """
import multiprocessing
from tests.pose.test_processes import answer, used_registration
if __name__ == "__main__":
    part, cloud, before = used_registration()
    for start in multiprocessing.get_all_start_methods():
        with multiprocessing.get_context(start).Pool(1) as pool:
            assert pool.apply_async(answer, (part, cloud)).get(180) == before, start
        assert answer(part, cloud) == before, start
"""


def answer(part: Registration, cloud: torch.Tensor) -> list[list[float]]:
    """Estimate a pose, as text holds it."""
    found = part.estimate(cloud=cloud)
    assert found.camera_from_model is not None
    return found.camera_from_model.matrix().tolist()


def used_registration() -> tuple[Registration, torch.Tensor, list[list[float]]]:
    """Give an estimator after its first answer, the cloud and the answer."""
    model = make_part("connector")
    part = Registration([model])
    surface = prepare_surface(model)
    seen = surface.points_m[(surface.outward @ torch.tensor([0.3, 0.4, -0.87]).double()) > 0.2]
    cloud = seen[::4] + torch.tensor([0.0, 0.0, 0.5]).double()
    return part, cloud, answer(part, cloud)


@pytest.mark.slow
def test_a_used_estimator_answers_in_a_worker_and_afterwards(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(_PROGRAM)
    root = str(Path(__file__).parents[2])
    paths = os.pathsep.join(path for path in (root, os.environ.get("PYTHONPATH")) if path)
    done = subprocess.run(
        [sys.executable, str(program)], capture_output=True, text=True, timeout=600, check=False,
        env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_no_array_stands_on_memory_that_sending_a_surface_frees() -> None:
    surface = prepare_surface(make_part("connector"))
    before = surface.sample_tree
    arrays = [before.low, before.counts, before.ball, before.normals, before.tree.points]
    values = [array.copy() for array in arrays]
    tensors = [surface.boxes.low_m, surface.boxes.counts, surface.ball_m, surface.points_m]
    for tensor in tensors:
        assert not any(np.shares_memory(tensor.numpy(), array) for array in arrays)
    ForkingPickler.dumps(surface)
    assert all(np.array_equal(a, b) for a, b in zip(arrays, values, strict=True))
