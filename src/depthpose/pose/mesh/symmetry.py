"""Declared symmetries: BOP's way of writing them, and as a set of transforms."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.types import Axis, Symmetries

BOP_STEP = 0.01
"""BOP turns about a continuous axis so that no point moves more than this share of the diameter."""


def turn_about(
    direction: Float[Tensor, "3"], point_m: Float[Tensor, "3"], angle_rad: Float[Tensor, "*batch"]
) -> Rigid:
    """Turn about the line through ``point_m``, by the right-hand rule (Rodrigues)."""
    x, y, z = (direction / direction.norm()).unbind()
    zero = torch.zeros_like(x)
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    angle = angle_rad[..., None, None].to(K)
    R = torch.eye(3).to(K) + angle.sin() * K + (1 - angle.cos()) * (K @ K)
    return Rigid(R, point_m - (R @ point_m[..., None]).squeeze(-1))


def symmetry_transforms(symmetries: Symmetries, max_step: float = BOP_STEP) -> Rigid:
    """List the transforms ``model_from_model`` that leave the object as it is.

    The identity, the discrete ones, and each of them followed by turns about each continuous axis
    (BOP: ``ceil(pi / max_step)`` equal steps of the full turn). BOP's toolkit leaves out the turn
    by 0 where there is an axis; here it is in, so that an exact estimate has no error.

    Returns:
        A batch, the identity first.
    """
    eye = Rigid(torch.eye(3)[None], torch.zeros(1, 3))
    discrete = symmetries.discrete
    if discrete is not None:
        eye = Rigid(torch.cat([eye.R.to(discrete.R), discrete.R]),
                    torch.cat([eye.t_m.to(discrete.t_m), discrete.t_m]))  # fmt: skip
    if not symmetries.continuous:
        return eye
    steps = math.ceil(math.pi / max_step)
    angles = torch.arange(steps, dtype=torch.float64) * (2 * math.pi / steps)
    every = [eye]
    for axis in symmetries.continuous:
        turns = turn_about(axis.direction.to(eye.R), axis.point_m.to(eye.R), angles[1:])
        R = turns.R[:, None] @ eye.R[None]
        t_m = (turns.R[:, None] @ eye.t_m[None, :, :, None]).squeeze(-1) + turns.t_m[:, None]
        every.append(Rigid(R.flatten(0, 1), t_m.flatten(0, 1)))
    return Rigid.cat(every)


def symmetries_from_bop(info: Mapping[str, Any], *, source: str) -> Symmetries:
    """Read ``symmetries_discrete`` (4x4, row by row) and ``symmetries_continuous``; both in mm.

    ``symmetries_found`` is ours: true where they were found in the geometry.

    Args:
        info: an object's entry of ``models_info.json``.
        source: what to call it in errors.

    Raises:
        InputError: an entry is no rigid transform or no axis.
    """
    turns, lines = (info.get(f"symmetries_{kind}", []) for kind in ("discrete", "continuous"))
    if not isinstance(turns, list) or not isinstance(lines, list):
        raise InputError(f"{source}: its symmetries are no lists; write [...] of them")
    matrices = [_rigid_from_bop(row, source) for row in turns]
    axes = tuple(_axis_from_bop(entry, source) for entry in lines)
    is_found = info.get("symmetries_found", False) is True
    if not matrices:
        return Symmetries(continuous=axes, is_found=is_found)
    stacked = torch.stack(matrices)
    discrete = Rigid(stacked[:, :3, :3], stacked[:, :3, 3])
    return Symmetries(discrete=discrete, continuous=axes, is_found=is_found)


def symmetries_to_bop(symmetries: Symmetries) -> dict[str, Any]:
    """Write symmetries as ``models_info.json`` has them; kinds without an entry are left out."""
    info: dict[str, Any] = {}
    if symmetries.discrete is not None:
        R, t_mm = symmetries.discrete.R, 1000 * symmetries.discrete.t_m
        top = torch.cat([R, t_mm[..., None]], -1).flatten(1).tolist()
        info["symmetries_discrete"] = [[*row, 0.0, 0.0, 0.0, 1.0] for row in top]
    if symmetries.continuous:
        info["symmetries_continuous"] = [
            {"axis": axis.direction.tolist(), "offset": (1000 * axis.point_m).tolist()}
            for axis in symmetries.continuous
        ]
    if symmetries.is_found and info:
        info["symmetries_found"] = True
    return info


def _rigid_from_bop(row: object, source: str) -> Float[Tensor, "4 4"]:
    try:
        matrix = torch.tensor(row, dtype=torch.float64).reshape(4, 4)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise InputError(
            f"{source}: the symmetry {repr(row)[:80]} is not 16 numbers; write a 4x4 matrix row by "
            "row"
        ) from error
    R = matrix[:3, :3]
    is_rigid = torch.allclose(R @ R.T, torch.eye(3).double(), atol=1e-3) and torch.det(R) > 0
    if not is_rigid or matrix[3].tolist() != [0, 0, 0, 1]:
        raise InputError(
            f"{source}: the symmetry {repr(row)[:200]} is no rigid motion; its upper left 3x3 is a "
            "rotation, its last row 0 0 0 1"
        )
    matrix[:3, 3] *= 0.001
    return matrix


def _axis_from_bop(entry: object, source: str) -> Axis:
    try:
        assert isinstance(entry, Mapping)
        direction = torch.tensor(entry["axis"], dtype=torch.float64).reshape(3)
        offset_mm = torch.tensor(entry.get("offset", [0, 0, 0]), dtype=torch.float64).reshape(3)
        length = float(direction.norm())
        assert 0 < length < math.inf
    except (AssertionError, KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise InputError(
            f'{source}: the continuous symmetry {repr(entry)[:80]} is not {{"axis": [x, y, z], '
            '"offset": [x, y, z]} with an axis of some length'
        ) from error
    return Axis(direction=direction / length, point_m=0.001 * offset_mm)
