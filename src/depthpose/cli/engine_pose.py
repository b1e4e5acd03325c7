"""The work behind ``depthpose pose predict --engine ray``."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from depthpose.cli.engine import EngineOptions, Inputs, Weights, run
from depthpose.cli.pose_inputs import CLOUDS, input_job, object_named
from depthpose.cli.pose_methods import PoseMethod, pose_methods
from depthpose.cli.pose_predicting import estimate_jobs
from depthpose.core.camera import Camera, read_camera
from depthpose.core.config import config_to_dict
from depthpose.core.engine import Files, Function, Job, Sample, stem
from depthpose.core.errors import InputError
from depthpose.core.files import image_size, write_json
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.pose.config import EstimateConfig, Unit
from depthpose.pose.estimator.given import cloud_input, view_input
from depthpose.pose.estimator.prepare import AnyInput
from depthpose.pose.predictions import Prediction, is_finished, prediction_row

CLOUD_FILES = Files(roles=("cloud",), suffixes=CLOUDS)
VIEW_FILES = Files(roles=("depth", "mask"), suffixes=(*LISTED_SUFFIXES, ".json"))
ENDING = "pose.json"
"""Of the one file of a result: an entry of ``poses.json``."""


@dataclass(frozen=True, kw_only=True)
class PoseWork:
    """Clouds, or depth images and masks, to poses or the reasons for none."""

    weights: Weights
    config: EstimateConfig
    object: str
    unit: Unit | None
    camera: Camera | None
    files: Files
    batch: int
    endings: Sequence[str] = (ENDING,)

    def start(self) -> Function:
        """Build the network."""
        with self.weights.unpacked() as path:
            (method,) = pose_methods([path], self.config)
        return partial(_predict, method, self)


def predict(
    words: Sequence[str],
    files: Files,
    work: PoseWork,
    camera: Path | None,
    out: str,
    options: EngineOptions,
) -> int:
    """Pose by an engine.

    Args:
        words: clouds, or depth images and masks, manifests or tar shards.
        files: what an input is made of.
        work: without the camera, and with the object that the user named.
        camera: file of the depth images' camera.
        out: folder of the results.
        options: of the engine.
    """
    inputs = Inputs.find(words, files)
    _refuse_other_masks(words, inputs)
    with work.weights.unpacked() as path:
        (method,) = pose_methods([path], replace(work.config, device="cpu"))
    name = object_named(work.object or None, method)
    known = None
    with inputs.first() as first:
        if camera is not None:
            known = read_camera(camera, image_size(first[0]))
    facts = {} if known is None else {"K": known.K.tolist()}
    settings = {
        **method.settings,
        "estimate": config_to_dict(work.config),
        "object": name,
        "unit": work.unit,
        **facts,
    }
    job = Job(
        work=replace(work, object=name, camera=known),
        items=inputs.items,
        tars=inputs.tars,
        out=out,
        settings=settings,
        form=options.shards,
        block=options.block,
    )
    return run(job, options, "inputs")


def _refuse_other_masks(words: Sequence[str], inputs: Inputs) -> None:
    """Refuse two folders whose files are not called alike; one manifest pairs as it likes."""
    for item in inputs.items if len(words) == 2 else ():
        depth, mask = map(stem, item.files)
        if depth != mask and len(inputs.items) > 1:
            raise InputError(
                f"{words[1]}: no mask called {depth!r}; the mask of a depth image bears its name"
            )


def _predict(method: PoseMethod, work: PoseWork, samples: Sequence[Sample], out: Path) -> list[str]:
    jobs = [input_job(s.name, work.object, partial(_read, work, s)) for s in samples]
    reasons: list[str] = []
    for estimate in estimate_jobs(method, jobs):
        prediction = Prediction(estimate=estimate)
        write_json(out / f"{estimate.name}.{ENDING}", prediction_row(prediction))
        reasons.append("" if is_finished(prediction) else estimate.reason)
    return reasons


def _read(work: PoseWork, sample: Sample) -> AnyInput:
    if work.camera is None:
        return cloud_input(sample.files[0], work.unit or "m", work.object, sample.name)
    depth, mask = sample.files
    return view_input(depth, mask, work.camera, work.object, sample.name, work.unit)
