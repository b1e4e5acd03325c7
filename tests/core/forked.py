"""Processes that begin with torch and the loop imported, which takes seconds in a fresh one."""

import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Mapping
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import MappingProxyType

from depthpose.core.run_folder import claim_folder


def start(
    function: Callable[..., None],
    *words: object,
    said: Path,
    environment: Mapping[str, str] = MappingProxyType({}),
    **options: object,
) -> BaseProcess:
    """Start a function in a process of a session of its own, with what it says in a file."""
    # Named here, and not on import: a process has one server, and other tests have another list.
    loaded = [__name__, "tests.core.loop_task", "accelerate", "torch.utils.tensorboard"]
    multiprocessing.set_forkserver_preload(loaded)
    process = multiprocessing.get_context("forkserver").Process(
        target=_run, args=(function, words, options, said, dict(environment))
    )
    process.start()
    return process


def _run(
    function: Callable[..., None],
    words: tuple[object, ...],
    options: dict[str, object],
    said: Path,
    environment: dict[str, str],
) -> None:
    os.environ.update(environment)
    os.setsid()
    file = said.open("w", buffering=1)
    sys.stdout = sys.stderr = file
    os.dup2(file.fileno(), 1)
    os.dup2(file.fileno(), 2)
    function(*words, **options)


def hold(folder: Path, seconds: float, settings: str) -> None:
    """Claim a folder with these settings, one a letter, and hold it."""
    for a in settings:
        claim_folder(folder, {"a": int(a)})
    sys.stdout.write("held\n")
    time.sleep(seconds)
