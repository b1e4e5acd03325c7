"""Parts of our own: closed, deterministic, and with the symmetries that they declare."""

from pathlib import Path

import pytest
import torch
import trimesh
from bench.negatives import random_simple_part
from tests.pose.synthetic_objects import write_part

from depthpose.core.errors import InputError
from depthpose.pose.mesh import (
    propose_symmetries,
    read_model,
    symmetries_from_proposals,
    with_found_symmetries,
)
from depthpose.pose.synthetic import PARTS, make_part
from depthpose.pose.synthetic.parts import make_part_mesh


@pytest.mark.parametrize("name", sorted(PARTS))
def test_a_part_is_closed_surfaces_that_face_outward(name: str) -> None:
    pieces = trimesh.Trimesh(*make_part_mesh(name)).split(only_watertight=False)
    assert all(piece.is_watertight and piece.volume > 0 for piece in pieces)
    assert 0.08 < make_part(name).diameter_m < 0.2


@pytest.mark.parametrize(("name", "turns", "axes"), [("bracket", 0, 0), ("spool", 0, 1)])
def test_a_part_has_the_symmetries_that_it_declares(name: str, turns: int, axes: int) -> None:
    model = make_part(name)
    for symmetries in (model.symmetries, symmetries_from_proposals(propose_symmetries(model))):
        found = 0 if symmetries.discrete is None else len(symmetries.discrete.R)
        assert (found, len(symmetries.continuous)) == (turns, axes)


def test_simple_parts_are_closed_surfaces_of_several_kinds() -> None:
    chance = torch.Generator().manual_seed(0)
    models = [random_simple_part(chance) for _ in range(12)]
    for model in models:
        mesh = trimesh.Trimesh(model.vertices_m.numpy(), model.faces.numpy())
        pieces = mesh.split(only_watertight=False)
        assert all(piece.is_watertight and piece.volume > 0 for piece in pieces)
    assert len({len(model.faces) for model in models}) >= 4  # boxes, tubes, cups and profiles
    box = next(model for model in models if len(model.faces) == 12)
    found = with_found_symmetries(box).symmetries.discrete
    assert found is not None
    assert len(found.R) >= 3


def test_a_written_part_is_read_back_in_millimetres(tmp_path: Path) -> None:
    model, back = make_part("mug"), read_model(write_part("mug", tmp_path), "mm")
    assert back.name == "mug"
    assert back.diameter_m == pytest.approx(model.diameter_m, rel=1e-6)
    assert torch.allclose(back.keypoints_m, model.keypoints_m, atol=1e-6)
    assert write_part("mug", tmp_path / "again").read_bytes() == (tmp_path / "mug.stl").read_bytes()


def test_an_unknown_part_names_its_nearest() -> None:
    with pytest.raises(InputError, match="no part is called 'flanch'; did you mean 'flange'"):
        make_part("flanch")
    with pytest.raises(InputError, match="no part is called 'cup'"):
        make_part("cup")
