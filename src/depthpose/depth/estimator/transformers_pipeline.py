"""Depth of pictures, by the interface of transformers' depth pipelines."""

import os
import warnings
from base64 import b64decode
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, cast
from urllib.request import urlopen

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from depthpose.core.camera import AnyCamera, AnyLens, camera_of, choose_lens
from depthpose.core.errors import InputError, Notice, refuse_unknown
from depthpose.depth.config import MatcherConfig
from depthpose.depth.estimator.net import (
    DEFAULT,
    AnyPicture,
    FakestereoNet,
    as_input,
)
from depthpose.depth.types import DepthInput, Map

_PHONE_FOCAL_WIDTHS = 0.75
"""Focal length of a phone's main camera, in widths of the picture."""


@dataclass(eq=False)
class DepthPipeline:
    """Callable that estimates depth of pictures, as transformers' pipelines do."""

    net: FakestereoNet  #: the estimator
    batch_size: int = 1  #: number of pictures in one call of its networks

    def __post_init__(self) -> None:
        _refuse_batch_size(self.batch_size)

    def __call__(
        self,
        inputs: AnyPicture | Iterable[AnyPicture] | None = None,
        camera: AnyCamera | None = None,
        *,
        images: AnyPicture | Iterable[AnyPicture] | None = None,
        focal_px: float | None = None,
        fov_deg: float | None = None,
        batch_size: int | None = None,
        timeout: float | None = None,
    ) -> dict[str, Any] | list[dict[str, Any]] | Iterator[dict[str, Any]]:
        """Estimate one picture, a list of them, or what a generator or dataset gives.

        Args:
            inputs: as :meth:`FakestereoNet.estimate` takes them, and as transformers does: the
                address of a picture (http, https), or its file in base64.
            camera: camera of all pictures. Without it, ``focal_px`` and ``fov_deg`` a picture's
                EXIF is taken, or else 0.75 widths, a phone's, with a notice: the metres are as
                wrong as that is.
            images: another name of ``inputs``.
            focal_px: the focal length alone [px].
            fov_deg: the horizontal field of view alone [degrees].
            batch_size: pictures of one size in one call of the networks; None: the pipeline's.
            timeout: longest time of a download [s]; None: no limit.

        Returns:
            For each picture ``predicted_depth``, metres (H, W), NaN where there are none, and
            ``depth``, an 8-bit picture of Pillow's, the farthest white, as transformers draws it.
            A list of pictures gives a list, another iterable an iterator.

        Raises:
            InputError: as :meth:`FakestereoNet.estimate`; a ``batch_size`` below 1.
        """
        if (inputs is None) == (images is None):
            raise InputError("give the pictures, as the first argument or as images=")
        argument = images if inputs is None else inputs
        lens = choose_lens(camera, focal_px, fov_deg)
        batch = self.batch_size if batch_size is None else batch_size
        _refuse_batch_size(batch)
        is_single = isinstance(argument, str | Path | Image.Image | np.ndarray | Tensor)
        pictures = [argument] if is_single else cast("Iterable[AnyPicture]", argument)
        estimates = self._estimate_each(pictures, lens, batch, timeout)
        if is_single:
            return next(estimates)
        return list(estimates) if isinstance(argument, list | tuple) else estimates

    def _estimate_each(
        self,
        pictures: Iterable[AnyPicture],
        lens: AnyLens | None,
        batch: int,
        timeout: float | None,
    ) -> Iterator[dict[str, Any]]:
        """Estimate pictures in batches; without a camera a phone's is assumed, with a notice."""
        remaining = iter(pictures)
        while chunk := list(islice(remaining, batch)):
            inputs: list[DepthInput] = []
            for picture in chunk:
                depth_input = as_input(_open_picture(picture, timeout), "the picture", lens)
                if depth_input.camera is None:
                    height, width = depth_input.left.shape[1:]
                    phone_focal_px = _PHONE_FOCAL_WIDTHS * width
                    camera = camera_of(phone_focal_px, (width, height))
                    depth_input = replace(depth_input, camera=camera)
                    warnings.warn(
                        f"no camera: a focal length of {phone_focal_px:g} px is taken, a phone's; "
                        "the metres are as wrong as it is. Give focal_px= or camera=",
                        Notice,
                        stacklevel=3,
                    )
                inputs.append(depth_input)
            for estimate in self.net.estimate_many(inputs, batch=batch):
                if isinstance(estimate, InputError):
                    raise estimate
                assert estimate.depth_m is not None
                picture_of_depth = _draw_grey(estimate.depth_m)
                yield {"predicted_depth": estimate.depth_m, "depth": picture_of_depth}


def _refuse_batch_size(batch_size: int) -> None:
    """Refuse a number of pictures below 1."""
    if batch_size < 1:
        raise InputError(f"pipeline: batch_size is {batch_size}; take 1 or more pictures")


def _draw_grey(depth_m: Map) -> Image.Image:
    """Draw depth in grey, from black for the nearest to white for the farthest and unknown."""
    finite_m = depth_m[depth_m.isfinite()]
    nearest_m, farthest_m = finite_m.aminmax() if len(finite_m) else torch.tensor([0.0, 1.0])
    share = (depth_m - nearest_m) / (farthest_m - nearest_m).clamp(min=1e-6)
    grey = (255 * share.nan_to_num(1.0).clamp(0, 1)).byte()
    return Image.fromarray(grey.cpu().numpy())


def pipeline(
    task: str = "depth-estimation",
    model: str | Path | None = None,
    device: str | int | torch.device | None = None,
    *,
    device_map: str | int | torch.device | Mapping[str, Any] | None = None,
    torch_dtype: str | torch.dtype | None = None,
    dtype: str | torch.dtype | None = None,
    batch_size: int = 1,
    **others: object,
) -> DepthPipeline:
    """Make a depth pipeline as transformers' function of this name does, of its one task here.

    Args:
        task: depth-estimation.
        model: weights with a generator, by name or file; None: ``default``.
        device: cpu, cuda, cuda:1, ...; or the number of a GPU, -1 for the CPU. None: the CPU.
        device_map: a device in place of ``device``; ``auto``: the GPU where there is one.
        torch_dtype: float32, the precision of the weights, or ``auto``, which is the same.
        dtype: newer name of it.
        batch_size: pictures of one size in one call of the networks.
        others: options of transformers that have no meaning here; each is refused unless None.

    Raises:
        InputError: another task, precision or option, or no such weights.
    """
    refuse_unknown("task", task, ["depth-estimation"])
    unsupported = [name for name, value in others.items() if value is not None]
    if unsupported:
        raise InputError(
            f"pipeline: {unsupported[0]} is no option here; leave it out (a model is a name of "
            "'depthpose weights list', a file or hf://OWNER/NAME@REVISION)"
        )
    precision = torch_dtype if dtype is None else dtype
    if precision not in (None, "auto", "float32", torch.float32):
        raise InputError(f"pipeline: torch_dtype is {precision}; networks run in float32, omit it")

    # The device, in all ways in which transformers lets it be named.
    if device is not None and device_map is not None:
        raise InputError("pipeline: device and device_map are both given; omit one of the two")
    chosen_device = device_map if device is None else device
    if chosen_device == "auto":
        chosen_device = "cuda" if torch.cuda.is_available() else "cpu"
    if isinstance(chosen_device, int):
        chosen_device = f"cuda:{chosen_device}" if chosen_device >= 0 else "cpu"
    if isinstance(chosen_device, Mapping):
        raise InputError(
            "pipeline: device_map is a mapping; the networks go to one device, as 'auto'"
        )

    config = MatcherConfig(device=str(chosen_device or "cpu"))
    net = FakestereoNet.load(model or DEFAULT, config=config)
    return DepthPipeline(net, batch_size)


def _open_picture(picture: AnyPicture, timeout: float | None) -> AnyPicture:
    """Open an address or base64 text as transformers does; return anything else unchanged."""
    if not isinstance(picture, str) or os.path.isfile(picture):  # noqa: PTH113  long text is no path
        return picture
    is_address = picture.startswith(("http://", "https://"))
    try:
        if is_address:
            with urlopen(picture, timeout=timeout) as response:  # noqa: S310  http alone
                content = response.read()
        else:
            content = b64decode(picture.partition("base64,")[2] or picture, validate=True)
        return Image.open(BytesIO(content))
    except (OSError, ValueError) as error:
        if is_address or picture.startswith("data:"):
            shown = picture if is_address else f"{picture[:30]}..."
            raise InputError(f"{shown}: is no picture that can be read ({error})") from error
        return picture
