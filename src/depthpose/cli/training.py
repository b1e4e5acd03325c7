"""``depthpose depth train view|select|stereo|finetune``."""

import dataclasses
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import tyro

from depthpose.core.errors import InputError

_LOOKED_AT = 20
"""Held-out pairs of a folder, where nothing else is said."""


def train(
    stage: tyro.conf.Positional[Literal["view", "select", "stereo", "finetune"]],
    out: Path,
    config: Path | None = None,
    data: tuple[str, ...] = (),
    held_out: tuple[str, ...] = (),
    generator: str | None = None,
    matcher: str | None = None,
    start: str | None = None,
    encoder: str | None = None,
    steps: int | None = None,
    seed: int | None = None,
    device: Literal["auto", "cpu"] | None = None,
    precision: Literal["fp32", "bf16", "fp16"] | None = None,
    resume: bool = False,
    finish: bool = False,
    view: str | None = None,
) -> int:
    """Train a generator, the matcher, or the first through the second, by stages.

        view      the thesis's generator, which paints the right view; needs pairs
        select    a generator that looks the right view up in the left image, and answers depth
                  itself; needs pairs with truth
        stereo    the matcher; needs pairs with truth
        finetune  either generator through the frozen matcher; needs weights of both

    A config holds every knob; the words below change what they name. The run folder keeps config,
    metrics, pictures, TensorBoard and the last state: --resume goes on from there, whatever
    stopped the training, and ends with the weights of a run that nothing stopped. Several GPUs or
    machines: 'accelerate launch -m depthpose depth train ...'.

        depthpose depth train view --config configs/depth/view.yaml --data kitti --out runs/view

    Args:
        stage: what is trained: view, select, stereo or finetune.
        out: the run folder.
        config: YAML with what differs from the thesis's settings.
        data: folders of pairs; they replace the config's.
        held_out: folders of pairs that validation looks at, and none of which is learnt from; of
            each 20, evenly taken, where the config says no other number.
        generator: finetune: weights of the generator to begin with.
        matcher: finetune: what matches the drawn view: weights with a matcher, by name or file,
            which are not changed.
        start: view, select, stereo: weights to begin with.
        encoder: select: weights of the encoder to begin with, of 'depthpose weights import
            efficientnet-lite0'.
        steps: optimiser steps in place of the config's length.
        seed: decides initial weights, order, augmentation and dropout.
        device: auto takes what accelerate finds; cpu takes no GPU.
        precision: arithmetic of the forward pass.
        resume: go on from the state that OUT holds.
        finish: make weights and card of the state that OUT holds, without another step; Ctrl-C
            twice does the same while it trains.
        view: live draws the losses in Rerun's viewer (an extra); FILE.rrd records them.
    """
    from depthpose.core.config import read_config
    from depthpose.core.run import find_shard
    from depthpose.depth.config import PairsConfig
    from depthpose.depth.train import STAGES, Run

    kind, run_stage = STAGES[stage]
    chosen = kind() if config is None else read_config(config, kind)
    loop = changed(chosen.loop, seed=seed, device=device, precision=precision)
    if steps is not None:
        loop = dataclasses.replace(loop, steps=steps, epochs=None)
    pairs = changed(chosen.pairs, folders=data or None)
    if held_out:
        looked_at = chosen.held_out or PairsConfig(
            focal_px=pairs.focal_px, truth=pairs.truth, limit=_LOOKED_AT
        )
        chosen = dataclasses.replace(
            chosen, held_out=dataclasses.replace(looked_at, folders=held_out)
        )
    words = {"generator": generator, "matcher": matcher, "start": start, "encoder": encoder}
    knobs = {field.name: field.type for field in dataclasses.fields(kind)}
    for word, value in words.items():
        if value is not None and (
            word not in knobs or (word in ("generator", "matcher") and stage != "finetune")
        ):
            raise InputError(f"--{word} has no meaning for '{stage}'; see --help.")
    chosen = changed(dataclasses.replace(chosen, loop=loop, pairs=pairs), **words)
    with progress_bar(view) as on_step:
        path = run_stage(chosen, Run(folder=out, resume=resume, finish=finish, on_step=on_step))
    if find_shard().rank == 0:
        say_trained(path)
    return 0


def say_trained(path: Path) -> None:
    """Print where the weights of a training are, and their card."""
    print(f"trained weights: {path}")
    card = path.with_suffix(".md")
    print(card.read_text() if card.is_file() else "", end="")


def changed(config: Any, **values: Any) -> Any:  # noqa: ANN401 - any config
    """Give a config with other values; None leaves a knob as it is."""
    return dataclasses.replace(config, **{k: v for k, v in values.items() if v is not None})


@contextmanager
def progress_bar(view: str | None = None) -> Iterator[Callable[[Any], None]]:
    """A bar with time left and the latest numbers; with ``view``, curves of them in Rerun too."""
    from tqdm import tqdm

    from depthpose.cli.viewing import open_viewer
    from depthpose.core.run import find_shard

    # Opened before the length is known; other processes than the first never show a step.
    is_first = find_shard().rank == 0
    is_logged = is_first and not (sys.stdout.isatty() and sys.stderr.isatty())
    with (
        tqdm(unit=" steps", disable=None if is_first else True) as bar,
        open_viewer(view if is_first else None) as viewer,
    ):
        lines = Lines() if is_logged else None

        def show(progress: Any) -> None:  # noqa: ANN401
            if bar.total is None:
                bar.reset(progress.steps)
                bar.initial = bar.n = progress.step - 1
            bar.update(progress.step - bar.n)
            if progress.numbers:
                bar.set_postfix({k: f"{v:.4g}" for k, v in progress.numbers.items()})
            if viewer is not None:
                viewer.show_step(progress)
            if lines is not None:
                lines.show(progress)

        yield show


class Lines:
    """A line a minute, for a log: the first step, the last, and what is left between them.

    Args:
        every_s: seconds between two lines.
        clock: seconds that only grow.
    """

    def __init__(self, every_s: float = 60.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._every_s, self._clock = every_s, clock
        self._began: tuple[int, float] | None = None
        self._last_s = 0.0
        self._numbers: dict[str, float] = {}

    def show(self, progress: Any) -> None:  # noqa: ANN401
        """Print a line where one is due; the latest numbers stand in it."""
        now_s = self._clock()
        self._numbers = progress.numbers or self._numbers
        is_end = progress.step >= progress.steps
        if self._began is None:
            self._began = (progress.step, now_s)
        elif not is_end and now_s - self._last_s < self._every_s:
            return
        self._last_s = now_s
        first, began_s = self._began
        said = [f"step {progress.step} of {progress.steps}"]
        if first < progress.step < progress.steps:
            left_s = (progress.steps - progress.step) * (now_s - began_s) / (progress.step - first)
            said.append(f"{left_s / 60:.0f} min left")
        said += [f"{name} {value:.4g}" for name, value in self._numbers.items()]
        print(", ".join(said), flush=True)
