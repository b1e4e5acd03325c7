"""What this machine computes on, and in which arithmetic."""

import os
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext
from typing import TypeVar, cast

import torch

from depthpose.core.errors import InputError, Notice, full_memory

_PROCESS = os.getpid()  # that loaded torch: one that is forked from it has another number
Item = TypeVar("Item")
Made = TypeVar("Made")


class PrecisionNotice(Notice):
    """A precision was asked for that this machine does not compute in; another is taken."""


@contextmanager
def force_float32() -> Iterator[None]:
    """Make float32 on the processor torch's default, without autocast, whatever the caller has set.

    With a caller's autocast, default dtype or default device, weights and inputs would differ in
    dtype or device. In a process that was forked after this module was imported, torch computes
    with one thread: OpenMP's other threads do not exist there, and torch would wait for them
    forever.
    """
    if os.getpid() != _PROCESS:
        torch.set_num_threads(1)
    dtype = torch.get_default_dtype()
    device = torch.get_default_device()
    on_cpu = nullcontext() if device.type == "cpu" else torch.device("cpu")
    if dtype != torch.float32:
        torch.set_default_dtype(torch.float32)
    kinds = [kind for kind in ("cpu", "cuda") if torch.is_autocast_enabled(kind)]
    try:
        with on_cpu, ExitStack() as off:
            for kind in kinds:
                off.enter_context(torch.autocast(kind, enabled=False))
            yield
    finally:
        if dtype != torch.float32:
            torch.set_default_dtype(dtype)


def each_in_float32(items: Iterator[Made]) -> Iterator[Made]:
    """Give the items of a generator, each made inside :func:`force_float32`."""
    nothing = object()
    while True:
        with force_float32():
            item = next(items, nothing)
        if item is nothing:
            return
        yield cast(Made, item)


def each_in_threads(
    work: Callable[[Item], Made], items: Iterable[Item], threads: int
) -> Iterator[Made]:
    """Do work for each item without gradients, and give the results in the order of the items.

    Items are taken only as threads become free. The threads share torch's processor cores.

    Raises:
        InputError: fewer than one thread.
    """
    if threads < 1:
        raise InputError(f"threads is {threads}; take 1 or more, 2 where two cores are free")
    without_gradients = torch.no_grad()(work)
    if threads == 1:
        yield from map(without_gradients, items)
        return
    cores = torch.get_num_threads()
    waiting: deque[Future[Made]] = deque()
    thread_cores = max(1, cores // threads)
    with ThreadPoolExecutor(threads, "", torch.set_num_threads, (thread_cores,)) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(without_gradients, item))
                if len(waiting) == threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
            torch.set_num_threads(cores)


@contextmanager
def refused_memory(name: str) -> Iterator[None]:
    """Turn an out-of-memory error into an :class:`InputError`: other inputs may be smaller."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if (reason := full_memory(error)) is None:
            raise
        raise InputError(f"{name}: {reason}") from error


def usable_device(name: str | torch.device) -> torch.device:
    """Give the device of a name, such as ``cpu`` or ``cuda:1``.

    Raises:
        InputError: this machine has none of that name, or it computes no float64.
    """
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError) as error:  # torch lists its 20 kinds
        raise InputError(
            f"device {str(name)!r} cannot be used here (no such name); take cpu, cuda or cuda:1"
        ) from error
    try:
        torch.ones(1, dtype=torch.float64, device=device).cpu()
    except (RuntimeError, AssertionError, TypeError, ImportError) as error:
        cause = str(error).splitlines()[0].partition(". ")[0]
        raise InputError(
            f"device {str(name)!r} cannot be used here ({cause}); take 'cpu'"
        ) from error
    return device


def device_of_process(device: str) -> str:
    """Give the device of this process: of ``cuda``, that which a launcher chose (LOCAL_RANK)."""
    local_rank = os.environ.get("LOCAL_RANK", "")
    return f"cuda:{local_rank}" if device == "cuda" and local_rank.isdecimal() else device


def computes_bf16(device: str | torch.device) -> bool:
    """Whether a device has instructions for bfloat16.

    Any accelerator does; of processors those for which oneDNN has such kernels: with AVX-512 (BW,
    VL and DQ), AMX or AVX-NE-CONVERT, and ARM's with BF16. Elsewhere oneDNN refuses bfloat16, or
    PyTorch computes it 20 to 30 times slower than float32.
    """
    if usable_device(device).type != "cpu":
        return True
    supports = getattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", None)
    return supports is not None and bool(supports())


def usable_precision(wanted: str, device: str | torch.device) -> str:
    """Give ``wanted``; ``fp32`` and a :class:`PrecisionNotice` where this machine has no bf16.

    Args:
        wanted: fp32, bf16 or fp16.
        device: where it is computed.
    """
    if wanted != "bf16" or computes_bf16(device):
        return wanted
    notice = "this processor has no arithmetic for bf16 (AVX-512, AMX); fp32 is taken in its place"
    warnings.warn(notice, PrecisionNotice, stacklevel=2)
    return "fp32"
