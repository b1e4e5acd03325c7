import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
import yaml
from PIL import Image

from depthpose.cli import main
from depthpose.core.errors import InputError
from depthpose.core.files import read_json, write_depth_png
from depthpose.core.rigid import Rigid
from depthpose.pose.datasets import (
    BopFrame,
    BopObject,
    check_bop,
    open_bop,
    write_bop_models,
    write_bop_scene,
)
from depthpose.pose.datasets.layouts import read_bop_models
from depthpose.pose.mesh import make_model, turn_about
from depthpose.pose.train.poses import stack_symmetries
from depthpose.pose.types import ObjectModel, Symmetries
from depthpose.report.pose import select_object_points

K = torch.tensor([[500.0, 0, 40], [0, 500, 30], [0, 0, 1]]).double()


def block(number: int) -> ObjectModel:
    mesh = trimesh.creation.box((0.04, 0.04, 0.06))
    z, origin = torch.tensor([0, 0, 1.0]).double(), torch.zeros(3).double()
    half = turn_about(z, origin, torch.tensor([math.pi]))
    return make_model(
        torch.from_numpy(np.array(mesh.vertices)),
        torch.from_numpy(np.array(mesh.faces)),
        name=f"block {number}",
        number=number,
        symmetries=Symmetries(discrete=half),
    )


def facing(x_m: float, z_m: float = 0.53) -> Rigid:
    return Rigid(torch.eye(3).double(), torch.tensor([x_m, 0, z_m]).double())


def frame(number: int) -> BopFrame:
    """Two blocks whose front faces, at half a metre, are squares of 40 pixels a side."""
    depth = torch.full((60, 80), torch.nan)
    masks = torch.zeros(2, 60, 80, dtype=torch.bool)
    masks[0, 11:50, 1:40] = True
    masks[1, 11:50, 41:80] = True
    depth[masks.any(0)] = 0.5
    return BopFrame(
        number=number,
        K=K,
        depth_m=depth,
        rgb=torch.rand(3, 60, 80, generator=torch.Generator().manual_seed(number)),
        objects=[
            BopObject(number=1, camera_from_model=facing(-0.02), visible=masks[0],
                      silhouette=masks[0]),
            BopObject(number=2, camera_from_model=facing(0.02),
                      visible=masks[1] & (torch.arange(80) < 60), silhouette=masks[1]),
        ],
    )  # fmt: skip


@pytest.fixture
def synthetic(tmp_path: Path) -> Path:
    write_bop_models(tmp_path, [block(1), block(2)])
    write_bop_scene(tmp_path, "test", 3, [frame(0), frame(7)])
    return tmp_path


def change(path: Path, edit: Callable[[Any], object]) -> None:
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def test_what_is_written_is_read_back(synthetic: Path) -> None:
    data = open_bop(synthetic)
    assert (data.layout, len(data)) == ("BOP", 4)
    assert [i.name for i in data.instances] == [
        "000003_000000_000000", "000003_000000_000001",
        "000003_000007_000000", "000003_000007_000001",
    ]  # fmt: skip
    sample, instance = data[1], data.instances[1]
    points_m = select_object_points(sample.input, block(2).diameter_m)
    assert torch.equal(instance.camera_from_model.t_m, facing(0.02).t_m)
    assert sample.input.object == "block 2"
    assert sample.truth.visible_fraction == pytest.approx(19 / 39)
    assert len(points_m) == 19 * 39
    # Depth is kept in tenths of a millimetre.
    assert torch.allclose(points_m[:, 2], torch.tensor(0.5), atol=6e-5)
    model = data.objects[2]
    assert model.diameter_m == pytest.approx(block(2).diameter_m)
    assert torch.allclose(model.keypoints_m, block(2).keypoints_m, atol=1e-6)
    assert model.symmetries.discrete is not None
    info = read_json(synthetic / "test/000003/scene_gt_info.json")
    assert isinstance(info, dict)
    assert info["0"][1]["bbox_visib"] == [41, 11, 19, 39]
    assert info["7"][0]["visib_fract"] == 1


def test_a_predicted_mask_takes_the_place_of_the_annotated(synthetic: Path) -> None:
    data = open_bop(synthetic)
    mask = torch.zeros(60, 80, dtype=torch.bool)
    mask[20:30, 10:20] = True
    assert torch.equal(data.view(data.instances[0], mask).input.mask, mask)
    with pytest.raises(InputError, match="the mask is 5x4"):
        data.view(data.instances[0], mask[:4, :5])


def test_objects_are_chosen_by_number_or_name(synthetic: Path) -> None:
    data = open_bop(synthetic)
    assert {i.object_id for i in data.of_objects(2).instances} == {2}
    assert {i.object_id for i in data.of_objects("block 1").instances} == {1}
    assert {i.object_id for i in data.of_objects("2").instances} == {2}
    with pytest.raises(InputError, match=r"no instance of 'cat'; objects here: 1 \(block 1\), 2 "):
        data.of_objects("cat")


def test_a_whole_folder_passes_the_check(
    synthetic: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = check_bop(synthetic)
    assert report.problems == []
    assert report.summary == (
        "BOP: 2 images, 4 instances, 4 masks, 2 objects, 2 models; nothing is wrong, 0 notices"
    )
    assert main(["data", "check", str(synthetic)]) == 0
    assert "nothing is wrong" in capsys.readouterr().out
    (synthetic / "test/000003/depth/000007.png").unlink()
    assert main(["data", "check", str(synthetic)]) == 1
    assert "missing: " in capsys.readouterr().out


def test_the_check_names_what_is_wrong(synthetic: Path) -> None:
    scene = synthetic / "test/000003"

    def said() -> str:
        return " | ".join(f"{p.kind}: {p.message}" for p in check_bop(synthetic, "test").problems)

    kept = (scene / "scene_camera.json").read_text()
    change(scene / "scene_camera.json", lambda c: c["0"].update(depth_scale=100.0))
    assert "depth_scale and cam_t_m2c both for millimetres?" in said() or "is it in" in said()
    (scene / "scene_camera.json").write_text(kept)
    mask = scene / "mask_visib/000000_000000.png"
    whole = mask.read_bytes()
    Image.fromarray(np.zeros((5, 6), np.uint8)).save(mask)
    assert "mismatch: is 6x5, but its depth image is 80x60" in said()
    mask.write_bytes(whole[:60])
    assert "unreadable" in said()
    mask.write_bytes((scene / "mask_visib/000000_000001.png").read_bytes())
    assert "the posed model does not lie on its mask" in said()
    mask.write_bytes(whole)
    change(synthetic / "models/models_info.json", lambda c: c["1"].update(diameter=70.0))
    assert "is 82.5 mm across, but models_info says 70.0 mm" in said()
    change(synthetic / "models/models_info.json", lambda c: c["2"].update(name="block 1"))
    assert "mismatch: calls objects 1 and 2 'block 1'; rename all but one" in said()
    (synthetic / "models/obj_000002.ply").write_bytes(
        b"version https://git-lfs.github.com/spec/v1\n"
    )
    assert "is a Git LFS pointer" in said()
    (synthetic / "models/obj_000002.ply").unlink()
    assert "has no mesh of object 2" in said()
    with pytest.raises(InputError, match=r"no split 'val'. Here: test"):
        check_bop(synthetic, "val")


def test_a_model_in_metres_is_reported(synthetic: Path) -> None:
    mesh = trimesh.creation.box((0.04, 0.04, 0.06))
    mesh.export(synthetic / "models/obj_000001.ply")
    problems = check_bop(synthetic).problems
    assert any("is it in metres? Then say unit m" in p.message for p in problems)
    with pytest.raises(InputError, match="of BOP, whose models are in mm, multiply it by 1000"):
        read_bop_models(synthetic, [1])


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda c: c["0"][0].update(cam_R_m2c=[2, 0, 0, 0, 1, 0, 0, 0, 1]), "is none: its determ"),
        (lambda c: c["0"][0].update(cam_R_m2c=[1, 2]), "where 9 numbers belong"),
        (lambda c: c["0"][0].update(cam_t_m2c="far"), "where 3 numbers belong"),
        (lambda c: c["0"][0].update(obj_id=-1), "where a number from 0 to 1000000000 belongs"),
        (lambda c: c.update({"0": 3}), "is no list of annotations"),
        (lambda c: c.update({"8": []}), "has no entry in scene_camera.json"),
        (lambda c: c.update({"x": []}), "is no number of an image"),
    ],
)
def test_damaged_annotations_are_refused(
    synthetic: Path, edit: Callable[[Any], object], said: str
) -> None:
    change(synthetic / "test/000003/scene_gt.json", edit)
    with pytest.raises(InputError, match=said):
        open_bop(synthetic)
    assert not check_bop(synthetic).is_ok


def test_damaged_cameras_and_files_are_refused(synthetic: Path) -> None:
    scene = synthetic / "test/000003"
    kept = (scene / "scene_camera.json").read_text()
    for edit, said in (({"cam_K": [1.0] * 9}, "K is"), ({"depth_scale": 0}, "millimetres a unit"),
                       ({"depth_scale": "1"}, "where a number belongs")):  # fmt: skip
        change(scene / "scene_camera.json", lambda c, e=edit: c["0"].update(e))
        with pytest.raises(InputError, match=said):
            open_bop(synthetic)
        (scene / "scene_camera.json").write_text(kept)
    (scene / "scene_gt.json").write_text("[]")
    with pytest.raises(InputError, match="where names to values belong"):
        open_bop(synthetic)
    with pytest.raises(InputError, match=r"no split 'val' .*Here: test"):
        open_bop(synthetic, "val")
    with pytest.raises(InputError, match=r"no folder models or"):
        _ = open_bop(linemod(synthetic / "other")).objects
    scene.rename(scene.with_name("kitchen"))
    with pytest.raises(InputError, match="scenes have numbers for names"):
        open_bop(synthetic)


def test_no_mask_is_reported_with_a_remedy(synthetic: Path) -> None:
    (synthetic / "test/000003/mask_visib/000000_000000.png").unlink()
    with pytest.raises(InputError, match="render mask_visib, or give masks of your own"):
        open_bop(synthetic)[0]
    assert any("has no mask_visib" in p.message for p in check_bop(synthetic).notices)


def linemod(folder: Path) -> Path:
    """Make a small Linemod_preprocessed: object 2's folder annotates object 1 too."""
    pose = {"cam_R_m2c": [1.0, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [20.0, 0, 530]}
    scene = folder / "data/02"
    for part in ("depth", "mask", "rgb"):
        (scene / part).mkdir(parents=True)
    gt = {i: [{**pose, "obj_id": 1}, {**pose, "obj_id": 2}] for i in range(3)}
    (scene / "gt.yml").write_text(yaml.safe_dump(gt))
    camera = {"cam_K": K.flatten().tolist(), "depth_scale": 1.0}
    (scene / "info.yml").write_text(yaml.safe_dump(dict.fromkeys(range(3), camera)))
    (scene / "train.txt").write_text("0001\n")
    (scene / "test.txt").write_text("0000\n0002\n")
    shown = frame(0)
    for i in range(3):
        write_depth_png(scene / f"depth/{i:04d}.png", shown.depth_m, 0.001)
        mask = shown.objects[1].silhouette.numpy().astype(np.uint8) * 255
        Image.fromarray(np.stack([mask] * 3, -1)).save(scene / f"mask/{i:04d}.png")
        Image.fromarray(np.stack([mask] * 3, -1)).save(scene / f"rgb/{i:04d}.png")
    return folder


def test_linemod_preprocessed(tmp_path: Path) -> None:
    folder = linemod(tmp_path / "Linemod_preprocessed")
    home = write_bop_models(folder, [block(2)])
    (home / "obj_000002.ply").rename(home / "obj_02.ply")
    info = {2: {"diameter": 1000 * block(2).diameter_m, "min_x": -20}}
    (home / "models_info.json").unlink()
    (home / "models_info.yml").write_text(yaml.safe_dump(info))
    data = open_bop(folder)
    assert data.layout == "Linemod_preprocessed"
    assert [(i.image_id, i.object_id, i.index) for i in data.instances] == [(0, 2, 1), (2, 2, 1)]
    assert [i.image_id for i in open_bop(folder, "train").instances] == [1]
    assert data[0].input.object == "obj_000002"
    assert int(data[0].input.mask.sum()) == 39 * 39
    assert check_bop(folder).problems == []
    with pytest.raises(InputError, match="the splits are train and test"):
        open_bop(folder, "val")
    (folder / "data/02/test.txt").write_text("0009\n")
    with pytest.raises(InputError, match="image 9 has no annotation"):
        open_bop(folder)


def test_eggbox_and_glue_of_linemod_get_the_half_turn_that_is_not_declared(tmp_path: Path) -> None:
    plain = [dataclasses.replace(block(n), symmetries=Symmetries()) for n in (9, 10, 11)]
    write_bop_models(tmp_path, plain)
    assert all(
        model.symmetries.is_none for model in read_bop_models(tmp_path, (9, 10, 11)).values()
    )
    models = read_bop_models(linemod(tmp_path), (9, 10, 11))
    assert models[9].symmetries.is_none
    point = torch.tensor([[0.01, 0.02, 0.03]]).double()
    for number in (10, 11):
        turn = models[number].symmetries.discrete
        assert turn is not None
        assert len(turn.R) == 1
        turned = Rigid(turn.R[0], turn.t_m[0]).apply(point)
        assert torch.allclose(turned, torch.tensor([[-0.01, -0.02, 0.03]]).double())
    # Training gets the copy, as evaluation does.
    assert stack_symmetries([models[10]], 0.05).R.shape[1] == 2


def test_the_real_frames(real: Path) -> None:
    lm = open_bop(real / "pose/lm")
    cat, ape = (lm[i] for i in range(2))
    assert (cat.input.object, ape.input.object) == ("cat", "ape")
    assert cat.truth.is_measured
    assert not ape.truth.is_measured
    assert check_bop(real / "pose/lm").is_ok
    # The clouds lie on their posed meshes: 1.6 and 1.2 mm, as the samples' README says.
    for sample, limit_m in ((cat, 0.0025), (ape, 0.0025)):
        number = next(i.object_id for i in lm.instances if i.name == sample.input.name)
        points = sample.truth.camera_from_model.apply(lm.objects[number].vertices_m.double())
        seen_m = select_object_points(sample.input, lm.objects[number].diameter_m)
        gap = torch.cdist(seen_m.double()[::4], points).amin(-1)
        assert float(gap.median()) < limit_m
    ycb = open_bop(real / "pose/ycb_frames")
    assert len(ycb) == 10
    assert len(ycb.objects[ycb.instances[0].object_id].faces) == 0
