"""A module to an ONNX model by ``torch.export``; a graph and its proof written, or neither."""

import logging
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from depthpose.core.checkpoint import file_sha256
from depthpose.core.errors import InputError
from depthpose.core.export.graph import OPSET, Graph, import_export
from depthpose.core.export.proof import Case, Limit, Row, measure_differences, refuse_beyond
from depthpose.core.files import atomic_write, write_json
from depthpose.core.run import environment, refuse_to_replace


@dataclass(frozen=True, kw_only=True, eq=False)
class Export:
    """What is written, and what it is compared with.

    Attributes:
        graph: writes the graph.
        cases: makes the inputs and PyTorch's answers.
        limits: how far each output may be off.
        facts: for users of the file, in its metadata.
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
    """Give the path of a graph's proof; NAME.json may be a camera."""
    return path.with_suffix(".proof.json")


MOST = 1 << 10
"""Largest multiple of a side that is given to the exporter; the graph itself has no bound."""


def network_model(module: nn.Module, images: Sequence[Tensor], multiple: int) -> Any:  # noqa: ANN401
    """Turn a module of images into an ONNX model whose batch, rows and columns are free.

    Args:
        module: in eval mode; takes tensors (b, c, h, w) of one size.
        images: an example of each; more than one image, sides of more than one ``multiple``, so
            that no size of the example is taken for a law.
        multiple: both sides are multiples of it.
    """
    onnx = import_export()
    batch = torch.export.Dim("batch", min=1, max=MOST)
    rows, columns = (torch.export.Dim(name, min=1, max=MOST) for name in ("rows", "columns"))
    free = {0: batch, 2: multiple * rows, 3: multiple * columns}
    with _quiet(), torch.no_grad():
        program = torch.onnx.export(
            module,
            tuple(images),
            dynamo=True,
            opset_version=OPSET,
            dynamic_shapes=tuple(free for _ in images),
            verbose=False,
        )
    assert program is not None
    return _bare(onnx.inliner.inline_local_functions(program.model_proto))


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the exporter's internal messages; the proof decides."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def _bare(model: Any) -> Any:  # noqa: ANN401
    """Drop what identifies the exporting machine: stack traces, paths, names of lines."""
    for part in (*model.graph.node, *model.graph.initializer, *model.graph.input):
        del part.metadata_props[:]
        part.doc_string = ""
    del model.graph.value_info[:]
    return model
