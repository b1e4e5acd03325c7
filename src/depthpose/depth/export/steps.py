"""Steps of a graph that depend on the sizes of its images: resizing, padding, focal lengths."""

from typing import Any

import numpy as np

from depthpose.core.export import Value


def size_of(image: Value) -> Value:
    """Give rows and columns of images."""
    return image.op("Shape", start=2, end=4)


def focal_yx(K: Value) -> Value:
    """Give the focal lengths of rows and of columns [px]."""
    return K.op("Reshape", [-1]).op("Gather", [4, 0])


def focal_size(size: Value, focal_px: Any, wanted_px: float) -> Value:  # noqa: ANN401
    """Give rows and columns at which an image has the wanted focal length."""
    scaled = (size.cast(np.float64) * float(wanted_px)) / focal_px
    return scaled.op("Round").op("Max", 1.0).cast(np.int64)


def resized_image(image: Value, size: Value) -> Value:
    """Resize images, averaging where they shrink."""
    resized = image.op("Resize", None, None, size, mode="linear", axes=[2, 3],
                       antialias=1, exclude_outside=1)  # fmt: skip
    return resized.op("Clip", np.float32(0), np.float32(1))


def resized_map(values: Value, size: Value) -> Value:
    """Resize maps (batch, height, width) without averaging."""
    lifted = values.op("Unsqueeze", [1])
    return lifted.op("Resize", None, None, size, mode="linear", axes=[2, 3]).op("Squeeze", [1])


def ratio(wide: Value, narrow: Value) -> Value:
    """Say how many times as wide, for disparities."""
    many, few = (columns(size).cast(np.float64) for size in (wide, narrow))
    return (many / few).cast(np.float32)


def rows(size: Value) -> Value:
    """Give the first of two sides, as a list of one."""
    return size.slice([0], [1], [0])


def columns(size: Value) -> Value:
    """Give the second of two sides, as a list of one."""
    return size.slice([1], [2], [0])


def joined(*sides: Any) -> Value:  # noqa: ANN401
    """Put sides one after the other; one at least is a value."""
    graph = next(side.graph for side in sides if isinstance(side, Value))
    parts = [side if isinstance(side, Value) else [side] for side in sides]
    return graph.op("Concat", *parts, axis=0)


def pads(image: Value, *, before: Any = None, after: Any = None) -> Value:  # noqa: ANN401
    """Give the widths that Pad takes, of rows and columns."""
    none = [0, 0]
    parts = [none, none if before is None else before, none, none if after is None else after]
    return image.graph.op("Concat", *parts, axis=0)
