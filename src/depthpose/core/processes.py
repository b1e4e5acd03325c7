"""Processes that a launcher starts with one command: their ranks, and waiting for each other."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from depthpose.core.errors import InputError

_RESULTS_POLL_S = 0.2  # between two looks at what other processes have finished

Item = TypeVar("Item")


@dataclass(frozen=True, kw_only=True)
class ProcessRank:
    """The rank of this process among those that a launcher started with one command."""

    rank: int = 0  #: 0 .. world - 1
    world: int = 1  #: number of processes

    def share_of(self, items: Sequence[Item]) -> Sequence[Item]:
        """Return this process's share of a list: items ``rank``, ``rank + world``, and so on."""
        return items[self.rank :: self.world]


def find_rank() -> ProcessRank:
    """Read the rank of this process from RANK and WORLD_SIZE; without them it is the only one.

    ``torchrun`` and ``accelerate launch`` set these variables.

    Raises:
        InputError: they are not whole numbers, or the rank is not below the number of processes.
    """
    rank = os.environ.get("RANK", "0")
    world = os.environ.get("WORLD_SIZE", "1")
    if not (rank.isdecimal() and world.isdecimal() and int(rank) < int(world)):
        raise InputError(
            f"RANK is {rank!r} and WORLD_SIZE {world!r}, but a rank is "
            "0 .. WORLD_SIZE - 1; let torchrun or accelerate launch set them, or unset both"
        )
    return ProcessRank(rank=int(rank), world=int(world))


def wait_for(
    names: Sequence[str],
    is_finished: Callable[[str], bool],
    timeout_s: float = 3600.0,
    count_steps: Callable[[], int] | None = None,
) -> None:
    """Wait until the processes of a launch have finished the results of all ``names``.

    Args:
        names: names of the results.
        is_finished: whether the result of a name is finished.
        timeout_s: longest time without progress; then a process is taken to have died.
        count_steps: a count whose growth is progress too, such as frames of a long video; None:
            only finished names are progress.

    Raises:
        InputError: there was no progress for that time; names the first result that is missing.
    """
    missing = [name for name in names if not is_finished(name)]
    step_count = 0
    last_progress = time.monotonic()
    while missing:
        if time.monotonic() - last_progress > timeout_s:
            raise InputError(
                f"nothing new for {timeout_s:.0f} s and {len(missing)} of {len(names)} are "
                f"missing, first {missing[0]!r}: another process may have failed. Start again; "
                "what is finished is kept."
            )
        time.sleep(min(_RESULTS_POLL_S, timeout_s))
        still_missing = [name for name in missing if not is_finished(name)]
        new_step_count = 0 if count_steps is None else count_steps()
        if len(still_missing) < len(missing) or new_step_count > step_count:
            last_progress = time.monotonic()
        missing = still_missing
        step_count = new_step_count
