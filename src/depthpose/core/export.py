"""Export of networks to ONNX files that run without torch, and the proof that outputs agree.

Graphs are built of the operators of opset 18 (https://onnx.ai/onnx/operators), the first whose
Resize averages where it shrinks. The proof is a table: for each output the largest and the mean
difference between onnxruntime and PyTorch, and their limit.
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
from depthpose.core.environment import describe_environment
from depthpose.core.errors import InputError, import_extra
from depthpose.core.files import atomic_write, write_json
from depthpose.core.run_folder import refuse_to_replace

OPSET = 18
_IR_VERSION = 10  # that of onnx 1.16: older runtimes do not read a newer one
TensorShape = Sequence[int | str]
"""Lengths of the axes; a name stands for a length that is known only when the graph runs."""


def import_onnx() -> Any:  # noqa: ANN401  what protobuf generates carries no types
    """Import ``onnx`` with the submodules and packages that an export needs.

    Raises:
        MissingExtraError: the extra ``export`` is not installed.
    """
    submodules = ("onnx.compose", "onnx.inliner", "onnx.numpy_helper")
    for name in ("onnx", *submodules, "onnxscript", "onnxruntime"):
        import_extra(name, "onnx, onnxruntime and onnxscript", "export", "export")
    return import_module("onnx")


@dataclass(frozen=True, eq=False)
class Value:
    """A tensor of a graph. Arithmetic with it adds nodes to the graph."""

    graph: "Graph"
    name: str  #: unique in the graph

    def op(self, kind: str, *others: Any, **attributes: Any) -> "Value":  # noqa: ANN401
        """Add an operator whose first input is this tensor, and return its first output."""
        return self.graph.op(kind, self, *others, **attributes)

    def cast(self, dtype: type) -> "Value":
        """Add a conversion to another type of numbers, and return the converted tensor."""
        return self.op("Cast", to=self.graph.onnx.helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))

    slice = partialmethod(op, "Slice")  # starts, ends, axes: lists, or values of int64
    __add__ = partialmethod(op, "Add")
    __sub__ = partialmethod(op, "Sub")
    __mul__ = partialmethod(op, "Mul")
    __truediv__ = partialmethod(op, "Div")
    __mod__ = partialmethod(op, "Mod")


@dataclass(kw_only=True, eq=False)
class Graph:
    """An ONNX graph that is built node by node, in the order in which nodes are added.

    Inputs of an operator are values, arrays, or numbers: an int becomes int64, a float float64.
    """

    onnx: Any = field(default_factory=import_onnx)  #: the package ``onnx``
    nodes: list[Any] = field(default_factory=list)
    constants: list[Any] = field(default_factory=list)
    inputs: list[Any] = field(default_factory=list)
    outputs: list[Any] = field(default_factory=list)
    numbers: Iterator[int] = field(default_factory=partial(count, 1))  #: they make names unique

    def input(self, name: str, dtype: type, shape: TensorShape) -> Value:
        """Add an input to the graph, and return it."""
        helper = self.onnx.helper
        element_type = helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
        self.inputs.append(helper.make_tensor_value_info(name, element_type, list(shape)))
        return Value(self, name)

    def output(self, name: str, value: Value, dtype: type, shape: TensorShape) -> None:
        """Make a value an output of the graph."""
        helper = self.onnx.helper
        element_type = helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
        self.nodes.append(helper.make_node("Identity", [value.name], [name]))
        self.outputs.append(helper.make_tensor_value_info(name, element_type, list(shape)))

    def op(self, kind: str, *inputs: Any, **attributes: Any) -> Value:  # noqa: ANN401
        """Add an operator and return its first output; None leaves an optional input out."""
        output_name = f"{kind}_{next(self.numbers)}"
        input_names: list[str] = []
        for value in inputs:
            if value is None:
                input_names.append("")
            elif isinstance(value, Value):
                input_names.append(value.name)
            else:
                name = f"constant_{next(self.numbers)}"
                self.constants.append(self.onnx.numpy_helper.from_array(np.asarray(value), name))
                input_names.append(name)
        node = self.onnx.helper.make_node(kind, input_names, [output_name], **attributes)
        self.nodes.append(node)
        return Value(self, output_name)

    def call(self, network: Any, *inputs: Value) -> tuple[Value, ...]:  # noqa: ANN401
        """Add all nodes of an ONNX model (``network``), fed by ``inputs``; return its outputs."""
        prefix = f"network_{next(self.numbers)}/"
        inner = self.onnx.compose.add_prefix(network, prefix).graph
        for value, inner_input in zip(inputs, inner.input, strict=True):
            node = self.onnx.helper.make_node("Identity", [value.name], [inner_input.name])
            self.nodes.append(node)
        self.nodes += inner.node
        self.constants += inner.initializer
        return tuple(Value(self, output.name) for output in inner.output)

    def model(self, facts: Mapping[str, Any]) -> Any:  # noqa: ANN401
        """Build and check the ONNX model of the graph, with ``facts`` as its metadata."""
        helper = self.onnx.helper
        graph = helper.make_graph(
            self.nodes, "depthpose", self.inputs, self.outputs, self.constants
        )
        opsets = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=opsets, producer_name="depthpose")
        model.ir_version = _IR_VERSION
        metadata = {
            name: fact if isinstance(fact, str) else json.dumps(fact)
            for name, fact in facts.items()
        }
        helper.set_model_props(model, metadata)
        self.onnx.checker.check_model(model, full_check=True)
        return model


ProofRow = dict[str, str | float]
"""A row of the proof: the comparison of one output of one case."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """Inputs of a graph, and PyTorch's outputs for them."""

    name: str  #: in the proof, such as the size of the inputs
    inputs: Mapping[str, np.ndarray]  #: by name
    expected: Mapping[str, np.ndarray]  #: by name; outputs that are left out are not compared
    #: masks by the names of outputs that are compared only there
    where: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Limit:
    """By how much an output may differ from PyTorch's.

    Where a decision depends on a rounding, a number may flip: it differs by more, or is NaN in one
    of the two outputs alone. Flipped numbers are left out of the differences.
    """

    value: float  #: the limit, in the output's unit
    of: Literal["largest", "mean"] = "largest"  #: which difference; the mean of outputs that jump
    is_relative: bool = False  #: differences are divided by PyTorch's numbers
    flips: float = 0.0  #: largest share of flipped numbers


def _compare_output(
    case: str, output: str, onnx_output: np.ndarray, torch_output: np.ndarray, limit: Limit
) -> ProofRow:
    """Compare an output of onnxruntime with PyTorch's: make its row of the proof.

    Whether the differences keep to ``limit.value`` is left to the caller.

    Args:
        case: name of the case.
        output: name of the output.
        onnx_output: numbers of onnxruntime.
        torch_output: numbers of PyTorch.
        limit: decides which differences are computed, and how many numbers may flip.

    Raises:
        InputError: shapes or places of NaN differ, too many numbers flip, or there is nothing to
            compare.
    """
    onnx_values = np.asarray(onnx_output, np.float64)
    torch_values = np.asarray(torch_output, np.float64)
    onnx_nan = np.isnan(onnx_values)
    torch_nan = np.isnan(torch_values)
    has_other_shape = onnx_values.shape != torch_values.shape
    if has_other_shape or ((onnx_nan != torch_nan).any() and not limit.flips):
        raise InputError(
            f"{output} of {case}: onnxruntime answers {onnx_values.shape} with "
            f"{onnx_nan.sum()} NaN, PyTorch {torch_values.shape} with "
            f"{torch_nan.sum()}; nothing is written."
        )

    # The difference is infinite where one output alone is NaN, and left out where both are.
    difference = np.abs(onnx_values - torch_values)
    if limit.is_relative:
        difference /= np.abs(torch_values)
    difference = np.where(onnx_nan != torch_nan, np.inf, difference)
    difference = difference[~np.isnan(difference)]

    # Numbers that flipped are counted and left out.
    flipped: ProofRow = {}
    if limit.flips:
        is_within = difference <= limit.value
        difference = difference[is_within]
        flipped_share = 1.0 - float(is_within.mean()) if is_within.size else 0.0
        if flipped_share > limit.flips:
            raise InputError(
                f"{output} of {case}: PyTorch and onnxruntime differ by more than {limit.value:g} "
                f"on {flipped_share:.3%} of the numbers, {limit.flips:.3%} may; nothing is written."
            )
        flipped = {"flipped": flipped_share}
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
    """An export: the graph to write, and the cases by which it is compared with PyTorch."""

    graph: Callable[[], Graph]  #: builds the graph
    cases: Callable[[], Iterable[Case]]  #: makes the cases
    limits: Mapping[str, Limit]  #: by the names of the outputs
    facts: Mapping[str, Any]  #: metadata of the file, for its users


def write_export(path: Path, export: Export) -> list[ProofRow]:
    """Write ``NAME.onnx`` and its proof, ``NAME.proof.json``, if its outputs agree with PyTorch's.

    Returns:
        The rows of the proof: the differences of each output of each case, and their limit.

    Raises:
        InputError: outputs differ, or one of the files exists or cannot be written.
        MissingExtraError: the extra ``export`` is not installed.
    """
    if path.suffix != ".onnx":
        raise InputError(f"{path}: the graph is written as ONNX; end the name in .onnx.")
    proof = path.with_suffix(".proof.json")  # not NAME.json, which may be a camera
    for file in (path, proof):
        refuse_to_replace(file)
    onnx = import_onnx()
    with atomic_write(path) as part:
        part.touch()  # a place that cannot be written is refused before the work
        facts = {**export.facts, "depthpose": version("depthpose")}
        onnx.save(export.graph().model(facts), str(part))
        rows = _compare_with_torch(part, export)
        runtimes = {name: version(name) for name in ("onnx", "onnxscript", "onnxruntime")}
        record = {
            "file": path.name,
            "sha256": file_sha256(part),
            "opset": OPSET,
            "environment": describe_environment() | runtimes,
            "facts": facts,
            "differences": rows,
        }
        write_json(proof, record)
    return rows


def _compare_with_torch(onnx_file: Path, export: Export) -> list[ProofRow]:
    """Run an ONNX file on all cases and compare it with PyTorch: make the rows of the proof.

    Raises:
        InputError: an output differs by more than its limit, or there is no case.
    """
    session = import_module("onnxruntime").InferenceSession(
        str(onnx_file), providers=["CPUExecutionProvider"]
    )
    rows: list[ProofRow] = []
    for case in export.cases():
        onnx_outputs = session.run(list(case.expected), dict(case.inputs))
        for name, onnx_output in zip(case.expected, onnx_outputs, strict=True):
            torch_output = case.expected[name]
            if name in case.where and onnx_output.shape == torch_output.shape:
                mask = case.where[name]
                onnx_output = onnx_output[mask]  # noqa: PLW2901
                torch_output = torch_output[mask]
            limit = export.limits[name]
            rows.append(_compare_output(case.name, name, onnx_output, torch_output, limit))

    if not rows:
        raise InputError("no output is compared with PyTorch's; nothing is written. Name a case.")
    for row in rows:
        difference = row[f"{row['limited']} difference"]
        limit = row["limit"]
        if not difference <= limit:  # pyright: ignore[reportOperatorIssue]  NaN fails too
            raise InputError(
                f"{row['output']} of {row['input']}: PyTorch and onnxruntime differ by "
                f"{difference:.3g} ({row['limited']}), the limit is {limit:.3g}; nothing is "
                "written. Install other versions of onnxscript and onnxruntime, and report this."
            )
    return rows


_MAX_SIZE = 1 << 10
"""Largest batch, and multiple of a side, for the exporter; the graph itself has no limit."""


def convert_network(module: nn.Module, images: Sequence[Tensor], multiple: int) -> Any:  # noqa: ANN401
    """Convert a network of images to an ONNX model whose batch, rows and columns are variable.

    Args:
        module: the network, in eval mode.
        images: examples of its inputs, each (b, c, h, w) with b, h and w larger than the least
            possible; else the exporter would take these for constants.
        multiple: number of which every height and width is a multiple.
    """
    onnx = import_onnx()
    batch = torch.export.Dim("batch", min=1, max=_MAX_SIZE)
    rows = torch.export.Dim("rows", min=1, max=_MAX_SIZE)
    columns = torch.export.Dim("columns", min=1, max=_MAX_SIZE)
    variable_sides = {0: batch, 2: multiple * rows, 3: multiple * columns}

    # The exporter's log and warnings are about its own inner workings.
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(action="ignore"), torch.no_grad():
            program = torch.onnx.export(
                module,
                tuple(images),
                dynamo=True,
                opset_version=OPSET,
                dynamic_shapes=tuple(variable_sides for _ in images),
                verbose=False,
            )
    finally:
        logger.setLevel(level)
    assert program is not None

    # Without stack traces and paths, which would identify the exporting machine.
    model = onnx.inliner.inline_local_functions(program.model_proto)
    for part in (*model.graph.node, *model.graph.initializer, *model.graph.input):
        del part.metadata_props[:]
        part.doc_string = ""
    del model.graph.value_info[:]
    return model
