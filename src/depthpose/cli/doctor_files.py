"""The work behind ``depthpose doctor FILE...``: what files are, and what is odd about them."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from depthpose.cli.pose_methods import read_pose
from depthpose.core import camera as cameras
from depthpose.core import files
from depthpose.core.errors import InputError
from depthpose.core.files.images import opened_image, read_numbers, value_range
from depthpose.core.rigid import geodesic_rad
from depthpose.pose.cloud import frame_advice, unit_advice
from depthpose.pose.datasets import decode_rle
from depthpose.pose.datasets.masks import read_runs
from depthpose.pose.mesh import MESH_READERS, exact_diameter, read_geometry

Size = tuple[int, int]

_UNITS_M = {"most sensors": 0.001, "TUM RGB-D": 0.0002, "KITTI": 1 / 256}
_MIN_DEPTH_M = 0.05
_MAX_DEPTH_M = 100.0
_MAX_LENGTH_M = 20.0  # of a part, and of the way to a scan
_MIN_LENGTH_MM = 2.0  # of a part
_MIN_DISTANCE_MM = 150.0  # no depth camera sees what is nearer
_MAX_8_BIT = 255
_MIN_UNKNOWN_SHARE = 0.02  # of depth images: of sensors 6 % and more has no reading
_MAX_SMOOTH_STEP = 0.012
"""Mean step between neighbours of a depth image, as a share of the range: of dense depth 0.004 at
most, of pictures 0.024 at least."""
_MAX_FOCAL_DIFFERENCE = 0.05  # of fx and fy, as a share
_HALF = 0.5


@dataclass(kw_only=True)
class FileFacts:
    """A file, what it is, what is odd, and what the others are compared with."""

    path: Path
    description: str = ""
    oddities: list[str] = field(default_factory=list)
    size: Size | None = None
    image: Tensor | None = None
    depth_units: Tensor | None = None
    camera: cameras.Camera | None = None
    mask: Tensor | None = None
    cloud: Tensor | None = None
    model: Tensor | None = None


def describe_files(paths: Sequence[Path]) -> int:
    """Print what each file is and what is odd about it; give the exit code."""
    # What has a size comes first: a camera file may need it.
    suffixes = cameras.CAMERA_SUFFIXES
    ordered = sorted(paths, key=lambda path: path.is_dir() or path.suffix.lower() in suffixes)
    all_facts: list[FileFacts] = []
    for path in ordered:
        size = next((other.size for other in all_facts if other.size is not None), None)
        try:
            all_facts.append(_describe_file(path, size))
        except InputError as error:
            all_facts.append(FileFacts(path=path, oddities=[str(error).removeprefix(f"{path}: ")]))

    # What each is, and where it contradicts another.
    for facts in all_facts:
        facts.oddities += _contradictions(facts, all_facts)
    for path in paths:
        facts = next(s for s in all_facts if s.path == path)
        print(f"{path}: {facts.description}" if facts.description else f"{path}: cannot be used")
        for oddity in facts.oddities:
            print(f"  odd: {oddity}")

    # Two pictures may be a pair, the left one first.
    is_odd = any(facts.oddities for facts in all_facts)
    pictures = [facts for facts in all_facts if facts.image is not None]
    if len(pictures) == 2 and pictures[0].size == pictures[1].size:
        left, right = (facts.image for facts in pictures)
        assert left is not None
        assert right is not None
        report = cameras.check_rectified(left, right)
        oddity = f"\n  odd: {report.message}" if report.is_wrong else f": {report.message}"
        print(f"{pictures[0].path.name} and {pictures[1].path.name} as a pair{oddity}")
        is_odd = is_odd or report.is_wrong
    return 1 if is_odd else 0


def _describe_file(path: Path, size: Size | None) -> FileFacts:
    """Tell what a file holds, by its suffix: a camera, a map, a mesh, a cloud or a picture.

    ``size``: width and height [px] of a picture beside it, for cameras that do not say theirs.
    """
    suffix = path.suffix.lower()
    if path.is_dir() or suffix in cameras.CAMERA_SUFFIXES:
        return _describe_text_file(path, size)
    if suffix in files.MAP_SUFFIXES:
        return _describe_map(path)
    if suffix in MESH_READERS:
        vertices, faces = read_geometry(path)
        points = torch.from_numpy(vertices)
        if not len(faces):
            return _describe_points(path, points)
        diameter = exact_diameter(points)
        unit = "metres (--unit m)" if diameter < _MIN_LENGTH_MM else "metres, cm or mm; measure it"
        unit = "millimetres (--unit mm)" if diameter > _MAX_LENGTH_M else unit
        # STL repeats the points of every face, and other files those at edges.
        count = len(np.unique(vertices, axis=0))
        description = (
            f"mesh of {count} points and {len(faces)} faces, {diameter:.4g} across: {unit}"
        )
        return FileFacts(path=path, description=description, model=points)
    if suffix in files.CLOUD_READERS:
        return _describe_points(path, files.read_cloud(path).points.double())
    return _describe_picture(path)


def _describe_text_file(path: Path, size: Size | None) -> FileFacts:
    """Read a text file as a camera, a pose, run lengths of a mask, or points."""
    if (posed := _describe_pose(path)) is not None:
        return posed
    if path.suffix.lower() == ".json":
        content = files.read_json(path)
        record = content[0] if isinstance(content, list) and len(content) == 1 else content
        if isinstance(record, dict) and {"counts", "segmentation"} & record.keys():
            return _describe_mask(path, decode_rle(*read_runs(record, str(path))))
    try:
        camera = cameras.read_camera(path, size)
    except InputError as error:
        if path.suffix.lower() != ".txt" or "no camera that is known" not in str(error):
            raise
        return _describe_points(path, files.read_cloud(path).points.double())
    fx = float(camera.K[0, 0])
    fy = float(camera.K[1, 1])
    wide = math.degrees(2 * math.atan(camera.width / (2 * fx)))
    description = (
        f"camera of {camera.width}x{camera.height}, fx {fx:.1f} px, {wide:.0f} degrees wide"
    )
    if isinstance(camera, cameras.StereoRig):
        description += f", baseline {camera.baseline_m:.4g} m"
    if camera.depth_unit_m is not None:
        description += f", depth in units of {camera.depth_unit_m:.4g} m"
    oddities = [oddity] if (oddity := cameras.suspicious_centre(camera)) is not None else []
    if abs(fx / fy - 1) > _MAX_FOCAL_DIFFERENCE:
        oddities.append(
            f"fx {fx:.1f} and fy {fy:.1f} differ by {abs(fx / fy - 1):.0%}, as of an image "
            "that was squeezed in one direction; was K scaled as the image was?"
        )
    return FileFacts(path=path, description=description, oddities=oddities, camera=camera)


def _describe_pose(path: Path) -> FileFacts | None:
    """A 4x4 matrix as ``pose track --first`` takes it; None where the file holds something else."""
    if path.is_dir():
        return None
    try:
        pose = read_pose(path)
    except InputError:
        return None
    turn = math.degrees(float(geodesic_rad(pose.R, torch.eye(3).to(pose.R))))
    away = float(pose.t_m.norm())
    oddities = []
    if away > _MAX_LENGTH_M:
        oddities.append(f"it moves by {away:.4g}, taken as metres: is it in millimetres?")
    return FileFacts(
        path=path,
        description=f"pose, turned by {turn:.1f} degrees, {away:.4g} m away",
        oddities=oddities,
    )


def _describe_picture(path: Path) -> FileFacts:
    """Tell whether a picture is a depth image, a mask or a photograph.

    One of 16 bits is a depth image where many pixels have no value, or neighbours are alike.
    """
    description = ""
    units = None
    with opened_image(path) as image:
        if image.mode == "I;16":
            units = torch.from_numpy(np.asarray(image).astype(np.float32))
    if units is not None:
        has_reading = units > 0
        low, high = value_range(units.numpy())
        unknown = 1 - float(has_reading.float().mean())
        span = max(high - low, 1)
        rough = float((units[:, 1:] - units[:, :-1]).abs().mean()) / span
        if unknown > _MIN_UNKNOWN_SHARE or rough < _MAX_SMOOTH_STEP:
            return _describe_depth(path, torch.where(has_reading, units, torch.nan))
        description = f", 16 bits a value, from {low} to {high}"
    picture = files.read_image(path)
    size = (picture.shape[2], picture.shape[1])
    description = f"picture of {size[0]}x{size[1]}{description}"
    low, high = picture.aminmax()
    if all(bool(((row == low) | (row == high)).all()) for row in picture):
        return _describe_mask(path, picture[0] > 0)
    return FileFacts(path=path, description=description, size=size, image=picture)


def _describe_mask(path: Path, mask: Tensor) -> FileFacts:
    """Describe a mask: its share of the image, and whether it is empty or inverted."""
    height, width = mask.shape
    share = float(mask.float().mean())
    edge = torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).float().mean()
    oddities = ["it is empty: no pixel is the object"] if share == 0 else []
    if share > _HALF and float(edge) > _HALF:
        oddities.append(f"it covers {share:.0%} of the image and its border: is it inverted?")
    description = f"mask of {width}x{height}, {share:.1%} of the image"
    return FileFacts(
        path=path, description=description, oddities=oddities, size=(width, height), mask=mask
    )


def _describe_depth(path: Path, units: Tensor) -> FileFacts:
    """Describe a 16-bit depth image, whose unit the file does not say."""
    height, width = units.shape
    readings = units[units.isfinite()]
    facts = FileFacts(path=path, size=(width, height), depth_units=units)
    facts.description = f"16-bit depth of {width}x{height}"
    if len(readings) == 0:
        facts.oddities.append("every pixel is 0: no reading")
        return facts
    median = float(readings.median())
    share = len(readings) / units.numel()
    maybe = ", ".join(f"{median * unit:.3g} m ({device})" for device, unit in _UNITS_M.items())
    facts.description += f", {share:.0%} known, median {median:g} units: {maybe}"
    if share == 1:
        facts.description += "; or, as no pixel is 0, a picture of 16 bits"
    if float(readings.max()) <= _MAX_8_BIT:
        facts.oddities.append("no value is above 255: a picture of depth, not the data?")
    return facts


def _describe_map(path: Path) -> FileFacts:
    """Describe a map of numbers (``.npy``, ``.pfm``): depth, disparity, or rows of points."""
    if path.suffix.lower() == ".npy":
        stored = read_numbers(path)
        if stored.dtype.kind != "f" and stored.ndim == 2:
            units = torch.from_numpy(stored.astype("float32"))
            return _describe_depth(path, torch.where(units > 0, units, torch.nan))
        if stored.ndim != 2 or stored.shape[1] in (3, 4):
            return _describe_points(path, files.read_cloud(path).points.double())
    values = files.read_map(path)
    readings = values[values.isfinite()]
    height, width = values.shape
    facts = FileFacts(path=path, description=f"map of {width}x{height}", size=(width, height))
    if len(readings) == 0:
        facts.oddities.append("no value is known")
        return facts
    median = float(readings.median())
    facts.description += f", {len(readings) / values.numel():.0%} known, median {median:.4g}"
    if float((readings < 0).float().mean()) > _HALF:
        facts.oddities.append(
            "most values are negative: disparity of exchanged views, or z backward?"
        )
    elif median > 2 * _MAX_DEPTH_M:
        facts.oddities.append(
            f"as metres the median {median:.4g} is too far; is it in millimetres? Divide by 1000"
        )
    return facts


def _describe_points(path: Path, points: Tensor) -> FileFacts:
    """Describe a cloud: the unit that its distance from the origin suggests, and its frame."""
    away = float(points.median(0).values.norm())
    unit = "centimetres" if away < _MIN_DISTANCE_MM else "millimetres"
    unit = "metres" if away < _MAX_LENGTH_M else unit
    description = f"{len(points)} points, {away:.4g} from the origin: {unit}"
    oddities = [oddity] if (oddity := frame_advice(points)) is not None else []
    if away < float((points - points.median(0).values).norm(dim=-1).median()):
        oddities = ["it lies about the origin: centred, or in a model's frame, not in the camera's"]
    return FileFacts(path=path, description=description, oddities=oddities, cloud=points)


def _contradictions(facts: FileFacts, all_facts: Sequence[FileFacts]) -> Iterator[str]:
    """Say what of a file contradicts the others: sizes, units, the scale of a model."""
    for other in all_facts:
        if (camera := other.camera) is not None and facts.size is not None:
            try:
                cameras.check_image_matches_camera(camera, *facts.size, "it")
            except InputError as error:
                yield f"beside {other.path.name}: {error}"
        if camera is not None and facts.depth_units is not None and camera.depth_unit_m is not None:
            median_m = float(facts.depth_units.nanmedian()) * camera.depth_unit_m
            if not _MIN_DEPTH_M < median_m < _MAX_DEPTH_M:
                yield (
                    f"beside {other.path.name}: its median is {median_m:.3g} m by the camera's "
                    f"depth_unit_m {camera.depth_unit_m:g}; 0.001 means millimetres"
                )
        is_depth = other.depth_units is not None
        if facts.mask is not None and is_depth and other.size != facts.size:
            yield f"it is not of the size of {other.path.name}; give the mask of this very image"
        if facts.model is not None and other.cloud is not None:
            advice = unit_advice(exact_diameter(facts.model), other.cloud)
            if advice is not None:
                yield f"beside {other.path.name}: {advice}"
