"""Pictures to depth by the interface of transformers' pipelines."""

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
    FakestereoNet,
    Picture,
    as_input,
)
from depthpose.depth.types import StereoInput

_PHONE = 0.75
"""Focal length of a phone's main camera, in widths of the picture."""


@dataclass(eq=False)
class DepthPipeline:
    """Pictures to ``{"predicted_depth", "depth"}``."""

    net: FakestereoNet  #: estimates images
    batch_size: int = 1  #: pictures of one size in one call of its networks

    def __call__(
        self,
        inputs: Picture | Iterable[Picture] | None = None,
        camera: AnyCamera | None = None,
        *,
        images: Picture | Iterable[Picture] | None = None,
        focal_px: float | None = None,
        fov_deg: float | None = None,
        batch_size: int | None = None,
        timeout: float | None = None,
    ) -> dict[str, Any] | list[dict[str, Any]] | Iterator[dict[str, Any]]:
        """Estimate one picture, a list of them, or what a generator or data set gives.

        Args:
            inputs: as :meth:`FakestereoNet.estimate` takes them, and as transformers does: the
                address of a picture (http, https), or its file in base64.
            camera: of all pictures. Without it, ``focal_px`` and ``fov_deg`` a picture's EXIF is
                taken, or else 0.75 widths, a phone's, with a notice: the metres are as wrong as
                that is.
            images: another name of ``inputs``.
            focal_px: the focal length alone [px].
            fov_deg: the horizontal field of view alone [degrees].
            batch_size: pictures of one size in one call of the networks; None: the pipeline's.
            timeout: of a download [s]; None: none.

        Returns:
            For each picture ``predicted_depth``, metres (H, W), NaN where there are none, and
            ``depth``, an 8-bit picture of Pillow's, the farthest white, as transformers draws it.
            Of a list a list, of another iterable an iterator.

        Raises:
            InputError: as :meth:`FakestereoNet.estimate`.
        """
        if (inputs is None) == (images is None):
            raise InputError("give the pictures, as the first argument or as images=")
        pictures_given = images if inputs is None else inputs
        lens = choose_lens(camera, focal_px, fov_deg)
        is_one = isinstance(pictures_given, str | Path | Image.Image | np.ndarray | Tensor)
        pictures = [pictures_given] if is_one else cast("Iterable[Picture]", pictures_given)
        estimates = self._each(pictures, lens, batch_size or self.batch_size, timeout)
        if is_one:
            return next(estimates)
        return list(estimates) if isinstance(pictures_given, list | tuple) else estimates

    def _each(
        self, pictures: Iterable[Picture], lens: AnyLens | None, batch: int, timeout: float | None
    ) -> Iterator[dict[str, Any]]:
        """Estimate pictures batch by batch; without a camera a phone's is assumed."""
        left = iter(pictures)
        while chunk := list(islice(left, batch)):
            inputs: list[StereoInput] = []
            for picture in chunk:
                taken = as_input(_opened(picture, timeout), "the picture", lens)
                if taken.camera is None:
                    height, width = taken.left.shape[1:]
                    phone_focal_px = _PHONE * width
                    taken = replace(taken, camera=camera_of(phone_focal_px, (width, height)))
                    warnings.warn(
                        f"no camera: a focal length of {phone_focal_px:g} px is taken, a phone's; "
                        "the metres are as wrong as it is. Give focal_px= or camera=",
                        Notice,
                        stacklevel=3,
                    )
                inputs.append(taken)
            for estimate in self.net.estimate_many(inputs, batch=batch):
                if isinstance(estimate, InputError):
                    raise estimate
                assert estimate.depth_m is not None
                # From the nearest (black) to the farthest (white); what has none is white too.
                depth_m = estimate.depth_m
                known_m = depth_m[depth_m.isfinite()]
                low, high = known_m.aminmax() if len(known_m) else torch.tensor([0.0, 1.0])
                share = ((depth_m - low) / (high - low).clamp(min=1e-6)).nan_to_num(1.0)
                drawn = Image.fromarray((255 * share.clamp(0, 1)).byte().cpu().numpy())
                yield {"predicted_depth": depth_m, "depth": drawn}


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
    """Build what transformers' function of this name builds, for the one task that is known.

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
    foreign = [name for name, value in others.items() if value is not None]
    if foreign:
        raise InputError(
            f"pipeline: {foreign[0]} is no option here; leave it out (a model is a name of "
            "'depthpose weights list', a file or hf://OWNER/NAME@REVISION)"
        )
    precision = torch_dtype if dtype is None else dtype
    if precision not in (None, "auto", "float32", torch.float32):
        raise InputError(f"pipeline: torch_dtype is {precision}; networks run in float32, omit it")
    if device is not None and device_map is not None:
        raise InputError("pipeline: device and device_map are both given; omit one of the two")
    chosen = device_map if device is None else device
    if chosen == "auto":
        chosen = "cuda" if torch.cuda.is_available() else "cpu"
    if isinstance(chosen, int):
        chosen = f"cuda:{chosen}" if chosen >= 0 else "cpu"
    if isinstance(chosen, Mapping):
        raise InputError(
            "pipeline: device_map is a mapping; the networks go to one device, as 'auto'"
        )
    net = FakestereoNet.load(model or DEFAULT, config=MatcherConfig(device=str(chosen or "cpu")))
    return DepthPipeline(net, batch_size)


def _opened(picture: Picture, timeout: float | None) -> Picture:
    """Open an address or base64 text as transformers does; return anything else unchanged."""
    if not isinstance(picture, str) or os.path.isfile(picture):  # noqa: PTH113  long text is no path
        return picture
    is_address = picture.startswith(("http://", "https://"))
    try:
        if is_address:
            with urlopen(picture, timeout=timeout) as answer:  # noqa: S310  http alone
                content = answer.read()
        else:
            content = b64decode(picture.partition("base64,")[2] or picture, validate=True)
        return Image.open(BytesIO(content))
    except (OSError, ValueError) as error:
        if is_address or picture.startswith("data:"):
            shown = picture if is_address else f"{picture[:30]}..."
            raise InputError(f"{shown}: is no picture that can be read ({error})") from error
        return picture
