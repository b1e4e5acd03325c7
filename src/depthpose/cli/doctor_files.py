"""The work behind ``depthpose doctor FILE...``: what files are, and what is odd about them."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from depthpose.cli.pose.transforms import read_pose
from depthpose.core import camera as cameras
from depthpose.core import files
from depthpose.core.errors import InputError
from depthpose.core.files.images import find_value_range, open_image, read_numbers
from depthpose.core.rigid import geodesic_rad
from depthpose.pose.cloud import advise_frame, advise_unit
from depthpose.pose.datasets import decode_rle
from depthpose.pose.datasets.masks import read_runs
from depthpose.pose.mesh import MESH_READERS, measure_diameter, read_geometry

Size = tuple[int, int]

_DEPTH_UNITS_M = {"most sensors": 0.001, "TUM RGB-D": 0.0002, "KITTI": 1 / 256}
"""Metres of a step of 16-bit depth images, by where they come from."""
_MIN_DEPTH_M = 0.05
_MAX_DEPTH_M = 100.0
"""Between these lies the median of a depth image whose unit is right."""
_MAX_LENGTH_M = 20.0
"""Largest diameter of a part, and largest distance of a pose or a cloud; larger: not in metres."""
_MIN_LENGTH_MM = 2.0
"""Least diameter of a part in millimetres; a smaller number is in metres."""
_MIN_DISTANCE_MM = 150.0
"""Least distance that a depth camera measures; a smaller number is in centimetres."""
_MAX_8_BIT = 255
_MIN_UNREAD_SHARE = 0.02
"""Least share of pixels without a reading in a depth image; of sensors it is 6 % and more."""
_MAX_SMOOTH_STEP = 0.012
"""Mean step between neighbours of a depth image, as a share of the range: of dense depth 0.004 at
most, of pictures 0.024 at least."""
_MAX_FOCAL_DIFFERENCE = 0.05
"""Largest relative difference of fx and fy."""
_HALF = 0.5
"""Share of an image that a mask covers, or of the values that are negative, only by mistake."""


@dataclass(kw_only=True)
class FileFacts:
    """A description of a file, what is odd about it, and its content, which others are held to.

    The file's kind decides which of image, depth, camera, mask, cloud and model is set.
    """

    path: Path
    description: str = ""  #: for the user; empty: the file cannot be used
    oddities: list[str] = field(default_factory=list)  #: what is odd, for the user
    size: Size | None = None  #: width and height [px] of an image, depth or mask
    image: Tensor | None = None  #: RGB in 0..1, (3, h, w)
    depth_units: Tensor | None = None  #: 16-bit depth as stored, (h, w), NaN without a reading
    camera: cameras.Camera | None = None
    mask: Tensor | None = None  #: whether a pixel is the object, (h, w)
    cloud: Tensor | None = None  #: points, (n, 3), in the file's unit
    model: Tensor | None = None  #: vertices, (n, 3), in the file's unit


def describe_files(paths: Sequence[Path]) -> int:
    """Print what each file is and what is odd about it, and return the exit code.

    It is 1 if something is odd, or a file cannot be used.
    """
    # Images first: a camera file may lack the image size.
    images_first = sorted(paths, key=_may_be_camera)
    all_facts: list[FileFacts] = []
    for path in images_first:
        size = next((facts.size for facts in all_facts if facts.size is not None), None)
        try:
            facts = _describe_file(path, size)
        except InputError as error:
            facts = FileFacts(path=path, oddities=[str(error).removeprefix(f"{path}: ")])
        all_facts.append(facts)

    # What each is, and where it contradicts another.
    for facts in all_facts:
        facts.oddities += _list_contradictions(facts, all_facts)
    for path in paths:
        facts = next(facts for facts in all_facts if facts.path == path)
        print(f"{path}: {facts.description or 'cannot be used'}")
        for oddity in facts.oddities:
            print(f"  odd: {oddity}")

    has_oddities = any(facts.oddities for facts in all_facts)
    pictures = [facts for facts in all_facts if facts.image is not None]
    if len(pictures) == 2 and pictures[0].size == pictures[1].size:
        is_pair_wrong = _check_pair(*pictures)
        has_oddities = has_oddities or is_pair_wrong
    return 1 if has_oddities else 0


def _may_be_camera(path: Path) -> bool:
    """Whether a path is a folder, or a file with a suffix that camera files have."""
    return path.is_dir() or path.suffix.lower() in cameras.CAMERA_SUFFIXES


def _check_pair(left: FileFacts, right: FileFacts) -> bool:
    """Print how two pictures match as a rectified pair, and return whether they do not."""
    assert left.image is not None
    assert right.image is not None
    report = cameras.check_rectified(left.image, right.image)
    outcome = f"\n  odd: {report.message}" if report.is_wrong else f": {report.message}"
    print(f"{left.path.name} and {right.path.name} as a pair{outcome}")
    return report.is_wrong


def _describe_file(path: Path, size: Size | None) -> FileFacts:
    """Describe a file by what its suffix says: a camera, a map, a mesh, a cloud or a picture.

    ``size``: width and height [px] of a picture beside it, for cameras without their own.
    """
    suffix = path.suffix.lower()
    if _may_be_camera(path):
        return _describe_text_file(path, size)
    if suffix in files.MAP_SUFFIXES:
        return _describe_map(path)
    if suffix in MESH_READERS:
        return _describe_mesh(path)
    if suffix in files.CLOUD_READERS:
        return _describe_points(path, files.read_cloud(path).points.double())
    return _describe_picture(path)


def _describe_mesh(path: Path) -> FileFacts:
    """Describe a mesh, with the unit that its diameter suggests; without faces, as points."""
    vertices, faces = read_geometry(path)
    points = torch.from_numpy(vertices)
    if not len(faces):
        return _describe_points(path, points)

    # The unit: no object is so large in metres, or so small in millimetres.
    diameter = measure_diameter(points)  # in the unit of the file
    if diameter > _MAX_LENGTH_M:
        unit = "millimetres (--unit mm)"
    elif diameter < _MIN_LENGTH_MM:
        unit = "metres (--unit m)"
    else:
        unit = "metres, cm or mm; measure it"

    # STL repeats the points of every face, and other files those at edges: each counts once.
    point_count = len(np.unique(vertices, axis=0))
    description = (
        f"mesh of {point_count} points and {len(faces)} faces, {diameter:.4g} across: {unit}"
    )
    return FileFacts(path=path, description=description, model=points)


def _describe_text_file(path: Path, size: Size | None) -> FileFacts:
    """Describe a text file, or a folder of them: a pose, run lengths of a mask, a camera or points.

    ``size``: size of an image beside it [px].
    """
    pose_facts = _describe_pose(path)
    if pose_facts is not None:
        return pose_facts
    if path.suffix.lower() == ".json":
        content = files.read_json(path)
        record = content[0] if isinstance(content, list) and len(content) == 1 else content
        if isinstance(record, dict) and {"counts", "segmentation"} & record.keys():
            return _describe_mask(path, decode_rle(*read_runs(record, str(path))))
    try:
        camera = cameras.read_camera(path, size)
    except InputError as error:
        # A text file of another form than any camera's may hold points.
        if path.suffix.lower() != ".txt" or "no camera that is known" not in str(error):
            raise
        return _describe_points(path, files.read_cloud(path).points.double())
    return _describe_camera(path, camera)


def _describe_camera(path: Path, camera: cameras.Camera) -> FileFacts:
    """Describe a camera: its size, field of view and baseline, and whether K is plausible."""
    fx = float(camera.K[0, 0])
    fy = float(camera.K[1, 1])
    fov_deg = math.degrees(2 * math.atan(camera.width / (2 * fx)))
    description = (
        f"camera of {camera.width}x{camera.height}, fx {fx:.1f} px, {fov_deg:.0f} degrees wide"
    )
    if isinstance(camera, cameras.StereoRig):
        description += f", baseline {camera.baseline_m:.4g} m"
    if camera.depth_unit_m is not None:
        description += f", depth in units of {camera.depth_unit_m:.4g} m"
    oddities: list[str] = []
    centre_advice = cameras.describe_suspicious_centre(camera)
    if centre_advice is not None:
        oddities.append(centre_advice)
    if abs(fx / fy - 1) > _MAX_FOCAL_DIFFERENCE:
        oddities.append(
            f"fx {fx:.1f} and fy {fy:.1f} differ by {abs(fx / fy - 1):.0%}, as of an image "
            "that was squeezed in one direction; was K scaled as the image was?"
        )
    return FileFacts(path=path, description=description, oddities=oddities, camera=camera)


def _describe_pose(path: Path) -> FileFacts | None:
    """Describe a 4x4 matrix, as ``pose track --first`` takes it; None: the file holds none."""
    if path.is_dir():
        return None
    try:
        pose = read_pose(path)
    except InputError:
        return None
    angle_deg = math.degrees(float(geodesic_rad(pose.R, torch.eye(3).to(pose.R))))
    distance_m = float(pose.t_m.norm())
    oddities: list[str] = []
    if distance_m > _MAX_LENGTH_M:
        oddities.append(f"it moves by {distance_m:.4g}, taken as metres: is it in millimetres?")
    description = f"pose, turned by {angle_deg:.1f} degrees, {distance_m:.4g} m away"
    return FileFacts(path=path, description=description, oddities=oddities)


def _describe_picture(path: Path) -> FileFacts:
    """Describe a picture: a depth image, a mask or a photograph."""
    with open_image(path) as image:
        units = None
        if image.mode == "I;16":
            units = torch.from_numpy(np.asarray(image).astype(np.float32))
    if units is not None and _is_depth(units):
        return _describe_depth(path, torch.where(units > 0, units, torch.nan))

    picture = files.read_image(path)
    darkest, brightest = picture.aminmax()
    has_two_values = bool(((picture == darkest) | (picture == brightest)).all())
    if has_two_values:
        return _describe_mask(path, picture[0] > 0)
    height, width = picture.shape[1:]
    description = f"picture of {width}x{height}"
    if units is not None:
        low, high = find_value_range(units.numpy())
        description += f", 16 bits a value, from {low} to {high}"
    return FileFacts(path=path, description=description, size=(width, height), image=picture)


def _is_depth(units: Tensor) -> bool:
    """Whether 16-bit values are depth: many pixels have no reading, or neighbours are alike."""
    low, high = find_value_range(units.numpy())
    unread_share = 1 - float((units > 0).float().mean())
    mean_step = float((units[:, 1:] - units[:, :-1]).abs().mean()) / max(high - low, 1)
    return unread_share > _MIN_UNREAD_SHARE or mean_step < _MAX_SMOOTH_STEP


def _describe_mask(path: Path, mask: Tensor) -> FileFacts:
    """Describe a mask: its share of the image, and whether it is empty or inverted."""
    height, width = mask.shape
    share = float(mask.float().mean())
    border = torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    border_share = float(border.float().mean())
    oddities = ["it is empty: no pixel is the object"] if share == 0 else []
    if share > _HALF and border_share > _HALF:
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
    medians = [f"{median * unit_m:.3g} m ({name})" for name, unit_m in _DEPTH_UNITS_M.items()]
    facts.description += f", {share:.0%} known, median {median:g} units: {', '.join(medians)}"
    if share == 1:
        facts.description += "; or, as no pixel is 0, a picture of 16 bits"
    if float(readings.max()) <= _MAX_8_BIT:
        facts.oddities.append("no value is above 255: a picture of depth, not the data?")
    return facts


def _describe_map(path: Path) -> FileFacts:
    """Describe a map of numbers (``.npy``, ``.pfm``): depth, disparity, or rows of points."""
    # Integers are depth in the sensor's unit; other shapes than an image's are points.
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
    elif median > 2 * _MAX_DEPTH_M:  # a map may hold disparity, of which 100 px are usual
        facts.oddities.append(
            f"as metres the median {median:.4g} is too far; is it in millimetres? Divide by 1000"
        )
    return facts


def _describe_points(path: Path, points: Tensor) -> FileFacts:
    """Describe a cloud: the unit that its distance from the origin suggests, and its frame."""
    centre = points.median(0).values
    distance = float(centre.norm())
    if distance < _MAX_LENGTH_M:
        unit = "metres"
    elif distance < _MIN_DISTANCE_MM:
        unit = "centimetres"
    else:
        unit = "millimetres"
    description = f"{len(points)} points, {distance:.4g} from the origin: {unit}"

    oddities: list[str] = []
    advice = advise_frame(points)
    if advice is not None:
        oddities = [advice]
    radius = float((points - centre).norm(dim=-1).median())
    if distance < radius:
        oddities = ["it lies about the origin: centred, or in a model's frame, not in the camera's"]
    return FileFacts(path=path, description=description, oddities=oddities, cloud=points)


def _list_contradictions(facts: FileFacts, all_facts: Sequence[FileFacts]) -> Iterator[str]:
    """List where a file contradicts the others in size, unit or scale; in words for the user."""
    for other in all_facts:
        camera = other.camera
        if camera is not None and facts.size is not None:
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
            advice = advise_unit(measure_diameter(facts.model), other.cloud)
            if advice is not None:
                yield f"beside {other.path.name}: {advice.message}"
