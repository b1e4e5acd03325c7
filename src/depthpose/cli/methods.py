"""Methods by their words on the command line, with what decides their results."""

import re
from typing import Any, NamedTuple

from depthpose.core.checkpoint import file_sha256, find_weights
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.depth.config import MatcherConfig, SGBMConfig
from depthpose.depth.estimator import FakestereoNet

_UNITS = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9}


class Method(NamedTuple):
    """An estimator, what to call it, and the JSON values that decide its results."""

    name: str
    net: FakestereoNet
    settings: dict[str, Any]


def psmnet_method(weights: str, config: MatcherConfig) -> Method:
    """PSMNet with weights from a file or by name."""
    path = find_weights(weights)
    facts = {"matcher": "psmnet", "weights": path.stem, "weights_sha256": file_sha256(path)}
    net = FakestereoNet.load(path, config=config)
    return Method(path.stem, net, {**facts, **config_to_dict(config)})


def sgbm_method(*, with_filled_holes: bool) -> Method:
    """OpenCV's StereoSGBM with the settings of our tables."""
    config = SGBMConfig(with_filled_holes=with_filled_holes)
    net = FakestereoNet.load(matcher="sgbm", config=config)
    name = "sgbm-filled" if with_filled_holes else "sgbm"
    return Method(name, net, {"matcher": "sgbm", **config_to_dict(config)})


def parse_bytes(text: str | None) -> int | None:
    """Read a size such as ``1GB``, ``800MB`` or ``1500000`` (bytes); decimal units.

    Raises:
        InputError: not a number with such a unit.
    """
    if text is None:
        return None
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMG]?B)?\s*", text, re.IGNORECASE)
    if found is None:
        raise InputError(f"--max-memory {text!r}: not a size. Write, say, 1GB or 800MB.")
    return int(float(found[1]) * _UNITS[(found[2] or "").upper()])
