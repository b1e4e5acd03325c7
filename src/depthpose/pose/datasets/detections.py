"""Detections from files of detectors: boxes or masks, with a class and a score."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from depthpose.core.errors import InputError, suggest_name
from depthpose.core.files import read_json, read_text, write_json
from depthpose.core.files.disk import make_suffix_error
from depthpose.pose.datasets.entries import (
    LARGEST_ID,
    check_rows,
    read_integer,
    read_number,
    read_numbers,
)
from depthpose.pose.datasets.masks import RunLengths, decode_rle, find_mask_box, read_runs
from depthpose.pose.types import ViewInput

Box = tuple[float, float, float, float]
"""Left, top, right and bottom edge [px]: the first pixel reaches from 0 to 1, as COCO counts."""
_NO_BOX = [-1.0] * 4  # as BOP writes the box of an empty mask
_YOLO_FORM = "class cx cy w h [confidence]"


@dataclass(frozen=True, kw_only=True, eq=False)
class Detection:
    """An object that a detector found in an image: its mask, or a box about it.

    Raises:
        InputError: it has neither or both, or a box whose edges are not in order.
    """

    # All but the box or the mask is None where the file does not give it.
    object: str | None = None  # name of its class
    object_id: int | None = None  #: number of its class (``category_id``)
    score: float = 1.0  #: confidence; 1 where the file gives none
    box: Box | None = None  #: edges; may reach beyond the image
    segmentation: RunLengths | None = None  #: its mask
    scene_id: int | None = None  #: number of the scene, of BOP's datasets
    image_id: int | None = None  #: number of the image
    image: str | None = None  #: name of the image's file without its ending
    seconds: float | None = None  #: time that the detector took for the image

    def __post_init__(self) -> None:
        if (self.box is None) == (self.segmentation is None):
            how_many = "neither" if self.box is None else "both"
            raise InputError(
                f"a detection has {how_many} of a box and a mask; give one: bbox [left, top, "
                'width, height], or a segmentation {"size": [height, width], "counts": [...]}'
            )
        if self.box is not None:
            check_box(self.box)

    @property
    def label(self) -> str:
        """The name of the class, or its number where there is no name."""
        return str(self.object_id) if self.object is None else self.object

    def mask(self, height: int, width: int) -> Bool[Tensor, "height width"]:
        """Mark the object's pixels in the image: those of the mask, or all that the box touches.

        Raises:
            InputError: the mask is of an image of another size, or the box lies outside of this.
        """
        if self.segmentation is None:
            assert self.box is not None
            return mask_from_box(self.box, height, width)
        runs = self.segmentation
        if (runs.height, runs.width) != (height, width):
            raise InputError(
                f"the mask of a detection is {runs.width}x{runs.height}, but the image "
                f"{width}x{height}; "
                "detect in this very image, or resize the masks to its size"
            )
        return decode_rle(*runs)


def mask_view(view: ViewInput, detection: Detection) -> ViewInput:
    """Return a view with the mask of a detection, or with the region of its box.

    Raises:
        InputError: the mask is of an image of another size, or the box lies outside of this.
    """
    mask = detection.mask(*view.depth_m.shape)
    return replace(view, mask=mask, is_region=detection.box is not None)


def parse_box(text: str) -> Box:
    """Read ``X0,Y0,X1,Y1``: left, top, right and bottom edge [px].

    Raises:
        InputError: these are not four numbers in order.
    """
    try:
        x0, y0, x1, y1 = (float(word) for word in text.split(","))
    except ValueError as error:
        raise InputError(
            f"box {text!r} is not X0,Y0,X1,Y1: four numbers [px], the left, top, right and bottom "
            "edge, as 120,80,260,210"
        ) from error
    check_box((x0, y0, x1, y1))
    return x0, y0, x1, y1


def check_box(box: Box) -> None:
    """Check that the edges of a box are finite and in order.

    Raises:
        InputError: they are not.
    """
    x0, y0, x1, y1 = box
    if not all(math.isfinite(edge) for edge in box) or not x0 < x1 or not y0 < y1:
        raise InputError(
            f"box {_format_edges(box)}: the right edge is to lie right of the left edge, and the "
            "bottom below the top; give left,top,right,bottom (of left,top,width,height add width "
            "and height)"
        )


def mask_from_box(box: Box, height: int, width: int) -> Bool[Tensor, "height width"]:
    """Mark all pixels of an image that a box touches; the box may reach beyond the image.

    Raises:
        InputError: its centre lies outside of the image.
    """
    check_box(box)
    x0, y0, x1, y1 = box
    if not (0 <= (x0 + x1) / 2 <= width and 0 <= (y0 + y1) / 2 <= height):
        raise InputError(
            f"box {_format_edges(box)}: its centre lies outside of the image of {width}x{height} "
            "pixels; give pixels of the depth image: a box of an image that is s times as large is "
            "to be divided by s"
        )
    mask = torch.zeros(height, width, dtype=torch.bool)
    rows = slice(max(0, math.floor(y0)), math.ceil(y1))
    columns = slice(max(0, math.floor(x0)), math.ceil(x1))
    mask[rows, columns] = True
    return mask


def read_detections(path: str | Path, size: tuple[int, int] | None = None) -> list[Detection]:
    """Read a file of detections: JSON as BOP or COCO share them, or YOLO's text.

    JSON is a list of entries with ``bbox`` (left, top, width, height) or a ``segmentation`` in run
    lengths, ``category_id`` or the ``name`` of a class, ``score``, ``image_id`` and ``scene_id``,
    or COCO's ``annotations`` with the names of its ``images`` and ``categories``. A ``.txt`` file
    is YOLO's of one image: in each line the number of the class, centre, width and height in shares
    of the image, and the confidence.

    Args:
        path: ``.json`` or ``.txt``.
        size: width and height of the image; ``.txt`` needs it.

    Raises:
        InputError: it is missing or damaged, or an entry is neither a box nor a mask.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".json":
        return _read_coco(path)
    if suffix == ".txt":
        return _read_yolo(path, size)
    raise make_suffix_error(path, "file of detections", (".json", ".txt"))


def _read_coco(path: Path) -> list[Detection]:
    """Read a JSON file of detections as BOP or COCO share them."""
    # The names of classes and images, which COCO lists apart.
    content = read_json(path)
    class_names: dict[int, str] = {}
    image_files: dict[int, str] = {}
    if isinstance(content, dict) and "annotations" in content:
        source = f"{path}: categories"
        for category in check_rows(content.get("categories", []), source):
            class_names[read_integer(category, "id", source)] = str(category.get("name"))
        source = f"{path}: images"
        for image in check_rows(content.get("images", []), source):
            image_files[read_integer(image, "id", source)] = str(image.get("file_name"))
        content = content["annotations"]

    # The detections.
    return [
        _parse_coco_entry(row, class_names, image_files, f"{path}: entry {place}")
        for place, row in enumerate(check_rows(content, str(path)))
    ]


def _parse_coco_entry(
    row: dict[str, Any], class_names: dict[int, str], image_files: dict[int, str], source: str
) -> Detection:
    """Make a detection of an entry of BOP or COCO; where it has a mask, its box is ignored.

    Args:
        row: the entry.
        class_names: by number.
        image_files: by number.
        source: of the entry, for errors.
    """
    # The class, by name or number.
    name = row.get("name", row.get("category_name"))
    object_id = None
    if "category_id" in row or name is None:
        object_id = read_integer(row, "category_id", source)
    if name is None and object_id is not None:
        name = class_names.get(object_id)

    # The image, by number or by the name of its file.
    image_id = None
    image_file = row.get("file_name")
    if _has_integer(row, "image_id"):
        image_id = read_integer(row, "image_id", source)
        image_file = image_files.get(image_id) if image_file is None else image_file
    elif "file_name" not in row:
        image_file = row.get("image_id")

    # The time is negative where it is not known.
    seconds = read_number(row, "time", -1.0, source)
    segmentation = row.get("segmentation")
    try:
        return Detection(
            object=None if name is None else str(name),
            object_id=object_id,
            score=read_number(row, "score", 1.0, source),
            box=None if segmentation else _read_coco_box(row, source),
            segmentation=read_runs(segmentation, source) if segmentation else None,
            scene_id=read_integer(row, "scene_id", source) if "scene_id" in row else None,
            image_id=image_id,
            image=None if image_file is None else PurePosixPath(str(image_file)).stem,
            seconds=seconds if seconds >= 0 else None,
        )
    except InputError as error:
        reason = str(error)
        raise InputError(reason if source in reason else f"{source}: {reason}") from error


def _read_coco_box(row: dict[str, Any], source: str) -> Box | None:
    """Read left, top, width and height of an entry as a box; None where it has none."""
    if row.get("bbox") is None:
        return None
    left, top, width, height = read_numbers(row, "bbox", 4, source)
    if [left, top, width, height] == _NO_BOX:
        return None
    return left, top, left + width, top + height


def _read_yolo(path: Path, size: tuple[int, int] | None) -> list[Detection]:
    """Read a text file of YOLO's boxes in an image of some size (width, height)."""
    if size is None:
        raise InputError(
            f"{path}: its boxes are shares of an image whose size is not known here; give JSON, or "
            "name it by --detections beside --depth"
        )
    lines = enumerate(read_text(path).splitlines(), 1)
    return [
        _parse_yolo_line(text, size, path.stem, f"{path}: line {line}")
        for line, text in lines
        if text.split()
    ]


def _parse_yolo_line(text: str, size: tuple[int, int], image: str, source: str) -> Detection:
    """Make a detection of a line: class, centre and size (shares of the image), and confidence.

    Args:
        text: the line.
        size: width and height of the image.
        image: its name.
        source: of the line, for errors.
    """
    words = text.split()
    if len(words) not in (5, 6):
        raise InputError(
            f"{source}: {len(words)} numbers, where {_YOLO_FORM} belong; polygons are to be turned "
            "into boxes, or masks given by --mask"
        )
    try:
        object_id = int(words[0])
        shares = [float(word) for word in words[1:]]
    except ValueError as error:
        raise InputError(f"{source}: {error}; write {_YOLO_FORM}") from error

    # Are these a class and shares of the image?
    cx, cy, w, h = shares[:4]
    is_share = all(0 <= share <= 1 for share in shares)
    if not is_share or not w * h > 0 or not 0 <= object_id <= LARGEST_ID:
        raise InputError(
            f"{source}: {text.strip()[:80]!r} is not {_YOLO_FORM}, a class of 0 or more, and "
            "shares of the image from 0 to 1; boxes in pixels go into JSON as COCO's bbox"
        )

    # To edges in pixels.
    width, height = size
    left = (cx - w / 2) * width
    right = (cx + w / 2) * width
    top = (cy - h / 2) * height
    bottom = (cy + h / 2) * height
    score = shares[4] if len(shares) == 5 else 1.0
    return Detection(object_id=object_id, score=score, box=(left, top, right, bottom), image=image)


def write_detections(path: str | Path, detections: Sequence[Detection]) -> None:
    """Write detections as BOP shares them, run lengths as plain numbers.

    Raises:
        InputError: one lacks its scene, image or number of object, or the disk refuses.
    """
    rows: list[dict[str, Any]] = []
    for detection in detections:
        row: dict[str, Any] = {
            "scene_id": detection.scene_id,
            "image_id": detection.image_id,
            "category_id": detection.object_id,
        }
        missing = [key for key, value in row.items() if value is None]
        if missing:
            raise InputError(
                f"{path}: a detection of {detection.label!r} has no {missing[0]}; BOP's has"
            )

        # The score, and the mask or the box.
        row["score"] = detection.score
        if detection.box is not None:
            x0, y0, x1, y1 = detection.box
            row["bbox"] = [x0, y0, x1 - x0, y1 - y0]
        else:
            runs = detection.segmentation
            assert runs is not None
            row["segmentation"] = {"size": [runs.height, runs.width], "counts": list(runs.counts)}
            row["bbox"] = find_mask_box(decode_rle(*runs))
        rows.append(row | {"time": -1.0 if detection.seconds is None else detection.seconds})
    write_json(Path(path), rows)


def parse_labels(text: str, objects: Sequence[str]) -> dict[str, str]:
    """Parse ``1=bracket,2=gear``: the object of each class.

    ``3=`` leaves class 3 out: the name of its object is empty.

    Args:
        text: classes, by number or name, and their objects.
        objects: names of the known objects.

    Returns:
        The names of objects by class.

    Raises:
        InputError: the text is not of this form, names a class twice, or an unknown object.
    """
    labels: dict[str, str] = {}
    for part in text.split(","):
        label, sign, name = (word.strip() for word in part.partition("="))
        if not label or not sign:
            raise InputError(
                f"labels {text!r}: {part.strip()!r} is not CLASS=OBJECT; write 1=bracket,2=gear"
            )
        if label in labels:
            raise InputError(f"labels {text!r}: class {label} is named twice; name it once")
        if name and name not in objects:
            raise InputError(
                f"labels {text!r}: class {label} is {name!r}, which is no known object; "
                f"{suggest_name(name, objects)}"
            )
        labels[label] = name
    return labels


def name_objects(
    detections: Sequence[Detection],
    labels: Mapping[str, str],
    objects: Sequence[str],
    wanted: str | None,
    source: str,
) -> list[Detection]:
    """Name the object of each detection, and leave out detections of other objects.

    Args:
        detections: of any classes.
        labels: of :func:`parse_labels`.
        objects: names of the known objects; a class of such a name is that object.
        wanted: the only object to keep, if any; where all detections are of one class without a
            name, it is this object.
        source: of the detections, in errors.

    Returns:
        The detections that are kept, with the names of their objects.

    Raises:
        InputError: a class is no known object.
    """
    named: list[Detection] = []
    is_one_class = len({detection.label for detection in detections}) == 1
    for detection in detections:
        # The object of its class.
        label = detection.label
        name = labels.get(label, detection.object)
        if name is None and wanted is not None and is_one_class:
            name = wanted
        if name is None:
            raise InputError(
                f"{source}: class {label} is a number without a name; say which object it is by "
                f"--labels {label}={objects[0]}, or leave it out by --labels {label}="
            )
        if name and name not in objects and wanted is None:
            raise InputError(
                f"{source}: class {name!r} is no known object; {suggest_name(name, objects)} Say "
                f"by --labels {label}=OBJECT which it is, or leave it out by --labels {label}="
            )
        if name == wanted or (name and wanted is None):
            named.append(replace(detection, object=name))
    return named


def group_by_image(
    detections: Sequence[Detection], images: Sequence[str], source: str
) -> dict[str, list[Detection]]:
    """Group detections by image.

    A detection belongs to the image that its ``image`` names, or else to that whose name is its
    ``image_id``. Where there is one image, and all detections are of one image, it is that.

    Args:
        detections: of any images.
        images: names of their files without endings.
        source: of the detections, in errors.

    Returns:
        The detections of each image, by its name.

    Raises:
        InputError: a detection names no image, or no detection is of a given image.
    """
    if len({detection.scene_id for detection in detections}) > 1:
        raise InputError(
            f"{source}: holds detections of several scenes; name the dataset by --bop, and the "
            "file by --masks"
        )
    detected_images = {(detection.image_id, detection.image) for detection in detections}
    if len(images) == 1 and len(detected_images) <= 1:
        return {images[0]: list(detections)}

    # By the name of the image, else by its number.
    groups: dict[str, list[Detection]] = {image: [] for image in images}
    by_number = {int(image): image for image in images if image.isascii() and image.isdecimal()}
    for entry, detection in enumerate(detections):
        if detection.image is None and detection.image_id is None:
            raise InputError(
                f"{source}: entry {entry} does not say of which image it is; add image_id, the "
                "number that the depth image has for a name, or file_name"
            )
        image = detection.image
        if image not in groups and detection.image_id is not None:
            image = by_number.get(detection.image_id)
        if image in groups:
            groups[image].append(detection)

    # Is any of them of one of the images?
    if detections and not any(groups.values()):
        first = detections[0]
        wanted = repr(images[0])
        if len(images) > 1:
            wanted += " or another image"
        raise InputError(
            f"{source}: no detection is of {wanted}; the first is of "
            f"{first.image or first.image_id!r}. Name the depth images as the detections say "
            "(image_id 12 is 12.png or 000012.png), or correct the file"
        )
    return groups


def _has_integer(row: Mapping[str, Any], key: str) -> bool:
    """Whether an entry has a whole number under a key."""
    return isinstance(row.get(key), int) and not isinstance(row[key], bool)


def _format_edges(box: Box) -> str:
    """Format the edges of a box for a message."""
    return ",".join(f"{edge:g}" for edge in box)
