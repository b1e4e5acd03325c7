import json
from pathlib import Path

import numpy as np
import pytest
import torch

from depthpose.core.errors import Notice
from depthpose.core.files import write_map
from depthpose.depth.datasets import open_dataset, project_lidar, read_lidar_depth
from depthpose.depth.datasets.frames import LidarDepth
from depthpose.depth.evaluate import evaluate

FRONT = np.array([[0.0, -10, 0, 0], [0, 0, -10, 0], [1, 0, 0, 0]])  # u = -10 y/x, v = -10 z/x


def literal(points: np.ndarray, P: np.ndarray, size: tuple[int, int], depth: str) -> np.ndarray:
    """The published procedure, word for word and point by point."""
    height, width = size
    canvas = np.zeros(size)
    kept: list[tuple[int, int, float]] = []
    for x, y, z, _ in points.astype(np.float64):
        if x < 0:
            continue
        a, b, c = P @ np.array([x, y, z, 1.0])
        if c == 0 or not np.isfinite([a / c, b / c]).all():
            continue
        u, v = np.round(a / c) - 1, np.round(b / c) - 1
        if 0 <= u < width and 0 <= v < height:
            kept.append((int(u), int(v), float(x if depth == "velodyne_x" else c)))
    for u, v, value in kept:
        canvas[v, u] = value
    shared = [v * (width - 1) + u - 1 for u, v, _ in kept]
    for index in {i for i in shared if shared.count(i) > 1}:
        group = [k for k, i in enumerate(shared) if i == index]
        u, v, _ = kept[group[0]]
        canvas[v, u] = min(kept[k][2] for k in group)
    canvas[canvas < 0] = 0
    return canvas.astype(np.float32)


def cloud(count: int, seed: int) -> np.ndarray:
    """Points that crowd a 5 x 4 image, its borders above all."""
    rng = np.random.default_rng(seed)
    x = rng.choice([1.0, 2.0, 3.0, -1.0, 0.0], count, p=[0.4, 0.3, 0.2, 0.05, 0.05])
    y, z = -rng.integers(0, 7, count) * x / 10, -rng.integers(0, 6, count) * x / 10
    return np.stack([x, y, z, np.zeros(count)], 1).astype(np.float32)


@pytest.mark.parametrize("depth", ["velodyne_x", "camera_z"])
@pytest.mark.parametrize("seed", range(8))
def test_a_scan_is_drawn_as_the_published_script_does(seed: int, depth: LidarDepth) -> None:
    points = cloud(60, seed)
    expected = literal(points, FRONT, (4, 5), depth)
    drawn = project_lidar(torch.from_numpy(points), FRONT, (4, 5), depth).nan_to_num(0.0)
    assert np.array_equal(drawn.numpy(), expected)


def test_the_index_that_is_not_one_to_one_is_reproduced() -> None:
    # (v 0, u 4) and (v 1, u 0) share the index of the published script: the first takes the
    # smaller depth of the two, the second keeps its own.
    points = torch.tensor([[9.0, -4.5, -0.9, 0], [2.0, -0.2, -0.4, 0]])
    drawn = project_lidar(points, FRONT, (4, 5), "velodyne_x")
    assert drawn[0, 4].item() == 2.0
    assert drawn[1, 0].item() == 2.0


def test_an_empty_scan_draws_nothing() -> None:
    drawn = project_lidar(torch.zeros(0, 4), FRONT, (4, 5), "velodyne_x")
    assert bool(torch.isnan(drawn).all())


@pytest.mark.data
@pytest.mark.parametrize(
    ("depth", "keys"),
    [("velodyne_x", ("v", "u", "depth_x_m")), ("camera_z", ("v_z", "u_z", "depth_z_m"))],
)
def test_every_reference_frame_is_equal_to_the_bit(
    real: Path, depth: LidarDepth, keys: tuple[str, str, str]
) -> None:
    frames = {frame.name: frame for frame in open_dataset(real / "depth/kitti_raw").frames}
    references = sorted((real / "reference/eigen_raw").glob("*.npz"))
    assert len(references) == 10
    for path in references:
        reference = np.load(path)
        expected = np.full(tuple(reference["shape"]), np.nan, np.float32)
        expected[reference[keys[0]], reference[keys[1]]] = reference[keys[2]]
        drawn = read_lidar_depth(frames[path.stem], depth)
        assert drawn.dtype == torch.float32
        assert np.array_equal(drawn.numpy(), expected, equal_nan=True), path.stem


@pytest.mark.data
def test_the_reference_metrics_are_reproduced(real: Path, tmp_path: Path) -> None:
    dataset = open_dataset(real / "depth/kitti_raw")
    rows = json.loads((real / "reference/eigen_raw/metrics.json").read_text())
    for row in rows:
        reference_px = _reference_prediction(row["k"])
        write_map(tmp_path / f"{row['drive']}_{row['frame']}.disparity_px.npy", reference_px)
    with pytest.warns(Notice, match="of another aspect"):
        result = evaluate(dataset, tmp_path, "eigen-raw", caps_m=(80.0, 50.0))
    ours = {(row.frame, row.cap_m): row for row in result.per_frame}
    assert len(rows) == len(ours) == 20
    for row in rows:
        own = ours[f"{row['drive']}_{row['frame']}", float(row["cap"])]
        assert own.pixels == row["pixels"]
        names = ("abs_rel", "sq_rel", "rmse", "rmse_log", "d1", "d2", "d3")
        assert [own.metrics[n] for n in names] == pytest.approx([row[n] for n in names], rel=1e-6)
    assert all("no truth of the kind velodyne_x" in why for why in result.skipped.values())
    assert len(result.skipped) == 8


def _reference_prediction(k: int) -> torch.Tensor:
    """The reference's invented disparity, in pixels of its own width."""
    v, u = np.meshgrid(np.linspace(0, 1, 256), np.linspace(0, 1, 512), indexing="ij")
    share = 0.004 + 0.07 * np.maximum(v - 0.42, 0) + 0.002 * (1 + np.sin(9 * u + k)) * v
    return torch.from_numpy(share.astype(np.float32)) * 512
