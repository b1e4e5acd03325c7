"""``depth predict`` and ``depth train``, as a user runs them."""

import dataclasses
import json
import math
import os
import random
import shutil
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import torch
from tests.core.test_camera_rectified import pair, texture
from tests.depth.constant_selection import sure_of
from tests.depth.small_training import TINY_MATCHER, write_tiny_weights
from tests.pages.read_page import read_page
from tests.synthetic_street import make_street

from depthpose.cli import main
from depthpose.cli.depth.inputs import list_pairs
from depthpose.cli.train import ProgressLog
from depthpose.core.checkpoint import find_weights, read_checkpoint
from depthpose.core.draw import draw_depth
from depthpose.core.errors import InputError
from depthpose.core.files import (
    read_image,
    read_map,
    read_video,
    write_depth_png,
    write_image,
    write_video,
)
from depthpose.core.loop import Progress, read_metrics
from depthpose.depth.estimator import net
from depthpose.depth.stereo import Matcher, PSMNet, SGBMMatcher
from depthpose.depth.synthesis import Synthesiser
from depthpose.depth.types import DepthEstimate, DepthInput
from depthpose.depth.weights import write_depth_weights

CAMERA = {"width": 64, "height": 48, "K": [[70, 0, 31.5], [0, 70, 23.5], [0, 0, 1]]}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small weights of both networks, three images and a camera."""
    folder = tmp_path_factory.mktemp("predict")
    write_tiny_weights(folder)
    for number in range(3):
        image = torch.rand(3, 48, 64, generator=torch.Generator().manual_seed(number))
        write_image(folder / "images" / f"{number}.png", image)
    (folder / "cam.json").write_text(json.dumps(CAMERA))
    return folder


def predict(home: Path, out: Path, *words: str) -> int:
    weights = ["--weights", str(home / "w.safetensors"), "--out", str(out)]
    return main(["depth", "predict", *words, *weights])


def test_a_folder_of_images_becomes_depth(home: Path, tmp_path: Path) -> None:
    camera = ["--camera", str(home / "cam.json"), "--cloud"]
    assert predict(home, tmp_path, str(home / "images"), *camera) == 0
    endings = ("depth_m.npy", "depth.png", "disparity_px.npy", "confidence.npy", "right.png",
               "color.png", "cloud.ply")  # fmt: skip
    for number in range(3):
        assert all((tmp_path / f"{number}.{ending}").is_file() for ending in endings)
    assert read_map(tmp_path / "0.depth_m.npy").shape == (48, 64)
    before = (tmp_path / "0.depth_m.npy").stat().st_mtime_ns
    assert predict(home, tmp_path, str(home / "images"), *camera) == 0
    assert (tmp_path / "0.depth_m.npy").stat().st_mtime_ns == before, "finished work is kept"


@pytest.mark.parametrize("name", ["0.color.png", "0.cloud.ply", "report.html", "run.json"])
def test_a_file_of_somebody_else_is_not_written_over(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    shutil.copy(home / "images" / "0.png", tmp_path)
    (tmp_path / name).write_text('"mine"')
    words = (str(tmp_path / "0.png"), "--camera", str(home / "cam.json"), "--cloud")
    assert predict(home, tmp_path, *words) == 2
    assert name in capsys.readouterr().err
    assert (tmp_path / name).read_text() == '"mine"'
    (tmp_path / name).unlink()
    (tmp_path / "run.json").unlink(missing_ok=True)
    assert predict(home, tmp_path, *words) == 0
    assert (tmp_path / "0.png").read_bytes() == (home / "images" / "0.png").read_bytes()


def test_a_folder_of_images_takes_no_results(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(home / "images", tmp_path / "images")
    words = ("--camera", str(home / "cam.json"))
    for word in (tmp_path / "images", tmp_path / "images" / "*.png"):
        assert predict(home, tmp_path / "images", str(word), *words) == 2
        assert "the inputs lie there, and a second run would" in capsys.readouterr().err
    assert len(list((tmp_path / "images").iterdir())) == 3


def test_an_image_that_is_called_like_a_frame_of_a_video_is_refused(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_video(tmp_path / "drive.avi", [torch.rand(3, 48, 64) for _ in range(2)], 5.0)
    shutil.copy(home / "images" / "0.png", tmp_path / "drive_000001.png")
    words = [str(tmp_path / name) for name in ("drive.avi", "drive_000001.png")]
    assert predict(home, tmp_path / "out", *words, "--focal-px", "70") == 2
    assert "an input is called 'drive_000001', as a frame of a video" in capsys.readouterr().err


def test_weights_that_answer_themselves_need_no_matcher(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = str(tmp_path / "own.safetensors")
    write_depth_weights(Path(weights), generator=sure_of(0), facts={"licence": "MIT"})
    image, camera = str(home / "images/0.png"), ["--camera", str(home / "cam.json")]
    words = [image, *camera, "--weights", weights, "--out"]
    assert main(["depth", "predict", *words, str(tmp_path / "own"), "--cloud"]) == 0
    assert bool(read_map(tmp_path / "own/0.depth_m.npy").isnan().all()), "nothing but sky"
    assert bool((read_image(tmp_path / "own/0.sky.png") == 1).all())
    page = read_page(tmp_path / "own/report.html")
    assert any("grey: sky or no answer" in text for text in page.texts["figcaption"])
    assert "100.0% of the pixels" in page.texts["dd"]
    assert [layer["count"] for scene in page.scenes for layer in scene["layers"]] == [0]
    asked = [*words, str(tmp_path / "sgbm"), "--matcher", "sgbm"]
    with patch.object(SGBMMatcher, "match", side_effect=InputError("OpenCV was asked")):
        assert main(["depth", "predict", *asked]) == 2
    assert "OpenCV was asked" in capsys.readouterr().err
    rig = tmp_path / "rig.json"
    rig.write_text(json.dumps({**CAMERA, "baseline_m": 0.5}))
    pair = [image, image, "--camera", str(rig), "--weights", weights, "--no-check"]
    assert main(["depth", "match", *pair, "--out", str(tmp_path / "pair")]) == 2
    assert "holds no matcher, which a pair needs" in capsys.readouterr().err


def test_an_image_unlike_the_known_is_refused_unless_asked_for(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network = sure_of(1)
    network.config = dataclasses.replace(network.config, least_confidence=0.99)
    network.head.bias = torch.nn.Parameter(torch.tensor([1.0, 3, 0, 0, 0] * 2))
    write_depth_weights(tmp_path / "g.safetensors", generator=network, facts={})
    words = [str(home / "images/0.png"), "--camera", str(home / "cam.json")]
    words += ["--weights", str(tmp_path / "g.safetensors"), "--out"]
    assert main(["depth", "predict", *words, str(tmp_path / "a")]) == 2
    assert "0: out of distribution for these weights" in capsys.readouterr().err
    assert not (tmp_path / "a/0.depth_m.npy").exists()
    assert main(["depth", "predict", *words, str(tmp_path / "b"), "--allow-ood"]) == 0
    assert "warning: 0: out of distribution" in capsys.readouterr().err
    assert "its depth is a guess" in (tmp_path / "b/0.warning.txt").read_text()
    assert "its depth is a guess" in (tmp_path / "b/report.html").read_text()


def test_where_depth_comes_from_is_one_word(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = str(tmp_path / "w.safetensors")
    matcher = PSMNet(TINY_MATCHER).eval()
    write_depth_weights(Path(weights), generator=sure_of(1), matcher=matcher, facts={})
    words = [str(home / "images/0.png"), "--camera", str(home / "cam.json"), "--weights", weights]
    found = {}
    for answer in ("own", "matched"):
        out = tmp_path / answer
        assert main(["depth", "predict", *words, "--answer", answer, "--out", str(out)]) == 0
        found[answer] = read_map(out / "0.disparity_px.npy")
        assert json.loads((out / "run.json").read_text())["settings"]["answer"] == answer
    assert not torch.equal(found["own"], found["matched"])
    capsys.readouterr()
    other = ["--answer", "own", "--matcher", "sgbm", "--out", str(tmp_path / "x")]
    assert main(["depth", "predict", *words, *other]) == 2
    assert "the depth is that of --matcher on the synthesised view" in capsys.readouterr().err


def test_a_threshold_is_chosen_on_a_folder(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given, out = tmp_path / "g.safetensors", tmp_path / "c.safetensors"
    write_depth_weights(given, generator=sure_of(1), facts={})
    shutil.copytree(home / "images", tmp_path / "pairs/left")
    lines = [f"{number} 64 48 70 31.5 23.5 0.5\n" for number in range(3)]
    (tmp_path / "pairs/calib.txt").write_text("".join(lines))
    words = [str(given), "--data", str(tmp_path / "pairs"), "--out", str(out)]
    assert main(["depth", "calibrate", *words]) == 2
    assert "3 images cannot say what refuses 0.01 of them" in capsys.readouterr().err
    assert main(["depth", "calibrate", *words, "--alarm-share", "0.5"]) == 0
    assert "3 images: confidence 1.000 to 1.000" in capsys.readouterr().out
    assert read_checkpoint(out).config["least_confidence"] == pytest.approx(1.0, abs=1e-3)


def test_a_pair_is_matched_by_the_default_weights_where_none_are_named(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig, image = tmp_path / "rig.json", str(home / "images/0.png")
    rig.write_text(json.dumps({**CAMERA, "baseline_m": 0.5}))
    pair = ["depth", "match", image, image, "--camera", str(rig), "--no-check", "--out"]
    for name, words in (("none", []), ("named", ["--matcher", "default"])):
        assert main([*pair, str(tmp_path / name), *words]) == 0
        settings = json.loads((tmp_path / name / "run.json").read_text())["settings"]
        assert settings["weights"] == "default"
    rig.write_text(json.dumps({**CAMERA, "baseline_m": 0.5, "cx_right_minus_left_px": 8.0}))
    assert main([*pair, str(tmp_path / "none")]) == 2, "the same pairs by another rig"
    assert "cx_right_minus_left_px" in capsys.readouterr().err
    assert main([*pair, str(tmp_path / "x"), "--matcher", "sgmb"]) == 2
    assert "'sgmb': neither a file nor the name of weights" in capsys.readouterr().err


def test_another_matcher_looks_at_the_drawn_view(home: Path, tmp_path: Path) -> None:
    """Weights are named by --matcher here as in a training."""
    words = (str(home / "images/0.png"), "--camera", str(home / "cam.json"))
    for matcher in ("default", str(home / "w.safetensors")):
        out = tmp_path / Path(matcher).stem
        assert predict(home, out, *words, "--matcher", matcher) == 0
    assert predict(home, tmp_path / "own", *words) == 0
    said = json.loads((tmp_path / "default/run.json").read_text())["settings"]
    assert said["matcher"] == "fakestereo with default"
    own, other, same = (read_map(tmp_path / f"{n}/0.depth_m.npy") for n in ("own", "default", "w"))
    assert torch.equal(own, same)
    assert not torch.equal(own, other)


def test_processes_share_a_folder_of_images(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = (str(home / "images"), "--camera", str(home / "cam.json"))
    monkeypatch.setenv("WORLD_SIZE", "2")
    done: list[set[str]] = []
    for rank in "10":
        monkeypatch.setenv("RANK", rank)
        assert predict(home, tmp_path / "shared", *words) == 0
        done.append({path.name for path in (tmp_path / "shared").glob("*.depth_m.npy")})
    assert len(done[0]) in (1, 2)
    assert done[0] < done[1] == {f"{k}.depth_m.npy" for k in range(3)}


def test_the_first_process_waits_for_the_others(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page shows their depth maps and their failures, those of frames of a video too."""
    for name in ("0", "1", "2"):
        write_image(tmp_path / "in" / f"{name}.png", read_image(home / "images" / f"{name}.png"))
    (tmp_path / "in" / "3.png").write_bytes(b"no picture")
    write_video(tmp_path / "in" / "drive.avi", [torch.full((3, 48, 64), 0.3)] * 2, 5.0)
    (tmp_path / "in" / "empty.avi").write_bytes(b"no video")
    # The first process takes 0, 2 and the empty video, the second one 1, 3 and the drive.
    names = ("0.png", "1.png", "2.png", "3.png", "empty.avi", "drive.avi")
    words = [str(tmp_path / "in" / name) for name in names]
    words += ["--camera", str(home / "cam.json"), "--allow-ood"]
    program = "import sys; from depthpose.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", program, "depth", "predict", *words]
    command += ["--weights", str(home / "w.safetensors"), "--out", str(tmp_path / "out")]
    monkeypatch.setenv("WORLD_SIZE", "2")
    with subprocess.Popen(command, env=os.environ | {"RANK": "1"}) as second:
        monkeypatch.setenv("RANK", "0")
        assert predict(home, tmp_path / "out", *words) == 1, "of the empty video"
        page = (tmp_path / "out" / "report.html").read_text()
    assert second.returncode == 1, "of the picture that is none"
    assert "5 depth maps in this folder" in page
    assert "3.png: not a readable picture" in page
    assert "empty.avi: not a video" in page


def test_a_focal_length_stands_for_a_centred_camera(home: Path, tmp_path: Path) -> None:
    image = str(home / "images" / "1.png")
    assert predict(home, tmp_path / "a", image, "--camera", str(home / "cam.json")) == 0
    assert predict(home, tmp_path / "b", image, "--focal-px", "70") == 0
    half_deg = math.degrees(math.atan(32 / 70))
    assert predict(home, tmp_path / "c", image, "--fov", f"{2 * half_deg:.9f}") == 0
    known = ["--focal-px", "70", "--known-distance", "30,20,5.5"]
    assert predict(home, tmp_path / "d", image, *known) == 0
    one, other, third, scaled = (
        read_map(tmp_path / name / "1.depth_m.npy") for name in ("a", "b", "c", "d")
    )
    assert torch.equal(one, other)
    torch.testing.assert_close(one, third, rtol=1e-5, atol=0)
    ratio = (scaled / one)[torch.isfinite(one)]
    torch.testing.assert_close(ratio, ratio[0].expand_as(ratio), rtol=1e-4, atol=0)
    assert float(scaled[18:23, 28:33].median()) == pytest.approx(5.5, rel=1e-4)


def test_a_video_keeps_one_scale(home: Path, tmp_path: Path) -> None:
    frames = [torch.full((3, 48, 64), 0.2 + 0.1 * k) for k in range(4)]
    write_video(tmp_path / "drive.avi", frames, 5.0)
    words = ["--focal-px", "70", "--color-range", "1", "40"]
    assert predict(home, tmp_path / "out", str(tmp_path / "drive.avi"), *words) == 0
    assert len(list((tmp_path / "out").glob("drive_*.depth_m.npy"))) == 4
    video = read_video(tmp_path / "out" / "drive.color.mp4")
    shown = list(video)
    assert len(shown) == 4
    assert video.fps == pytest.approx(5.0)
    for (_, picture), file in zip(
        shown, sorted((tmp_path / "out").glob("*.depth_m.npy")), strict=True
    ):
        wanted = draw_depth(read_map(file), 1.0, 40.0)
        assert float((picture - wanted).abs().mean()) < 0.05, file
    page = (tmp_path / "out" / "report.html").read_text()
    assert (
        page.count('<video controls muted loop preload="metadata" src="data:video/mp4;base64,') == 1
    )
    assert "drive.color.mp4: depth, 1 m bright to 40 m dark" in page


def test_a_frame_of_a_video_that_is_refused_leaves_the_others(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = [torch.full((3, 48, 64), 0.2 + 0.1 * k) for k in range(4)]
    write_video(tmp_path / "drive.avi", frames, 5.0)
    refused = InputError("drive_000001: a black frame")
    estimate = net.depth_from_images

    def refuse_one(
        synthesiser: Synthesiser,
        matcher: Matcher | None,
        images: Sequence[DepthInput],
        *,
        allow_ood: bool,
    ) -> list[DepthEstimate]:
        if any(image.name == "drive_000001" for image in images):
            raise refused
        return estimate(synthesiser, matcher, images, allow_ood=allow_ood)

    out = tmp_path / "out"
    with patch.object(net, "depth_from_images", refuse_one):
        assert predict(home, out, str(tmp_path / "drive.avi"), "--focal-px", "70") == 1
    assert "failed: drive_000001: a black frame" in capsys.readouterr().err
    assert len(list(out.glob("*.depth_m.npy"))) == 3
    assert len(list(read_video(out / "drive.color.mp4"))) == 4, "a grey frame in its place"
    assert "black frame" in " ".join(read_page(out / "report.html").texts["td"])


@pytest.fixture
def roads() -> Iterator[None]:
    """Let networks see a road in every image, as high and tilted as its name says."""

    def estimate(
        synthesiser: Synthesiser,
        matcher: Matcher | None,
        images: Sequence[DepthInput],
        *,
        allow_ood: bool,
    ) -> list[DepthEstimate]:
        estimates: list[DepthEstimate] = []
        for image in images:
            number = int(image.name[-1])
            rows = (torch.arange(48.0) - 23.5) / 70
            inverse = (rows + math.tan(math.radians(2 + 0.5 * number))) / (1.5 + 0.1 * number)
            depth_m = (1 / inverse.clamp(min=1 / 60))[:, None].expand(48, 64).contiguous()
            estimates.append(DepthEstimate(input=image, depth_m=depth_m, disparity_px=35 / depth_m))
        return estimates

    with patch.object(net, "depth_from_images", estimate):
        yield


def grounds(out: Path) -> dict[str, dict[str, float]]:
    """Read the roads of a folder of results."""
    return {path.name: json.loads(path.read_text()) for path in sorted(out.glob("*.ground.json"))}


@pytest.mark.usefixtures("roads")
@pytest.mark.parametrize("batch", ["1", "3"])
def test_frames_of_a_video_have_one_mount_also_where_a_run_goes_on(
    home: Path, tmp_path: Path, batch: str
) -> None:
    frames = [torch.full((3, 48, 64), 0.2 + 0.1 * k) for k in range(4)]
    write_video(tmp_path / "drive.avi", frames, 5.0)
    out = tmp_path / "out"
    words = [str(tmp_path / "drive.avi"), "--focal-px", "70", "--batch", batch]
    assert predict(home, out, *words) == 0
    whole = grounds(out)
    heights = [ground["height_m"] for ground in whole.values()]
    assert len(heights) == 4
    assert heights[3] - heights[0] < 0.5 * 0.3, "the height is held"
    for name in ("drive_000001", "drive_000003"):
        for path in out.glob(f"{name}.*"):
            path.unlink()
    assert predict(home, out, *words) == 0
    assert grounds(out) == whole


@pytest.mark.usefixtures("roads")
def test_images_have_a_mount_each_or_one_together(home: Path, tmp_path: Path) -> None:
    images = tmp_path / "images"
    for number in range(4):
        write_image(images / f"{number}.png", torch.full((3, 48, 64), 0.2 + 0.1 * number))
    apart = tmp_path / "apart"
    together = tmp_path / "together"
    assert predict(home, apart, str(images), "--focal-px", "70") == 0
    assert predict(home, together, str(images), "--focal-px", "70", "--one-mount") == 0
    spreads: list[float] = []
    for out in (apart, together):
        heights = [ground["height_m"] for ground in grounds(out).values()]
        spreads.append(max(heights) - min(heights))
    assert spreads[0] > 0.25
    assert spreads[1] < 0.6 * spreads[0]


def test_sides_of_other_names_are_not_paired_by_order(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = read_image(home / "images/0.png")
    for name in ("left/a.png", "left/b.png", "right/a.png", "right/c.png"):
        write_image(tmp_path / name, image)
    sides = [str(tmp_path / side) for side in ("left", "right")]
    (tmp_path / "rig.json").write_text(json.dumps({**CAMERA, "baseline_m": 0.2}))
    words = ["--camera", str(tmp_path / "rig.json"), "--out", str(tmp_path / "out")]
    assert main(["depth", "match", *sides, *words]) == 2
    assert "no partner of the same name or number is there for 'b', 'c'" in capsys.readouterr().err


def write_doubtful_pairs(home: Path) -> list[str]:
    """One good pair among others: swapped, one view twice, two scenes, nothing to match."""
    left, right = pair()
    bare = torch.linspace(0, 1, 480).expand(3, 240, 480)
    pairs = {
        "a": (left, right), "b": (right, left), "c": (left, 0.9 * left),
        "d": (left, texture(240, 480, 1)), "e": (bare, 0.9 * bare),
    }  # fmt: skip
    for name, views in pairs.items():
        for side, view in zip(("left", "right"), views, strict=True):
            write_image(home / side / f"{name}.png", view)
    rig = {"width": 480, "height": 240, "K": [[400, 0, 240], [0, 400, 120], [0, 0, 1]]}
    (home / "camera.json").write_text(json.dumps({**rig, "baseline_m": 0.2}))
    return [str(home / "left"), str(home / "right"), "--camera", str(home / "camera.json")]


def test_every_pair_is_checked_named_and_the_others_are_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = ["depth", "match", *write_doubtful_pairs(tmp_path), "--matcher", "sgbm"]
    assert main([*words, "--out", str(out)]) == 1
    said = capsys.readouterr().err
    wrong = {"b": "left and right look swapped", "c": "left and right show the same view",
             "d": "the images do not belong together"}  # fmt: skip
    for name, why in wrong.items():
        assert f"failed: {name}: {why}" in said
    doubt = "only 0 of the 25 matches needed: cannot tell whether the pair is rectified"
    assert f"warning: e: {doubt}" in said
    assert sorted(path.name[0] for path in out.glob("*.depth_m.npy")) == ["a", "e"]
    assert (out / "e.warning.txt").read_text() == f"{doubt}\n"
    page = " ".join(read_page(out / "report.html").texts["td"])
    assert f"e: {doubt}" in page
    assert all(why in page for why in wrong.values())
    assert main([*words, "--no-check", "--out", str(out)]) == 0
    assert len(list(out.glob("*.depth_m.npy"))) == 5


def test_the_check_of_a_folder_names_every_wrong_pair(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_doubtful_pairs(tmp_path)
    assert main(["data", "check", str(tmp_path)]) == 1
    said = capsys.readouterr().out
    for name, why in (("b", "left and right look swapped"), ("c", "left and right show the same"),
                      ("d", "the images do not belong")):  # fmt: skip
        assert f"mismatch: {tmp_path}/right/{name}.png: beside {name}.png: {why}" in said
    assert f"note: {tmp_path}/right/e.png: beside e.png: only 0 of the 25 matches" in said
    assert "right/a.png" not in said


def test_another_right_image_needs_another_folder(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, other = (str(home / f"images/{k}.png") for k in (0, 1))
    (tmp_path / "rig.json").write_text(json.dumps({**CAMERA, "baseline_m": 0.2}))
    words = [
        "--camera",
        str(tmp_path / "rig.json"),
        "--no-check",
        "--weights",
        str(home / "m.safetensors"),
    ]
    words += ["--out", str(tmp_path / "out")]
    assert main(["depth", "match", one, one, *words]) == 0
    assert main(["depth", "match", one, one, *words]) == 0
    write_image(tmp_path / "right.png", read_image(Path(other)))
    assert main(["depth", "match", one, str(tmp_path / "right.png"), *words]) == 2
    assert "has changed since its result '0'" in capsys.readouterr().err


def test_sizes_that_differ_are_no_matter_of_the_check(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_image(tmp_path / "right.png", torch.rand(3, 40, 64))
    (tmp_path / "rig.json").write_text(json.dumps({**CAMERA, "baseline_m": 0.2}))
    pair = [str(home / "images/0.png"), str(tmp_path / "right.png")]
    words = ["--camera", str(tmp_path / "rig.json"), "--out", str(tmp_path / "out")]
    assert main(["depth", "match", *pair, *words]) == 2
    error = capsys.readouterr().err
    assert "a rectified pair has one size" in error
    assert "--no-check" not in error


def test_the_page_shows_some_of_many_and_the_numbers_of_their_files(
    home: Path, tmp_path: Path
) -> None:
    for number in range(9):
        image = torch.rand(3, 48, 64, generator=torch.Generator().manual_seed(number))
        write_image(tmp_path / "in" / f"<b>{number}.png", image)
    (tmp_path / "in" / "broken.png").write_bytes(b"no picture")
    out = tmp_path / "out"
    assert predict(home, out, str(tmp_path / "in"), "--camera", str(home / "cam.json")) == 1
    page = read_page(out / "report.html")
    assert page.texts["h1"] == ["Depth of 9 images"]
    assert "Shown: 6 of 9 depth maps in this folder (spread evenly)." in page.texts["p"]
    (reason,) = page.texts["td"]
    assert "broken.png" in reason
    names = page.texts["h2"][1:]
    assert names == [f"<b>{number}" for number in (0, 2, 3, 5, 6, 8)]
    assert "b" not in page.tags, "a name is no markup"
    assert len(page.pictures) == 6 * 4
    facts = [value for value in page.texts["dd"] if value.endswith(" m")]
    for name, scene, said in zip(names, page.scenes, facts, strict=True):
        depth_m = read_map(out / f"{name}.depth_m.npy")
        known_m = depth_m[depth_m.isfinite()]
        numbers = np.percentile(known_m.numpy(), (1, 50, 99))
        assert said == "{:.2f}, {:.2f}, {:.2f} m".format(*numbers)
        assert scene["layers"][0]["count"] == int((known_m <= 80).sum())


def test_the_page_of_a_video_shows_its_frames(home: Path, tmp_path: Path) -> None:
    frames = [torch.full((3, 48, 64), 0.05 * k) for k in range(8)]
    write_video(tmp_path / "drive.avi", frames, 5.0)
    assert predict(home, tmp_path, str(tmp_path / "drive.avi"), "--focal-px", "70") == 0
    shown = read_page(tmp_path / "report.html").texts["h2"][1:]
    assert shown == ["Videos", *(f"drive_{k:06d}" for k in (0, 2, 3, 4, 6, 7))]


def test_one_broken_image_stops_no_other(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no picture")
    good = str(home / "images" / "0.png")
    for out, lens in enumerate((("--focal-px", "70"), ("--camera", str(home / "cam.json")))):
        words = (str(broken), good, *lens, "--batch", "2")
        assert predict(home, tmp_path / str(out), *words) == 1
        assert "broken.png" in capsys.readouterr().err
        assert (tmp_path / str(out) / "0.depth_m.npy").is_file()


def test_one_image_of_another_camera_stops_no_other_of_its_batch(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = read_image(home / "images" / "0.png")
    write_image(tmp_path / "in" / "odd.png", image[:, 5:])
    write_image(tmp_path / "in" / "right.png", image)
    words = (str(tmp_path / "in"), "--camera", str(home / "cam.json"), "--batch", "4")
    assert predict(home, tmp_path / "out", *words) == 1
    assert "odd" in capsys.readouterr().err
    assert (tmp_path / "out" / "right.depth_m.npy").is_file()
    assert not (tmp_path / "out" / "odd.depth_m.npy").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "0.png has none in its EXIF: give --camera FILE, --focal-px, or --fov"),
        (
            ["--focal-px", "70", "--fov", "90"],
            "--fov: has no effect here; --focal-px is the focal length",
        ),
        (["--fov", "190"], "spans 1 to 170 degrees"),
        (["--fov", "90", "--known-distance", "1,2"], "write X,Y,METRES, such as 640,300,12.5"),
        (["--fov", "90", "--camera-height", "150"], "--camera-height 150: give 0.1 to 20 metres"),
        (["--fov", "90", "--camera-tilt", "-80"], "--camera-tilt -80: give -45 to 45 degrees"),
        (["--fov", "90", "--camera-tilt", "-8"], "so a camera tilt of -8 degrees cannot set"),
        (
            ["--fov", "90", "--camera-height", "1.4", "--known-distance", "1,2,3"],
            "--known-distance: has no effect here; --camera-height sets the scale",
        ),
        (
            ["--fov", "90", "--one-mount", "--known-distance", "1,2,3"],
            "--known-distance holds for one image, and the frames of a video or of --one-mount",
        ),
        (["--focal-px", "0.5"], "not a focal length in pixels"),
        (["--focal-px", "70", "--color-range", "9", "3"], "near first"),
        (["--focal-px", "70", "--weights", "defualt"], "neither a file nor the name"),
        (
            ["--focal-px", "70", "--weights", "default", "--max-memory", "1GB"],
            "for a matcher with weights, and none runs here",
        ),
    ],
)
def test_unusable_words_are_refused(
    home: Path, tmp_path: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    image = str(home / "images" / "0.png")
    weights = [] if "--weights" in words else ["--weights", str(home / "w.safetensors")]
    assert main(["depth", "predict", image, *words, *weights, "--out", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err


def test_a_baseline_is_said_to_be_left_alone(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rig.json").write_text(json.dumps({**CAMERA, "baseline_m": 0.2}))
    image = str(home / "images" / "0.png")
    assert predict(home, tmp_path / "out", image, "--camera", str(tmp_path / "rig.json")) == 0
    assert "baseline is ignored" in capsys.readouterr().err
    assert predict(home, tmp_path / "mono", image, "--camera", str(home / "cam.json")) == 0
    one, other = (read_map(tmp_path / name / "0.disparity_px.npy") for name in ("out", "mono"))
    assert torch.equal(one, other)


def test_packing_writes_the_card_and_halves_the_file(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "packed-nc.safetensors"
    words = ["--trained-on", "drives", "--licence", "CC BY-NC-SA 3.0", "--terms", "research only"]
    assert main(["weights", "pack", str(home / "w.safetensors"), "--out", str(out), "--half",
                 *words]) == 0  # fmt: skip
    assert read_checkpoint(out).facts["terms"] == "research only"
    card = "# packed-nc\n\n- **Licence**: CC BY-NC-SA 3.0\n- **Terms**: research only\n"
    assert (tmp_path / "packed-nc.md").read_text() == f"{card}- **Trained on**: drives\n"
    again = ["weights", "pack", str(out), "--out", str(tmp_path / "again.safetensors")]
    with pytest.warns(UserWarning, match="research only"):
        assert main([*again, "--trained-on", "drives", "--licence", "MIT"]) == 0
    assert read_checkpoint(tmp_path / "again.safetensors").facts["terms"] == "research only"
    named = tmp_path / "named.safetensors"
    with pytest.warns(UserWarning, match="research"):
        assert main(["weights", "pack", "kitti-nc", "--matcher", "default", "--out", str(named),
                     *words]) == 0  # fmt: skip
    theirs = read_checkpoint(find_weights("kitti-nc")).facts["terms"]
    assert read_checkpoint(named).facts["terms"] == f"research only {theirs}"
    assert main([*again, "--trained-on", "drives", "--licence", "MIT"]) == 2
    assert "again.safetensors: is there already; delete it" in capsys.readouterr().err
    (tmp_path / "new.md").touch()
    new = str(tmp_path / "new.safetensors")
    assert main(["weights", "pack", "kitti-nc", "--out", new, *words]) == 2
    assert "new.md: is there already; delete it" in capsys.readouterr().err
    (tmp_path / "new.md").unlink()
    assert main(["weights", "pack", "kiti-nc", "--out", new, *words]) == 2
    assert "neither a file nor the name of weights" in capsys.readouterr().err
    assert out.stat().st_size < (home / "w.safetensors").stat().st_size
    image = str(home / "images" / "0.png")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert main(["depth", "predict", image, "--focal-px", "70", "--weights", str(out), "--out",
                     str(tmp_path / "out")]) == 0  # fmt: skip


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("train")
    street = make_street(0.2)
    assert street.input.right is not None
    assert street.input.camera is not None
    assert street.truth.disparity_px is not None
    write_image(folder / "left" / "a.png", street.input.left)
    write_image(folder / "right" / "a.png", street.input.right)
    write_depth_png(folder / "disp_occ" / "a.png", street.truth.disparity_px)
    K = street.input.camera.K
    lines = [f"focal_px: {K[0, 0]}", f"cx: {K[0, 2]}", f"cy: {K[1, 2]}", "baseline_m: 0.5327"]
    (folder / "calib.txt").write_text("\n".join(lines))
    return folder


VIEW = """
generator: {width: 2, levels: 3, virtual_focal_px: 130.0}
discriminator_width: 2
pairs: {focal_px: 130.0, augment: {crop_px: [32, 64]}}
loop: {steps: 4, batch_size: 2, device: cpu}
"""


SELECT = """
generator: {encoder_width: 0.1, widths: [4, 4, 4, 4], planes: 6, disparity_px: [1, 32],
  virtual_focal_px: 130.0}
with_frozen_stem: false
encoder_rate: 1.0
adam: {learning_rate: 2.0e-5, warmup_steps: 2}
pairs: {truth: disparity, augment: {crop_px: [32, 64]}}
loop: {steps: 4, batch_size: 2, device: cpu}
"""


def test_training_by_config_and_words(
    pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "view.yaml").write_text(VIEW)
    words = ["depth", "train", "view", "--config", str(tmp_path / "view.yaml")]
    held_out = shutil.copytree(pairs, tmp_path / "held")
    words += ["--data", str(pairs), "--held-out", str(held_out), "--out", str(tmp_path / "run")]
    assert main([*words, "--steps", "2"]) == 0
    said = capsys.readouterr().out
    assert "generator.safetensors" in said
    assert "- **Time**: 2 steps in " in said
    assert said.startswith("step 1 of 2"), "there is no terminal"
    assert "\nstep 2 of 2, discriminator/loss " in said
    assert "held_out/l1" in read_metrics(tmp_path / "run")[-1]
    assert list((tmp_path / "run" / "pictures").glob("*.png"))
    assert (tmp_path / "run" / "generator.safetensors").is_file()
    assert main([*words, "--steps", "2"]) == 2
    assert "Add --resume" in capsys.readouterr().err
    assert main([*words, "--steps", "2", "--resume"]) == 0
    assert main([*words, "--steps", "3", "--resume"]) == 2
    assert "loop.steps = 2, but now it is 3" in capsys.readouterr().err


def test_without_a_terminal_a_line_is_printed_each_minute(
    capsys: pytest.CaptureFixture[str],
) -> None:
    seconds = iter(range(0, 4000, 10))
    log = ProgressLog(clock=lambda: float(next(seconds)))
    for step in range(1, 101):
        numbers = {"net/loss": 1 / step} if step % 50 == 0 else {}
        log.show(Progress(step=step, steps=100, numbers=numbers))
    said = capsys.readouterr().out.splitlines()
    assert said[:2] == ["step 1 of 100", "step 7 of 100, 16 min left"]
    assert said[-2:] == [
        "step 97 of 100, 0 min left, net/loss 0.02",
        "step 100 of 100, net/loss 0.01",
    ]
    assert len(said) == 18


def test_a_stopped_training_is_finished_by_a_word(
    pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "view.yaml").write_text(VIEW.replace("steps: 4", "steps: 4, save_every_steps: 1"))
    words = ["depth", "train", "view", "--config", str(tmp_path / "view.yaml")]
    words += ["--data", str(pairs), "--out", str(tmp_path / "run")]
    assert main([*words, "--finish"]) == 2
    assert "holds no state of a training" in capsys.readouterr().err

    def stop(self: ProgressLog, progress: Progress) -> None:
        if progress.step == 1:
            raise KeyboardInterrupt

    with patch.object(ProgressLog, "show", stop):
        assert main(words) == 130
    assert main([*words, "--finish"]) == 0
    assert "- **Time**: " in capsys.readouterr().out
    assert (tmp_path / "run" / "generator.safetensors").is_file()


@pytest.mark.slow
def test_two_processes_select_as_one_that_accumulates(pairs: Path, tmp_path: Path) -> None:
    """Weights agree to float32 rounding; batch norm statistics are each process's own."""
    found: list[dict[str, torch.Tensor]] = []
    for processes, accumulate in ((1, 2), (2, 1)):
        config, out = tmp_path / f"{processes}.yaml", tmp_path / f"run-{processes}"
        config.write_text(SELECT.replace("steps: 4", f"steps: 4, accumulate: {accumulate}"))
        launch = ["-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2"]
        words = [sys.executable, *(launch if processes == 2 else []), "-m", "depthpose", "depth"]
        words += ["train", "select", "--config", str(config), "--data", str(pairs)]
        done = subprocess.run([*words, "--out", str(out)], capture_output=True, check=False)
        assert done.returncode == 0, done.stderr.decode()[-3000:]
        found.append(torch.load(out / "state.pt", weights_only=True)["modules"]["generator"])
    for name, tensor in found[0].items():
        if "running" not in name and "num_batches" not in name:
            torch.testing.assert_close(tensor, found[1][name], rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "config", "early", "late"), [("view", VIEW, 2, 3), ("select", SELECT, 1, 2)]
)
def test_kills_at_any_moment_change_no_weight_of_a_stage(
    pairs: Path, tmp_path: Path, stage: str, config: str, early: int, late: int
) -> None:
    """Before the first step too, while samples are read, and while weights are written."""
    text = config.replace("steps: 4", "steps: 140, save_every_steps: 7, validate_every_steps: 50")
    (tmp_path / "stage.yaml").write_text(text)
    words = [sys.executable, "-m", "depthpose", "depth", "train", stage, "--resume"]
    words += ["--config", str(tmp_path / "stage.yaml"), "--data", str(pairs)]
    words += ["--held-out", str(shutil.copytree(pairs, tmp_path / "held")), "--out"]
    subprocess.run([*words, str(tmp_path / "whole")], check=True, capture_output=True)
    moments, killed = random.Random(1), tmp_path / "killed"
    state = killed / "state.pt"
    # The early ones meet a run that has saved nothing, the others one that went on.
    for sign in early * [killed / "run.json"] + late * [state]:
        before = sign.stat().st_mtime_ns if sign is state and sign.exists() else 0
        process = subprocess.Popen([*words, str(killed)], stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + 120
        while not (sign.exists() and sign.stat().st_mtime_ns != before):
            assert time.monotonic() < deadline
            assert process.poll() is None
            time.sleep(0.01)
        time.sleep(moments.uniform(0.0, 0.2))
        process.kill()
        process.wait()
    assert torch.load(state, weights_only=True)["step"] < 140
    subprocess.run([*words, str(killed)], check=True, capture_output=True)
    one, other = (
        read_checkpoint(folder / "generator.safetensors").state
        for folder in (tmp_path / "whole", killed)
    )
    assert one.keys() == other.keys()
    assert all(torch.equal(one[key], other[key]) for key in one)
    assert not list(killed.rglob(".part-*"))
    assert all(read_image(path).numel() for path in (killed / "pictures").glob("*.png"))
    steps = [row["step"] for row in read_metrics(killed)]
    assert steps == sorted(steps)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("genrator: {}", "unknown key 'genrator'; did you mean 'generator'?"),
        ("generator: {widht: 3}", "unknown key 'generator.widht'; did you mean 'width'?"),
        ("loop: {steps: many}", "steps"),
    ],
)
def test_a_misspelt_config_names_its_nearest_setting(
    pairs: Path, tmp_path: Path, text: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "c.yaml").write_text(text)
    words = ["depth", "train", "view", "--config", str(tmp_path / "c.yaml"), "--data", str(pairs)]
    assert main([*words, "--out", str(tmp_path / "run")]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "adam", "otherwise"),
    [
        (("depth", "train", "view"), "discriminator_adam", "there is nothing to train on"),
        (("pose", "train"), "adam", "there is no object to learn"),
    ],
)
def test_a_warm_up_longer_than_the_training_is_refused(
    command: tuple[str, ...],
    adam: str,
    otherwise: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = tmp_path / "c.yaml"
    words = [*command, "--config", str(config), "--out", str(tmp_path / "run")]
    config.write_text(f"{adam}: {{warmup_steps: 9}}\nloop: {{steps: 8}}\n")
    assert main(words) == 2
    assert f"{adam}.warmup_steps is 9, but loop.steps is 8, so" in capsys.readouterr().err
    assert main([*words, "--resume"]) == 2
    assert otherwise in capsys.readouterr().err, "the config of a run that goes on stays"
    config.write_text(f"{adam}: {{warmup_steps: 8}}\nloop: {{steps: 8}}\n")
    assert main([*words, "--steps", "4"]) == 2
    assert otherwise in capsys.readouterr().err, "a try may be shorter"
    config.write_text(f"{adam}: {{warmup_steps: 9}}\nloop: {{steps: 8}}\n")
    assert main([*words, "--steps", "9"]) == 2
    assert otherwise in capsys.readouterr().err, "or longer than the config says"


def test_words_of_another_stage_are_refused(
    pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["depth", "train", "stereo", "--data", str(pairs), "--out", str(tmp_path / "run")]
    assert main([*words, "--generator", "default"]) == 2
    assert "--generator has no meaning for 'stereo'" in capsys.readouterr().err


def test_an_evaluation_after_a_change_of_its_inputs_is_refused(
    home: Path, pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    shutil.copytree(pairs, data)
    words = [
        "depth",
        "evaluate",
        "--data",
        str(data),
        "--protocol",
        "kitti-2015",
        "--out",
        str(out),
    ]
    measure = [*words, "--weights", str(home / "m.safetensors")]
    assert main(measure) == 0
    assert main(measure) == 0
    calibration = data / "calib.txt"
    before = calibration.read_text()
    calibration.write_text(f"{before}\n")
    assert main(measure) == 2
    assert f"{calibration}: has changed since its result" in capsys.readouterr().err


def test_a_matcher_of_pairs_is_refused_on_frames_without_a_right_view(
    home: Path, pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    shutil.copytree(pairs, data, ignore=shutil.ignore_patterns("right"))
    words = ["depth", "evaluate", "--data", str(data), "--protocol", "kitti-2015"]
    weights = ["--weights", str(home / "w.safetensors"), f"quick:{home / 'm.safetensors'}"]
    assert main([*words, *weights, "--out", str(tmp_path / "out")]) == 2
    assert "m-quick matches both views, and data has no right view" in capsys.readouterr().err
    assert not (tmp_path / "out" / "w").exists()  # before any work


def test_methods_of_one_name_are_refused(
    home: Path, pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "other").mkdir()
    other = shutil.copy(home / "m.safetensors", tmp_path / "other")
    words = ["depth", "evaluate", "--data", str(pairs), "--protocol", "kitti-2015"]
    weights = ["--weights", str(home / "m.safetensors"), other]
    assert main([*words, *weights, "--out", str(tmp_path / "out")]) == 2
    assert "two methods are called 'm'" in capsys.readouterr().err


def test_confidence_of_an_earlier_method_does_not_stay(
    home: Path, pairs: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    words = ["depth", "evaluate", "--data", str(pairs), "--protocol", "kitti-2015"]
    assert main([*words, "--weights", str(home / "m.safetensors"), "--out", str(out)]) == 0
    assert (out / "confidence.csv").is_file()
    others = tmp_path / "others"
    others.mkdir()
    (disparity,) = out.rglob("a.disparity_px.npy")
    shutil.copy(disparity, others)
    assert main([*words, "--predictions", str(others), "--out", str(out)]) == 0
    assert not list(out.glob("confidence.*"))


def test_pairs_in_folders_go_by_name(tmp_path: Path) -> None:
    for name in ("left/x/1.png", "left/y/0.png", "right/0.png", "right/1.png"):
        write_image(tmp_path / name, torch.rand(3, 20, 30))
    pairs = list_pairs(str(tmp_path / "left/*/*.png"), str(tmp_path / "right"))
    assert [(left.stem, right.stem) for left, right in pairs] == [("1", "1"), ("0", "0")]
