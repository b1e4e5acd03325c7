"""A training that stops itself, for tests of resuming."""

from collections.abc import Callable

from depthpose.core.loop import Progress


class StoppedError(Exception):
    """What a killed training raises here."""


def stop_after(step: int) -> Callable[[Progress], None]:
    """Give what raises :class:`StoppedError` when a step is done."""

    def stop(progress: Progress) -> None:
        if progress.step == step:
            raise StoppedError

    return stop
