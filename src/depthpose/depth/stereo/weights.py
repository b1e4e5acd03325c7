"""Published weights of PSMNet, brought in."""

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from depthpose.core.checkpoint import (
    Checkpoint,
    file_sha256,
    read_torch_file,
    save_checkpoint,
)
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.depth.stereo.published import psmnet_from_published

KIND = "psmnet"


def import_psmnet(file: Path, out: Path, *, align_corners: bool) -> None:
    """Turn the authors' checkpoint into a weights file of ours.

    Args:
        file: their ``.tar`` (a PyTorch file, not an archive to unpack), read without its code.
        out: the ``.safetensors`` file to write.
        align_corners: see :func:`psmnet_from_published`; it is recorded in ``out``.

    Raises:
        InputError: not a checkpoint of the published network.
    """
    content = read_torch_file(file)
    state = content.get("state_dict", content)
    if not isinstance(state, Mapping) or not all(isinstance(v, Tensor) for v in state.values()):
        raise InputError(
            f"{file}: holds no 'state_dict' of tensors, so it is not a checkpoint of PSMNet. Its "
            f"entries are {', '.join(map(repr, list(content)[:5]))}."
        )
    try:
        network = psmnet_from_published(state, align_corners=align_corners)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    facts = {
        "align_corners": str(align_corners).lower(),
        "origin": f"imported from a file with sha256 {file_sha256(file)}",
        "trained_on": "not recorded in the published file",
        "licence": "as published by its authors",
    }
    config = config_to_dict(network.config)
    state = network.state_dict()
    save_checkpoint(out, Checkpoint(kind=KIND, config=config, state=state, facts=facts))
