"""BOP's csv of predictions, ours and anybody's."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from depthpose.core.errors import InputError
from depthpose.pose.datasets import BopDataset, BopResult, read_results, write_results
from depthpose.pose.predictions.records import Place, Prediction, score_of
from depthpose.pose.types import PoseEstimate


def results_name(dataset: BopDataset) -> str:
    """Name the BOP csv of a data set: ``depthpose_DATASET-SPLIT.csv``."""
    return f"depthpose_{dataset.folder.resolve().name}-{dataset.split}.csv"


def read_bop_results(path: Path) -> list[Prediction]:
    """Read anybody's BOP csv as predictions.

    A row has a share of its image's time; its score is kept as the share of votes that agree.

    Raises:
        InputError: the file is missing or damaged.
    """
    results = read_results(path)
    rows_of = Counter((result.scene_id, result.image_id) for result in results)
    found: list[Prediction] = []
    for row, result in enumerate(results, 1):
        place = Place(result.scene_id, result.image_id, result.object_id)
        whole_s = result.seconds
        estimate = PoseEstimate(
            name=f"row {row}",
            object=f"obj_{result.object_id:06d}",
            status="ok",
            camera_from_model=result.camera_from_model,
            inlier_share=result.score,
            seconds={} if whole_s is None else {"image": whole_s / rows_of[place[:2]]},
        )
        found.append(Prediction(estimate=estimate, place=place))
    return found


def alternatives_name(dataset: BopDataset) -> str:
    """Name the csv that holds alternatives too: ``depthpose-alternatives_DATASET-SPLIT.csv``."""
    return results_name(dataset).replace("depthpose_", "depthpose-alternatives_", 1)


def write_bop_results(
    path: Path, predictions: Iterable[Prediction], *, with_alternatives: bool = False
) -> None:
    """Write BOP's csv; refused ones have no row. An image's time is the sum over its estimates.

    Args:
        path: the csv.
        predictions: of a data set.
        with_alternatives: give each alternative a row too, its probability the score. BOP's
            measures take the surest rows of an image, so they are no row of the csv that is
            measured.

    Raises:
        InputError: a pose belongs to no scene, or the disk refuses.
    """
    known = list(predictions)
    seconds: dict[tuple[int, int], float] = {}
    for prediction in known:
        if prediction.place is not None:
            image = prediction.place[:2]
            spent = sum(prediction.estimate.seconds.values())
            seconds[image] = seconds.get(image, 0.0) + spent
    answered = [p for p in known if p.estimate.is_posed]
    if with_alternatives:
        answered = [other for p in answered for other in [p, *_others(p)]]
    write_results(path, [_result(p, seconds) for p in answered])


def _others(prediction: Prediction) -> list[Prediction]:
    """Give each alternative as a prediction of its own."""
    return [
        replace(
            prediction,
            estimate=replace(
                prediction.estimate,
                camera_from_model=other.camera_from_model,
                certainty=other.probability,
                alternatives=(),
            ),
        )
        for other in prediction.estimate.alternatives
    ]


def _result(prediction: Prediction, seconds: dict[tuple[int, int], float]) -> BopResult:
    pose, place = prediction.estimate.camera_from_model, prediction.place
    if place is None:
        raise InputError(
            f"{prediction.estimate.name}: belongs to no scene of a BOP data set, and its csv is of "
            "such; leave it out"
        )
    assert pose is not None
    spent_s = seconds[place[:2]]
    return BopResult(
        scene_id=place.scene_id,
        image_id=place.image_id,
        object_id=place.object_id,
        score=score_of(prediction.estimate),
        camera_from_model=pose,
        seconds=spent_s if spent_s > 0 else None,
    )
