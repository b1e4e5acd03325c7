"""The work behind ``--engine ray`` of ``depth predict`` and ``match``, and of measuring shards.

Where shards are measured, each frame is measured where its shard is read; the rows of all frames
are collected here in the order of the data set, and summed as if one process had measured them.
"""

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from depthpose.cli.depth.evaluating import signed
from depthpose.cli.depth.matching import rig_facts, say_doubt
from depthpose.cli.depth.methods import Method, sgbm_method, weights_method
from depthpose.cli.depth.options import LensOptions, PredictOutput, ScaleOptions
from depthpose.cli.depth.predicting import Lens, Predictor, read_lens
from depthpose.cli.engine import EngineOptions, Inputs, Weights, run, say
from depthpose.core.camera import StereoRig, read_rig
from depthpose.core.engine import (
    Done,
    Files,
    Function,
    Job,
    Sample,
    read_job_settings,
    read_shard,
    result_items,
    run_here,
    run_job,
    shard_results,
    stem,
)
from depthpose.core.errors import InputError
from depthpose.core.files import VIDEO_SUFFIXES, image_size, read_image
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.depth.config import Answer, MatcherConfig
from depthpose.depth.datasets import Dataset, open_dataset
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.evaluate import Evaluation, Measured, measure_frame, summarise
from depthpose.depth.predictions import CLOUD_M, ENDINGS, write_estimate
from depthpose.depth.types import StereoInput

IMAGES = Files(roles=("image",), suffixes=LISTED_SUFFIXES)
PAIRS = Files(roles=("left", "right"), suffixes=LISTED_SUFFIXES)


@dataclass(frozen=True, kw_only=True)
class NetSpec:
    """What a worker builds its networks of; without weights it is OpenCV's matcher."""

    weights: Weights | None
    config: MatcherConfig
    with_right: bool
    with_sgbm: bool
    allow_ood: bool = True
    answer: Answer | None = None

    def build(self) -> Method:
        """Build the networks on the device of the config."""
        if self.weights is None:
            return sgbm_method(with_filled_holes=False)
        with self.weights.unpacked() as path:
            return weights_method(
                path,
                self.config,
                with_right=self.with_right,
                matcher="sgbm" if self.with_sgbm else None,
                allow_ood=self.allow_ood,
                answer=self.answer,
            )

    def settings(self) -> dict[str, Any]:
        """Say what decides the results; this machine need not have the workers' device."""
        method = replace(self, config=replace(self.config, device="cpu")).build()
        own = {"device": self.config.device} if "device" in method.settings else {}
        return method.settings | own


@dataclass(frozen=True, kw_only=True)
class PredictWork:
    """Single images to the files of their depth."""

    spec: NetSpec
    lens: Lens
    look: PredictOutput
    files: Files = IMAGES
    endings: Sequence[str] = ENDINGS

    @property
    def batch(self) -> int:
        """Images that go through the networks together."""
        return self.look.batch

    def start(self) -> Function:
        """Build the networks."""
        net = self.spec.build().net
        assert isinstance(net, FakestereoNet)
        return partial(_predict, net, self.lens, self.look)


@dataclass(frozen=True, kw_only=True)
class MatchWork:
    """Stereo pairs to the files of their depth."""

    spec: NetSpec
    rig: StereoRig
    with_cloud: bool
    with_check: bool
    files: Files = PAIRS
    endings: Sequence[str] = ENDINGS
    batch: int = 1

    def start(self) -> Function:
        """Build the matcher."""
        return partial(_match, self.spec.build(), self)


def predict(
    words: Sequence[str],
    given: tuple[LensOptions, ScaleOptions],
    spec: NetSpec,
    look: PredictOutput,
    out: str,
    options: EngineOptions,
) -> int:
    """Predict by an engine; ``given`` is what is known of the camera, and what sets the scale."""
    video = next((word for word in words if word.lower().endswith(tuple(VIDEO_SUFFIXES))), None)
    if video is not None:
        raise InputError(f"{video}: --engine ray takes no videos; omit --engine for them")
    inputs = Inputs.find(words, IMAGES)
    with inputs.first() as (image,):
        lens = read_lens(given[0], [image], given[1])
    settings = {
        **spec.settings(), "camera": lens.facts(), "color_range_m": list(look.color_range)
    }  # fmt: skip
    work = PredictWork(spec=spec, lens=lens, look=look)
    return say(run(work, inputs, out, settings, options), out, "depth maps")


def match(
    words: Sequence[str],
    camera: Path,
    spec: NetSpec,
    out: str,
    options: EngineOptions,
    *,
    with_cloud: bool,
    with_check: bool,
) -> int:
    """Match by an engine; ``words`` are the left and right sides, manifests or tar shards."""
    inputs = Inputs.find(words, PAIRS)
    with inputs.first() as (left, _):
        rig = read_rig(camera, image_size(left))
    work = MatchWork(spec=spec, rig=rig, with_cloud=with_cloud, with_check=with_check)
    settings = {**spec.settings(), "camera": rig_facts(rig)}
    return say(run(work, inputs, out, settings, options), out, "pairs")


def _predict(
    net: FakestereoNet, lens: Lens, look: PredictOutput, samples: Sequence[Sample], out: Path
) -> list[str]:
    predictor = Predictor(lens=lens, net=net, out=out, look=look)
    predictor.predict_images({sample.name: sample.files[0] for sample in samples})
    return [str(predictor.failures.get(sample.name, "")) for sample in samples]


def _match(method: Method, work: MatchWork, samples: Sequence[Sample], out: Path) -> list[str]:
    assert isinstance(method.net, FakestereoNet)
    reasons: list[str] = []
    for sample in samples:
        try:
            left, right = (read_image(file) for file in sample.files)
            pair = StereoInput(name=sample.name, left=left, right=right, camera=work.rig)
            found = method.net.estimate_pair(pair, with_check=work.with_check)
            say_doubt(pair, found)
            write_estimate(out, pair, found, cloud_m=CLOUD_M if work.with_cloud else None)
            reasons.append("")
        except InputError as error:
            reasons.append(str(error))
    return reasons


ENDING = "measured.json"
RESULTS = Files(roles=("record", "shard"), suffixes=(".json", ".tar", ".parquet"))


@dataclass(frozen=True, kw_only=True)
class ShardTruth:
    """Shards of predictions to the numbers of their frames; every worker reads the truth.

    Attributes:
        data: folder of the data set, which all workers see.
        split: of it.
        protocol: how prediction and truth are compared.
        caps_m: metres beyond which truth does not count.
    """

    data: str
    split: str | None
    protocol: str
    caps_m: tuple[float, ...]
    files: Files = RESULTS
    endings: Sequence[str] = (ENDING,)
    batch: int = 1

    def start(self) -> Function:
        """Open the data set."""
        return partial(_measure, open_dataset(Path(self.data), self.split), self)


def measure_shards(
    dataset: Dataset, predictions: str, truth: ShardTruth, out: Path, options: EngineOptions
) -> Evaluation:
    """Measure shards of predictions, here or on a cluster, and put the rows together.

    Raises:
        InputError: a prediction is missing or damaged, or no frame has truth.
    """
    items = result_items(predictions)
    before = read_job_settings(predictions)
    settings = {
        "predictions": before, "data": truth.data, "split": truth.split,
        "protocol": truth.protocol, "caps_m": list(truth.caps_m),
    }  # fmt: skip
    home = str(out / "measured" / stem(predictions.rstrip("/")))
    job = Job(work=truth, items=items, out=home, settings=settings, block=1)
    done = run_job(job, options.build() if options.is_ray else run_here)
    found = _gather(home, done, {item.name for item in items})
    with tempfile.TemporaryDirectory() as nothing:
        for index, frame in enumerate(dataset.frames):
            if frame.name not in found:  # it has no truth, or its absence is an error
                found[frame.name] = measure_frame(
                    dataset, index, Path(nothing), truth.protocol, truth.caps_m
                )
    name = stem(predictions.rstrip("/"))
    return signed(summarise(dataset, truth.protocol, found), name, before)


def _gather(home: str, every: Sequence[Done], names: set[str]) -> dict[str, list[Measured] | str]:
    found: dict[str, list[Measured] | str] = {}
    for done in every:
        for name, reason in done.failures:
            if name in names:
                raise InputError(f"{home}: {reason}")
        for name, files in shard_results(home, done):
            if name in names:
                found |= _parse(json.loads(files[ENDING]))
    return found


def _parse(values: Mapping[str, Any]) -> dict[str, list[Measured] | str]:
    return {
        frame: some if isinstance(some, str) else [Measured.from_values(one) for one in some]
        for frame, some in values.items()
    }


def _measure(
    dataset: Dataset, truth: ShardTruth, samples: Sequence[Sample], out: Path
) -> list[str]:
    return [_measure_shard(dataset, truth, sample, out) for sample in samples]


def _measure_shard(dataset: Dataset, truth: ShardTruth, sample: Sample, out: Path) -> str:
    record, shard = sample.files
    places = {frame.name: index for index, frame in enumerate(dataset.frames)}
    found: dict[str, Any] = {}
    try:
        done = Done.from_json(record.read_bytes())
        names = {name for name, reason in done.entries if not reason}
        for name, files in read_shard(str(shard), names, done.endings):
            if name in places:
                found[name] = _measure_files(dataset, places[name], files, truth)
    except InputError as error:
        return str(error)
    (out / f"{sample.name}.{ENDING}").write_text(json.dumps(found))
    return ""


def _measure_files(
    dataset: Dataset, index: int, files: Mapping[str, bytes], truth: ShardTruth
) -> list[dict[str, Any]] | str:
    """Measure one frame by the files of its prediction."""
    with tempfile.TemporaryDirectory(prefix="depthpose-") as folder:
        for ending, data in files.items():
            path = Path(folder) / f"{dataset.frames[index].name}.{ending}"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        found = measure_frame(dataset, index, Path(folder), truth.protocol, truth.caps_m)
    return found if isinstance(found, str) else [one.to_values() for one in found]
