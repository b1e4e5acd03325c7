"""Samples a second of each data source and number of workers, and of the training steps.

    python bench/training_speed.py --data FOLDER [--workers 0 1 2]

Sources: a folder of pairs (read, decoded, augmented), the same held in memory, and streets rendered
on the fly. Then the samples a second that the compact training steps take.
"""

import itertools
import time
from dataclasses import replace
from pathlib import Path

import torch
from shared import make_parser, report, setting
from torch.utils.data import DataLoader

from depthpose.core.config import read_config
from depthpose.depth.augment import TrainingPair
from depthpose.depth.config import PairsConfig, StreetsConfig
from depthpose.depth.generators import UNetGenerator
from depthpose.depth.stereo import PSMNet
from depthpose.depth.train import FinetuneTask, StereoTask, TrainingPairs, ViewTask
from depthpose.depth.train.config import FinetuneTraining, StereoTraining, ViewTraining

CONFIGS = Path(__file__).parents[1] / "configs" / "depth"


def sources(data: str, view: ViewTraining) -> dict[str, PairsConfig]:
    """Configure three data sources for the compact generator."""
    pairs = replace(view.pairs, folders=(data,), with_cache=False)
    synthetic = StreetsConfig(scale=0.52)
    return {
        "folder": pairs,
        "folder, in memory": replace(pairs, with_cache=True),
        "streets on the fly": replace(pairs, folders=(), streets=synthetic),
    }


def data_rate(config: PairsConfig, workers: int, samples: int) -> float:
    """Measure samples a second, after the workers have started."""
    pairs = TrainingPairs(config, 0, needs_truth=False)
    if config.with_cache:
        for index in range(len(pairs)):
            pairs.read(index)
    indices = [[3 * k, 3 * k + 1, 3 * k + 2] for k in range(samples)]
    loader = iter(DataLoader(pairs, batch_sampler=indices, num_workers=workers))  # pyright: ignore[reportArgumentType]
    warm_up = 2 + 2 * workers
    for _ in itertools.islice(loader, warm_up):
        pass
    start_s = time.perf_counter()
    count = sum(len(batch.left) for batch in itertools.islice(loader, samples - warm_up))
    return count / (time.perf_counter() - start_s)


def step_rates(pairs: PairsConfig) -> dict[str, float]:
    """Measure the samples a second that each compact stage takes, in its own precision."""
    view = read_config(CONFIGS / "compact-view.yaml", ViewTraining)
    stereo = read_config(CONFIGS / "compact-stereo.yaml", StereoTraining)
    finetune = read_config(CONFIGS / "compact-finetune.yaml", FinetuneTraining)
    generator = UNetGenerator(view.generator)
    matcher = PSMNet(stereo.network_config)
    frozen = PSMNet(stereo.network_config)
    stages = {
        "view": (ViewTask(generator, view, None), view),
        "stereo": (StereoTask(matcher, stereo, None), stereo),
        "finetune": (FinetuneTask(generator, frozen, finetune, None), finetune),
    }
    rates = {}
    for name, (task, config) in stages.items():
        augmented = replace(pairs, augment=config.pairs.augment)
        dataset = TrainingPairs(augmented, 0, needs_truth=True)
        samples = [dataset[k] for k in range(config.loop.batch_size)]
        batch = TrainingPair(*(torch.stack(field) for field in zip(*samples, strict=True)))
        times_s = []
        for _ in range(4):
            start_s = time.perf_counter()
            with torch.autocast("cpu", torch.bfloat16, enabled=config.loop.precision == "bf16"):
                for turn in task.step(batch):
                    turn.loss.backward()
                    task.optimizers[turn.optimizer][0].step()
            times_s.append(time.perf_counter() - start_s)
        rates[name] = config.loop.batch_size / min(times_s[1:])  # the first step compiles
    return rates


def main() -> None:
    """Print both tables and write them to out/bench."""
    parser = make_parser(__doc__)
    parser.add_argument("--data", required=True, help="folder of pairs with truth")
    parser.add_argument("--workers", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--batches", type=int, default=20)
    options = parser.parse_args()
    view = read_config(CONFIGS / "compact-view.yaml", ViewTraining)
    configs = sources(options.data, view)
    rates = step_rates(configs["folder"])
    print(setting())
    report(
        "training_speed_steps",
        [{"stage": name, "samples_per_s": rate} for name, rate in rates.items()],
    )
    rows = []
    for name, config in configs.items():
        for workers in options.workers:
            rate = data_rate(config, workers, options.batches)
            rows.append({"source": name, "workers": workers, "samples_per_s": rate})
    report("training_speed", rows)


if __name__ == "__main__":
    main()
