"""A network to an ONNX file that runs without torch, and the proof that both answer alike.

Operators are those of opset 18 (https://onnx.ai/onnx/operators), the first whose Resize averages
where it shrinks. The proof: largest and mean difference to PyTorch's answers, and their limit.
"""

import json
import logging
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial, partialmethod
from importlib import import_module
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from depthpose.core.checkpoint import file_sha256
from depthpose.core.errors import InputError, import_extra
from depthpose.core.files import atomic_write, write_json
from depthpose.core.run import environment, refuse_to_replace

OPSET = 18
Shape = Sequence[int | str]  # text names a side that is known only when the graph runs


def import_export() -> Any:  # noqa: ANN401  what protobuf generates carries no types
    """Import ONNX, and check that the packages that it needs are installed."""
    parts = ("onnx.compose", "onnx.inliner", "onnx.numpy_helper", "onnxscript", "onnxruntime")
    for name in ("onnx", *parts):
        import_extra(name, "onnx, onnxruntime and onnxscript", "export", "export")
    return import_module("onnx")


@dataclass(frozen=True, eq=False)
class Value:
    """A tensor of a graph; arithmetic on it adds nodes."""

    graph: "Graph"
    name: str

    def op(self, kind: str, *others: Any, **attributes: Any) -> "Value":  # noqa: ANN401
        """Feed it to an operator, first of its inputs."""
        return self.graph.op(kind, self, *others, **attributes)

    def cast(self, dtype: type) -> "Value":
        """Give the same numbers in another type."""
        return self.op("Cast", to=self.graph.onnx.helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))

    slice = partialmethod(op, "Slice")  # starts, ends, axes: lists, or values of int64
    __add__ = partialmethod(op, "Add")
    __sub__ = partialmethod(op, "Sub")
    __mul__ = partialmethod(op, "Mul")
    __truediv__ = partialmethod(op, "Div")
    __mod__ = partialmethod(op, "Mod")


@dataclass(kw_only=True, eq=False)
class Graph:
    """Nodes in the order in which they are written.

    Inputs of an operator are values, arrays, or numbers: an int becomes int64, a float float64.
    """

    onnx: Any = field(default_factory=import_export)
    nodes: list[Any] = field(default_factory=list)
    constants: list[Any] = field(default_factory=list)
    inputs: list[Any] = field(default_factory=list)
    outputs: list[Any] = field(default_factory=list)
    names: Iterator[int] = field(default_factory=partial(count, 1))

    def input(self, name: str, dtype: type, shape: Shape) -> Value:
        """Add an input of the graph."""
        helper = self.onnx.helper
        kind = helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
        self.inputs.append(helper.make_tensor_value_info(name, kind, list(shape)))
        return Value(self, name)

    def output(self, name: str, value: Value, dtype: type, shape: Shape) -> None:
        """Make a value an output of the graph."""
        helper = self.onnx.helper
        kind = helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
        self.nodes.append(helper.make_node("Identity", [value.name], [name]))
        self.outputs.append(helper.make_tensor_value_info(name, kind, list(shape)))

    def op(self, kind: str, *inputs: Any, **attributes: Any) -> Value:  # noqa: ANN401
        """Add an operator and give its first output; None leaves an optional input out."""
        out = f"{kind}_{next(self.names)}"
        names: list[str] = []
        for value in inputs:
            if value is None or isinstance(value, Value):
                names.append("" if value is None else value.name)
                continue
            names.append(f"constant_{next(self.names)}")
            tensor = self.onnx.numpy_helper.from_array(np.asarray(value), names[-1])
            self.constants.append(tensor)
        self.nodes.append(self.onnx.helper.make_node(kind, names, [out], **attributes))
        return Value(self, out)

    def call(self, network: Any, *inputs: Value) -> tuple[Value, ...]:  # noqa: ANN401
        """Put a whole model's nodes here and give its outputs."""
        prefix = f"network_{next(self.names)}/"
        inner = self.onnx.compose.add_prefix(network, prefix).graph
        for value, wanted in zip(inputs, inner.input, strict=True):
            node = self.onnx.helper.make_node("Identity", [value.name], [wanted.name])
            self.nodes.append(node)
        self.nodes += inner.node
        self.constants += inner.initializer
        return tuple(Value(self, output.name) for output in inner.output)

    def model(self, facts: Mapping[str, Any]) -> Any:  # noqa: ANN401
        """Close the graph."""
        helper = self.onnx.helper
        graph = helper.make_graph(
            self.nodes, "depthpose", self.inputs, self.outputs, self.constants
        )
        opsets = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=opsets, producer_name="depthpose")
        model.ir_version = 10  # of onnx 1.16: younger ones would shut out older runtimes
        texts = {k: v if isinstance(v, str) else json.dumps(v) for k, v in facts.items()}
        helper.set_model_props(model, texts)
        self.onnx.checker.check_model(model, full_check=True)
        return model


Row = dict[str, str | float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """One input and what PyTorch answers, by the names of the graph's inputs and outputs."""

    name: str  # its size, for the table
    inputs: Mapping[str, np.ndarray]
    expected: Mapping[str, np.ndarray]  # what is not named is not compared
    where: Mapping[str, np.ndarray] = field(default_factory=dict)  # the part that is, if not all


@dataclass(frozen=True, kw_only=True)
class Limit:
    """How far an output may be off.

    ``flips`` may be off by more, or be NaN in one answer alone, where a decision is at its limit;
    they are left out of the differences.
    """

    value: float  #: the limit, in the output's unit
    of: Literal["largest", "mean"] = "largest"  #: mean where the output is discontinuous
    is_relative: bool = False  #: differences are shares of what PyTorch answers
    flips: float = 0.0  #: share of the numbers that may be off by more


def _row(
    case: str, output: str, output_values: np.ndarray, expected: np.ndarray, limit: Limit
) -> Row:
    """Compare an output of the graph with that of PyTorch; give the row that proves they agree.

    NaN must be in the same places. Of an output that may flip (a discrete choice on a rounding), a
    share of ``limit.flips`` may differ by more than ``limit.value``.

    Raises:
        InputError: they do not agree, or there is nothing to compare.
    """
    output_values, expected = (
        np.asarray(values, np.float64) for values in (output_values, expected)
    )
    is_nan = np.isnan(output_values), np.isnan(expected)
    is_other = output_values.shape != expected.shape
    if is_other or ((is_nan[0] != is_nan[1]).any() and not limit.flips):
        raise InputError(
            f"{output} of {case}: onnxruntime answers {output_values.shape} with "
            f"{is_nan[0].sum()} NaN, PyTorch {expected.shape} with "
            f"{is_nan[1].sum()}; nothing is written."
        )
    difference = np.abs(output_values - expected)
    if limit.is_relative:
        difference /= np.abs(expected)
    difference = np.where(is_nan[0] != is_nan[1], np.inf, difference)
    difference = difference[~np.isnan(difference)]
    flipped: Row = {}
    if limit.flips:
        is_within = difference <= limit.value
        difference = difference[is_within]
        share = 1.0 - float(is_within.mean()) if is_within.size else 0.0
        if share > limit.flips:
            raise InputError(
                f"{output} of {case}: PyTorch and onnxruntime differ by more than {limit.value:g} "
                f"on {share:.3%} of the numbers, {limit.flips:.3%} may; nothing is written."
            )
        flipped = {"flipped": share}
    if not difference.size:
        raise InputError(
            f"{output} of {case}: PyTorch gives not one number that could be compared, and what is "
            "not compared is not proven; nothing is written. Are these the weights of a training "
            "that went well?"
        )
    return {
        "input": case,
        "output": output,
        "largest difference": float(difference.max()),
        "mean difference": float(difference.mean()),
        "limited": limit.of,
        "limit": limit.value,
        "unit": "share" if limit.is_relative else "as the output",
        **flipped,
    }


@dataclass(frozen=True, kw_only=True, eq=False)
class Export:
    """What is written, and what it is compared with."""

    graph: Callable[[], Graph]
    cases: Callable[[], Iterable[Case]]
    limits: Mapping[str, Limit]
    facts: Mapping[str, Any]  # for users of the file, in its metadata


def freeze(path: Path, export: Export) -> list[Row]:
    """Write ``NAME.onnx``, once it agrees with PyTorch, and ``NAME.proof.json`` beside it."""
    if path.suffix != ".onnx":
        raise InputError(f"{path}: the graph is written as ONNX; end the name in .onnx.")
    proof = path.with_suffix(".proof.json")  # NAME.json may be a camera
    for file in (path, proof):
        refuse_to_replace(file)
    onnx = import_export()
    with atomic_write(path) as part:
        part.touch()  # a place that cannot be written is refused before the work
        facts = {**export.facts, "depthpose": version("depthpose")}
        onnx.save(export.graph().model(facts), str(part))
        session = import_module("onnxruntime").InferenceSession(
            str(part), providers=["CPUExecutionProvider"]
        )
        rows: list[Row] = []
        for case in export.cases():
            answers = session.run(list(case.expected), dict(case.inputs))
            for (name, expected), output_values in zip(case.expected.items(), answers, strict=True):
                if name in case.where and output_values.shape == expected.shape:
                    mask = case.where[name]
                    output_values = output_values[mask]  # noqa: PLW2901
                    expected = expected[mask]  # noqa: PLW2901
                rows.append(_row(case.name, name, output_values, expected, export.limits[name]))
        if not rows:
            raise InputError(
                "no output is compared with PyTorch's; nothing is written. Name a case."
            )
        for row in rows:
            difference = row[f"{row['limited']} difference"]
            limit = row["limit"]
            if not difference <= limit:  # pyright: ignore[reportOperatorIssue]  NaN fails too
                raise InputError(
                    f"{row['output']} of {row['input']}: PyTorch and onnxruntime differ by "
                    f"{difference:.3g} ({row['limited']}), the limit is {limit:.3g}; nothing is "
                    "written. Install other versions of onnxscript and onnxruntime, and report "
                    "this."
                )
        runtimes = {name: version(name) for name in ("onnx", "onnxscript", "onnxruntime")}
        record = {
            "file": path.name,
            "sha256": file_sha256(part),
            "opset": OPSET,
            "environment": environment() | runtimes,
            "facts": facts,
            "differences": rows,
        }
        write_json(proof, record)
    return rows


MOST = 1 << 10  # multiple of a side for the exporter; the graph itself has no bound


def network_model(module: nn.Module, images: Sequence[Tensor], multiple: int) -> Any:  # noqa: ANN401
    """Turn a module of images, in eval mode, into an ONNX model of free batch, rows and columns.

    ``images``, (b, c, h, w) each, are examples: more than one image, sides of more than one
    ``multiple``, so that no size of theirs is taken for a law. All sides are such multiples.
    """
    onnx = import_export()
    batch = torch.export.Dim("batch", min=1, max=MOST)
    rows, columns = (torch.export.Dim(name, min=1, max=MOST) for name in ("rows", "columns"))
    free = {0: batch, 2: multiple * rows, 3: multiple * columns}
    logger = logging.getLogger("torch.onnx")  # its messages are of the exporter's inside
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(action="ignore"), torch.no_grad():
            program = torch.onnx.export(
                module,
                tuple(images),
                dynamo=True,
                opset_version=OPSET,
                dynamic_shapes=tuple(free for _ in images),
                verbose=False,
            )
    finally:
        logger.setLevel(level)
    assert program is not None
    model = onnx.inliner.inline_local_functions(program.model_proto)
    # Stack traces, paths and names of lines would identify the exporting machine.
    for part in (*model.graph.node, *model.graph.initializer, *model.graph.input):
        del part.metadata_props[:]
        part.doc_string = ""
    del model.graph.value_info[:]
    return model
