"""Rows as a data frame of pandas, which is not a dependency of depthpose."""

from collections.abc import Iterable, Mapping
from importlib import import_module
from typing import Any


def make_data_frame(rows: Iterable[Mapping[str, Any]]) -> Any:  # noqa: ANN401  pandas is no dependency
    """Convert rows, mappings of column names to values, to a ``pandas.DataFrame``.

    A mapping inside a row becomes a column for each of its entries, called ``NAME.ENTRY``.

    Raises:
        ImportError: pandas is not installed.
    """
    try:
        pandas = import_module("pandas")
    except ImportError as error:
        raise ImportError(
            "a data frame needs pandas, which is not installed: pip install pandas"
        ) from error
    return pandas.json_normalize([dict(row) for row in rows], max_level=1)
