"""Which instances are measured, said so that two numbers can be told apart."""

import hashlib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

from depthpose.core.errors import InputError
from depthpose.pose.bop import BopDataset, Instance, Target
from depthpose.pose.predictions import Place, place_of


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
