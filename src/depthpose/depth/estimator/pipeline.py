"""Depth from one image in the form of Hugging Face's ``pipeline("depth-estimation")``.

Code that is written for transformers' pipeline runs with this one: the same call, the same keys.
What is ours: ``predicted_depth`` is in metres, and the camera can be said.
"""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from depthpose.core.camera.camera_file import AnyCamera, AnyLens, choose_lens
from depthpose.core.errors import Notice, refuse_unknown
from depthpose.depth.config import MatcherConfig
from depthpose.depth.estimator.inputs import Picture, as_tensor, exif_focal_px
from depthpose.depth.estimator.net import DEFAULT, FakestereoNet

_PHONE = 0.75
"""Focal length of a phone's main camera, in widths of the picture."""


class DepthPipeline:
    """Pictures to ``{"predicted_depth", "depth"}``.

    Args:
        net: estimates one image.
    """

    def __init__(self, net: FakestereoNet) -> None:
        self.net = net

    def __call__(
        self,
        inputs: Picture | Sequence[Picture],
        camera: AnyCamera | None = None,
        *,
        focal_px: float | None = None,
        fov_deg: float | None = None,
    ) -> dict[str, Any] | list[dict[str, Any]]:
        """Estimate one picture, or a list of them.

        Args:
            inputs: as :meth:`FakestereoNet.estimate` takes them.
            camera: of all pictures. Without it, ``focal_px`` and ``fov_deg`` a picture's EXIF is
                taken, or else 0.75 widths, a phone's, with a notice: the metres are as wrong as
                that is.
            focal_px: the focal length alone [px].
            fov_deg: the horizontal field of view alone [degrees].

        Returns:
            For each picture ``predicted_depth``, metres (H, W), NaN where there are none, and
            ``depth``, an 8-bit picture of Pillow's, the farthest white, as transformers draws it.

        Raises:
            InputError: as :meth:`FakestereoNet.estimate`.
        """
        lens = choose_lens(camera, focal_px, fov_deg)
        if isinstance(inputs, list | tuple):
            return [self._one(one, lens) for one in inputs]
        return self._one(inputs, lens)

    def _one(self, picture: object, lens: AnyLens | None) -> dict[str, Any]:
        image = as_tensor(picture)
        if lens is None:
            lens = exif_focal_px(picture, "the picture")
        if lens is None:
            lens = _PHONE * image.shape[2]
            warnings.warn(
                f"no camera: a focal length of {lens:g} px is taken, a phone's; the metres are as "
                "wrong as it is. Give focal_px= or camera=",
                Notice,
                stacklevel=3,
            )
        (found,) = self.net.estimate_many([image], lens)
        assert found.depth_m is not None
        return {"predicted_depth": found.depth_m, "depth": _drawn(found.depth_m)}


def pipeline(
    task: str = "depth-estimation", model: str | Path | None = None, device: str | int = "cpu"
) -> DepthPipeline:
    """Build what transformers' function of this name builds, for the one task that is known.

    Args:
        task: depth-estimation.
        model: weights with a generator, by name or file; None: ``default``.
        device: cpu, cuda, cuda:1, ...; or the number of a GPU, -1 for the CPU.

    Raises:
        InputError: another task, or no such weights.
    """
    refuse_unknown("task", task, ["depth-estimation"])
    if isinstance(device, int):
        device = f"cuda:{device}" if device >= 0 else "cpu"
    net = FakestereoNet.load(model or DEFAULT, config=MatcherConfig(device=device))
    return DepthPipeline(net)


def _drawn(depth_m: Float[Tensor, "h w"]) -> Image.Image:
    """Draw depth from the nearest (black) to the farthest (white); what has none is white too."""
    known = depth_m[depth_m.isfinite()]
    low, high = known.aminmax() if len(known) else (torch.zeros(()), torch.ones(()))
    share = ((depth_m - low) / (high - low).clamp(min=1e-6)).nan_to_num(1.0)
    return Image.fromarray((255 * share.clamp(0, 1)).byte().cpu().numpy())
