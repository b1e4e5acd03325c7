"""Samples a second of each data source and number of workers, and of the training steps.

    python bench/training_speed.py --data FOLDER [--workers 0 1 2]

The source is a folder of pairs (read, decoded, augmented), the same held in memory, and streets
rendered on the fly; then the samples a second that the compact training steps take.
"""

import argparse
import itertools
import time
from dataclasses import replace
from pathlib import Path

import torch
from shared import report, setting
from torch.utils.data import DataLoader

from depthpose.core.config import read_config
from depthpose.depth.augment import TrainingPair
from depthpose.depth.config import PairsConfig, StreetsConfig
from depthpose.depth.stereo import PSMNet
from depthpose.depth.synthesis import UNetGenerator
from depthpose.depth.train import FinetuneTask, StereoTask, TrainingPairs, ViewTask
from depthpose.depth.train.config import FinetuneTraining, StereoTraining, ViewTraining

CONFIGS = Path(__file__).parents[1] / "configs" / "depth"


def sources(data: str, view: ViewTraining) -> dict[str, PairsConfig]:
    """Three data sources for the compact generator."""
    pairs = replace(view.pairs, folders=(data,), with_cache=False)
    synthetic = StreetsConfig(scale=0.52)
    return {
        "folder": pairs,
        "folder, in memory": replace(pairs, with_cache=True),
        "streets on the fly": replace(pairs, folders=(), streets=synthetic),
    }


def data_rate(config: PairsConfig, workers: int, samples: int) -> float:
    """Samples a second, after the workers have started."""
    pairs = TrainingPairs(config, 0, needs_truth=False)
    if config.with_cache:
        for index in range(len(pairs)):
            pairs.read(index)
    indices = [[3 * k, 3 * k + 1, 3 * k + 2] for k in range(samples)]
    loader = iter(DataLoader(pairs, batch_sampler=indices, num_workers=workers))  # pyright: ignore[reportArgumentType]
    warm = 2 + 2 * workers
    for _ in itertools.islice(loader, warm):
        pass
    begin, count = time.perf_counter(), 0
    for batch in itertools.islice(loader, samples - warm):
        count += len(batch.left)
    return count / (time.perf_counter() - begin)


def step_rates(pairs: PairsConfig) -> dict[str, float]:
    """Samples a second that each compact stage takes, in its own precision."""
    view = read_config(CONFIGS / "compact-view.yaml", ViewTraining)
    stereo = read_config(CONFIGS / "compact-stereo.yaml", StereoTraining)
    tune = read_config(CONFIGS / "compact-finetune.yaml", FinetuneTraining)
    generator, matcher = UNetGenerator(view.generator), PSMNet(stereo.matcher)
    frozen = PSMNet(stereo.matcher)
    crops = {
        "view": (ViewTask(generator, view, None), view),
        "stereo": (StereoTask(matcher, stereo, None), stereo),
        "finetune": (FinetuneTask(generator, frozen, tune, None), tune),
    }
    rates = {}
    for name, (task, config) in crops.items():
        chosen = replace(pairs, augment=config.pairs.augment)
        found = TrainingPairs(chosen, 0, needs_truth=True)
        samples = [found[k] for k in range(config.loop.batch_size)]
        batch = TrainingPair(*(torch.stack(part) for part in zip(*samples, strict=True)))
        times = []
        for _ in range(4):
            begin = time.perf_counter()
            with torch.autocast("cpu", torch.bfloat16, enabled=config.loop.precision == "bf16"):
                for turn in task.step(batch):
                    turn.loss.backward()
                    task.optimizers[turn.optimizer][0].step()
            times.append(time.perf_counter() - begin)
        rates[name] = config.loop.batch_size / min(times[1:])
    return rates


def main() -> None:
    """Print both tables and write them to out/bench."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--data", required=True, help="folder of pairs with truth")
    parser.add_argument("--workers", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--batches", type=int, default=20)
    options = parser.parse_args()
    view = read_config(CONFIGS / "compact-view.yaml", ViewTraining)
    chosen = sources(options.data, view)
    steps = [{"stage": n, "samples_per_s": r} for n, r in step_rates(chosen["folder"]).items()]
    print(setting())
    report("training_speed_steps", steps)
    rows = [
        {"source": name, "workers": workers,
         "samples_per_s": data_rate(config, workers, options.batches)}
        for name, config in chosen.items()
        for workers in options.workers
    ]  # fmt: skip
    report("training_speed", rows)


if __name__ == "__main__":
    main()
