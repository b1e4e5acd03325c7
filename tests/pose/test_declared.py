"""Symmetries that a user declares: in words, in place, checked against the surface."""

import json
import math
import warnings
from pathlib import Path

import pytest
import torch
from tests.pose.synthetic_objects import K, bottle, pose_at, view_of

from depthpose.core.errors import InputError, Notice
from depthpose.core.rigid import Rigid, geodesic_rad, rotation_by
from depthpose.pose.mesh import assign_symmetries, declare_symmetry, make_model, read_symmetry
from depthpose.pose.registration import Registration
from depthpose.pose.synthetic.parts import make_part
from depthpose.pose.types import ObjectModel, Symmetries, ViewInput

CENTRE_M = torch.tensor([0.031, -0.022, 0.013])


def gear(teeth: int = 18, keyway_m: float = 0.004, at_m: torch.Tensor = CENTRE_M) -> ObjectModel:
    """A gear 80 mm wide about z, with one deeper gap, its middle far from the file's origin."""
    count = 720
    angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    wave = (teeth * angle).cos() * 4
    radius_m = 0.037 + 0.003 * wave.clamp(-1, 1)
    radius_m[:20] -= keyway_m
    ring = torch.stack([radius_m * angle.cos(), radius_m * angle.sin()], -1)
    low = torch.cat([ring, torch.full((count, 1), -0.006)], -1)
    high = torch.cat([ring, torch.full((count, 1), 0.006)], -1)
    ends = torch.tensor([[0, 0, -0.006], [0, 0, 0.006]]).double()
    i = torch.arange(count)
    j = (i + 1) % count
    bottom, top = torch.full_like(i, 2 * count), torch.full_like(i, 2 * count + 1)
    faces = [
        (i, j, j + count),
        (i, j + count, i + count),
        (j, i, bottom),
        (i + count, j + count, top),
    ]
    vertices = torch.cat([low, high, ends]) + at_m
    return make_model(vertices, torch.cat([torch.stack(f, -1) for f in faces]), name="gear")


def turns_of(model: ObjectModel) -> torch.Tensor:
    discrete = model.symmetries.discrete
    assert discrete is not None
    eye = torch.eye(3).double().expand_as(discrete.R)
    return geodesic_rad(discrete.R, eye).rad2deg().sort().values


def test_words() -> None:
    (one,) = read_symmetry("z,18")
    assert one.direction.tolist() == [0, 0, 1]
    assert one.turns == 18
    assert one.angles_rad.rad2deg().tolist() == pytest.approx([20.0 * k for k in range(1, 18)])
    (free,) = read_symmetry(" Y , FREE ")
    assert free.turns is None
    assert free.direction.tolist() == [0, 1, 0]
    six, two = read_symmetry("0 0 2,6+1 1 0,2")
    assert six.direction.tolist() == [0, 0, 1]
    assert two.direction.tolist() == pytest.approx([0.5**0.5, 0.5**0.5, 0])


@pytest.mark.parametrize(
    "text",
    ["", "z", "z,", "z,1", "z,0", "z,-2", "z,2.5", "z,361", "w,2", "0 0 0,2", "1 2,2", "z,2+",
     "18,z", "nan 0 1,2", "z,all"],
)  # fmt: skip
def test_words_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"is no axis with 2 to 360 turns; write AXIS,N"):
        read_symmetry(text)


def test_an_axis_goes_where_the_surface_has_it() -> None:
    model = gear()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        declared = declare_symmetry(model, "z,18")
    assert turns_of(declared)[::2].tolist() == pytest.approx([20.0 * k for k in range(1, 10)])
    discrete = declared.symmetries.discrete
    assert discrete is not None
    assert not declared.symmetries.is_found
    moved_m = discrete.apply(CENTRE_M.double()[None])[:, 0] - CENTRE_M
    assert float(moved_m.norm(dim=-1).max()) < 0.0003
    # Along the axis nothing moves, and the model itself stays.
    assert torch.allclose(discrete.t_m[:, 2], torch.zeros(17).double(), atol=1e-9)
    assert declared.vertices_m is model.vertices_m


def test_a_free_axis() -> None:
    spool = make_part("spool")
    shifted = make_model(spool.vertices_m + torch.tensor([0.5, 0, 0.1]), spool.faces, name="spool")
    declared = declare_symmetry(shifted, "z,free")
    assert declared.symmetries.discrete is None
    (axis,) = declared.symmetries.continuous
    assert axis.direction.tolist() == [0, 0, 1]
    assert axis.point_m[:2].tolist() == pytest.approx([0.5, 0], abs=1e-4)


def test_axes_together_make_a_group() -> None:
    # A box: half turns about all three axes, of which two are said.
    corners = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3) * torch.tensor(
        [0.2, 0.1, 0.05]
    )
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = torch.tensor([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))])
    box = make_model(corners + 0.3, faces, name="box")
    assert turns_of(declare_symmetry(box, "x,2+y,2")).tolist() == pytest.approx([180.0] * 3)
    can = declare_symmetry(bottle(), "z,free+x,2").symmetries
    assert len(can.continuous) == 1
    assert can.discrete is not None
    with pytest.raises(InputError, match="its turns make more than 720 copies"):
        declare_symmetry(box, "x,7+1 2 0,11")


@pytest.mark.parametrize(("text", "is_told"), [("z,6", False), ("z,5", True), ("x,2", True)])
def test_a_symmetry_that_the_surface_contradicts_is_told(text: str, is_told: bool) -> None:
    flange = make_part("flange")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        declared = declare_symmetry(flange, text)
    said = [str(one.message) for one in told if one.category is Notice]
    assert bool(said) == is_told
    assert all(f"flange: turned by the symmetry {text} its surface lies up to" in s for s in said)
    assert declared.symmetries.discrete is not None  # as the user says


def test_bop_forms(tmp_path: Path) -> None:
    turn = [-1, 0, 0, 2 * 31.0, 0, -1, 0, 2 * -22.0, 0, 0, 1, 0, 0, 0, 0, 1]
    entry = {"symmetries_discrete": [turn]}
    (tmp_path / "entry.json").write_text(json.dumps(entry))
    (tmp_path / "models_info.json").write_text(json.dumps({"0": entry, "5": {"diameter": 3}}))
    given = [entry, tmp_path / "entry.json", str(tmp_path / "models_info.json")]
    for form in given:
        declared = declare_symmetry(gear(teeth=18, keyway_m=0.0), form)
        assert turns_of(declared).tolist() == pytest.approx([180.0], abs=0.1)
        assert declared.symmetries.discrete is not None
        assert declared.symmetries.discrete.t_m[0].tolist() == pytest.approx([0.062, -0.044, 0])
    (tmp_path / "other.json").write_text(json.dumps({"3": entry, "5": entry}))
    with pytest.raises(InputError, match=r"other.json: has no entry '0' with symmetries of gear"):
        declare_symmetry(gear(), tmp_path / "other.json")
    with pytest.raises(InputError, match="symmetry of gear: there is none in it"):
        declare_symmetry(gear(), {"symmetries_discrete": []})
    as_is = Symmetries(
        discrete=Rigid(rotation_by(torch.tensor([[0, 0, math.pi]])), torch.zeros(1, 3)),
        is_found=True,
    )
    centred = gear(at_m=torch.zeros(3), keyway_m=0.0)
    assert not declare_symmetry(centred, as_is).symmetries.is_found


def test_whose_symmetry_it_is() -> None:
    both = ["gear", "nut"]
    assert assign_symmetries(None, both) == {}
    assert assign_symmetries("z,18", ["gear"]) == {"gear": "z,18"}
    assert assign_symmetries(["gear:z,18", "nut:z,6+x,2"], both) == {
        "gear": "z,18",
        "nut": "z,6+x,2",
    }
    assert assign_symmetries({"nut": "z,6"}, both) == {"nut": "z,6"}
    bop = {"symmetries_continuous": [{"axis": [0, 0, 1]}]}
    assert assign_symmetries(bop, ["gear"]) == {"gear": bop}
    cases = [
        ("z,18", r"2 objects are known \(gear, nut\); say whose it is: gear:z,18"),
        (["gaer:z,18"], "symmetry 'gaer:z,18': no object is called so; did you mean 'gear'"),
        ({"gaer": "z,18"}, "symmetry of 'gaer': no object is called so"),
        ({1: "z,18"}, "symmetry of 1: no object is called so"),
        (["gear:z,18", "gear:x,2"], "symmetry of 'gear' is given twice; join the two by"),
    ]
    for given, said in cases:
        with pytest.raises(InputError, match=said):
            assign_symmetries(given, both)


@pytest.mark.slow
def test_declared_copies_are_one_answer(tmp_path: Path) -> None:
    model = gear(keyway_m=0.0)
    pose = pose_at(0.0, 0.35, seed=1)
    depth_m, mask = view_of(model, pose)
    noise_m = 0.0005 * torch.randn(depth_m.shape, generator=torch.Generator().manual_seed(0))
    depth_m = torch.where(mask, depth_m.float() + noise_m, torch.nan)
    view = ViewInput(name="v", depth_m=depth_m, mask=mask, K=K.float(), object="gear")
    path = tmp_path / "gear.obj"
    faces = "".join(f"f {a} {b} {c}\n" for a, b, c in (model.faces + 1).tolist())
    places = "".join(f"v {x} {y} {z}\n" for x, y, z in (1000 * model.vertices_m).tolist())
    path.write_text(places + faces)
    parts = Registration.load(path, unit="mm", symmetry="z,18+x,2")
    assert len(turns_of(parts.models[0])) == 35
    (found,) = parts.estimate_many([view])
    assert found.is_ok
    assert found.alternatives == ()
    with pytest.raises(InputError, match=r"symmetry 'z': 'z' is no axis with 2 to 360 turns"):
        Registration.load(path, unit="mm", symmetry="z")
