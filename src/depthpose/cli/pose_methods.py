"""Methods and masks of pose commands, by their names."""

import json
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from tqdm import tqdm

from depthpose.cli.engine import Weights
from depthpose.cli.pose_options import DataSetOptions, RegisterOptions, SequenceOptions
from depthpose.core.checkpoint import file_sha256, find_weights, read_checkpoint, warn_of_terms
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.core.files import read_image, write_json
from depthpose.core.rigid import Rigid
from depthpose.core.run import claim_folder
from depthpose.core.units import Unit
from depthpose.pose import datasets, predictions
from depthpose.pose.baselines import DepthImageNet
from depthpose.pose.config import EstimateConfig
from depthpose.pose.datasets.layouts import integer, read_rows
from depthpose.pose.inputs import AnyInput, rigid_input
from depthpose.pose.mesh import FIXED_UNITS, symmetries_to_bop, unit_of
from depthpose.pose.network_pose import DepthImageRegressor, GeoPoseNet
from depthpose.pose.registration import Registration
from depthpose.pose.segmentation import Segmenter
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.weights import read_pose_weights


@dataclass(frozen=True, kw_only=True, eq=False)
class Masks:
    """The pixels that a method is given: their name in tables, and the jobs that they make."""

    name: str
    jobs: Callable[[Mapping[int, str]], list[predictions.PoseJob[ViewInput]]]
    settings: Mapping[str, Any]


def find_masks(
    kinds: Sequence[str], dataset: datasets.BopDataset, out: Path, device: str = "cpu"
) -> list[Masks]:
    """Understand ``truth``, ``predicted``, files of BOP detections and segmentation weights."""
    paths = [mask_path(kind) for kind in kinds]
    names = _file_names(kinds, paths)
    masks: list[Masks] = []
    for kind, path, name in zip(kinds, paths, names, strict=True):
        settings: dict[str, Any] = {}
        jobs = partial(predictions.instance_jobs, dataset)
        if path is not None:
            if path.suffix == ".json":
                detections = datasets.read_detections(path)
            else:
                detections = _segmented(path, name, dataset, out, device)
            jobs = partial(predictions.detection_jobs, dataset, detections=detections)
            settings = {"masks_sha256": file_sha256(path)}
        elif kind == "predicted":
            file = datasets.LAYOUTS[dataset.layout].predicted_mask
            if file is None:
                raise InputError(
                    f"{dataset.folder}: came without predicted masks, as Linemod_preprocessed has "
                    "them; give --masks a file of BOP detections, or weights of a segmentation"
                )
            jobs = partial(predictions.instance_jobs, dataset, predicted_mask=file)
            settings = {"masks_of": "segnet_results"}
        masks.append(Masks(name=name, jobs=jobs, settings=settings))
    return masks


def mask_path(kind: str) -> Path | None:
    """Give the file of a kind of masks as :func:`find_masks` takes it; None where it is a word."""
    if kind in ("truth", "predicted"):
        return None
    return Path(kind) if kind.endswith(".json") else find_weights(kind)


def name_with_checksum(path: Path) -> str:
    """Name a file with the start of its SHA-256, so that another file of that name differs."""
    try:
        return f"{path.name} {file_sha256(path)[:12]}"
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give another file") from error


def dataset_settings(dataset: datasets.BopDataset) -> dict[str, Any]:
    """Give the settings that identify a data set, wherever its folder lies."""
    return {
        "dataset": dataset.folder.resolve().name,
        "split": dataset.split,
        "annotations_sha256": dataset.sha256[:12],
    }


def _segmented(
    path: Path, name: str, dataset: datasets.BopDataset, out: Path, device: str
) -> list[datasets.Detection]:
    """Segment the images that are not segmented yet, for every object that the weights know.

    Other objects or images may be asked for next time: what is there stays, what lacks is added.
    """
    # The numbers that the data set gives to the objects of the weights: by name, else by number.
    segmenter = Segmenter.load(path, device)
    names = datasets.object_names(dataset.folder)
    by_name = {name: number for number, name in names.items()}
    numbers_of = dict(zip(segmenter.weights.objects, segmenter.weights.numbers, strict=True))
    numbers = {
        name: by_name.get(name, number)
        for name, number in numbers_of.items()
        if name in by_name or names.get(number) not in numbers_of
    }
    wanted = {instance.object_id for instance in dataset.instances}
    lost = sorted(wanted - set(numbers.values()))
    if len(lost) == len(wanted):
        known_objects = ", ".join(f"{name} ({number})" for name, number in numbers_of.items())
        raise InputError(
            f"{path}: segments {known_objects}, but {dataset.folder} shows objects {lost}; give "
            "weights of its objects"
        )
    if lost:
        print(f"{path}: segments no objects {lost}; each is missing", file=sys.stderr)

    # What an earlier run found, and in which images.
    home = out / "detections" / name
    claim_folder(home, {"weights_sha256": file_sha256(path), **dataset_settings(dataset)})
    file = home.parent / f"{name}.json"
    record = home / "images.json"
    done: set[tuple[int, int]] = set()
    detections: list[datasets.Detection] = []
    with suppress(InputError):  # damaged or missing: all is segmented again
        earlier = datasets.read_detections(file)
        record_name = str(record)
        rows = read_rows(record)
        done = {
            (integer(row, "scene_id", record_name), integer(row, "im_id", record_name))
            for row in rows
        }
        detections = [d for d in earlier if (d.scene_id, d.image_id) in done]

    images = {(i.scene_id, i.image_id): i for i in dataset.instances}
    unsegmented = [images[place] for place in sorted(images.keys() - done)]
    if unsegmented:
        for instance in tqdm(unsegmented, "segmentation", disable=None, unit=" images"):
            detections += _segment_image(segmenter, instance, numbers)
        datasets.write_detections(file, detections)
        places = sorted(done | images.keys())
        write_json(record, [{"scene_id": scene, "im_id": image} for scene, image in places])
    return detections


def _segment_image(
    segmenter: Segmenter, instance: datasets.Instance, numbers: Mapping[str, int]
) -> list[datasets.Detection]:
    """Segment the image of an instance; ``numbers``: those of the objects by name."""
    if instance.rgb is None:
        raise InputError(f"{instance.name}: has no picture, and a segmentation needs pictures")
    start = perf_counter()
    objects = segmenter.segment(read_image(instance.rgb))
    spent_s = perf_counter() - start
    return [
        datasets.Detection(
            scene_id=instance.scene_id,
            image_id=instance.image_id,
            object_id=numbers[object],
            score=score,
            segmentation=datasets.encode_rle(mask),
            seconds=spent_s,
        )
        for object in objects.masks
        if object in numbers
        for mask, score in zip(objects.masks[object], objects.scores[object].tolist(), strict=True)
    ]


def _file_names(words: Sequence[str], paths: Sequence[Path | None]) -> list[str]:
    """Name files by their stems, with folders where stems are equal; words stay as they are."""
    return distinct_names(
        [(None, w) if p is None else (p.parent, p.stem) for w, p in zip(words, paths, strict=True)]
    )


def distinct_names(files: Sequence[tuple[Path | None, str]]) -> list[str]:
    """Give each its own name; of equal ones, with as many folders above it as distinguish them.

    ``files``: the folder that something lies in, None where it lies in none, and its name.
    """
    parts = [(*(folder.resolve().parts[1:] if folder else ()), name) for folder, name in files]
    for path_parts, count in Counter(parts).items():
        if count > 1:
            raise InputError(
                f"{'/'.join(path_parts[-2:])}: {count} that are given have this name, and their "
                "results would be one; give it once, or rename a file"
            )
    names: list[str] = []
    depths = [1] * len(parts)
    for _ in range(max(map(len, parts), default=0)):
        names = [
            "-".join(path_parts[-depth:]) for path_parts, depth in zip(parts, depths, strict=True)
        ]
        counts = Counter(names)
        depths = [d + (counts[name] > 1) for d, name in zip(depths, names, strict=True)]
    return names


REGISTER = "register"  # the name of our own registration, which needs no training
_SAME_DIAMETER = 0.05
_FARTHEST_BASE_M = 50.0  # of a camera from the base of its robot

EstimateMany = Callable[[Sequence[ViewInput]], Sequence[PoseEstimate]]


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseMethod:
    """An estimator, what to call it, the objects it knows, and what decides its results.

    ``find`` gives the poses of named objects in a view without a mask, ``track`` follows one
    through frames; None: it cannot. ``holder``: what knows the objects, in messages.
    ``expects_all``: whether each object is expected in each image, as CAD files are that are given.
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
    """Build the estimators of weights files of any kinds, given by their paths or by names.

    Files of one name are distinguished by their folders.
    """
    paths = [None if name == REGISTER else find_weights(name) for name in names]
    labels = _file_names(names, paths)
    return [
        _network_method(path, label, config)
        if path
        else _registration_method(label, models, config)
        for path, label in zip(paths, labels, strict=True)
    ]


def _registration_method(
    name: str, models: Sequence[ObjectModel], config: EstimateConfig
) -> PoseMethod:
    """Make the method that registers models without training."""
    if not models:
        raise InputError(
            "--method register looks for CAD files: give --cad part.stl --unit mm, or --bop, whose "
            "models it takes"
        )
    net = Registration(models, config)
    fingerprints: dict[str, str] = {}
    for model in models:  # a shape is named by its bytes, and by what is declared of it
        digest = sha256(model.vertices_m.contiguous().numpy().tobytes())
        digest.update(model.faces.contiguous().numpy().tobytes())
        if not model.symmetries.is_found and not model.symmetries.is_none:
            digest.update(json.dumps(symmetries_to_bop(model.symmetries)).encode())
        fingerprints[model.name] = digest.hexdigest()[:16]
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


def _network_method(path: Path, name: str, config: EstimateConfig) -> PoseMethod:
    """Make the method of a weights file: a network that votes, or the regressor.

    Its name in tables says how it departs from the defaults.
    """
    pose_weights = read_pose_weights(path)
    warn_of_terms(pose_weights.facts)
    is_regressor = isinstance(pose_weights.network, DepthImageNet)
    net = (
        DepthImageRegressor(pose_weights, config)
        if is_regressor
        else GeoPoseNet(pose_weights, config)
    )
    name += "" if config.voting.method == "ransac" else "-least-squares"
    name += "" if config.with_icp else "-without-icp"
    facts = {"kind": read_checkpoint(path).kind, "weights": path.stem}
    facts |= {"weights_sha256": file_sha256(path)}
    return PoseMethod(
        name=name,
        estimate_many=net.estimate_many,
        takes_clouds=not is_regressor,
        models=pose_weights.models,
        settings={**facts, "estimate": config_to_dict(config)},
        find=None if isinstance(net, DepthImageRegressor) else net.find_in,
        track=None if isinstance(net, DepthImageRegressor) else net.track_in,
    )


def _with_base_pose(method: PoseMethod, base: Rigid) -> PoseMethod:
    """Make a method add ``base_from_model`` to its estimates."""
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
    """What an estimator is made from, in this process or by the workers of an engine.

    ``weights``: of a network, by name or file, or packed to travel; None: ``models`` are registered
    without training. ``base_from_camera``: adds the pose in a robot's frame to every estimate.
    """

    config: EstimateConfig
    weights: str | Weights | None = None
    models: Sequence[ObjectModel] = ()
    base_from_camera: Rigid | None = None

    def build(self, device: str | None = None) -> PoseMethod:
        """Build the estimator, on a device or on that of the config."""
        method = self._build(device)
        base = self.base_from_camera
        return method if base is None else _with_base_pose(method, base)

    def _build(self, device: str | None) -> PoseMethod:
        """Build the estimator without what is added to its estimates."""
        config = self.config if device is None else replace(self.config, device=device)
        if self.weights is None or self.weights == REGISTER:
            return _registration_method(REGISTER, self.models, config)
        if isinstance(self.weights, str):
            path = find_weights(self.weights)
            return _network_method(path, path.stem, config)
        with self.weights.unpacked() as name:
            return _network_method(Path(name), Path(name).stem, config)


def unit_of_cad(files: Sequence[str], cad_unit: Unit | None, unit: Unit | None) -> Unit | None:
    """Give the unit of CAD files: their option, else that of clouds, unless each has its own."""
    has_own = all(Path(path).suffix.lower() in FIXED_UNITS for path in files)
    cad_unit = cad_unit or (None if has_own else unit)
    for path in files:
        unit_of(path, cad_unit)
    return cad_unit


def make_method_source(
    weights: str,
    register: RegisterOptions,
    unit: Unit | None,
    dataset: DataSetOptions | SequenceOptions,
    config: EstimateConfig,
    base: Sequence[str] = (),
) -> PoseMethodSource:
    """Say what the options of a command make an estimator from."""
    base_from_camera = read_base(base)
    cad_unit = unit_of_cad(register.cad, register.cad_unit, unit)
    if register.symmetry and (not register.is_register or not register.cad):
        raise InputError(
            f"--symmetry {register.symmetry[0]}: is of --method register with --cad; a network and "
            "a data set have the symmetries that they declare"
        )
    if not register.is_register:
        return PoseMethodSource(config=config, weights=weights, base_from_camera=base_from_camera)
    if dataset.bop is not None:
        models = tuple(datasets.open_bop(dataset.bop, dataset.split).objects.values())
        return PoseMethodSource(config=config, models=models)
    if not register.cad:
        return PoseMethodSource(config=config, base_from_camera=base_from_camera)
    loaded = Registration.load(*register.cad, unit=cad_unit, symmetry=register.symmetry or None)
    return PoseMethodSource(config=config, models=loaded.models, base_from_camera=base_from_camera)


def predict_instances(
    dataset: datasets.BopDataset, method: PoseMethod, masks: Masks, out: Path, batch: int = 1
) -> Path:
    """Estimate every instance that is not estimated yet, and write ``poses.json`` and BOP's csv."""
    jobs = masks.jobs(match_names(dataset, method.models))
    home = out / "predictions" / f"{method.name}_{masks.name}"
    settings = {
        **method.settings,
        "masks": masks.name,
        **masks.settings,
        **dataset_settings(dataset),
    }
    written = predictions.predict(method.estimate_many, jobs, home, settings, batch)
    label = f"{method.name}, {masks.name} masks"
    for _ in tqdm(written, label, total=len(jobs), disable=None, unit=" instances"):
        pass
    predictions.write_bop_results(
        home / predictions.results_name(dataset), predictions.read_predictions(home)
    )
    return home


def match_names(dataset: datasets.BopDataset, models: Sequence[ObjectModel]) -> dict[int, str]:
    """Find what a method calls each object of a data set: by its name, else by its number."""
    by_name = {model.name: model for model in models}
    by_number = {model.number: model for model in models}
    names: dict[int, str] = {}
    for number, dataset_model in dataset.objects.items():
        model = by_name.get(dataset_model.name) or by_number.get(number)
        if model is None:
            model_names = ", ".join(f"{m.name} ({m.number})" for m in models)
            raise InputError(
                f"object {number} ({dataset_model.name}) is none of those the weights know: "
                f"{model_names}. Leave it out by --objects"
            )
        if abs(model.diameter_m / dataset_model.diameter_m - 1) > _SAME_DIAMETER:
            raise InputError(
                f"object {number} ({dataset_model.name}) is {dataset_model.diameter_m:.4f} m "
                f"across, but the weights' {model.name} is {model.diameter_m:.4f} m: another "
                "object, or another unit"
            )
        names[number] = model.name
    return names


def read_pose(path: Path, option: str = "--first", what: str = "camera_from_model") -> Rigid:
    """Read a pose: that of a ``poses.json`` of one, or a 4x4 matrix in a text file.

    Brackets and commas in it do no harm.
    """
    if path.name == predictions.POSES:
        return _read_only_pose(path, option)
    try:
        text = path.read_text()
    except (OSError, ValueError) as error:
        raise InputError(
            f"{option} {path}: cannot be read ({error}); give a text file with the 4x4 matrix "
            f"{what} in metres"
        ) from error
    return _rigid_of(text, f"{option} {path}", what)


def _read_only_pose(path: Path, option: str) -> Rigid:
    """Read the pose of a ``poses.json`` that holds one."""
    rows = enumerate(read_rows(path))
    read = [predictions.parse_prediction(row, f"{path}: entry {i}") for i, row in rows]
    poses = [p.estimate.camera_from_model for p in read if p.estimate.camera_from_model is not None]
    if len(poses) != 1:
        raise InputError(
            f"{option} {path}: holds {len(poses)} poses; give a poses.json of one, or a text file "
            "with the 4x4 matrix camera_from_model in metres"
        )
    return poses[0]


def read_base(words: Sequence[str]) -> Rigid | None:
    """Read ``--base-from-camera``: a text file, or 16 numbers row by row; None: it is unset."""
    if not words:
        return None
    option = "--base-from-camera"
    what = "base_from_camera"
    if len(words) == 1 and Path(words[0]).is_file():
        base = read_pose(Path(words[0]), option, what)
    else:
        base = _rigid_of(" ".join(words), option, what)
    if float(base.t_m.norm()) > _FARTHEST_BASE_M:
        raise InputError(
            f"{option}: the camera is {float(base.t_m.norm()):.0f} m from the base; is that in "
            "millimetres? Give metres"
        )
    return base


def _rigid_of(text: str, source: str, what: str) -> Rigid:
    """Read the 16 numbers of a 4x4 matrix row by row; ``source`` and ``what`` name it in errors."""
    try:
        words = re.sub(r"[\[\],;]", " ", text).split()
        values = torch.tensor([float(word) for word in words], dtype=torch.float64)
    except ValueError as error:
        raise InputError(
            f"{source}: cannot be read as numbers ({error}); give a text file with the 4x4 matrix "
            f"{what} in metres"
        ) from error
    if len(values) != 16:
        raise InputError(f"{source}: {len(values)} numbers; give the 16 of a 4x4 matrix")
    try:
        return rigid_input(values.reshape(4, 4), what, what)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error


def choose_objects(
    dataset: datasets.BopDataset, method: PoseMethod, object: str | None
) -> datasets.BopDataset:
    """Keep the objects of a data set that the weights know, or the one named; print the others."""
    numbers = {model.name: model.number for model in method.models}
    if object is not None:
        is_theirs = object in datasets.object_names(dataset.folder).values()
        return dataset.of_objects(object if is_theirs else numbers.get(object, object))
    object_ids = sorted({instance.object_id for instance in dataset.instances})
    estimable = [
        n for n in object_ids if n in numbers.values() or dataset.objects[n].name in numbers
    ]
    left_out = sorted(set(object_ids) - set(estimable))
    if not estimable:
        raise InputError(
            f"{dataset.folder}: holds objects {left_out}, but the {method.holder} know "
            f"{', '.join(numbers)}; give {method.holder} of its objects"
        )
    if left_out:
        message = f"left out, as the {method.holder} do not know them: objects {left_out}"
        print(message, file=sys.stderr)
    return dataset.of_objects(*estimable)
