"""Each kind of extension is one function and one entry of a registry, and is used from there."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.pose.synthetic_frames import make_dataset, moved, predictions_of
from tests.pose.synthetic_objects import bracket
from torch.nn.functional import huber_loss

from depthpose.cli import main
from depthpose.cli.pose.file_jobs import make_cloud_jobs
from depthpose.core.config import config_from_dict
from depthpose.core.errors import InputError
from depthpose.core.files import CLOUD_READERS, PointCloud, read_cloud
from depthpose.core.files.disk import AnyPath
from depthpose.core.rigid import Rigid
from depthpose.pose.datasets import LAYOUTS, Instance, Layout, open_bop
from depthpose.pose.datasets.layouts import read_bop_instances
from depthpose.pose.evaluate import METRICS, Metric
from depthpose.pose.evaluate.errors import ErrorContext
from depthpose.pose.losses import POINT_LOSSES, direction_loss
from depthpose.pose.mesh import MESH_READERS, read_model
from depthpose.pose.predictions import write_bop_results
from depthpose.pose.train import PoseTraining
from depthpose.web.answer import FILE_FIELDS


def read_json_points(path: AnyPath) -> PointCloud:
    """A format of our own: a JSON list of points."""
    return PointCloud(points=torch.tensor(json.loads(Path(path).read_text())))


def test_extending_clouds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(CLOUD_READERS, ".points", read_json_points)
    points = bracket().vertices_m + torch.tensor([0.0, 0.0, 0.5])
    path = tmp_path / "part.points"
    path.write_text(json.dumps(points.tolist()))
    # Read by its suffix, found in a folder, by an engine, by doctor, and as a model to train on.
    assert torch.equal(read_cloud(path).points, points)
    (job,) = make_cloud_jobs(tmp_path, "m", "bracket", tmp_path.parent / "out")
    assert torch.equal(job.read().points_m, points)
    assert ".points" in CLOUD_READERS
    assert main(["doctor", str(path)]) in (0, 1)
    assert f"{len(points)} points" in capsys.readouterr().out
    assert np.allclose(read_model(path, "m").vertices_m, points)


def read_json_mesh(path: AnyPath) -> tuple[np.ndarray, np.ndarray]:
    """A format of our own: points and faces in JSON."""
    read = json.loads(Path(path).read_text())
    return np.array(read["points"], dtype=np.float64), np.array(read["faces"], dtype=np.int64)


def test_extending_meshes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, path = bracket(), tmp_path / "part.corners"
    mesh = {"points": model.vertices_m.tolist(), "faces": model.faces.tolist()}
    path.write_text(json.dumps(mesh))
    with pytest.raises(InputError, match=r"\.corners is no model format"):
        read_model(path, "m")
    monkeypatch.setitem(MESH_READERS, ".corners", read_json_mesh)
    read = read_model(path, "m")
    assert read.diameter_m == pytest.approx(model.diameter_m)
    assert len(read.faces) == len(model.faces)


def test_extending_layouts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A layout of our own: BOP's, with the scenes of each split in a folder ``scenes``."""

    def splits(folder: Path) -> list[str]:
        return sorted(path.parent.name for path in folder.glob("*/scenes"))

    def instances(folder: Path, split: str) -> Iterator[Instance]:
        for scene in sorted((folder / split / "scenes").iterdir()):
            yield from read_bop_instances(scene)

    known = make_dataset(tmp_path / "own", frames=1)
    (tmp_path / "own/test").rename(tmp_path / "scenes")
    (tmp_path / "own/test").mkdir()
    (tmp_path / "scenes").rename(tmp_path / "own/test/scenes")
    assert not any(layout.splits(tmp_path / "own") for layout in LAYOUTS.values())
    monkeypatch.setitem(LAYOUTS, "own", Layout(splits=splits, instances=instances))
    dataset = open_bop(tmp_path / "own")
    assert (dataset.layout, len(dataset)) == ("own", len(known))
    assert torch.equal(dataset[0].truth.camera_from_model.R, known.instances[0].camera_from_model.R)
    # The commands take it: the check of a folder names it.
    assert main(["data", "check", str(tmp_path / "own")]) == 0
    assert "own: 1 images, 2 instances" in capsys.readouterr().out


def add_median(estimated: Rigid, instance: Instance, context: ErrorContext) -> float:
    """A metric of our own: the median distance of a model point [m]."""
    points_m = context.model.vertices_m.double()
    true = instance.camera_from_model
    gaps_m = (estimated.apply(points_m) - true.apply(points_m)).norm(dim=-1)
    return float(gaps_m.median())


def test_extending_metrics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    summaries = {"near_5_mm": lambda errors, _: float((errors < 0.005).double().mean())}
    metric = Metric(measure=add_median, summaries=summaries, has_median=True)
    monkeypatch.setitem(METRICS, "add_median_m", metric)
    dataset = make_dataset(tmp_path / "set", frames=2)
    shifted = predictions_of(dataset, lambda i: moved(i, [0.0] * 5 + [0.002 + 0.004 * i.image_id]))
    write_bop_results(tmp_path / "own_set-test.csv", shifted)
    words = ["--bop", str(tmp_path / "set"), "--csv", str(tmp_path / "own_set-test.csv")]
    assert main(["pose", "evaluate", *words, "--out", str(tmp_path / "out")]) == 0
    instances = json.loads((tmp_path / "out/instances.json").read_text())
    medians = [row["add_median_m"] for row in instances]
    assert medians == pytest.approx([0.002, 0.002, 0.006, 0.006], rel=1e-4)
    rows = json.loads((tmp_path / "out/rows.json").read_text())
    assert [row["near_5_mm"] for row in rows] == [0.5] * 4
    assert rows[-1]["add_median_m_median"] == pytest.approx(0.004, rel=1e-4)
    assert "near_5_mm" in (tmp_path / "out/table.md").read_text()
    assert "near_5_mm" in (tmp_path / "out/report.html").read_text().replace("<wbr>", "")


def test_extending_losses(monkeypatch: pytest.MonkeyPatch) -> None:
    def huber(found: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
        return huber_loss(found, truth, reduction="none").mean((-2, -1))

    with pytest.raises(InputError, match="loss"):
        PoseTraining(loss="huber")
    monkeypatch.setitem(POINT_LOSSES, "huber", huber)
    assert config_from_dict({"loss": "huber"}, PoseTraining, source="own.yaml").loss == "huber"
    found, points = torch.tensor([[[0.0, 3.0, 0.0]]]), torch.zeros(1, 3)
    copies = torch.tensor([[[[0.0, 1.0, 0.0]]]])
    loss = direction_loss(found, points, copies, torch.tensor([0]), "huber")
    assert float(loss) == pytest.approx((2 - 0.5) / 3)


def test_the_page_takes_every_cloud_and_mesh() -> None:
    assert FILE_FIELDS["cloud"][1] == tuple(CLOUD_READERS)
    assert FILE_FIELDS["cad"][1] == tuple(MESH_READERS)
