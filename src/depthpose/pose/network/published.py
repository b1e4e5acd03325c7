"""Import of weights in MinkowskiEngine's layout: FCGF's ResUNetBN2C, with or without norms.

What the import writes is a bare network, without any object.
"""

import re
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from depthpose.core.checkpoint import (
    Checkpoint,
    build_network,
    file_sha256,
    read_checkpoint,
    read_published,
    save_checkpoint,
)
from depthpose.core.config import config_from_dict, config_to_dict
from depthpose.core.errors import InputError
from depthpose.pose.network.resunet import ResUNet, ResUNetConfig

KIND = "resunet"


def write_network(path: Path, network: ResUNet, facts: Mapping[str, str]) -> None:
    """Write a network with its config to one ``.safetensors`` file."""
    config, state = config_to_dict(network.config), network.state_dict()
    facts = {**facts, "norm_mode": network.config.norm}
    save_checkpoint(path, Checkpoint(kind=KIND, config=config, state=state, facts=facts))


def read_network(path: Path) -> ResUNet:
    """Read what :func:`write_network` wrote, in eval mode.

    Raises:
        InputError: no such weights, or weights that do not fit their own config.
    """
    return network_of(read_checkpoint(path, KIND), str(path))


def network_of(checkpoint: Checkpoint, source: str) -> ResUNet:
    """Build the network of a checkpoint, in eval mode; 16-bit weights come back as 32-bit.

    Raises:
        InputError: weights that do not fit their own config.
    """
    config = config_from_dict(checkpoint.config, ResUNetConfig, source=source)
    return build_network(lambda: ResUNet(config), checkpoint, source).eval()


_PARTS = {"kernel": "weight", "bias": "bias"}
_CONVS = tuple(f"conv{i}" for i in (1, 2, 3, 4)) + tuple(f"conv{i}_tr" for i in (1, 2, 3, 4))


def import_fcgf(file: Path, out: Path, *, classes: int | None = None) -> None:
    """Turn a checkpoint of FCGF's network into a weights file of ours.

    Args:
        file: the published checkpoint; it is read without running any code in it.
        out: the ``.safetensors`` file to write.
        classes: how many objects the outputs are directions for; None: they are descriptors.

    Raises:
        InputError: not such a checkpoint, or outputs that no whole number of keypoints fills.
    """
    state = read_published(file, "checkpoint of FCGF's network")
    try:
        network = resunet_from_published(state, classes=classes)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    facts = {"imported_from": Path(file).name, "source_sha256": file_sha256(file)}
    write_network(out, network, facts)


def resunet_from_published(state: Mapping[str, Tensor], *, classes: int | None = None) -> ResUNet:
    """Make the network, in eval mode, from a state dict; its size is read off the shapes.

    Args:
        state: names as FCGF gives them, with or without ``module.``.
        classes: as for :func:`import_fcgf`.

    Raises:
        InputError: a name is missing, unknown or holds another shape; nothing is half loaded.
    """
    given = {name.removeprefix("module."): value for name, value in state.items()}
    network = ResUNet(_config_of(given, classes))
    wanted = network.state_dict()
    # The count of batches steers nothing at inference, and old files do not hold it.
    ours = {name: t for name, t in wanted.items() if name.endswith("num_batches_tracked")}
    ours.update((_our_name(name), _our_shape(value)) for name, value in given.items())
    faults = [f"{name} is missing" for name in wanted if name not in ours]
    faults += [f"{name} is unknown" for name in ours if name not in wanted]
    faults += [
        f"{name} is {tuple(ours[name].shape)}, not {tuple(tensor.shape)}"
        for name, tensor in wanted.items()
        if name in ours and ours[name].shape != tensor.shape
    ]
    if faults:
        raise InputError(
            f"these are not the weights of FCGF's ResUNetBN2C: {'; '.join(faults[:4])}"
            f"{f' and {len(faults) - 4} more' if faults[4:] else ''}. Give the value that the "
            "file holds under 'state_dict'; other networks of MinkowskiEngine do not fit."
        )
    network.load_state_dict(ours)
    return network.eval()


def _config_of(given: Mapping[str, Tensor], classes: int | None) -> ResUNetConfig:
    needed = [f"{name}.kernel" for name in (*_CONVS, "final")]
    lost = [
        name
        for name in needed
        if not (isinstance(kernel := given.get(name), Tensor) and kernel.ndim in (2, 3))
    ]
    if lost:
        raise InputError(
            f"these are not the weights of FCGF's ResUNetBN2C: {', '.join(lost[:3])} "
            f"{'is' if lost[1:] == [] else 'are'} missing. Give the value that the file holds "
            "under 'state_dict'."
        )
    widths = [given[f"{name}.kernel"].shape[-1] for name in _CONVS]
    first, outputs = given["conv1.kernel"], given["final.kernel"].shape[-1]
    if classes is not None and (classes < 1 or outputs % (3 * classes)):
        raise InputError(
            f"{outputs} outputs are not 3 directions of each keypoint of {classes} classes; leave "
            "the number of classes out where the outputs are descriptors."
        )
    return ResUNetConfig(
        classes=classes or 1,
        keypoints=outputs // (3 * classes) if classes else 1,
        descriptor=outputs if classes is None else None,
        norm="batch" if any(name.startswith("norm1.") for name in given) else "none",
        with_bias="conv1.bias" in given,
        first_kernel=round(first.shape[0] ** (1 / 3)) if first.ndim == 3 else 1,
        encoder=(widths[0], widths[1], widths[2], widths[3]),
        decoder=(widths[4], widths[5], widths[6], widths[7]),
        inputs=first.shape[-2],
    )


def _our_name(published: str) -> str:
    """Translate one published name; an unknown one comes back as it is and is refused later."""
    places = {"1": "first", "2": "second"}
    rules = (
        (r"^conv1_tr\.(kernel|bias)$", lambda m: f"mix.{_PARTS[m[1]]}"),
        (r"^final\.(kernel|bias)$", lambda m: f"final.{_PARTS[m[1]]}"),
        (r"^conv([1-4])\.(kernel|bias)$", lambda m: f"down.{int(m[1]) - 1}.conv.{_PARTS[m[2]]}"),
        (r"^conv([2-4])_tr\.(kernel|bias)$", lambda m: f"up.{4 - int(m[1])}.conv.{_PARTS[m[2]]}"),
        (r"^norm([1-4])\.(?:bn\.)?(\w+)$", lambda m: f"down.{int(m[1]) - 1}.norm.{m[2]}"),
        (r"^norm([2-4])_tr\.(?:bn\.)?(\w+)$", lambda m: f"up.{4 - int(m[1])}.norm.{m[2]}"),
        (r"^block([1-4])\.", lambda m: f"down_blocks.{int(m[1]) - 1}."),
        (r"^block([2-4])_tr\.", lambda m: f"up_blocks.{4 - int(m[1])}."),
        (r"\.conv([12])\.(kernel|bias)$", lambda m: f".{places[m[1]]}.conv.{_PARTS[m[2]]}"),
        (r"\.norm([12])\.(?:bn\.)?(\w+)$", lambda m: f".{places[m[1]]}.norm.{m[2]}"),
    )
    for pattern, ours in rules:
        published = re.sub(pattern, ours, published)
    return published


def _our_shape(value: Tensor) -> Tensor:
    """MinkowskiEngine keeps 1x1 kernels as (in, out) and biases as (1, out)."""
    if value.ndim == 2:
        return value[0] if value.shape[0] == 1 else value[None]
    return value
