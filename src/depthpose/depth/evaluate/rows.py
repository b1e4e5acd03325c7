"""Rows of an evaluation; their fields are the columns of its tables, in this order."""

from collections.abc import Mapping
from dataclasses import dataclass, fields

Cell = str | int | float
"""What a table holds."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A row whose columns are its fields, in order.

    A field that is None is no column; a mapping is a column for each of its entries.
    """

    def columns(self) -> dict[str, Cell]:
        """Give the columns by name, as files and printed tables hold them."""
        found: dict[str, Cell] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Mapping):
                found |= value
            elif value is not None:
                found[field.name] = value
        return found


@dataclass(frozen=True, kw_only=True)
class Source(Row):
    """Whose predictions were measured.

    Attributes:
        method: its name.
        input: which images it was given.
        speed: at which networks ran.
        weights: name of the file.
        weights_sha256: the first 12 digits.
    """

    method: str
    input: str = ""
    speed: str = ""
    weights: str = ""
    weights_sha256: str = ""


@dataclass(frozen=True, kw_only=True)
class MeanRow(Row):
    """Means over frames, each of the same weight.

    Attributes:
        method: as in :class:`Source`, like the next four; None: not known.
        input: which images it was given.
        speed: at which networks ran.
        weights: name of the file.
        weights_sha256: the first 12 digits.
        protocol: by which the frames were measured.
        dataset: its name.
        cap_m: truth beyond it does not count; None for disparity.
        frames: how many.
        pixels: sum of the pixels compared.
        coverage: share of the pixels with truth that have a prediction.
        metrics: means of what all frames with a predicted pixel have, in the order of
            ``depth.metrics.METRICS``, then those of the drawn view and of the confidence.
    """

    method: str | None = None
    input: str | None = None
    speed: str | None = None
    weights: str | None = None
    weights_sha256: str | None = None
    protocol: str
    dataset: str
    cap_m: float | None
    frames: int
    pixels: int
    coverage: float
    metrics: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class FrameRow(Row):
    """Numbers of one frame; the fields are those of :class:`MeanRow`, ``frame`` is its name."""

    method: str | None = None
    input: str | None = None
    speed: str | None = None
    weights: str | None = None
    protocol: str
    dataset: str
    frame: str
    cap_m: float | None
    pixels: int
    coverage: float
    metrics: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class DecileRow(Row):
    """Mean error of the n-th tenth of the pixels, from the least sure (1) to the surest (10).

    Attributes:
        confidence_decile: n.
        error: the name of the error and its mean over frames.

    The other fields are those of :class:`MeanRow`.
    """

    method: str | None = None
    input: str | None = None
    speed: str | None = None
    weights: str | None = None
    protocol: str
    dataset: str
    cap_m: float | None
    frames: int
    confidence_decile: int
    error: Mapping[str, float]
