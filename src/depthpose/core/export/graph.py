"""A graph of ONNX operators around and between exported networks.

Operators are those of opset 18 (https://onnx.ai/onnx/operators), the first whose Resize averages
where it shrinks.
"""

import json
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

import numpy as np

from depthpose.core.errors import MissingExtraError

OPSET = 18
Shape = Sequence[int | str]
"""Sides of a tensor; text names a side that is known only when the graph runs."""


class Value:
    """A tensor of a graph; arithmetic on it adds nodes."""

    def __init__(self, graph: "Graph", name: str) -> None:
        self.graph = graph
        self.name = name

    def op(self, kind: str, *others: Any, **attributes: Any) -> "Value":  # noqa: ANN401
        """Feed it to an operator, first of its inputs."""
        return self.graph.op(kind, self, *others, **attributes)

    def cast(self, dtype: type) -> "Value":
        """Give the same numbers in another type."""
        return self.op("Cast", to=_onnx_type(dtype))

    def slice(self, starts: Any, ends: Any, axes: Sequence[int]) -> "Value":  # noqa: ANN401
        """Cut out a part; numbers are lists, or values of int64."""
        return self.op("Slice", starts, ends, list(axes))

    def __add__(self, other: Any) -> "Value":  # noqa: ANN401
        return self.op("Add", other)

    def __sub__(self, other: Any) -> "Value":  # noqa: ANN401
        return self.op("Sub", other)

    def __mul__(self, other: Any) -> "Value":  # noqa: ANN401
        return self.op("Mul", other)

    def __truediv__(self, other: Any) -> "Value":  # noqa: ANN401
        return self.op("Div", other)

    def __mod__(self, other: Any) -> "Value":  # noqa: ANN401
        return self.op("Mod", other)


class Graph:
    """Nodes in the order in which they are written.

    Inputs of an operator are values, arrays, or numbers: an int becomes int64, a float float64.

    Raises:
        MissingExtraError: the extra ``export`` is not installed.
    """

    def __init__(self) -> None:
        self._onnx = import_export()
        self._nodes: list[Any] = []
        self._constants: list[Any] = []
        self._inputs: list[Any] = []
        self._outputs: list[Any] = []
        self._number = 0

    def input(self, name: str, dtype: type, shape: Shape) -> Value:
        """Add an input of the graph."""
        self._inputs.append(self._described(name, dtype, shape))
        return Value(self, name)

    def output(self, name: str, value: Value, dtype: type, shape: Shape) -> None:
        """Make a value an output of the graph."""
        self._nodes.append(self._onnx.helper.make_node("Identity", [value.name], [name]))
        self._outputs.append(self._described(name, dtype, shape))

    def op(self, kind: str, *inputs: Any, **attributes: Any) -> Value:  # noqa: ANN401
        """Add an operator and give its first output; None leaves an optional input out."""
        out = self._new_name(kind)
        names = ["" if given is None else self._name_of(given) for given in inputs]
        self._nodes.append(self._onnx.helper.make_node(kind, names, [out], **attributes))
        return Value(self, out)

    def call(self, network: Any, *inputs: Value) -> tuple[Value, ...]:  # noqa: ANN401
        """Put a whole model's nodes here and give its outputs.

        Args:
            network: an ONNX model, from :func:`depthpose.core.export.network_model`.
            inputs: in the order of the model's own.
        """
        prefix = self._new_name("network") + "/"
        inner = self._onnx.compose.add_prefix(network, prefix).graph
        for given, wanted in zip(inputs, inner.input, strict=True):
            node = self._onnx.helper.make_node("Identity", [given.name], [wanted.name])
            self._nodes.append(node)
        self._nodes += inner.node
        self._constants += inner.initializer
        return tuple(Value(self, output.name) for output in inner.output)

    def model(self, facts: Mapping[str, Any]) -> Any:  # noqa: ANN401
        """Close the graph.

        Args:
            facts: for users of the file, each in its metadata, as text or JSON.
        """
        helper = self._onnx.helper
        graph = helper.make_graph(
            self._nodes, "depthpose", self._inputs, self._outputs, self._constants
        )
        opsets = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=opsets, producer_name="depthpose")
        model.ir_version = 10  # of onnx 1.16: younger ones would shut out older runtimes
        texts = {k: v if isinstance(v, str) else json.dumps(v) for k, v in facts.items()}
        helper.set_model_props(model, texts)
        self._onnx.checker.check_model(model, full_check=True)
        return model

    def _name_of(self, given: Any) -> str:  # noqa: ANN401
        if isinstance(given, Value):
            return given.name
        name = self._new_name("constant")
        self._constants.append(self._onnx.numpy_helper.from_array(np.asarray(given), name))
        return name

    def _new_name(self, kind: str) -> str:
        self._number += 1
        return f"{kind}_{self._number}"

    def _described(self, name: str, dtype: type, shape: Shape) -> Any:  # noqa: ANN401
        return self._onnx.helper.make_tensor_value_info(name, _onnx_type(dtype), list(shape))


def _onnx_type(dtype: type) -> int:
    return import_export().helper.np_dtype_to_tensor_dtype(np.dtype(dtype))


_PACKAGES = (
    "onnxruntime",
    "onnxscript",
    "onnx.compose",
    "onnx.inliner",
    "onnx.numpy_helper",
    "onnx",
)


def import_export() -> Any:  # noqa: ANN401  what protobuf generates carries no types
    """Import ONNX, and make sure that what goes with it is there too.

    Raises:
        MissingExtraError: one of the three is not installed.
    """
    try:
        return [import_module(name) for name in _PACKAGES][-1]
    except ImportError as error:
        raise MissingExtraError("onnx, onnxruntime and onnxscript", "export", "export") from error
