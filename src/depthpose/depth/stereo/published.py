"""Import of the weights that PSMNet's authors published."""

import re
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from depthpose.core.checkpoint import Checkpoint, file_sha256, read_published, save_checkpoint
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.depth.config import PSMNetConfig
from depthpose.depth.stereo.psmnet import PSMNet

_PARTS = {"0": "conv", "1": "norm"}
_HOURGLASS = ("down1", "same1", "down2", "same2", "up2", "up1")


def _features_name(name: str) -> str:
    rules = (
        (r"firstconv\.([024])\.([01])\.", lambda m: f"stem.{int(m[1]) // 2}.{_PARTS[m[2]]}."),
        (r"layer(\d)\.", lambda m: f"stages.{int(m[1]) - 1}."),
        (r"conv1\.0\.([01])\.", lambda m: f"first.{_PARTS[m[1]]}."),
        (r"conv2\.([01])\.", lambda m: f"second.{_PARTS[m[1]]}."),
        (r"downsample\.([01])\.", lambda m: f"shortcut.{_PARTS[m[1]]}."),
        (r"branch(\d)\.1\.([01])\.", lambda m: f"pyramid.{int(m[1]) - 1}.{_PARTS[m[2]]}."),
        (r"lastconv\.0\.([01])\.", lambda m: f"fuse.{_PARTS[m[1]]}."),
        (r"lastconv\.2\.", lambda _: "project."),
    )
    for pattern, ours in rules:
        name = re.sub(pattern, ours, name)
    return name


def _volume_name(name: str) -> str:
    rules = (
        (r"^(dres[01])\.([02])\.([01])\.", lambda m: f"{m[1]}.{int(m[2]) // 2}.{_PARTS[m[3]]}."),
        (
            r"^dres([234])\.conv([1-6])(?:\.0)?\.([01])\.",
            lambda m: f"hourglasses.{int(m[1]) - 2}.{_HOURGLASS[int(m[2]) - 1]}.{_PARTS[m[3]]}.",
        ),
        (r"^classif(\d)\.0\.([01])\.", lambda m: f"heads.{int(m[1]) - 1}.hidden.{_PARTS[m[2]]}."),
        (r"^classif(\d)\.2\.", lambda m: f"heads.{int(m[1]) - 1}.cost."),
    )
    for pattern, ours in rules:
        name = re.sub(pattern, ours, name)
    return name


def _our_name(published: str) -> str:
    """Translate one published name; an unknown one comes back as it is and is refused later."""
    name = published.removeprefix("module.")
    prefix = "feature_extraction."
    if name.startswith(prefix):
        return "features." + _features_name(name.removeprefix(prefix))
    return _volume_name(name)


def psmnet_from_published(state: Mapping[str, Tensor], *, align_corners: bool) -> PSMNet:
    """Make a PSMNet of default size, in eval mode, from the authors' state dict.

    Args:
        state: what their checkpoint holds under ``state_dict``, with or without ``module.``.
        align_corners: True for their weights of 2018 (KITTI 2015), False for those of 2021. The
            file does not say, and a wrong choice costs about a pixel.

    Raises:
        InputError: a name is missing, unknown or holds another shape; nothing is half loaded.
    """
    network = PSMNet(PSMNetConfig(align_corners=align_corners))
    wanted = network.state_dict()
    given = {_our_name(name): (name, value) for name, value in state.items()}
    optional = {name for name in wanted if name.endswith("num_batches_tracked")}
    _refuse_other_tensors(wanted, given, optional)
    # The count of batches steers nothing at inference; files older than 2018 do not hold it.
    network.load_state_dict({**wanted, **{name: value for name, (_, value) in given.items()}})
    return network.eval()


def _refuse_other_tensors(
    wanted: Mapping[str, Tensor], given: Mapping[str, tuple[str, Tensor]], optional: set[str]
) -> None:
    missing = sorted(set(wanted) - set(given) - optional)
    unknown = sorted(given[name][0] for name in set(given) - set(wanted))
    shapes = [
        f"{given[name][0]} is {tuple(given[name][1].shape)} and should be {tuple(value.shape)}"
        for name, value in wanted.items()
        if name in given and given[name][1].shape != value.shape
    ]
    faults = [
        f"{what}: {', '.join(names[:5])}{f' and {len(names) - 5} more' if names[5:] else ''}"
        for what, names in (("missing", missing), ("unknown", unknown), ("misshaped", shapes))
        if names
    ]
    if faults:
        raise InputError(
            f"these are not the weights of the published stacked-hourglass PSMNet: "
            f"{'; '.join(faults)}. Give the value that the file holds under 'state_dict'"
        )


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
    state = read_published(file, "checkpoint of PSMNet")
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
