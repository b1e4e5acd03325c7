"""The packages of the extra ``export``, imported where they are used."""

from importlib import import_module
from typing import Any

from depthpose.core.errors import MissingExtraError

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
