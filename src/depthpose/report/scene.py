"""Clouds and lines in space, and their form for the 3D view of a page (``viewer.js``)."""

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from depthpose.core.files import Cloud

MOST_POINTS = 60_000
"""Of one cloud on a page: 0.7 MB of text."""
MOST_LINES = 20_000

_GREY = 0.55
"""Of points without a colour; it is seen on white and on black."""
_RED_GREEN_BLUE = ((0.85, 0.2, 0.2), (0.15, 0.65, 0.25), (0.25, 0.45, 0.95))


@dataclass(frozen=True, kw_only=True, eq=False)
class Lines:
    """Straight pieces of line.

    Attributes:
        ends_m: both ends of each.
        color: RGB in [0, 1], one for each piece.
    """

    ends_m: Float[Tensor, "n 2 3"]
    color: Float[Tensor, "n 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Layer:
    """A part of a scene that can be hidden.

    Attributes:
        name: what the viewer calls it; layers of one name are hidden together.
        shape: coloured points (NaN left out), or lines; metres, camera frame.
        is_shown: whether it is seen at first.
    """

    name: str
    shape: Cloud | Lines
    is_shown: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """What one 3D view shows.

    Attributes:
        caption: stands below it.
        layers: drawn together.
    """

    caption: str
    layers: Sequence[Layer]

    @property
    def note(self) -> str:
        """Which layers are shown thinned; empty where none is."""
        said = [
            f"{layer.name}: {_most(layer.shape)} of {_count(layer.shape)}, thinned evenly"
            for layer in self.layers
            if _count(layer.shape) > _most(layer.shape)
        ]
        return "; ".join(said)

    def encoded(self) -> dict[str, Any]:
        """Give the JSON that ``viewer.js`` reads: base64 of 16-bit places and 8-bit colours."""
        return {"caption": self.caption, "note": self.note,
                "layers": [_encoded(layer) for layer in self.layers]}  # fmt: skip


def page_file(name: Literal["viewer.js", "page.css"]) -> str:
    """Read the viewer, which defines ``showScene(element, scene)``, or the style of all pages."""
    return files("depthpose.report").joinpath(name).read_text(encoding="utf-8")


def colored_points(points_m: Float[Tensor, "n 3"], color: tuple[float, float, float]) -> Cloud:
    """Make points of one colour, RGB in [0, 1]."""
    return Cloud(points=points_m, color=torch.tensor(color).expand(len(points_m), 3))


def colored_lines(ends_m: Float[Tensor, "n 2 3"], color: tuple[float, float, float]) -> Lines:
    """Make lines of one colour."""
    return Lines(ends_m=ends_m, color=torch.tensor(color).expand(len(ends_m), 3))


def frame_axes(origin_m: Float[Tensor, "3"], R: Float[Tensor, "3 3"], length_m: float) -> Lines:
    """Draw the axes of a frame: x red, y green, z blue.

    Args:
        origin_m: where it stands, in the camera frame.
        R: its axes as columns.
        length_m: of each.
    """
    tips_m = origin_m + length_m * R.mT
    ends_m = torch.stack([origin_m.expand(3, 3), tips_m], 1)
    return Lines(ends_m=ends_m.float(), color=torch.tensor(_RED_GREEN_BLUE))


def _count(shape: Cloud | Lines) -> int:
    return len(shape.points if isinstance(shape, Cloud) else shape.ends_m)


def _most(shape: Cloud | Lines) -> int:
    return MOST_POINTS if isinstance(shape, Cloud) else MOST_LINES


def _encoded(layer: Layer) -> dict[str, Any]:
    shape = layer.shape
    if isinstance(shape, Cloud):
        kind, places, color = "points", shape.points, shape.color
        color = torch.full_like(places, _GREY) if color is None else color
    else:
        kind, places, color = "lines", shape.ends_m, shape.color
    kept = _spread(len(places), _most(shape))
    places, color = places[kept], color[kept]
    bytes_of_color = (color.detach().cpu().clamp(0, 1) * 255).round().byte().numpy()
    return {
        "name": layer.name,
        "kind": kind,
        "shown": layer.is_shown,
        "count": len(places),
        **_encoded_places(places.detach().cpu().numpy().astype(np.float64).reshape(-1, 3)),
        "colors": _base64(bytes_of_color),
    }


def _encoded_places(places_m: Float64[np.ndarray, "n 3"]) -> dict[str, Any]:
    """Store places as steps of 1/65535 of their extent: half the size of float32.

    A street of 80 m has steps of 1.2 mm, a table of 1.5 m of 0.02 mm.
    """
    low = places_m.min(0) if len(places_m) else np.zeros(3)
    step = (places_m.max(0) - low) / 65535 if len(places_m) else np.zeros(3)
    steps = np.round((places_m - low) / np.where(step > 0, step, 1))
    return {
        "low": low.tolist(),
        "step": step.tolist(),
        "places": _base64(steps.astype("<u2")),
    }


def _spread(count: int, most: int) -> Int64[Tensor, " m"]:
    """Choose one row of each of ``most`` equal runs, by chance, always the same ones.

    Equal steps through the rows of a depth image would leave lines of points.
    """
    if count <= most:
        return torch.arange(count)
    chance = torch.rand(most, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return ((torch.arange(most) + chance) * (count / most)).long().clamp(max=count - 1)


def _base64(values: np.ndarray) -> str:
    return b64encode(np.ascontiguousarray(values).tobytes()).decode()
