"""Each kind of extension is one function and one entry of a registry, and is used from there."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.pose.made_object import bracket

from depthpose.cli import main
from depthpose.cli.pose.engine import cloud_files
from depthpose.cli.pose.inputs import cloud_jobs
from depthpose.core.files import Cloud, cloud_suffixes, read_cloud
from depthpose.core.files.cloud import CLOUD_READERS
from depthpose.core.files.disk import AnyPath
from depthpose.pose.mesh import mesh_suffixes, read_model
from depthpose.web.answer import KINDS


def read_json_points(path: AnyPath) -> Cloud:
    """A format of our own: a JSON list of points."""
    return Cloud(points=torch.tensor(json.loads(Path(path).read_text())))


def test_extending_clouds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(CLOUD_READERS, ".points", read_json_points)
    points = bracket().vertices_m + torch.tensor([0.0, 0.0, 0.5])
    path = tmp_path / "part.points"
    path.write_text(json.dumps(points.tolist()))
    # Read by its suffix, found in a folder, by an engine, by doctor, and as a model to train on.
    assert torch.equal(read_cloud(path).points, points)
    (job,) = cloud_jobs(tmp_path, "m", "bracket", tmp_path.parent / "out")
    assert torch.equal(job.read().points_m, points)
    assert ".points" in cloud_files().suffixes
    assert main(["doctor", str(path)]) in (0, 1)
    assert f"{len(points)} points" in capsys.readouterr().out
    assert np.allclose(read_model(path, "m").vertices_m, points)


def test_the_page_takes_every_cloud_and_mesh() -> None:
    assert KINDS["cloud"][1] == cloud_suffixes()
    assert KINDS["cad"][1] == mesh_suffixes()
