"""Conversion of files, arrays or tensors to the inputs of a pose estimate."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from depthpose.core.camera import (
    AnyLens,
    Camera,
    camera_of,
    check_image_matches_camera,
    refuse_outside,
)
from depthpose.core.errors import InputError
from depthpose.core.files import read_cloud, read_stored_depth
from depthpose.core.rigid import Rigid, is_rigid
from depthpose.core.units import Unit, metres_of
from depthpose.pose.datasets import decode_rle, mask_from_labels, number_objects, read_labels
from depthpose.pose.datasets.masks import object_numbers, read_runs
from depthpose.pose.mesh.shapes import is_shape, shape_geometry
from depthpose.pose.rays import warn_of_rays
from depthpose.pose.segmentation import label_parts
from depthpose.pose.types import AnyInput as AnyInput
from depthpose.pose.types import CloudInput, ViewInput

AnyArray = str | Path | np.ndarray | Tensor  #: a file, an array or a tensor
AnyCloud = AnyArray | object  #: a cloud as rows of points, its file, or one of trimesh or Open3D
AnyMask = AnyArray | Mapping[str, Any]  #: a mask, its file, or COCO's run lengths
_LEAST_INSTANCE_SHARE = 0.2
"""Least size of a piece of a mask that is an object, as a share of the largest piece; smaller ones
are fragments of a segmentation."""


def cloud_input(cloud: AnyCloud, unit: Unit, object: str, name: str) -> CloudInput:
    """Convert points of any unit to a cloud in metres.

    Args:
        cloud: points, a file, or a cloud of trimesh or Open3D.
        unit: of the points.
        object: name of the object that they are of.
        name: of the cloud, in results and errors.

    Raises:
        InputError: the file cannot be read, or holds no rows of x, y and z.
    """
    if is_shape(cloud):
        cloud, _ = shape_geometry(cloud)
    is_file = isinstance(cloud, str | Path)
    points = read_cloud(cloud).points if is_file else _convert_to_tensor(cloud)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(
            f"{name}: the cloud is of shape {tuple(points.shape)}; give points as rows of x, y and "
            "z: (n, 3)"
        )
    points_m = (points.double() * metres_of(unit)).float()
    return CloudInput(name=name, points_m=points_m, object=object)


def depth_input(
    depth: AnyArray, camera: AnyLens | None, name: str, unit: Unit | None = None
) -> tuple[Float[Tensor, "h w"], Camera | None]:
    """Convert a depth image to metres, NaN where there is no reading, and read its camera.

    Args:
        depth: whole numbers in ``unit`` or the unit of the camera; or floats, in ``unit`` if it is
            given and else in metres.
        camera: of the image, in any form; None: it is not known.
        name: of the image in errors, where it is no file.
        unit: of the depth. Whole numbers need it where the camera has no unit.

    Returns:
        The depth; and the camera, None where it is not known.

    Raises:
        InputError: a file cannot be read, the depth is no image, or its unit is not known or is
            another one than that of its camera.
    """
    is_file = isinstance(depth, str | Path)
    values = read_stored_depth(depth) if is_file else _convert_to_tensor(depth)
    if values.ndim != 2:
        raise InputError(f"{name}: the depth is of shape {tuple(values.shape)}, not (h, w)")
    height, width = values.shape
    its_camera = camera_of(camera, (width, height))

    # To metres. Floats are metres unless ``unit`` is given: the camera's unit is not theirs.
    camera_unit_m = None if its_camera is None else its_camera.depth_unit_m
    unit_m = None if unit is None else metres_of(unit)
    if not values.is_floating_point():
        label = str(depth) if is_file else name
        if unit_m is not None and camera_unit_m is not None and unit_m != camera_unit_m:
            raise InputError(
                f"{label}: unit {unit} is {unit_m:g} m, but its camera says depth_unit_m "
                f"{camera_unit_m:g}; omit one of the two (the unit of a CAD file is --cad-unit)"
            )
        unit_m = camera_unit_m if unit_m is None else unit_m
        if unit_m is None:
            raise InputError(
                f"{label}: its depth is in whole numbers, and nothing says of what; give a camera "
                'with "depth_unit_m" (0.001 where they are millimetres, 0.0002 of TUM RGB-D, '
                "0.00390625 of KITTI), --unit mm (in Python unit='mm'), or floats, which "
                "are metres unless a unit is given"
            )
        values = values.double()
    is_read = (values > 0) & values.isfinite()  # ROS writes +inf where a surface is out of range
    depth_m = torch.where(is_read, values * (unit_m or 1.0), torch.nan).float()
    return depth_m, its_camera


def view_input(
    depth: AnyArray,
    mask: AnyMask | None,
    camera: AnyLens | None,
    object: str,
    name: str,
    unit: Unit | None = None,
) -> ViewInput:
    """Convert a depth image, a mask and a camera to a view in metres.

    Args:
        depth: as for :func:`depth_input`.
        mask: the object's pixels; None: all pixels.
        camera: of the depth image.
        object: name of the object.
        name: of the view, in results and errors.
        unit: of the depth, where its camera says none.

    Raises:
        InputError: a file cannot be read, the unit of the depth is not known, or mask, camera and
            depth image differ in size.
    """
    depth_m, its_camera = depth_input(depth, camera, name, unit)
    if its_camera is None:
        raise InputError(f"{name}: the camera of the depth image is missing; give camera=")
    height, width = depth_m.shape

    # The mask, of this very image.
    pixels = torch.ones(height, width).bool()
    if mask is not None:
        mask_name = str(mask) if isinstance(mask, str | Path) else name
        pixels = mask_from_labels(labels_input(mask, name), mask_name)
    if tuple(pixels.shape) != (height, width):
        raise InputError(
            f"{name}: the mask is of shape {tuple(pixels.shape)}, but the depth image of "
            f"{(height, width)}; give the mask of this very image"
        )

    # The camera, of an image of this size.
    check_image_matches_camera(its_camera, width, height, name)
    K = its_camera.K
    try:
        refuse_outside(K, width, height)
    except InputError as error:
        raise InputError(
            f"{name}: K is of another image or size: {error}. Resizing an image by s makes fx, fy, "
            "cx and cy s times as large"
        ) from error
    warn_of_rays(depth_m, K)
    return ViewInput(name=name, depth_m=depth_m, mask=pixels, K=K, object=object)


def rigid_input(
    pose: Rigid | AnyArray, name: str = "first", what: str = "camera_from_model"
) -> Rigid:
    """Convert a rigid transform, or its 4x4 matrix in metres.

    Args:
        pose: the transform.
        name: what errors call the transform.
        what: which transform it is, in errors, such as ``target_from_source``.

    Raises:
        InputError: the matrix is no rigid transform.
    """
    if isinstance(pose, Rigid):
        return pose
    matrix = torch.zeros(0) if isinstance(pose, str | Path) else _convert_to_tensor(pose).double()
    if tuple(matrix.shape) != (4, 4):
        raise InputError(
            f"{name} is a {type(pose).__name__} of shape {tuple(matrix.shape)}; give a Rigid, or "
            f"the 4x4 matrix {what} in metres"
        )
    if not is_rigid(matrix, slack=1e-4):
        raise InputError(
            f"{name} is no rigid transform; give [R t; 0 0 0 1], R a rotation, t in metres (a "
            "transposed matrix has t in its last row)"
        )
    return Rigid(matrix[:3, :3].contiguous(), matrix[:3, 3].contiguous())


def split_instances(labels: Int64[Tensor, "h w"]) -> list[Bool[Tensor, "h w"]]:
    """Split labels of the pixels of an image into one mask for each object, the largest first.

    Where there are several labels besides 0, each is an object. Else each connected piece is one,
    where pixels that touch at a corner are connected; pieces below a fifth of the largest are
    fragments, and left out.
    """
    # One mask for each label, where there are several.
    numbers, pixels = labels[labels != 0].unique(return_counts=True)
    if len(numbers) > 1:
        order = pixels.argsort(descending=True, stable=True)
        return [labels == number for number in numbers[order]]

    # Else one for each connected piece.
    label, pixels = label_parts(labels != 0)
    order = pixels.argsort(descending=True, stable=True)
    least_px = max(1, math.ceil(_LEAST_INSTANCE_SHARE * int(pixels.max())))
    return [label == k for k in order if int(pixels[k]) >= least_px]


def labels_input(mask: AnyMask, name: str) -> Int64[Tensor, "_ _"]:
    """Convert a mask to labels: 0 beside the objects, else the number of an object.

    Objects keep their numbers, but for a single one, which becomes 1; numbers that fill no square
    of three by three pixels are dropped (:func:`number_objects`). Files are read by
    :func:`read_labels`. Fractions in [0, 1] are probabilities: those above a half are the object.

    Args:
        mask: an array or tensor (h, w), a file, or COCO's run lengths.
        name: of the mask, in errors.

    Raises:
        InputError: a file cannot be read, or the mask is not (h, w), or holds other fractions or
            NaN.
    """
    if isinstance(mask, str | Path):
        return read_labels(Path(mask))
    if isinstance(mask, Mapping):
        return decode_rle(*read_runs(mask, name)).long()
    values = _convert_to_tensor(mask)
    if values.ndim != 2:
        raise InputError(
            f"{name}: the mask is of shape {tuple(values.shape)}, not (h, w); give the mask of one "
            "image, without other axes"
        )
    return number_objects(object_numbers(values, name).numpy())


def _convert_to_tensor(values: Any) -> Tensor:  # noqa: ANN401  whatever a caller has
    """Convert numbers of any library to a tensor on the CPU, of a type that torch computes with.

    Raises:
        InputError: they are not real numbers.
    """
    if isinstance(values, Tensor) and not values.is_complex():
        # torch has few operations for unsigned numbers of more than a byte.
        is_unsigned = values.dtype in (torch.uint16, torch.uint32, torch.uint64)
        return (values.long() if is_unsigned else values).detach().cpu()
    array = np.asarray(values)
    is_numeric = array.dtype.kind in "biuf"
    if not is_numeric:
        is_complex = array.dtype.kind == "c"
        what = "complex numbers where real" if is_complex else f"a {type(values).__name__} where"
        raise InputError(
            f"{what} numbers belong; give a tensor or array of numbers, "
            "or a file's path (of a camera: a Camera, its file or its matrix K)"
        )

    # Types that torch lacks or hardly supports, and the other byte order.
    if array.dtype.kind == "u" and array.dtype.itemsize > 1:
        array = array.astype(np.int64)
    if array.dtype.kind == "f" and array.dtype.itemsize > 8:
        array = array.astype(np.float64)
    array = array.astype(array.dtype.newbyteorder("="), copy=False)
    return torch.from_numpy(np.require(array, requirements=["C", "W"]))  # Pillow lends read-only
