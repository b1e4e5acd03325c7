"""Write a graph and its proof, or neither."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from depthpose.core.checkpoint import file_sha256
from depthpose.core.errors import InputError
from depthpose.core.export.extra import import_export
from depthpose.core.export.graph import OPSET, Graph
from depthpose.core.export.proof import Case, Limit, Row, measure_differences, refuse_beyond
from depthpose.core.files import atomic_write, write_json
from depthpose.core.run import environment, refuse_to_replace


@dataclass(frozen=True, kw_only=True, eq=False)
class Export:
    """What becomes a file, and what holds it to account.

    Attributes:
        graph: writes the graph.
        cases: makes the inputs and PyTorch's answers.
        limits: how far each output may be off.
        facts: what a user of the file must know; they stand in its metadata.
    """

    graph: Callable[[], Graph]
    cases: Callable[[], Iterable[Case]]
    limits: Mapping[str, Limit]
    facts: Mapping[str, Any]


def freeze(path: Path, export: Export) -> list[Row]:
    """Write ``NAME.onnx``, once it agrees with PyTorch, and ``NAME.proof.json`` beside it.

    Returns:
        The differences, a row for each input and output.

    Raises:
        InputError: another suffix, a file that is there already, a place that cannot be written,
            or answers that differ.
        MissingExtraError: the extra ``export`` is not installed.
    """
    if path.suffix != ".onnx":
        raise InputError(f"{path}: the graph is written as ONNX; end the name in .onnx.")
    for file in (path, proof_path(path)):
        refuse_to_replace(file)
    onnx = import_export()
    with atomic_write(path) as part:
        part.touch()  # a place that cannot be written is refused before the work
        facts = {**export.facts, "depthpose": version("depthpose")}
        onnx.save(export.graph().model(facts), str(part))
        rows = measure_differences(part, export.cases(), export.limits)
        refuse_beyond(rows)
        runtimes = {name: version(name) for name in ("onnx", "onnxscript", "onnxruntime")}
        record = {
            "file": path.name,
            "sha256": file_sha256(part),
            "opset": OPSET,
            "environment": environment() | runtimes,
            "facts": facts,
            "differences": rows,
        }
        write_json(proof_path(path), record)
    return rows


def proof_path(path: Path) -> Path:
    """Give the place of a graph's proof; NAME.json may be somebody's camera."""
    return path.with_suffix(".proof.json")
