"""Pose methods by their names, and their predictions of a data set."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from tqdm import tqdm

from depthpose.cli.engine import Weights
from depthpose.cli.pose.masks import Masks, distinct_names, of_dataset
from depthpose.cli.pose.options import RegisterOptions
from depthpose.core.checkpoint import file_sha256, find_weights, read_checkpoint, warn_of_terms
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.baselines import DepthImageNet, FpfhConfig, FpfhEstimator
from depthpose.pose.config import EstimateConfig, Unit
from depthpose.pose.datasets import BopDataset, open_bop
from depthpose.pose.estimator import DepthImageRegressor, GeoPoseNet, Registration
from depthpose.pose.estimator.prepare import AnyInput
from depthpose.pose.mesh import FIXED_UNITS, unit_of
from depthpose.pose.predictions import (
    predict,
    read_predictions,
    results_name,
    write_bop_results,
)
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.weights import read_pose_weights

REGISTRATION = "open3d"
"""The name of Open3D's features, RANSAC and ICP, where weights are named."""
REGISTER = "register"
"""The name of our own registration, which needs no training."""
_SAME_DIAMETER = 0.05

EstimateMany = Callable[[Sequence[ViewInput]], Sequence[PoseEstimate]]


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseMethod:
    """An estimator, what to call it, the objects it knows, and what decides its results.

    Attributes:
        takes_clouds: whether it can do without a depth image.
        find: gives the poses of named objects in a view without a mask; None: it cannot.
        track: follows a named object through frames; None: it cannot.
        holder: what knows the objects, in messages.
    """

    name: str
    estimate_many: EstimateMany
    takes_clouds: bool
    models: Sequence[ObjectModel]
    settings: Mapping[str, Any]
    find: Callable[[ViewInput, Sequence[str]], list[PoseEstimate]] | None = None
    track: Callable[[Iterable[AnyInput], str, Rigid | None], Iterator[PoseEstimate]] | None = None
    holder: str = "weights"


def pose_methods(
    names: Sequence[str], config: EstimateConfig, models: Sequence[ObjectModel] = ()
) -> list[PoseMethod]:
    """Build the estimators of weights files of any kinds, given by their paths or by names.

    Files of one name are distinguished by their folders.

    Args:
        names: of weights, or paths; ``register`` and ``open3d`` have none: they take models.
        config: of the estimators that have weights.
        models: what registration looks for.

    Raises:
        InputError: there are no such weights, they pose nothing, or are given twice.
        MissingExtraError: registration is wanted, and Open3D is not installed.
    """
    takers = {REGISTRATION: _open3d, REGISTER: _register}
    paths = [None if name in takers else find_weights(name) for name in names]
    labels = distinct_names(
        [(p.parent, p.stem) if p else (None, n) for p, n in zip(paths, names, strict=True)]
    )
    return [
        _method(path, label, config) if path else takers[name](label, models, config)
        for path, name, label in zip(paths, names, labels, strict=True)
    ]


def _open3d(name: str, models: Sequence[ObjectModel], _: EstimateConfig) -> PoseMethod:
    if not models:
        raise InputError(
            f"{REGISTRATION}: it looks for the models of a data set; give --bop to 'pose evaluate'"
        )
    return PoseMethod(
        name=name,
        estimate_many=FpfhEstimator(models).estimate_many,
        takes_clouds=False,
        models=models,
        settings={"kind": "registration", "fpfh": config_to_dict(FpfhConfig())},
    )


def _register(name: str, models: Sequence[ObjectModel], config: EstimateConfig) -> PoseMethod:
    if not models:
        raise InputError(
            "--method register looks for CAD files: give --cad part.stl --unit mm, or --bop, whose "
            "models it takes"
        )
    net = Registration(models, config)
    known = {model.name: _digest(model) for model in models}
    return PoseMethod(
        name=name,
        estimate_many=net.estimate_many,
        takes_clouds=True,
        models=models,
        settings={"kind": REGISTER, "models": known, "estimate": config_to_dict(config)},
        find=net.find_in,
        track=net.track_in,
        holder="models",
    )


def _digest(model: ObjectModel) -> str:
    """Name a shape by its bytes."""
    digest = sha256(model.vertices_m.contiguous().numpy().tobytes())
    digest.update(model.faces.contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


@dataclass(frozen=True, kw_only=True, eq=False)
class MethodSource:
    """What an estimator is made from, in this process or by the workers of an engine.

    Attributes:
        config: of the estimator.
        weights: of a network, by name or file, or packed to travel; None: ``models`` are registered
            without training.
        models: what registration looks for.
    """

    config: EstimateConfig
    weights: str | Weights | None = None
    models: Sequence[ObjectModel] = ()

    def build(self, device: str | None = None) -> PoseMethod:
        """Build the estimator, on a device or on that of the config.

        Raises:
            InputError: as :func:`pose_methods`.
        """
        config = self.config if device is None else replace(self.config, device=device)
        if self.weights is None:
            return _register(REGISTER, self.models, config)
        if isinstance(self.weights, str):
            return pose_methods([self.weights], config)[0]
        with self.weights.unpacked() as path:
            return pose_methods([path], config)[0]

    def packed(self) -> "MethodSource":
        """Give the same with the weights in memory."""
        if not isinstance(self.weights, str):
            return self
        return replace(self, weights=Weights.read(self.weights))


def source_of(
    weights: str,
    register: RegisterOptions,
    unit: Unit | None,
    bop: tuple[Path, str] | None,
    config: EstimateConfig,
) -> MethodSource:
    """Say what the options of a command make an estimator from.

    Args:
        weights: of a network, by name or file.
        register: whether CAD files alone are looked for, and which.
        unit: of the CAD files, where ``register`` says none.
        bop: folder and split of a data set, which has its own models.
        config: of the estimator.

    Raises:
        InputError: options that do not go together, no unit, or a CAD file that cannot be read.
    """
    _refuse_contradictions(register, unit, bop)
    if register.method == "network":
        return MethodSource(config=config, weights=weights)
    if bop is not None:
        return MethodSource(config=config, models=tuple(open_bop(*bop).objects.values()))
    models = (
        Registration.load(*register.cad, unit=_cad_unit(register, unit)).models
        if register.cad
        else ()
    )
    return MethodSource(config=config, models=tuple(models))


def _refuse_contradictions(
    register: RegisterOptions, unit: Unit | None, bop: tuple[Path, str] | None
) -> None:
    if register.method == "network" and register.cad:
        raise InputError(
            "--cad: weights know their own objects; add --method register, or train weights of "
            "this part by 'depthpose pose train --cad'"
        )
    if register.cad_unit and not register.cad:
        raise InputError("--cad-unit is the unit of --cad, and no CAD file is given; leave it out")
    if register.cad and bop is not None:
        raise InputError("--cad: the models of --bop are taken; leave --cad out")
    for path in register.cad:
        unit_of(path, _cad_unit(register, unit))


def _cad_unit(register: RegisterOptions, unit: Unit | None) -> Unit | None:
    """Give the unit of the CAD files; that of clouds is not of files that have their own."""
    has_own = all(Path(path).suffix.lower() in FIXED_UNITS for path in register.cad)
    return register.cad_unit or (None if has_own else unit)


def _method(path: Path, name: str, config: EstimateConfig) -> PoseMethod:
    found = read_pose_weights(path)
    warn_of_terms(found.facts)
    is_regressor = isinstance(found.network, DepthImageNet)
    net = DepthImageRegressor(found, config) if is_regressor else GeoPoseNet(found, config)
    suffix = "" if config.voting.method == "ransac" else "-least-squares"
    suffix += "" if config.with_icp else "-without-icp"
    facts = {"kind": read_checkpoint(path).kind, "weights": path.stem}
    facts |= {"weights_sha256": file_sha256(path)}
    return PoseMethod(
        name=name + suffix,
        estimate_many=net.estimate_many,
        takes_clouds=not is_regressor,
        models=found.models,
        settings={**facts, "estimate": config_to_dict(config)},
        find=None if isinstance(net, DepthImageRegressor) else net.find_in,
        track=None if isinstance(net, DepthImageRegressor) else net.track_in,
    )


def predict_all(
    dataset: BopDataset, method: PoseMethod, masks: Masks, out: Path, batch: int = 1
) -> Path:
    """Estimate every instance that is not estimated yet, and write ``poses.json`` and BOP's csv.

    Returns:
        The folder of the predictions.
    """
    jobs = masks.jobs(match_names(dataset, method.models))
    home = out / "predictions" / f"{method.name}_{masks.name}"
    settings = {**method.settings, "masks": masks.name, **masks.settings, **of_dataset(dataset)}
    written = predict(method.estimate_many, jobs, home, settings, batch)
    label = f"{method.name}, {masks.name} masks"
    for _ in tqdm(written, label, total=len(jobs), disable=None, unit=" instances"):
        pass
    write_bop_results(home / results_name(dataset), read_predictions(home))
    return home


def match_names(dataset: BopDataset, models: Sequence[ObjectModel]) -> dict[int, str]:
    """Find what a method calls each object of a data set: by its name, else by its number.

    Raises:
        InputError: the method does not know an object, or means another one of that number.
    """
    by_name = {model.name: model for model in models}
    by_number = {model.number: model for model in models}
    names: dict[int, str] = {}
    for number, own in dataset.objects.items():
        model = by_name.get(own.name) or by_number.get(number)
        if model is None:
            known = ", ".join(f"{m.name} ({m.number})" for m in models)
            raise InputError(
                f"object {number} ({own.name}) is none of those the weights know: {known}. Leave "
                "it out by --objects"
            )
        if abs(model.diameter_m / own.diameter_m - 1) > _SAME_DIAMETER:
            raise InputError(
                f"object {number} ({own.name}) is {own.diameter_m:.4f} m across, but the weights' "
                f"{model.name} is {model.diameter_m:.4f} m: another object, or another unit"
            )
        names[number] = model.name
    return names
