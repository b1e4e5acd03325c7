"""Rows as a data frame of pandas, which is no dependency."""

from collections.abc import Iterable, Mapping
from importlib import import_module
from typing import Any


def data_frame(rows: Iterable[Mapping[str, Any]]) -> Any:  # noqa: ANN401  pandas is no dependency
    """Give rows as a ``pandas.DataFrame``; a mapping is a column ``NAME.ENTRY`` for each entry."""
    try:
        pandas = import_module("pandas")
    except ImportError as error:
        raise ImportError(
            "a data frame needs pandas, which is not installed: pip install pandas"
        ) from error
    return pandas.json_normalize([dict(row) for row in rows], max_level=1)
