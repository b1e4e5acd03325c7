"""What each stage of a computation took."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """A stopwatch for named stages, in wall seconds.

    Example::

        watch = Stopwatch()
        with watch.stage("icp"):
            refine()
        print(watch.seconds["icp"])
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure a ``with`` block, and add its time to that of a stage."""
        began = time.perf_counter()
        try:
            yield
        finally:
            spent_s = time.perf_counter() - began
            self.seconds[name] = self.seconds.get(name, 0.0) + spent_s
