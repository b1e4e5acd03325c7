"""Devices, threads, precision and memory of the computation on this machine."""

import os
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext
from typing import TypeVar, cast

import torch

from depthpose.core.errors import InputError, Notice, describe_full_memory

_IMPORTING_PROCESS = os.getpid()  # a process that is forked later has another number
Item = TypeVar("Item")
Result = TypeVar("Result")


class PrecisionNotice(Notice):
    """This machine does not compute in the wanted precision, and another one is taken."""


@contextmanager
def force_float32() -> Iterator[None]:
    """Inside the block, make float32 on the CPU torch's default, and switch autocast off.

    With a caller's autocast, default dtype or default device, weights and inputs would differ in
    dtype or device. The caller's settings are restored afterwards. In a process that was forked
    after this module was imported, torch is set to one thread: the other threads of OpenMP do not
    exist there, and torch would wait for them forever.
    """
    if os.getpid() != _IMPORTING_PROCESS:
        torch.set_num_threads(1)
    callers_dtype = torch.get_default_dtype()
    callers_device = torch.get_default_device()
    on_cpu = nullcontext() if callers_device.type == "cpu" else torch.device("cpu")
    if callers_dtype != torch.float32:
        torch.set_default_dtype(torch.float32)
    autocast_devices = [name for name in ("cpu", "cuda") if torch.is_autocast_enabled(name)]
    try:
        with on_cpu, ExitStack() as autocast_off:
            for name in autocast_devices:
                autocast_off.enter_context(torch.autocast(name, enabled=False))
            yield
    finally:
        if callers_dtype != torch.float32:
            torch.set_default_dtype(callers_dtype)


def iterate_in_float32(items: Iterator[Result]) -> Iterator[Result]:
    """Yield the items of a generator, computing each of them inside :func:`force_float32`.

    Between two items the caller's own settings hold.
    """
    end = object()
    while True:
        with force_float32():
            item = next(items, end)
        if item is end:
            return
        yield cast(Result, item)


def map_in_threads(
    function: Callable[[Item], Result], items: Iterable[Item], threads: int
) -> Iterator[Result]:
    """Apply a function to items in several threads; yield the results in the order of the items.

    At most ``threads`` items are being processed or wait to be yielded, so that the inputs of a
    long run need not fit into memory.

    Args:
        function: called without gradients.
        items: taken one by one.
        threads: number of threads, which share torch's processor cores.

    Raises:
        InputError: fewer than one thread.
    """
    if threads < 1:
        raise InputError(f"threads is {threads}; take 1 or more, 2 where two cores are free")
    function_without_gradients = torch.no_grad()(function)
    if threads == 1:
        yield from map(function_without_gradients, items)
        return

    cores = torch.get_num_threads()
    cores_per_thread = max(1, cores // threads)
    futures: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(
        threads, initializer=torch.set_num_threads, initargs=(cores_per_thread,)
    ) as pool:
        try:
            for item in items:
                futures.append(pool.submit(function_without_gradients, item))
                if len(futures) == threads:
                    yield futures.popleft().result()
            while futures:
                yield futures.popleft().result()
        finally:  # also where the caller takes no more results
            for future in futures:
                future.cancel()
            torch.set_num_threads(cores)


@contextmanager
def refused_memory(name: str) -> Iterator[None]:
    """Turn an out-of-memory error into an :class:`InputError` that begins with ``name``.

    A run over many inputs then goes on with the next, which may be smaller.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        reason = describe_full_memory(error)
        if reason is None:
            raise
        raise InputError(f"{name}: {reason}") from error


def usable_device(name: str | torch.device) -> torch.device:
    """Return the device of a name, such as ``cpu`` or ``cuda:1``, after a small computation on it.

    Raises:
        InputError: this machine has no such device, or it cannot compute in float64.
    """
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError) as error:  # its text would list all 20 kinds of torch
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
    """Return the device of this process: for ``cuda`` the GPU of its rank, such as ``cuda:1``.

    The rank is that of a launcher (``LOCAL_RANK``). Without a launcher ``cuda`` is returned as it
    is, and so is any other device.
    """
    local_rank = os.environ.get("LOCAL_RANK", "")
    if device == "cuda" and local_rank.isdecimal():
        return f"cuda:{local_rank}"
    return device


def computes_bf16(device: str | torch.device) -> bool:
    """Whether a device has instructions for bfloat16.

    Every accelerator is taken to have them. Of processors those have for which oneDNN has bfloat16
    kernels: with AVX-512 (BW, VL and DQ), AMX or AVX-NE-CONVERT, and ARM's with BF16. On others
    oneDNN refuses bfloat16, or PyTorch computes it 20 to 30 times slower than float32.
    """
    if usable_device(device).type != "cpu":
        return True
    is_supported = getattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", None)
    return is_supported is not None and bool(is_supported())


def usable_precision(wanted: str, device: str | torch.device) -> str:
    """Return the wanted precision, or ``fp32`` in place of ``bf16`` where the device lacks it.

    Args:
        wanted: fp32, bf16 or fp16.
        device: where it is computed.

    Warns:
        PrecisionNotice: fp32 is taken in place of bf16.
    """
    if wanted != "bf16" or computes_bf16(device):
        return wanted
    notice = "this processor has no arithmetic for bf16 (AVX-512, AMX); fp32 is taken in its place"
    warnings.warn(notice, PrecisionNotice, stacklevel=2)
    return "fp32"
