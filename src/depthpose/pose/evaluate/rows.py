"""Rows of instances to a row an object, and to their mean."""

import hashlib
import statistics
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.pose.config import EvaluationConfig
from depthpose.pose.datasets import BopDataset, Instance, Target
from depthpose.pose.metrics import BOP_PIXELS, BOP_SHARES, auc, average_recall
from depthpose.pose.predictions import Place, place_of
from depthpose.pose.types import ObjectModel

Row = dict[str, Any]
_COUNTS = ("instances", "annotated")
_DECILES = 10


def object_row(name: str, rows: Sequence[Row], vsd: Mapping[str, Float[Tensor, "10"]]) -> Row:
    """Sum up the instances of an object, or of all objects.

    ``success``, ``refused`` and ``wrong`` add up to 1: an instance without an answer is refused.
    The medians of rotation and translation are of the answers alone; all else counts everything.

    Args:
        name: what the row is called.
        rows: one an instance.
        vsd: VSD at ten taus, by the name of the instance, where it was measured.
    """
    count = len(rows)
    answered = [row for row in rows if row["status"] == "ok"]
    success = sum(row["is_success"] for row in rows) / count
    coverage = len(answered) / count
    row: Row = {
        "object": name,
        "instances": count,
        "annotated": sum(row["truth"] == "annotated" for row in rows),
        "success": success,
        "refused": 1 - coverage,
        "wrong": coverage - success,
        "coverage": coverage,
        "auc": auc(_column(rows, "error_m")),
        "auc_adds": auc(_column(rows, "adds_m")),
    }
    row |= _recalls(rows, vsd)
    for error in ("rotation_deg", "translation_m"):
        values = [item[error] for item in answered]
        row[f"{error}_median"] = statistics.median(values) if values else None
    return row | _times(rows)


def mean_row(rows: Sequence[Row]) -> Row:
    """Average the rows of objects: each object counts the same, as in LineMOD's tables."""
    mean: Row = {"object": "mean"}
    for name in rows[0]:
        values = [row[name] for row in rows if row.get(name) is not None]
        if name in _COUNTS:
            mean[name] = sum(values)
        elif name not in ("object", "metric", "diameter_m"):
            # A recall of some objects alone would pass for that of all.
            is_lacking = not values or (name.startswith("ar") and len(values) < len(rows))
            mean[name] = None if is_lacking else sum(values) / len(values)
    return mean


def risk_rows(rows: Sequence[Row]) -> list[Row]:
    """Say how many answers are wrong if only the surest are given: ten shares of all instances.

    ``coverage`` 0.1 is the surest tenth of the instances; ``risk`` is the share of wrong ones among
    the answers given, ``least_score`` what the least sure of them has. It ends with the answers.
    """
    answered = sorted((row for row in rows if row["status"] == "ok"), key=lambda row: -row["score"])
    found: list[Row] = []
    for tenth in range(1, _DECILES + 1):
        given = answered[: round(tenth * len(rows) / _DECILES)]
        if not given or (found and len(given) == found[-1]["answers"]):
            continue
        wrong = sum(not row["is_success"] for row in given)
        found.append({
            "coverage": len(given) / len(rows),
            "answers": len(given),
            "least_score": given[-1]["score"],
            "risk": wrong / len(given),
        })  # fmt: skip
    return found


def _recalls(rows: Sequence[Row], vsd: Mapping[str, Float[Tensor, "10"]]) -> Row:
    """BOP's three average recalls and their mean; what was not measured is None."""
    shares = torch.tensor([row["mssd_m"] / row["diameter_m"] for row in rows], dtype=torch.float64)
    found: Row = {
        "ar_mssd": average_recall(shares[:, None], BOP_SHARES),
        "ar_mspd": average_recall(_column(rows, "mspd_px")[:, None], BOP_PIXELS),
        "ar_vsd": None,
        "ar": None,
    }
    if all(row["instance"] in vsd for row in rows):
        every = torch.stack([vsd[row["instance"]] for row in rows])
        found["ar_vsd"] = average_recall(every, BOP_SHARES)
        found["ar"] = (found["ar_vsd"] + found["ar_mssd"] + found["ar_mspd"]) / 3
    return found


def _times(rows: Sequence[Row]) -> Row:
    """Mean milliseconds of each stage over the instances that went through it, and of all."""
    found: Row = {}
    for name in (name for name in rows[0] if name.startswith("ms_")):
        values = [row[name] for row in rows if row[name] is not None]
        found[name] = sum(values) / len(values) if values else None
    return found


def _column(rows: Sequence[Row], name: str) -> Float[Tensor, " n"]:
    return torch.tensor([row[name] for row in rows], dtype=torch.float64)


def frames_hash(instances: Sequence[Instance]) -> str:
    """Give the SHA-256 of the list of instances, a line each: scene, image, object, place."""
    lines = (f"{i.scene_id} {i.image_id} {i.object_id} {i.index}\n" for i in instances)
    return hashlib.sha256("".join(sorted(lines)).encode()).hexdigest()


def of_targets(dataset: BopDataset, targets: Sequence[Target]) -> BopDataset:
    """Keep the instances that a list of targets asks for, the most visible where it takes fewer.

    Raises:
        InputError: a target is not annotated so many times.
    """
    found: dict[Place, list[Instance]] = defaultdict(list)
    for instance in dataset.instances:
        found[place_of(instance)].append(instance)
    kept: list[Instance] = []
    for target in targets:
        place = Place(target.scene_id, target.image_id, target.object_id)
        there = sorted(found[place], key=lambda i: -(i.visible_fraction or 0.0))
        if len(there) < target.count:
            raise InputError(
                f"{dataset.folder}: the targets ask for {target.count} of object "
                f"{target.object_id} in scene {target.scene_id}, image {target.image_id}, but "
                f"{len(there)} are annotated in split {dataset.split!r}; give the list of this "
                "very split"
            )
        kept += there[: target.count]
    kept.sort(key=lambda i: (i.scene_id, i.image_id, i.index))
    return replace(dataset, instances=kept)


PVNET_DIAMETERS_M = {
    1: 0.097430, 2: 0.286908, 4: 0.171593, 5: 0.193416, 6: 0.152633, 8: 0.259425, 9: 0.107131,
    10: 0.176364, 11: 0.164857, 12: 0.148204, 13: 0.303153, 14: 0.285155, 15: 0.208394,
}  # fmt: skip
"""Of LineMOD's 13 objects by BOP's number, as PVNet's published evaluation has them."""

_OTHER_DATA_SET = 0.25


def diameter_of(model: ObjectModel, config: EvaluationConfig) -> float:
    """Give the diameter [m] that the thresholds are shares of.

    Raises:
        InputError: PVNet's table is asked for an object that it does not have.
    """
    if config.diameters == "bop":
        return model.diameter_m
    printed_m = PVNET_DIAMETERS_M.get(model.number, 0.0)
    if abs(printed_m / model.diameter_m - 1) > _OTHER_DATA_SET:
        raise InputError(
            f"object {model.number} ({model.name}) has a diameter of {model.diameter_m:.3f} m, "
            "which is no object of PVNet's table of LineMOD; take the data set's diameters, bop"
        )
    return printed_m


def is_adds(model: ObjectModel, config: EvaluationConfig) -> bool:
    """Whether an object is measured by ADD-S."""
    return config.adds == "all" or not model.symmetries.is_none
