import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from depthpose.core.checkpoint import file_sha256
from depthpose.core.errors import InputError, MissingExtraError
from depthpose.core.export import Case, Export, Graph, Limit, convert_network, write_export

onnxruntime = pytest.importorskip("onnxruntime")
X = np.array([[1, 2, 3], [4, 5, 6]], np.float32)


def line_graph() -> Graph:
    """``2 x + 1``, and the columns of ``x`` but the last."""
    graph = Graph()
    x = graph.input("x", np.float32, ("n", 3))
    graph.output("y", x * np.float32(2) + np.float32(1), np.float32, ("n", 3))
    graph.output("left", x.slice([0], [-1], [1]), np.float32, ("n", 2))
    return graph


def line_export(
    y: np.ndarray = 2 * X + 1,
    graph: Callable[[], Graph] = line_graph,
    **limit: Any,  # noqa: ANN401
) -> Export:
    case = Case(name="2x3", inputs={"x": X}, expected={"y": y, "left": X[:, :2]})
    limits = {"y": Limit(value=1e-6, **limit), "left": Limit(value=0.0)}
    facts = {"licence": "MIT", "objects": ["cup"]}
    return Export(graph=graph, cases=lambda: [case], limits=limits, facts=facts)


def test_a_proven_file_runs_and_says_what_it_is(tmp_path: Path) -> None:
    path = tmp_path / "new" / "line.onnx"
    rows = write_export(path, line_export())
    assert [row["largest difference"] for row in rows] == [0.0, 0.0]
    session = onnxruntime.InferenceSession(str(path))
    assert np.array_equal(session.run(["y"], {"x": X[:1]})[0], [[3, 5, 7]])
    facts = session.get_modelmeta().custom_metadata_map
    assert facts["licence"] == "MIT"
    assert json.loads(facts["objects"]) == ["cup"]
    record = json.loads(path.with_suffix(".proof.json").read_text())
    assert record["sha256"] == file_sha256(path)
    assert record["differences"] == rows
    assert {"torch", "onnx", "onnxruntime", "onnxscript"} <= record["environment"].keys()


@pytest.mark.parametrize(
    ("y", "limit", "message"),
    [
        (
            2 * X + 1.5,
            {},
            r"y of 2x3: PyTorch and onnxruntime differ by 0.5 \(largest\), the limit",
        ),
        (2 * X + 1.5, {"of": "mean"}, r"differ by 0.5 \(mean\)"),
        ((2 * X + 1) / 2, {"is_relative": True}, r"differ by 1 \(largest\)"),
        (
            np.where(X > 5, np.nan, 2 * X + 1),
            {},
            r"answers \(2, 3\) with 0 NaN, PyTorch .* with 1;",
        ),
        (X[:1], {}, r"answers \(2, 3\) .* PyTorch \(1, 3\)"),
    ],
)
def test_answers_that_differ_are_not_written(
    y: np.ndarray, limit: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        write_export(tmp_path / "line.onnx", line_export(y, **limit))
    assert list(tmp_path.iterdir()) == []


def test_one_large_difference_is_compared_by_its_kind(tmp_path: Path) -> None:
    y = 2 * X + 1
    y[0, 0] += 3e-6
    with pytest.raises(InputError, match="differ by"):
        write_export(tmp_path / "line.onnx", line_export(y))
    rows = write_export(tmp_path / "line.onnx", line_export(y, of="mean"))
    assert 0 < float(rows[0]["mean difference"]) < 1e-6


@pytest.mark.parametrize("wrong", [np.nan, 9.0])
def test_a_share_may_flip_and_is_said(wrong: float, tmp_path: Path) -> None:
    """One of six numbers is far off, or NaN in one answer alone: a sixth may, a tenth may not."""
    y = 2 * X + 1
    y[0, 0] = wrong
    rows = write_export(tmp_path / "line.onnx", line_export(y, flips=0.2))
    assert rows[0]["flipped"] == pytest.approx(1 / 6)
    assert rows[0]["largest difference"] == 0.0
    assert "flipped" not in rows[1]
    with pytest.raises(InputError, match=r"by more than 1e-06 on 16\.667% .* 10\.000% may"):
        write_export(tmp_path / "other.onnx", line_export(y, flips=0.1))
    with pytest.raises(InputError, match=r"on 100\.000% of the numbers"):
        write_export(tmp_path / "other.onnx", line_export(np.full_like(X, np.nan), flips=0.9))
    assert not (tmp_path / "other.onnx").exists()


def test_an_interrupt_leaves_no_half_file(tmp_path: Path) -> None:
    path = tmp_path / "line.onnx"

    def stopped() -> Graph:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_export(path, line_export(graph=stopped))
    assert not list(tmp_path.iterdir())


def test_an_older_file_is_not_written_over(tmp_path: Path) -> None:
    path = tmp_path / "line.onnx"
    path.write_bytes(b"old")
    with pytest.raises(InputError, match=r"line\.onnx: is there already"):
        write_export(path, line_export(graph=never))
    assert path.read_bytes() == b"old"


def never() -> Graph:
    raise AssertionError("the work began")


def test_a_place_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is a file, but a folder is needed"):
        write_export(tmp_path / "file" / "line.onnx", line_export(graph=never))
    (tmp_path / "folder.onnx").mkdir()
    with pytest.raises(InputError, match="is there already"):
        write_export(tmp_path / "folder.onnx", line_export(graph=never))
    with pytest.raises(InputError, match=r"line\.pt: the graph is written as ONNX; end the name"):
        write_export(tmp_path / "line.pt", line_export(graph=never))


@pytest.mark.parametrize("package", ["onnx", "onnxscript", "onnxruntime"])
def test_a_missing_extra_is_named(
    package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=r"pip install -e '.\[export\]'"):
        write_export(tmp_path / "line.onnx", line_export(graph=never))
    assert list(tmp_path.iterdir()) == []


def test_a_network_keeps_its_sizes_free_and_its_maker_to_itself() -> None:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Conv2d(1, 2, 3, 2, 1), nn.ReLU(), nn.Conv2d(2, 1, 3, 1, 1)).eval()
    graph = Graph()
    x = graph.input("x", np.float32, ("n", 1, "h", "w"))
    # Twice, one after the other: names of two networks do not meet.
    model = convert_network(network, [torch.rand(2, 1, 16, 24)], 4)
    (once,) = graph.call(model, x)
    (twice,) = graph.call(model, once)
    graph.output("y", twice, np.float32, ("n", 1, "h4", "w4"))
    written = graph.model({}).SerializeToString()
    assert b".py" not in written
    session = onnxruntime.InferenceSession(written)
    for shape in ((1, 1, 8, 8), (3, 1, 32, 8)):
        image = torch.rand(shape)
        answer = session.run(None, {"x": image.numpy()})[0]
        with torch.no_grad():
            expected = network(network(image))
        torch.testing.assert_close(torch.from_numpy(answer), expected, rtol=0, atol=1e-6)


def test_a_camera_of_the_same_name_stays(tmp_path: Path) -> None:
    (tmp_path / "line.json").write_text("my camera")
    write_export(tmp_path / "line.onnx", line_export())
    assert (tmp_path / "line.json").read_text() == "my camera"
    assert (tmp_path / "line.proof.json").is_file()


@pytest.mark.parametrize(
    ("cases", "message"),
    [
        ([], r"no output is compared with PyTorch's; nothing is written\. Name a case\."),
        (
            [Case(name="2x3", inputs={"x": X}, expected={"y": 2 * X + 1}, where={"y": X > 9})],
            r"y of 2x3: PyTorch gives not one number that could be compared, .* nothing is written",
        ),
        (
            [Case(name="2x3", inputs={"x": np.full_like(X, np.nan)},
                  expected={"y": np.full_like(X, np.nan)})],
            r"y of 2x3: PyTorch gives not one number",
        ),
    ],
)  # fmt: skip
def test_what_nothing_is_compared_with_is_not_proven(
    cases: list[Case], message: str, tmp_path: Path
) -> None:
    limits = {"y": Limit(value=0.0)}
    export = Export(graph=line_graph, cases=lambda: cases, limits=limits, facts={})
    with pytest.raises(InputError, match=message):
        write_export(tmp_path / "line.onnx", export)
    assert list(tmp_path.iterdir()) == []


def test_only_the_part_that_is_named_is_compared(tmp_path: Path) -> None:
    y = 2 * X + 1
    y[0, 0] = np.nan
    case = Case(name="2x3", inputs={"x": X}, expected={"y": y}, where={"y": ~np.isnan(y)})
    export = Export(
        graph=line_graph, cases=lambda: [case], limits={"y": Limit(value=0.0)}, facts={}
    )
    assert write_export(tmp_path / "line.onnx", export)[0]["largest difference"] == 0
