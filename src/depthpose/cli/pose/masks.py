"""The masks that pose methods are given, by their names."""

import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

from tqdm import tqdm

from depthpose.core.checkpoint import file_sha256, find_weights
from depthpose.core.errors import InputError
from depthpose.core.files import read_image, write_json
from depthpose.core.run import claim_folder
from depthpose.pose.datasets import (
    LAYOUTS,
    BopDataset,
    Detection,
    Instance,
    encode_rle,
    object_names,
    read_detections,
    write_detections,
)
from depthpose.pose.datasets.parse import integer, read_rows
from depthpose.pose.predictions import Job, detection_jobs, instance_jobs
from depthpose.pose.segmentation import Segmenter
from depthpose.pose.types import ViewInput


@dataclass(frozen=True, kw_only=True, eq=False)
class Masks:
    """Which pixels a method is given: what to call them, and the jobs that they make."""

    name: str
    jobs: Callable[[Mapping[int, str]], list[Job[ViewInput]]]
    settings: Mapping[str, Any]


def find_masks(
    kinds: Sequence[str], dataset: BopDataset, out: Path, device: str = "cpu"
) -> list[Masks]:
    """Understand ``truth``, ``predicted``, files of BOP detections and segmentation weights.

    Args:
        kinds: which masks.
        dataset: whose images are used.
        out: where a segmentation writes what it finds.
        device: of a segmentation.

    Raises:
        InputError: one is none of these, or the data set came without predicted masks.
    """
    paths = [_path_of(kind) for kind in kinds]
    files = [
        (None, kind) if path is None else (path.parent, path.stem)
        for kind, path in zip(kinds, paths, strict=True)
    ]
    return [
        _shipped_masks(kind, dataset)
        if path is None
        else _file_masks(path, name, dataset, out, device)
        for kind, path, name in zip(kinds, paths, distinct_names(files), strict=True)
    ]


def mask_files(kinds: Sequence[str]) -> list[str]:
    """Name masks as :func:`find_masks` takes them; files by what they hold.

    Raises:
        InputError: there is no such file.
    """
    paths = [_path_of(kind) for kind in kinds]
    return [
        kind if path is None else named_file(path) for kind, path in zip(kinds, paths, strict=True)
    ]


def named_file(path: Path) -> str:
    """Name a file with the start of its SHA-256: another one of that name is another name.

    Raises:
        InputError: it cannot be read.
    """
    try:
        return f"{path.name} {file_sha256(path)[:12]}"
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give another file") from error


def of_dataset(dataset: BopDataset) -> dict[str, Any]:
    """Settings that say which data set results are of, wherever its folder lies."""
    return {
        "dataset": dataset.folder.resolve().name,
        "split": dataset.split,
        "annotations_sha256": dataset.sha256[:12],
    }


def _path_of(kind: str) -> Path | None:
    if kind in ("truth", "predicted"):
        return None
    return Path(kind) if kind.endswith(".json") else find_weights(kind)


def _shipped_masks(kind: str, dataset: BopDataset) -> Masks:
    if kind == "truth":
        return Masks(name=kind, jobs=lambda names: instance_jobs(dataset, names), settings={})
    mask_of = LAYOUTS[dataset.layout].predicted_mask
    if mask_of is None:
        raise InputError(
            f"{dataset.folder}: came without predicted masks, as Linemod_preprocessed has them; "
            "give --masks a file of BOP detections, or weights of a segmentation"
        )
    return Masks(
        name=kind,
        jobs=lambda names: instance_jobs(dataset, names, partial(mask_of, dataset.folder)),
        settings={"masks_of": "segnet_results"},
    )


def _file_masks(path: Path, name: str, dataset: BopDataset, out: Path, device: str) -> Masks:
    is_list = path.suffix == ".json"
    detections = read_detections(path) if is_list else _segmented(path, name, dataset, out, device)
    return Masks(
        name=name,
        jobs=lambda names: detection_jobs(dataset, names, detections),
        settings={"masks_sha256": file_sha256(path)},
    )


def _segmented(
    path: Path, name: str, dataset: BopDataset, out: Path, device: str
) -> list[Detection]:
    """Segment the images that are not segmented yet, for every object that the weights know.

    Other objects or images may be asked for next time: what is there stays, what lacks is added.
    """
    segmenter = Segmenter.load(path, device)
    numbers = _numbers_of(segmenter, dataset, path)
    home = out / "detections" / name
    claim_folder(home, {"weights_sha256": file_sha256(path), **of_dataset(dataset)})
    file, record = home.parent / f"{name}.json", home / "images.json"
    try:
        done = _read_images(record)
        known = (
            [d for d in read_detections(file) if (d.scene_id, d.image_id) in done] if done else []
        )
    except InputError:  # damaged or missing: all is segmented again
        done, known = set(), []
    images = {(i.scene_id, i.image_id): i for i in dataset.instances}
    left = [images[place] for place in sorted(images.keys() - done)]
    if left:
        known += _detect(segmenter, left, numbers)
        write_detections(file, known)
        places = sorted(done | images.keys())
        write_json(record, [{"scene_id": scene, "im_id": image} for scene, image in places])
    return known


def _read_images(record: Path) -> set[tuple[int, int]]:
    rows = read_rows(record) if record.is_file() else []
    return {(integer(r, "scene_id", str(record)), integer(r, "im_id", str(record))) for r in rows}


def _numbers_of(segmenter: Segmenter, dataset: BopDataset, path: Path) -> dict[str, int]:
    """Find what a data set numbers each object of the weights: by its name, else by its number."""
    names = object_names(dataset.folder)
    by_name = {name: number for number, name in names.items()}
    own = dict(zip(segmenter.weights.objects, segmenter.weights.numbers, strict=True))
    numbers = {
        name: by_name.get(name, number)
        for name, number in own.items()
        if name in by_name or names.get(number) not in own
    }
    wanted = {instance.object_id for instance in dataset.instances}
    lost = sorted(wanted - set(numbers.values()))
    if len(lost) == len(wanted):
        known = ", ".join(f"{name} ({number})" for name, number in own.items())
        raise InputError(
            f"{path}: segments {known}, but {dataset.folder} shows objects {lost}; give weights "
            "of its objects"
        )
    if lost:
        print(f"{path}: segments no objects {lost}; each is missing", file=sys.stderr)
    return numbers


def _detect(
    segmenter: Segmenter, images: Sequence[Instance], numbers: Mapping[str, int]
) -> Iterable[Detection]:
    """Segment each picture once; what it took is its time."""
    for shown in tqdm(images, "segmentation", disable=None, unit=" images"):
        if shown.rgb is None:
            raise InputError(f"{shown.name}: has no picture, and a segmentation needs pictures")
        start = perf_counter()
        found = segmenter.segment(read_image(shown.rgb))
        spent_s = perf_counter() - start
        for name, masks in found.masks.items():
            for mask, score in zip(masks, found.scores[name].tolist(), strict=True):
                if name in numbers:
                    yield Detection(
                        scene_id=shown.scene_id,
                        image_id=shown.image_id,
                        object_id=numbers[name],
                        score=score,
                        segmentation=encode_rle(mask),
                        seconds=spent_s,
                    )


def distinct_names(files: Sequence[tuple[Path | None, str]]) -> list[str]:
    """Give each its own name; of equal ones, with as many folders above it as distinguish them.

    Args:
        files: the folder that something lies in, None where it lies in none, and its name.

    Raises:
        InputError: two of one name lie in one folder, or one is given twice.
    """
    parts = [(*(folder.resolve().parts[1:] if folder else ()), name) for folder, name in files]
    for some, count in Counter(parts).items():
        if count > 1:
            raise InputError(
                f"{'/'.join(some[-2:])}: {count} that are given have this name, and their results "
                "would be one; give it once, or rename a file"
            )
    names: list[str] = []
    depths = [1] * len(parts)
    for _ in range(max(map(len, parts), default=0)):
        names = ["-".join(some[-depth:]) for some, depth in zip(parts, depths, strict=True)]
        counts = Counter(names)
        depths = [d + (counts[name] > 1) for d, name in zip(depths, names, strict=True)]
    return names
