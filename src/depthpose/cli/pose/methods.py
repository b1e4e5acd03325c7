"""What estimates poses in a command: networks or registered models, and how they are built."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from depthpose.cli.engine import PackedWeights
from depthpose.cli.file_names import name_files
from depthpose.cli.pose.options import DataSetOptions, PoseInputs, RegisterOptions, SequenceOptions
from depthpose.cli.pose.transforms import read_base
from depthpose.core.checkpoint import file_sha256, find_weights, read_checkpoint, warn_of_terms
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError, suggest_name
from depthpose.core.rigid import Rigid
from depthpose.core.units import Unit
from depthpose.pose import datasets
from depthpose.pose.config import EstimateConfig
from depthpose.pose.estimator import PoseEstimator
from depthpose.pose.inputs import AnyInput
from depthpose.pose.mesh import FIXED_UNITS, symmetries_to_bop, unit_of
from depthpose.pose.network_pose import DepthImageRegressor, GeoPoseNet
from depthpose.pose.networks.baselines import DepthImageNet
from depthpose.pose.registration import Registration, read_parts
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.weights import read_pose_weights

REGISTER = "register"
"""Word of ``--weights`` for registration, which needs none; and its name in tables."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseMethod:
    """An estimator of poses in a command: its name in tables, and what decides its results."""

    name: str  #: name in tables
    estimator: PoseEstimator  #: what estimates
    settings: Mapping[str, Any]  #: JSON values that decide its results
    #: if given, every estimate has the pose from the robot's base too.
    base_from_camera: Rigid | None = None

    @property
    def models(self) -> Sequence[ObjectModel]:
        """The objects that it can pose."""
        return self.estimator.models

    @property
    def holder(self) -> str:
        """What knows the objects, in messages."""
        return self.estimator.holder

    def estimate_many(self, inputs: Sequence[AnyInput]) -> list[PoseEstimate]:
        """Estimate a pose of each masked view or cloud."""
        return [self._in_base(estimate) for estimate in self.estimator.estimate_many(inputs)]

    def find(self, view: ViewInput, objects: Sequence[str]) -> list[PoseEstimate]:
        """Estimate the poses of named objects in a view without a mask."""
        return [self._in_base(estimate) for estimate in self.estimator.find(view, objects=objects)]

    def track(
        self, frames: Iterable[AnyInput | PoseEstimate], object: str, first: Rigid | None
    ) -> Iterator[PoseEstimate]:
        """Follow an object through frames, perhaps from a first pose."""
        return map(self._in_base, self.estimator.track(frames, object=object, first=first))

    def _in_base(self, estimate: PoseEstimate) -> PoseEstimate:
        """Add the pose from the robot's base to an estimate, where the base is known."""
        if self.base_from_camera is None:
            return estimate
        return estimate.in_base(self.base_from_camera)


def build_methods(
    names: Sequence[str], config: EstimateConfig, models: Sequence[ObjectModel] = ()
) -> list[PoseMethod]:
    """Build a method for each name of weights, and registration for the word ``register``.

    Args:
        names: weights by name or file, or ``register``. Files of one name are distinguished by
            their folders.
        config: settings of the estimators.
        models: models that are registered.

    Raises:
        InputError: weights cannot be read, or two are the same, or nothing is to be registered.
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
    fingerprints = {model.name: _fingerprint_model(model) for model in models}
    settings = {"kind": REGISTER, "models": fingerprints, "estimate": config_to_dict(config)}
    return PoseMethod(name=name, estimator=Registration(models, config), settings=settings)


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

    is_regressor = isinstance(pose_weights.network, DepthImageNet)
    build = DepthImageRegressor if is_regressor else GeoPoseNet
    return PoseMethod(name=name, estimator=build(pose_weights, config), settings=settings)


def _with_base(method: PoseMethod, base_from_camera: Rigid | None) -> PoseMethod:
    """Return a method whose estimates also have ``base_from_model``; None: the method itself."""
    if base_from_camera is None:
        return method
    settings = {**method.settings, "base_from_camera": base_from_camera.matrix().tolist()}
    return replace(method, base_from_camera=base_from_camera, settings=settings)


@dataclass(frozen=True, kw_only=True, eq=False)
class RegistrationSpec:
    """The models and settings from which this process, or a worker, builds a registration.

    ``base_from_camera``: if given, every estimate has the pose from the robot's base too.
    """

    models: Sequence[ObjectModel]
    config: EstimateConfig
    base_from_camera: Rigid | None = None

    def build(self) -> PoseMethod:
        """Build the registration of the models.

        Raises:
            InputError: there are no models.
        """
        method = _make_registration_method(REGISTER, self.models, self.config)
        return _with_base(method, self.base_from_camera)


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseNetworkSpec:
    """The weights and settings from which this process, or a worker, builds a pose network.

    ``weights``: a name or file, or its content. ``base_from_camera``: if given, every estimate has
    the pose from the robot's base too.
    """

    weights: str | PackedWeights
    config: EstimateConfig
    base_from_camera: Rigid | None = None

    def build(self) -> PoseMethod:
        """Build the network on the device of the config.

        Raises:
            InputError: the weights cannot be read.
        """
        if isinstance(self.weights, PackedWeights):
            with self.weights.unpacked() as file:
                return self._build_from(Path(file))
        return self._build_from(find_weights(self.weights))

    def _build_from(self, file: Path) -> PoseMethod:
        """Build the network of a weights file."""
        method = _make_network_method(file, file.stem, self.config)
        return _with_base(method, self.base_from_camera)

    def with_packed_weights(self) -> "PoseNetworkSpec":
        """Return the spec with the content of its weights file, for workers of other machines."""
        if isinstance(self.weights, PackedWeights):
            return self
        return replace(self, weights=PackedWeights.read(self.weights))


PoseMethodSpec = RegistrationSpec | PoseNetworkSpec


def resolve_object(name: str | None, method: PoseMethod) -> str:
    """Choose the object of a method by its name, or its only object.

    Raises:
        InputError: the method has no such object, or several and none is named.
    """
    names = [model.name for model in method.models]
    if name is None and len(names) > 1:
        raise InputError(f"the {method.holder} know {', '.join(names)}; say which by --object")
    if name is not None and name not in names:
        raise InputError(
            f"--object {name}: the {method.holder} do not know it; {suggest_name(name, names)}"
        )
    return names[0] if name is None else name


def find_cad_unit(files: Sequence[str], cad_unit: Unit | None, unit: Unit | None) -> Unit | None:
    """Return the unit of CAD files: ``--cad-unit``, else ``--unit``; None if their format fixes it.

    Raises:
        InputError: a file's format does not fix the unit, and none is given.
    """
    if cad_unit is None and not all(Path(path).suffix.lower() in FIXED_UNITS for path in files):
        cad_unit = unit
    for path in files:
        unit_of(path, cad_unit)  # raises where there is none
    return cad_unit


def make_method_spec(
    weights: str,
    parts: PoseInputs | RegisterOptions,
    unit: Unit | None,
    dataset: DataSetOptions | SequenceOptions,
    config: EstimateConfig,
    base_words: Sequence[str] = (),
    *,
    is_registration: bool,
) -> PoseMethodSpec:
    """Make the spec of a network, or of the registration of models of a dataset or of CAD files.

    Args:
        weights: name or file of the weights; unused in a registration.
        parts: options of the CAD files, their unit and their symmetries.
        unit: unit of the CAD files where ``parts`` has none.
        dataset: options of the dataset; if they name one, its models are registered, not CAD files.
        config: settings of the estimator.
        base_words: words of ``--base-from-camera``; none where a dataset is posed.
        is_registration: register models, without the network.

    Raises:
        InputError: a file cannot be read, or a unit is missing.
    """
    base_from_camera = read_base(base_words)
    cad_unit = find_cad_unit(parts.cad, parts.cad_unit, unit)
    if not is_registration:
        return PoseNetworkSpec(weights=weights, config=config, base_from_camera=base_from_camera)
    if dataset.bop is not None:
        # No base_from_camera: it is refused beside --bop, since a dataset's cameras move.
        models = tuple(datasets.open_bop(dataset.bop, dataset.split).objects.values())
        return RegistrationSpec(models=models, config=config)
    models = read_parts(parts.cad, cad_unit, parts.symmetry or None)
    return RegistrationSpec(models=models, config=config, base_from_camera=base_from_camera)
