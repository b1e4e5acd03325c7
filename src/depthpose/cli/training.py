"""Progress of trainings, and what they leave."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def say_trained(path: Path) -> None:
    """Print where the weights of a training are, and their card."""
    print(f"trained weights: {path}")
    card = path.with_suffix(".md")
    print(card.read_text() if card.is_file() else "", end="")


@contextmanager
def progress_bar(view: str | None = None) -> Iterator[Callable[[Any], None]]:
    """A bar with time left and the latest numbers; with ``view``, curves of them in Rerun too."""
    from tqdm import tqdm

    from depthpose.core.run import find_rank
    from depthpose.report.viewer import open_viewer

    # Opened before the length is known; other processes than the first never show a step.
    is_first = find_rank().rank == 0
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
