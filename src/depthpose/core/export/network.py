"""A module to an ONNX model, by the exporter that stands on ``torch.export``."""

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from depthpose.core.export.extra import import_export
from depthpose.core.export.graph import OPSET

MOST = 1 << 10
"""Largest multiple of a side that the exporter is told of; the graph itself has no bound."""


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
    """Keep back what the exporter says of its own insides; the proof is the judge."""
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
    """Drop what speaks of the machine that exported: stack traces, paths, names of lines."""
    for part in (*model.graph.node, *model.graph.initializer, *model.graph.input):
        del part.metadata_props[:]
        part.doc_string = ""
    del model.graph.value_info[:]
    return model
