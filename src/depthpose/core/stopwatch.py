"""Measurement of the time that each stage of a computation takes."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Measures named stages in seconds of wall time.

    Example::

        watch = Stopwatch()
        with watch.stage("icp"):
            refine()
        print(watch.seconds["icp"])
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}  #: time of each stage so far, by name [s]

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure a ``with`` block, and add its time to ``seconds[name]``."""
        began = time.perf_counter()
        try:
            yield
        finally:
            spent_s = time.perf_counter() - began
            self.seconds[name] = self.seconds.get(name, 0.0) + spent_s
