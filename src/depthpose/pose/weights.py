"""Pose weights on disk: one file with a network and every object that it knows."""

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Any

import torch
from torch import Tensor

from depthpose.core.checkpoint import (
    Checkpoint,
    build_network,
    find_weights,
    halve_state,
    read_checkpoint,
    save_checkpoint,
)
from depthpose.core.config import config_from_dict, config_to_dict
from depthpose.core.errors import InputError
from depthpose.core.files.disk import refused_as
from depthpose.pose.config import SHAPE_FEATURES, CloudConfig, RefusalConfig
from depthpose.pose.mesh import (
    gap_to_surface_m,
    refuse_equal_names,
    symmetries_from_bop,
    symmetries_to_bop,
)
from depthpose.pose.networks.baselines import (
    DepthImageConfig,
    DepthImageNet,
    PointNet,
    PointNetConfig,
)
from depthpose.pose.networks.resunet import ResUNet, ResUNetConfig
from depthpose.pose.types import ObjectModel, SurfaceColors

DirectionNet = ResUNet | PointNet  #: networks whose points vote
AnyNetwork = DirectionNet | DepthImageNet  #: every network that estimates poses
KIND = "geoposenet"  #: of files with the method's own network
POSE_NETWORKS: dict[str, tuple[type[AnyNetwork], type]] = {
    KIND: (ResUNet, ResUNetConfig),
    "pointnet": (PointNet, PointNetConfig),
    "depth-image": (DepthImageNet, DepthImageConfig),
}
"""Network and config of each kind of file: the method's, and those of its baselines."""
_KEYPOINT_DIAMETERS = 0.02  # largest distance of a keypoint from the right mesh
_LARGEST_SIZE_ERROR = 0.05  # largest share by which the diameter of the right mesh is another one
_SURFACE = ("vertices_m", "faces", "normals")  # tensors that a licence may forbid to ship
_TENSORS = (*_SURFACE, "keypoints_m")  # all tensors that a model needs


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseWeights:
    """The contents of a file of pose weights: enough to pose an object without its CAD file."""

    network: AnyNetwork  #: in eval mode where it was read
    models: tuple[ObjectModel, ...]  #: the objects; class k of the network is ``models[k]``
    cloud: CloudConfig  #: by which the clouds were lifted that the network was trained on
    refusal: RefusalConfig  #: when its poses are withheld, unless the estimator's config says
    facts: Mapping[str, str]  #: the card in short: ``trained_on``, ``licence``, ``terms`` and more

    def __post_init__(self) -> None:
        # A class for each model.
        config = self.network.config
        if len(self.models) != config.classes:
            raise InputError(
                f"the network knows {config.classes} classes, but {len(self.models)} models are "
                "given; class k is models[k]. Give one model for each."
            )

        # The features that its clouds give.
        inputs = SHAPE_FEATURES if self.cloud.with_shape else 1
        if isinstance(config, ResUNetConfig) and config.inputs != inputs:
            raise InputError(
                f"the network takes {config.inputs} features of a voxel, but its clouds give "
                f"{inputs}. Set with_shape of the cloud as it was in training."
            )

        # The keypoints of each model.
        keypoints = None if isinstance(config, DepthImageConfig) else config.keypoints
        for model in self.models:
            if keypoints not in (None, len(model.keypoints_m)):
                raise InputError(
                    f"the network points at {keypoints} keypoints, but object {model.name!r} has "
                    f"{len(model.keypoints_m)}. Make the model with as many."
                )
        refuse_equal_names(self.models)


def write_pose_weights(
    path: Path, weights: PoseWeights, *, with_half: bool = False, with_meshes: bool = True
) -> None:
    """Write a network and its objects to one ``.safetensors`` file.

    Args:
        path: of the file.
        weights: the network and its objects.
        with_half: write the network in 16 bits, at half the size; models stay exact.
        with_meshes: write the models' surfaces. A licence may forbid it; then the file cannot be
            used until :func:`complete_weights` has added them again.
    """
    # The tensors: those of the network, and those of each model.
    network = weights.network
    network_state = halve_state(network) if with_half else network.state_dict()
    state = {f"network.{name}": tensor for name, tensor in network_state.items()}
    for k, model in enumerate(weights.models):
        state |= _store_tensors(k, model, _TENSORS if with_meshes else ("keypoints_m",))
        if with_meshes:
            state |= _store_colors(k, model)

    # The settings, and of each model what is no tensor.
    config = {
        "network": config_to_dict(network.config),
        "cloud": config_to_dict(weights.cloud),
        "refusal": config_to_dict(weights.refusal),
        "models": [
            {
                "name": model.name,
                "number": model.number,
                "diameter_m": model.diameter_m,
                **symmetries_to_bop(model.symmetries),
            }
            for model in weights.models
        ],
    }
    facts = dict(weights.facts)
    if isinstance(network, ResUNet):
        facts["norm_mode"] = network.config.norm
    kinds = {network_class: kind for kind, (network_class, _) in POSE_NETWORKS.items()}
    kind = kinds[type(network)]
    save_checkpoint(path, Checkpoint(kind=kind, config=config, state=state, facts=facts))


def complete_weights(path: Path, meshes: Mapping[int, ObjectModel], out: Path) -> None:
    """Add surfaces to weights that were written without them.

    Names, keypoints and symmetries stay those of the weights.

    Args:
        path: of the weights.
        meshes: models with surfaces, by number.
        out: path of the completed weights.

    Raises:
        InputError: an object is missing, or is not the one that the weights were trained on.
    """
    checkpoint = read_checkpoint(path)
    state = dict(checkpoint.state)
    for k, record in enumerate(checkpoint.config.get("models", ())):
        number = record["number"]
        keypoints_m = state[f"models.{k}.keypoints_m"]
        if number not in meshes:
            raise InputError(
                f"{path}: knows object {number} ({record['name']}), but there is no such model "
                f"among {sorted(meshes)}. Give the dataset that it was trained on."
            )

        # Is the mesh that of the object that was trained on?
        model = meshes[number]
        gap_m = gap_to_surface_m(keypoints_m, model)
        diameter_m = record["diameter_m"]
        is_other_size = abs(model.diameter_m / diameter_m - 1) > _LARGEST_SIZE_ERROR
        if gap_m > _KEYPOINT_DIAMETERS * diameter_m or is_other_size:
            raise InputError(
                f"{path}: a keypoint of object {number} ({record['name']}, {diameter_m:.3g} m "
                f"long) lies {gap_m:.3g} m off the model {model.name} ({model.diameter_m:.3g} m "
                "long): another object, frame or unit. Give the models that it was trained on."
            )

        state |= _store_tensors(k, model, _SURFACE)
        state |= _store_colors(k, model)
    save_checkpoint(out, dataclasses.replace(checkpoint, state=state))


def _store_tensors(k: int, model: ObjectModel, names: Sequence[str]) -> dict[str, Tensor]:
    """Copy tensors of model k, by their names in a file; whole numbers as 32 bits.

    They are copies, since safetensors refuses to write a tensor that two models share.
    """
    stored: dict[str, Tensor] = {}
    for name in names:
        tensor = getattr(model, name)
        dtype = tensor.dtype if tensor.is_floating_point() else torch.int32
        stored[f"models.{k}.{name}"] = tensor.to(dtype, copy=True)
    return stored


_COLORS = "colors."  # prefix of the names of a model's coloured points


def _store_colors(k: int, model: ObjectModel) -> dict[str, Tensor]:
    """Convert the colours of model k to tensors, by their names in a file; a byte for a channel."""
    colors = model.colors
    if colors is None:
        return {}
    tensors = {
        "points_m": colors.points_m.clone(),
        "normals": colors.normals.half(),
        "rgb": (255 * colors.rgb).round().clamp(0, 255).to(torch.uint8),
        # A row of three columns, as all tensors of a model are; each holds the number.
        "spacing_m": torch.full((1, 3), colors.spacing_m),
    }
    return {f"models.{k}.{_COLORS}{name}": tensor for name, tensor in tensors.items()}


def _restore_colors(state: Mapping[str, Tensor]) -> SurfaceColors | None:
    """Restore the colours among the tensors of a model; None where it has none."""
    tensors = _select_by_prefix(state, _COLORS)
    if not tensors:
        return None
    points_m = tensors["points_m"].float()
    normals = tensors["normals"].float()
    rgb = tensors["rgb"].float()
    if not len(points_m) == len(normals) == len(rgb) > 0:
        raise ValueError(f"{len(points_m)} coloured points have {len(rgb)} colours")
    spacing_m = float(tensors["spacing_m"][0, 0])
    return SurfaceColors(points_m=points_m, normals=normals, rgb=rgb / 255, spacing_m=spacing_m)


def _select_by_prefix(state: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Select the tensors whose names have a prefix, by their names without it."""
    return {
        name.removeprefix(prefix): tensor
        for name, tensor in state.items()
        if name.startswith(prefix)
    }


def read_object_numbers(path: Path) -> tuple[int, ...]:
    """Read BOP's numbers of the objects that weights know, with or without their surfaces.

    Raises:
        InputError: they are of another kind, or damaged.
    """
    checkpoint = read_checkpoint(path)
    if checkpoint.kind not in POSE_NETWORKS:
        raise InputError(
            f"{path}: holds weights of kind {checkpoint.kind!r}, which know no objects; give those "
            "of a pose network ('depthpose weights list')"
        )
    records = checkpoint.config.get("models")
    with refused_as(path, "file of pose weights", "it is damaged, or knows no objects"):
        return tuple(int(record["number"]) for record in records or ())


def read_pose_weights(path: Path) -> PoseWeights:
    """Read what :func:`write_pose_weights` wrote; 16-bit weights come back as 32-bit.

    Raises:
        InputError: no such weights, a part that is missing, or weights that do not fit their own
            config.
    """
    checkpoint = read_checkpoint(path)
    source = str(path)
    network = build_pose_network(checkpoint, source)
    if not any(f"models.0.{name}" in checkpoint.state for name in _SURFACE):
        label = quote(str(path))
        with suppress(InputError):  # a name where it leads to this file
            label = path.stem if find_weights(path.stem) == path else label
        raise InputError(
            f"{path}: came without its objects' meshes, which their licence keeps back. Put them "
            f"in once: depthpose weights complete {label} --models FOLDER --out "
            f"{quote(path.stem + '-complete.safetensors')}, with the dataset's folder."
        )

    # The objects.
    parts = checkpoint.config
    records = parts.get("models")
    if not isinstance(records, list) or not records:
        raise InputError(f"{path}: its config lists no 'models', so nothing could be posed.")
    models: list[ObjectModel] = []
    with refused_as(path, "file of pose weights", "it is damaged, or of another version"):
        for k, record in enumerate(records):
            state = _select_by_prefix(checkpoint.state, f"models.{k}.")
            models.append(_restore_model(record, state, f"{source}: model {k}"))

    # No tensor but theirs and the network's.
    prefixes = ("network.", *(f"models.{k}." for k in range(len(models))))
    strays = [name for name in checkpoint.state if not name.startswith(prefixes)]
    if strays:
        raise InputError(f"{source}: tensor {strays[0]!r} is unexpected; it belongs to no part.")
    return PoseWeights(
        network=network,
        models=tuple(models),
        cloud=config_from_dict(parts["cloud"], CloudConfig, source=source),
        refusal=config_from_dict(parts["refusal"], RefusalConfig, source=source),
        facts={name: fact for name, fact in checkpoint.facts.items() if name != "norm_mode"},
    )


def _restore_model(record: Any, state: Mapping[str, Tensor], source: str) -> ObjectModel:  # noqa: ANN401
    """Build an object from its entry in the config and its tensors; ``source`` is for errors."""
    # Is all there that an object needs?
    missing = [name for name in _TENSORS if name not in state]
    missing += [name for name in ("name", "number", "diameter_m") if name not in record]
    if missing:
        raise InputError(f"{source} has no {missing[0]!r}; the file is of another version.")

    # Do its tensors fit each other?
    vertices = state["vertices_m"]
    faces = state["faces"].long()
    shapes = {name: tuple(tensor.shape[1:]) for name, tensor in state.items()}
    if set(shapes.values()) != {(3,)} or len(state["normals"]) != len(vertices):
        raise InputError(f"{source} has tensors of shapes {shapes}; each is (n, 3).")
    if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < len(vertices):
        raise InputError(
            f"{source}: a face names vertex {int(faces.max())} of {len(vertices)}; the file is "
            "damaged."
        )
    return ObjectModel(
        name=str(record["name"]),
        number=int(record["number"]),
        vertices_m=vertices,
        faces=faces,
        normals=state["normals"],
        diameter_m=float(record["diameter_m"]),
        keypoints_m=state["keypoints_m"],
        symmetries=symmetries_from_bop(record, source=source),
        colors=_restore_colors(state),
    )


def settings_of(checkpoint: Checkpoint, source: str) -> dict[str, Any]:
    """Read the settings of a file's network, clouds and refusal, with defaults for missing ones.

    Args:
        checkpoint: of pose weights.
        source: of the checkpoint, in errors.

    Raises:
        InputError: a setting is unknown, or has a value that is refused.
    """
    _, network_config = POSE_NETWORKS[checkpoint.kind]
    kinds = {"network": network_config, "cloud": CloudConfig, "refusal": RefusalConfig}
    settings: dict[str, Any] = {}
    for name, config_kind in kinds.items():
        config = config_from_dict(checkpoint.config[name], config_kind, source=source)
        settings[name] = config_to_dict(config)
    return settings


def build_pose_network(checkpoint: Checkpoint, source: str) -> AnyNetwork:
    """Build the network alone, in eval mode, of weights with or without their objects' surfaces.

    Raises:
        InputError: they are of another kind, or do not fit their own config.
    """
    if checkpoint.kind not in POSE_NETWORKS:
        raise InputError(
            f"{source}: holds weights of kind {checkpoint.kind!r}, but a pose takes one of "
            f"{', '.join(map(repr, POSE_NETWORKS))}."
        )
    network_class, config_kind = POSE_NETWORKS[checkpoint.kind]
    for name in ("network", "cloud", "refusal"):
        if not isinstance(checkpoint.config.get(name), Mapping):
            raise InputError(
                f"{source}: its config has no {name!r}; the file is of another version."
            )
    config = config_from_dict(checkpoint.config["network"], config_kind, source=source)

    # The tensors of the network alone.
    state = _select_by_prefix(checkpoint.state, "network.")
    network_checkpoint = dataclasses.replace(checkpoint, state=state)
    return build_network(lambda: network_class(config), network_checkpoint, source).eval()
