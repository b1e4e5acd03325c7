"""What this machine computes on, and in which arithmetic."""

import warnings

import torch

from depthpose.core.errors import InputError, Notice


class PrecisionNotice(Notice):
    """A precision was asked for that this machine does not compute in; another is taken."""


def usable_device(name: str | torch.device) -> torch.device:
    """Give the device of a name, such as ``cpu`` or ``cuda:1``.

    Raises:
        InputError: this machine has none of that name, or it computes no float64.
    """
    device = _named_device(name)
    try:
        torch.ones(1, dtype=torch.float64, device=device).cpu()
    except (RuntimeError, AssertionError, TypeError, ImportError) as error:
        said = str(error).splitlines()[0].partition(". ")[0]
        raise InputError(
            f"device {str(name)!r} cannot be used here ({said}); take 'cpu'"
        ) from error
    return device


def _named_device(name: str | torch.device) -> torch.device:
    try:
        return torch.device(name)
    except (RuntimeError, TypeError) as error:  # torch lists its 20 kinds
        raise InputError(
            f"device {str(name)!r} cannot be used here (no such name); take cpu, cuda or cuda:1"
        ) from error


def computes_bf16(device: str | torch.device) -> bool:
    """Whether bfloat16 is computed in itself there.

    Any accelerator does; of processors those for which oneDNN has such kernels: with AVX-512 (BW,
    VL and DQ), AMX or AVX-NE-CONVERT, and ARM's with BF16. Elsewhere oneDNN refuses bfloat16, or
    PyTorch computes it 20 to 30 times slower than float32.
    """
    if _named_device(device).type != "cpu":
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
