"""Below which confidence of a generator an image is out of its distribution."""

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from depthpose.core.checkpoint import read_checkpoint, save_checkpoint
from depthpose.core.errors import InputError
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.types import StereoInput
from depthpose.depth.weights import BOTH

_KIND = "selection"


def measure_image_confidence(net: FakestereoNet, images: Iterable[StereoInput]) -> list[float]:
    """Give the confidence in each image as a whole, 0..1 (``DepthEstimate.image_confidence``)."""
    found: list[float] = []
    for image in images:
        image_confidence = net.estimate_pair(replace(image, right=None)).image_confidence
        if image_confidence is None:
            raise InputError(
                "these weights have no generator with a confidence of its own; take those of "
                "'depthpose depth train select'"
            )
        found.append(image_confidence)
    return found


def refuse_share(images: int, alarm_share: float) -> None:
    """Refuse a share of images that so many of them cannot tell."""
    if not 0 < alarm_share < 1:
        raise InputError(f"alarm_share is {alarm_share:g}; it must be above 0 and below 1")
    if images * alarm_share < 1:
        raise InputError(
            f"{images} images cannot say what refuses {alarm_share:g} of them; "
            f"give {math.ceil(1 / alarm_share)} images or more, or a larger share"
        )


def calibrate(weights: Path, image_confidence: list[float], alarm_share: float, out: Path) -> float:
    """Write weights that refuse all but ``1 - alarm_share`` of images like some that are known.

    Args:
        weights: with a generator that selects; its tensors stay as they are.
        image_confidence: of images that the weights shall know (:func:`measure_image_confidence`).
        alarm_share: share of these that may be refused, 0..1.
        out: the file of the weights.

    Returns:
        The ``least_confidence`` that they bear.

    Raises:
        InputError: too few images for that share, or weights of another kind.
    """
    refuse_share(len(image_confidence), alarm_share)
    least = min(round(float(np.quantile(image_confidence, alarm_share)), 4), 0.9999)
    found = read_checkpoint(weights)
    config = dict(found.config)
    own = config.get(_KIND) if found.kind == BOTH else config if found.kind == _KIND else None
    if not isinstance(own, dict):
        raise InputError(
            f"{weights}: holds no generator that selects; take weights of 'train select'"
        )
    changed = {**own, "least_confidence": least}
    config = {**config, _KIND: changed} if found.kind == BOTH else changed
    save_checkpoint(out, replace(found, config=config))
    return least
