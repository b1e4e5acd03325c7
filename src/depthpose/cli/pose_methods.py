"""What estimates poses in a command: weights or registered models, by their names."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from depthpose.cli.engine import Weights
from depthpose.cli.file_names import name_files
from depthpose.cli.pose_options import DataSetOptions, PoseInputs, RegisterOptions, SequenceOptions
from depthpose.cli.pose_transforms import read_base
from depthpose.core.checkpoint import file_sha256, find_weights, read_checkpoint, warn_of_terms
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.core.units import Unit
from depthpose.pose import datasets
from depthpose.pose.baselines import DepthImageNet
from depthpose.pose.config import EstimateConfig
from depthpose.pose.inputs import AnyInput
from depthpose.pose.mesh import FIXED_UNITS, symmetries_to_bop, unit_of
from depthpose.pose.network_pose import DepthImageRegressor, GeoPoseNet
from depthpose.pose.registration import Registration, read_parts
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.weights import read_pose_weights

REGISTER = "register"
"""In place of weights: our own registration, which needs no training."""

EstimateMany = Callable[[Sequence[ViewInput]], Sequence[PoseEstimate]]


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseMethod:
    """An estimator, what to call it, the objects it knows, and what decides its results.

    ``find`` gives the poses of named objects in a view without a mask, ``track`` follows one
    through frames; None: it cannot. ``holder``: what messages call the source of the objects.
    ``expects_all``: whether every object is expected in every image, as that of a CAD file is.
    """

    name: str
    estimate_many: EstimateMany
    takes_clouds: bool  # whether it can do without a depth image
    models: Sequence[ObjectModel]
    settings: Mapping[str, Any]
    find: Callable[[ViewInput, Sequence[str]], list[PoseEstimate]] | None = None
    track: (
        Callable[[Iterable[AnyInput | PoseEstimate], str, Rigid | None], Iterator[PoseEstimate]]
        | None
    ) = None
    holder: str = "weights"
    expects_all: bool = False


def build_methods(
    names: Sequence[str], config: EstimateConfig, models: Sequence[ObjectModel] = ()
) -> list[PoseMethod]:
    """Build the estimator of each weights file (a path or a name), or of ``register``.

    Files of one name are distinguished by their folders. ``models``: what is registered.
    """
    paths = [None if name == REGISTER else find_weights(name) for name in names]
    labels = name_files(names, paths)
    methods: list[PoseMethod] = []
    for path, label in zip(paths, labels, strict=True):
        if path is None:
            methods.append(_make_registration_method(label, models, config))
        else:
            methods.append(_make_network_method(path, label, config))
    return methods


def _make_registration_method(
    name: str, models: Sequence[ObjectModel], config: EstimateConfig
) -> PoseMethod:
    """Make the method that registers models without training."""
    if not models:
        raise InputError(
            "--method register looks for CAD files: give --cad part.stl --unit mm, or --bop, whose "
            "models it takes"
        )
    net = Registration(models, config)
    fingerprints = {model.name: _fingerprint_model(model) for model in models}
    return PoseMethod(
        name=name,
        estimate_many=net.estimate_many,
        takes_clouds=True,
        models=models,
        settings={"kind": REGISTER, "models": fingerprints, "estimate": config_to_dict(config)},
        find=net.find_in,
        track=net.track_in,
        holder="models",
        expects_all=True,
    )


def _fingerprint_model(model: ObjectModel) -> str:
    """Compute the start of the SHA-256 of a model's mesh and of its declared symmetries."""
    digest = sha256(model.vertices_m.contiguous().numpy().tobytes())
    digest.update(model.faces.contiguous().numpy().tobytes())
    if not model.symmetries.is_found and not model.symmetries.is_none:
        digest.update(json.dumps(symmetries_to_bop(model.symmetries)).encode())
    return digest.hexdigest()[:16]


def _make_network_method(path: Path, name: str, config: EstimateConfig) -> PoseMethod:
    """Make the method of a weights file: a network that votes, or the regressor.

    Its name in tables also says which settings differ from the defaults.
    """
    pose_weights = read_pose_weights(path)
    warn_of_terms(pose_weights.facts)
    if config.voting.method != "ransac":
        name += "-least-squares"
    if not config.with_icp:
        name += "-without-icp"

    settings = {
        "kind": read_checkpoint(path).kind,
        "weights": path.stem,
        "weights_sha256": file_sha256(path),
        "estimate": config_to_dict(config),
    }

    if isinstance(pose_weights.network, DepthImageNet):
        return PoseMethod(
            name=name,
            estimate_many=DepthImageRegressor(pose_weights, config).estimate_many,
            takes_clouds=False,
            models=pose_weights.models,
            settings=settings,
        )
    net = GeoPoseNet(pose_weights, config)
    return PoseMethod(
        name=name,
        estimate_many=net.estimate_many,
        takes_clouds=True,
        models=pose_weights.models,
        settings=settings,
        find=net.find_in,
        track=net.track_in,
    )


def _with_base(method: PoseMethod, base: Rigid) -> PoseMethod:
    """Return a method whose estimates also have the pose in the robot's frame, ``base_from_model``.

    ``base``: the transform ``base_from_camera``.
    """
    find = method.find
    track = method.track

    def estimate_many(views: Sequence[ViewInput]) -> list[PoseEstimate]:
        return [estimate.in_base(base) for estimate in method.estimate_many(views)]

    def find_in(view: ViewInput, objects: Sequence[str]) -> list[PoseEstimate]:
        assert find is not None
        return [estimate.in_base(base) for estimate in find(view, objects)]

    def track_in(
        frames: Iterable[AnyInput], object: str, first: Rigid | None
    ) -> Iterator[PoseEstimate]:
        assert track is not None
        return (estimate.in_base(base) for estimate in track(frames, object, first))

    return replace(
        method,
        estimate_many=estimate_many,
        find=None if find is None else find_in,
        track=None if track is None else track_in,
        settings={**method.settings, "base_from_camera": base.matrix().tolist()},
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseMethodSource:
    """The description of an estimator, from which this process or an engine's workers build it.

    ``weights``: of a network, by name or file, or as bytes to be sent to workers; None: ``models``
    are registered without training. ``base_from_camera``: if given, every estimate has the pose
    from the robot's base too.
    """

    config: EstimateConfig
    weights: str | Weights | None = None
    models: Sequence[ObjectModel] = ()
    base_from_camera: Rigid | None = None

    def build(self, device: str | None = None) -> PoseMethod:
        """Build the estimator; ``device`` takes the place of the config's."""
        method = self._build_in_camera(device)
        base = self.base_from_camera
        return method if base is None else _with_base(method, base)

    def _build_in_camera(self, device: str | None) -> PoseMethod:
        """Build the estimator of poses from the camera alone."""
        config = self.config if device is None else replace(self.config, device=device)
        if self.weights is None or self.weights == REGISTER:
            return _make_registration_method(REGISTER, self.models, config)
        if isinstance(self.weights, str):
            path = find_weights(self.weights)
            return _make_network_method(path, path.stem, config)
        with self.weights.unpacked() as name:
            return _make_network_method(Path(name), Path(name).stem, config)


def unit_of_cad(files: Sequence[str], cad_unit: Unit | None, unit: Unit | None) -> Unit | None:
    """Give the unit of CAD files: ``--cad-unit``, else ``--unit``; None if their format fixes it.

    Raises:
        InputError: a file's format does not fix the unit, and none is given.
    """
    if cad_unit is None and not all(Path(path).suffix.lower() in FIXED_UNITS for path in files):
        cad_unit = unit
    for path in files:
        unit_of(path, cad_unit)  # raises where there is none
    return cad_unit


def make_method_source(
    weights: str | None,
    parts: PoseInputs | RegisterOptions,
    unit: Unit | None,
    dataset: DataSetOptions | SequenceOptions,
    config: EstimateConfig,
    base: Sequence[str] = (),
) -> PoseMethodSource:
    """Read what an estimator is built from: weights, or the models of a data set or of CAD files.

    ``weights``: None: models are registered. ``base``: the words of ``--base-from-camera``.
    """
    base_from_camera = read_base(base)
    cad_unit = unit_of_cad(parts.cad, parts.cad_unit, unit)
    if parts.symmetry and (weights is not None or not parts.cad):
        raise InputError(
            f"--symmetry {parts.symmetry[0]}: is of --method register with --cad; a network and "
            "a data set have the symmetries that they declare"
        )
    if weights is not None:
        return PoseMethodSource(config=config, weights=weights, base_from_camera=base_from_camera)
    if dataset.bop is not None:
        models = tuple(datasets.open_bop(dataset.bop, dataset.split).objects.values())
        return PoseMethodSource(config=config, models=models)
    if not parts.cad:
        return PoseMethodSource(config=config, base_from_camera=base_from_camera)
    models = read_parts(parts.cad, cad_unit, parts.symmetry or None)
    return PoseMethodSource(config=config, models=models, base_from_camera=base_from_camera)
