"""Poses and other rigid transforms that options give, as files or as numbers."""

import re
from collections.abc import Sequence
from pathlib import Path

import torch

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose import predictions
from depthpose.pose.datasets.entries import read_rows
from depthpose.pose.inputs import rigid_input

_FARTHEST_BASE_M = 50.0
"""Largest distance of a camera from the base of its robot; a larger one is in millimetres."""


def read_pose(path: Path, option: str = "--first", transform: str = "camera_from_model") -> Rigid:
    """Read a pose: the only one of a ``poses.json``, or a 4x4 matrix in a text file, in metres.

    Brackets, commas and semicolons between its numbers are skipped.

    Args:
        path: the file.
        option: option that names it, for errors.
        transform: name of the matrix, for errors.

    Raises:
        InputError: the file holds no pose, or several.
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
    """Read the pose of a ``poses.json`` that holds exactly one; ``option`` named the file.

    Raises:
        InputError: there are several poses, or none.
    """
    poses: list[Rigid] = []
    for index, row in enumerate(read_rows(path)):
        estimate = predictions.parse_prediction(row, f"{path}: entry {index}").estimate
        if estimate.camera_from_model is not None:  # else it was refused
            poses.append(estimate.camera_from_model)
    if len(poses) != 1:
        raise InputError(
            f"{option} {path}: holds {len(poses)} poses; give a poses.json of one, or a text file "
            "with the 4x4 matrix camera_from_model in metres"
        )
    return poses[0]


def read_base(words: Sequence[str]) -> Rigid | None:
    """Read the pose of the camera in the robot's base from the words of ``--base-from-camera``.

    They name a text file, or are 16 numbers row by row; without words there is no pose.

    Raises:
        InputError: they give no rigid transform, or a camera too far away, as in millimetres.
    """
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

    Args:
        text: the numbers; brackets, commas and semicolons between them are skipped.
        source: the option, and the file if there is one, for errors.
        transform: name of the matrix, for errors.

    Raises:
        InputError: the text is not 16 numbers, or their matrix is not rigid.
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
        # Errors call the value, and the kind of transform that it should be, by the same name.
        return rigid_input(values.reshape(4, 4), name=transform, what=transform)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
