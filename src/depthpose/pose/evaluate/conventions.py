"""Predictions by another convention: of which change of all of them would most be right?"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from depthpose.core.rigid import Rigid
from depthpose.pose.datasets import BopDataset
from depthpose.pose.evaluate.errors import METRICS, ErrorContext, match
from depthpose.pose.predictions import Prediction, place_of

_TRIED = 40
"""Instances that each change is tried on."""
_MANY, _TIMES = 0.2, 3
"""A change is said where so many are right by it, and so many times more than without."""
_SCALES = {
    1.0: "",
    1000.0: "t were 1000 times larger (is it in metres? BOP's csv has millimetres)",
    10.0: "t were 10 times larger (is it in centimetres? BOP's csv has millimetres)",
    0.001: "t were 1000 times smaller (is it in mm? poses.json has metres, BOP's csv mm)",
}
_TURNS = {
    "": lambda pose: pose,
    "R were transposed (it is written row by row)": lambda pose: Rigid(pose.R.mT, pose.t_m),
    "poses were inverted (they are camera_from_model)": lambda pose: pose.inverse(),
    "y and z of the camera were negated (y is down, z forward; OpenGL's are y up, z backward)": (
        lambda pose: Rigid(_FLIP.to(pose.R) @ pose.R, _FLIP.to(pose.t_m) @ pose.t_m)
    ),
}
_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


def convention_advice(
    dataset: BopDataset,
    predictions: Sequence[Prediction],
    rulers: Mapping[int, ErrorContext],
    limit: float,
) -> str | None:
    """Say by which change of all predictions many more were right; None where by none.

    Args:
        dataset: instances with truth.
        predictions: of them.
        rulers: of each object, by its number.
        limit: the ADD (ADD-S) of a success, in diameters.
    """
    answers = [p for p in predictions if p.estimate.is_posed]
    there = match(dataset.instances, answers, dataset.objects)
    seen = [instance for instance in dataset.instances if instance.name in there]
    some = seen[:: max(1, len(seen) // _TRIED)][:_TRIED]
    places, names = {place_of(one) for one in some}, {one.name for one in some}
    answers = [p for p in answers if p.place in places or p.estimate.name in names]

    def count_right(scale: float, turn: str) -> int:
        changed: list[Prediction] = []
        for one in answers:
            pose = one.estimate.camera_from_model
            assert pose is not None
            pose = _TURNS[turn](Rigid(pose.R.double(), pose.t_m.double()))
            pose = Rigid(pose.R, pose.t_m * scale)
            estimate = replace(one.estimate, camera_from_model=pose)
            changed.append(replace(one, estimate=estimate))
        found = match(some, changed, dataset.objects)
        right = 0
        for instance in some:
            pose = found[instance.name].camera_from_model if instance.name in found else None
            if pose is not None:
                ruler = rulers[instance.object_id]
                error_m = METRICS["error_m"].measure(pose, instance, ruler)
                right += float(error_m) < limit * ruler.diameter_m
        return right

    now = count_right(1.0, "")
    enough = max(min(3, len(some)), _MANY * len(some), _TIMES * now)
    best, said = 0, ""
    for turn in _TURNS if some and now < len(some) / _TIMES else ():
        for scale, words in _SCALES.items():
            right = count_right(scale, turn)
            if right > best:
                best, said = right, " and ".join(filter(None, (words, turn)))
    if not said or best < enough:
        return None
    return f"{now} of {len(some)} answers that were tried are right, but {best} were if {said}"
