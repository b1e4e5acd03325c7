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
from depthpose.cli.pose_options import DataSetOptions, PoseInputs, RegisterOptions, SequenceOptions
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
from depthpose.pose.registration import Registration, read_parts
from depthpose.pose.segmentation import Segmenter
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.weights import read_pose_weights


@dataclass(frozen=True, kw_only=True, eq=False)
class Masks:
    """One kind of masks of a data set, its name in tables, and what decides which masks they are.

    ``make_jobs`` makes a job for each mask; it takes the names that the method has for the objects,
    by their numbers in the data set.
    """

    name: str
    make_jobs: Callable[[Mapping[int, str]], list[predictions.PoseJob[ViewInput]]]
    settings: Mapping[str, Any]


def prepare_masks(
    kinds: Sequence[str], dataset: datasets.BopDataset, out: Path, device: str = "cpu"
) -> list[Masks]:
    """Prepare each kind of masks; images are segmented now where a kind is a segmentation.

    Args:
        kinds: each ``truth`` (annotated masks), ``predicted`` (those that came with
            Linemod_preprocessed), a JSON file of BOP detections, or weights of a segmentation.
        dataset: whose instances are masked.
        out: folder of the run; segmented masks are written below it.
        device: that segments.
    """
    paths = [mask_path(kind) for kind in kinds]
    names = _names_of_files(kinds, paths)
    masks: list[Masks] = []
    for kind, path, name in zip(kinds, paths, names, strict=True):
        if path is not None:
            masks.append(_detected_masks(path, name, dataset, out, device))
        elif kind == "predicted":
            masks.append(_predicted_masks(dataset))
        else:
            make_jobs = partial(predictions.instance_jobs, dataset)
            masks.append(Masks(name=name, make_jobs=make_jobs, settings={}))
    return masks


def _detected_masks(
    path: Path, name: str, dataset: datasets.BopDataset, out: Path, device: str
) -> Masks:
    """Take masks from a JSON file of BOP detections, or segment the images by weights."""
    if path.suffix == ".json":
        detections = datasets.read_detections(path)
    else:
        detections = _segment_dataset(path, name, dataset, out, device)
    make_jobs = partial(predictions.detection_jobs, dataset, detections=detections)
    return Masks(name=name, make_jobs=make_jobs, settings={"masks_sha256": file_sha256(path)})


def _predicted_masks(dataset: datasets.BopDataset) -> Masks:
    """Take the masks that a segmentation network left in the data set, as it was published."""
    predicted_mask = datasets.LAYOUTS[dataset.layout].predicted_mask
    if predicted_mask is None:
        raise InputError(
            f"{dataset.folder}: came without predicted masks, as Linemod_preprocessed has "
            "them; give --masks a file of BOP detections, or weights of a segmentation"
        )
    make_jobs = partial(predictions.instance_jobs, dataset, predicted_mask=predicted_mask)
    return Masks(name="predicted", make_jobs=make_jobs, settings={"masks_of": "segnet_results"})


def mask_path(kind: str) -> Path | None:
    """Give the file of a kind of masks, as :func:`prepare_masks` takes it.

    None for ``truth`` and ``predicted``, which are in the data set.
    """
    if kind in ("truth", "predicted"):
        return None
    return Path(kind) if kind.endswith(".json") else find_weights(kind)


def name_with_checksum(path: Path) -> str:
    """Give a file's name with the start of its SHA-256, so that a changed file is told apart."""
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


def _segment_dataset(
    path: Path, name: str, dataset: datasets.BopDataset, out: Path, device: str
) -> list[datasets.Detection]:
    """Segment the images of a data set by weights, except those that an earlier run segmented.

    Detections of all objects of the weights are written to ``OUT/detections/NAME.json``, so that a
    later run may ask for other objects, or for more images.
    """
    segmenter = Segmenter.load(path, device)
    numbers = _numbers_in_dataset(segmenter, dataset, path)

    home = out / "detections" / name
    claim_folder(home, {"weights_sha256": file_sha256(path), **dataset_settings(dataset)})
    detections_file = home.parent / f"{name}.json"
    images_file = home / "images.json"
    segmented: set[tuple[int, int]] = set()
    detections: list[datasets.Detection] = []
    with suppress(InputError):  # damaged or missing: all is segmented again
        earlier = datasets.read_detections(detections_file)
        segmented = _read_segmented_images(images_file)
        detections = [d for d in earlier if (d.scene_id, d.image_id) in segmented]

    images = {(i.scene_id, i.image_id): i for i in dataset.instances}
    unsegmented = [images[image] for image in sorted(images.keys() - segmented)]
    if unsegmented:
        for instance in tqdm(unsegmented, "segmentation", disable=None, unit=" images"):
            detections += _segment_image(segmenter, instance, numbers)
        datasets.write_detections(detections_file, detections)
        rows = [
            {"scene_id": scene, "im_id": image}
            for scene, image in sorted(segmented | images.keys())
        ]
        write_json(images_file, rows)
    return detections


def _numbers_in_dataset(
    segmenter: Segmenter, dataset: datasets.BopDataset, path: Path
) -> dict[str, int]:
    """Give the data set's number of each object of the weights: by its name, else by its number.

    Objects of the data set that the weights do not segment are printed; it is an error if they
    segment none.
    """
    names = datasets.object_names(dataset.folder)
    number_by_name = {name: number for number, name in names.items()}
    weights_numbers = dict(zip(segmenter.weights.objects, segmenter.weights.numbers, strict=True))
    numbers: dict[str, int] = {}
    for name, number in weights_numbers.items():
        if name in number_by_name:
            numbers[name] = number_by_name[name]
        elif names.get(number) not in weights_numbers:  # the number is no other object's
            numbers[name] = number

    wanted = {instance.object_id for instance in dataset.instances}
    missing = sorted(wanted - set(numbers.values()))
    if len(missing) == len(wanted):
        weights_objects = ", ".join(f"{name} ({k})" for name, k in weights_numbers.items())
        raise InputError(
            f"{path}: segments {weights_objects}, but {dataset.folder} shows objects {missing}; "
            "give weights of its objects"
        )
    if missing:
        print(f"{path}: segments no objects {missing}; each is missing", file=sys.stderr)
    return numbers


def _read_segmented_images(path: Path) -> set[tuple[int, int]]:
    """Read which images an earlier run segmented: scene and image numbers."""
    source = str(path)
    return {
        (integer(row, "scene_id", source), integer(row, "im_id", source)) for row in read_rows(path)
    }


def _segment_image(
    segmenter: Segmenter, instance: datasets.Instance, numbers: Mapping[str, int]
) -> list[datasets.Detection]:
    """Segment the image of an instance; ``numbers``: of the data set's objects, by their names."""
    if instance.rgb is None:
        raise InputError(f"{instance.name}: has no picture, and a segmentation needs pictures")
    start = perf_counter()
    segmented = segmenter.segment(read_image(instance.rgb))
    seconds = perf_counter() - start

    detections: list[datasets.Detection] = []
    for object, masks in segmented.masks.items():
        if object not in numbers:
            continue
        scores = segmented.scores[object].tolist()
        for mask, score in zip(masks, scores, strict=True):
            detection = datasets.Detection(
                scene_id=instance.scene_id,
                image_id=instance.image_id,
                object_id=numbers[object],
                score=score,
                segmentation=datasets.encode_rle(mask),
                seconds=seconds,
            )
            detections.append(detection)
    return detections


def _names_of_files(words: Sequence[str], paths: Sequence[Path | None]) -> list[str]:
    """Name files by their stems, with folders where stems are equal; words stay as they are."""
    placed_names = [
        (None, word) if path is None else (path.parent, path.stem)
        for word, path in zip(words, paths, strict=True)
    ]
    return distinct_names(placed_names)


def distinct_names(placed_names: Sequence[tuple[Path | None, str]]) -> list[str]:
    """Make names distinct: equal ones get as many folders in front as it takes to tell them apart.

    ``placed_names``: the folder that each lies in, None where it lies in none, and its name.
    """
    parts = [
        (*(folder.resolve().parts[1:] if folder else ()), name) for folder, name in placed_names
    ]
    for path_parts, count in Counter(parts).items():
        if count > 1:
            raise InputError(
                f"{'/'.join(path_parts[-2:])}: {count} that are given have this name, and their "
                "results would be one; give it once, or rename a file"
            )

    # Equal names are lengthened by a folder, all at once, until none are equal.
    names: list[str] = []
    part_counts = [1] * len(parts)
    for _ in range(max(map(len, parts), default=0)):
        names = [
            "-".join(path_parts[-count:])
            for path_parts, count in zip(parts, part_counts, strict=True)
        ]
        uses = Counter(names)
        part_counts = [
            count + 1 if uses[name] > 1 else count
            for count, name in zip(part_counts, names, strict=True)
        ]
    return names


REGISTER = "register"
"""In place of weights: our own registration, which needs no training."""
_SAME_DIAMETER = 0.05
"""Largest relative difference of the diameters of one object in a data set and in weights."""
_FARTHEST_BASE_M = 50.0
"""Largest distance of a camera from the base of its robot; a larger one is in millimetres."""

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
    labels = _names_of_files(names, paths)
    methods: list[PoseMethod] = []
    for path, label in zip(paths, labels, strict=True):
        if path is None:
            methods.append(_registration_method(label, models, config))
        else:
            methods.append(_network_method(path, label, config))
    return methods


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
    fingerprints = {model.name: _model_fingerprint(model) for model in models}
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


def _model_fingerprint(model: ObjectModel) -> str:
    """Give the start of the SHA-256 of a model's mesh and of its declared symmetries."""
    digest = sha256(model.vertices_m.contiguous().numpy().tobytes())
    digest.update(model.faces.contiguous().numpy().tobytes())
    if not model.symmetries.is_found and not model.symmetries.is_none:
        digest.update(json.dumps(symmetries_to_bop(model.symmetries)).encode())
    return digest.hexdigest()[:16]


def _network_method(path: Path, name: str, config: EstimateConfig) -> PoseMethod:
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
    """What an estimator is built from, in this process or by the workers of an engine.

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
            return _registration_method(REGISTER, self.models, config)
        if isinstance(self.weights, str):
            path = find_weights(self.weights)
            return _network_method(path, path.stem, config)
        with self.weights.unpacked() as name:
            return _network_method(Path(name), Path(name).stem, config)


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


def predict_instances(
    dataset: datasets.BopDataset, method: PoseMethod, masks: Masks, out: Path, batch: int = 1
) -> Path:
    """Estimate every instance that is not estimated yet, and write ``poses.json`` and BOP's csv."""
    jobs = masks.make_jobs(match_names(dataset, method.models))
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
    """Give the name that a method has for each object of a data set, by the object's number.

    Objects are matched by name, else by number.

    Raises:
        InputError: the method has no such object, or one of another diameter.
    """
    matched_models = _match_models(dataset, models)
    names: dict[int, str] = {}
    for number, dataset_model in dataset.objects.items():
        model = matched_models.get(number)
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


def _match_models(
    dataset: datasets.BopDataset, models: Sequence[ObjectModel]
) -> dict[int, ObjectModel]:
    """Give the method's model of each object of a data set that has one, by the object's number.

    It is that of the object's name, else that of its number, unless the data set has another object
    of that model's name.
    """
    names_in_dataset = set(datasets.object_names(dataset.folder).values())
    by_name = {model.name: model for model in models}
    by_number = {model.number: model for model in models if model.name not in names_in_dataset}
    matched_models: dict[int, ObjectModel] = {}
    for number, dataset_model in dataset.objects.items():
        model = by_name.get(dataset_model.name) or by_number.get(number)
        if model is not None:
            matched_models[number] = model
    return matched_models


def read_pose(path: Path, option: str = "--first", transform: str = "camera_from_model") -> Rigid:
    """Read a pose: the only one of a ``poses.json``, or a 4x4 matrix in a text file, in metres.

    Brackets, commas and semicolons between its numbers are skipped. ``option`` and ``transform``
    name the file and the matrix in errors.
    """
    if path.name == predictions.POSES:
        return _read_only_pose(path, option)
    try:
        text = path.read_text()
    except (OSError, ValueError) as error:
        raise InputError(
            f"{option} {path}: cannot be read ({error}); give a text file with the 4x4 matrix "
            f"{transform} in metres"
        ) from error
    return _parse_rigid(text, f"{option} {path}", transform)


def _read_only_pose(path: Path, option: str) -> Rigid:
    """Read the pose of a ``poses.json`` that holds exactly one."""
    estimates = [
        predictions.parse_prediction(row, f"{path}: entry {i}").estimate
        for i, row in enumerate(read_rows(path))
    ]
    poses = [
        estimate.camera_from_model
        for estimate in estimates
        if estimate.camera_from_model is not None
    ]
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
    transform = "base_from_camera"
    if len(words) == 1 and Path(words[0]).is_file():
        base = read_pose(Path(words[0]), option, transform)
    else:
        base = _parse_rigid(" ".join(words), option, transform)
    distance_m = float(base.t_m.norm())
    if distance_m > _FARTHEST_BASE_M:
        raise InputError(
            f"{option}: the camera is {distance_m:.0f} m from the base; is that in "
            "millimetres? Give metres"
        )
    return base


def _parse_rigid(text: str, source: str, transform: str) -> Rigid:
    """Parse a rigid transform: the 16 numbers of its 4x4 matrix, row by row, in metres.

    ``source`` and ``transform`` name it in errors.
    """
    try:
        words = re.sub(r"[\[\],;]", " ", text).split()
        values = torch.tensor([float(word) for word in words], dtype=torch.float64)
    except ValueError as error:
        raise InputError(
            f"{source}: cannot be read as numbers ({error}); give a text file with the 4x4 matrix "
            f"{transform} in metres"
        ) from error
    if len(values) != 16:
        raise InputError(f"{source}: {len(values)} numbers; give the 16 of a 4x4 matrix")
    try:
        return rigid_input(values.reshape(4, 4), transform, transform)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error


def choose_objects(
    dataset: datasets.BopDataset, method: PoseMethod, object: str | None
) -> datasets.BopDataset:
    """Restrict a data set to the objects that a method poses, or to the one named.

    Objects that the method does not have are printed.
    """
    numbers = {model.name: model.number for model in method.models}
    if object is not None:
        names_in_dataset = datasets.object_names(dataset.folder).values()
        if object not in names_in_dataset and object in numbers:
            return dataset.of_objects(numbers[object])  # the method's own name of the object
        return dataset.of_objects(object)  # the data set's name or number of it

    object_ids = sorted({instance.object_id for instance in dataset.instances})
    matched_models = _match_models(dataset, method.models)
    estimable = [number for number in object_ids if number in matched_models]
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
