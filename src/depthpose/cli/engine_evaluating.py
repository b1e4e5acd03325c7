"""The work behind ``depthpose depth evaluate --predictions SHARDS``.

Each frame is measured where its shard is read; the rows of all frames come together here, in the
order of the data set, and are summed as if one process had measured them.
"""

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from depthpose.cli.engine import EngineOptions
from depthpose.cli.evaluating import signed
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
from depthpose.depth.evaluate import Evaluation, Measured, measure_frame, summarise
from depthpose.depth.kitti import Dataset, open_dataset

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
    made = read_job_settings(predictions)
    settings = {
        "predictions": made, "data": truth.data, "split": truth.split,
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
    return signed(summarise(dataset, truth.protocol, found), name, made)


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
