"""The layout of DenseFusion's ``Linemod_preprocessed`` to instances."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from depthpose.core.errors import InputError
from depthpose.core.files import read_text
from depthpose.core.files.text import parse_yaml, refuse_heavy
from depthpose.pose.datasets.frames import Instance
from depthpose.pose.datasets.parse import camera_from_bop, entry_number, integer, pose_from_bop
from depthpose.pose.mesh import turn_about
from depthpose.pose.types import Symmetries

_OF_YAML = {b"[": 750, b"{": 750, b",": 450, b":": 500, b"\n": 500, b"- ": 500}
"""Bytes that a value takes while it is read, measured with PyYAML 6."""

_MAX_BYTES = 2**22
"""Of a list of images."""

SYMMETRIC = (10, 11)
"""Eggbox and glue: measured by ADD-S ever since Hinterstoisser et al. (2012)."""


def linemod_splits(folder: Path) -> tuple[str, ...]:
    """Name the splits of a folder; none where it is not laid out as Linemod_preprocessed."""
    return ("train", "test") if any(folder.glob("data/[0-9][0-9]/gt.yml")) else ()


def linemod_symmetries(number: int) -> Symmetries:
    """Give what ``models_info.yml`` does not say: eggbox and glue, turned half about z, look alike.

    BOP's ``models_info.json`` of the same meshes declares these turns.
    """
    if number not in SYMMETRIC:
        return Symmetries()
    up, origin = torch.tensor([0.0, 0.0, 1.0]).double(), torch.zeros(3).double()
    return Symmetries(discrete=turn_about(up, origin, torch.tensor([math.pi]).double()))


def read_yaml(path: Path) -> dict[Any, Any]:
    """Read a YAML file of the data set.

    Raises:
        InputError: it cannot be read, or holds no mapping.
    """
    text = read_text(path)
    refuse_heavy(path, text.encode(), _OF_YAML)
    content = parse_yaml(path, text)
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds a {type(content).__name__}, where names to values belong")
    return content


def linemod_instances(folder: Path, split: str) -> Iterator[Instance]:
    """Read the annotations of a split: ``train`` or ``test``, by the lists beside the data.

    The folder of an object shows others too (in object 2's they are annotated): its own alone
    counts, as in every published number.

    Raises:
        InputError: a file is missing or damaged, or an entry is not what it must be.
    """
    for scene in sorted(folder.glob("data/[0-9][0-9]")):
        listed = scene / f"{split}.txt"
        if not listed.is_file():
            raise InputError(f"{listed}: no such list; the splits are train and test")
        truths, infos = read_yaml(scene / "gt.yml"), read_yaml(scene / "info.yml")
        for line in read_text(listed, _MAX_BYTES).split():
            if entry_number(line) is None:
                raise InputError(f"{listed}: {line[:40]!r} is no number of an image")
            yield _make_instance(scene, int(line), (truths, infos))


def _make_instance(
    scene: Path, image: int, parts: tuple[dict[Any, Any], dict[Any, Any]]
) -> Instance:
    number = int(scene.name)
    source = f"{scene / 'gt.yml'}: image {image}"
    entries = parts[0].get(image)
    if not isinstance(entries, list):
        raise InputError(f"{source} has no annotation; is the list of another download?")
    own = [e for e in entries if integer(e, "obj_id", source) == number]
    if len(own) != 1:
        raise InputError(f"{source} annotates object {number} {len(own)} times, where once belongs")
    K, unit_m = camera_from_bop(parts[1].get(image), f"{scene / 'info.yml'}: image {image}")
    mask, rgb = scene / "mask" / f"{image:04d}.png", scene / "rgb" / f"{image:04d}.png"
    return Instance(
        scene_id=number,
        image_id=image,
        index=entries.index(own[0]),
        object_id=number,
        K=K,
        depth=scene / "depth" / f"{image:04d}.png",
        depth_unit_m=unit_m,
        mask=mask if mask.is_file() else None,
        rgb=rgb if rgb.is_file() else None,
        camera_from_model=pose_from_bop(own[0], source),
    )


def segnet_mask(folder: Path, instance: Instance) -> Path:
    """Name the predicted mask that came with the data set (255 on the object)."""
    home = folder / "segnet_results" / f"{instance.object_id:02d}_label"
    return home / f"{instance.image_id:04d}_label.png"
