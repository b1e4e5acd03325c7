"""The page without a browser: what it answers, what it refuses, what it leaves behind."""

import io
import json
import tempfile
import threading
import time
import zipfile
from base64 import b64decode
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from httpx2 import Response
from starlette.testclient import TestClient
from tests.depth.constant_selection import sure_of
from tests.pose.synthetic_objects import CAMERA, pose_at, view_of
from tests.web.samples import PART, write_street, write_view

from depthpose.core.camera import write_camera
from depthpose.core.files import read_image, write_depth_png, write_image, write_map
from depthpose.core.rigid import Rigid
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.stereo import CallableMatcher, LightMatcher
from depthpose.depth.synthesis import make_synthesiser
from depthpose.pose.metrics import adds_m
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.synthetic import make_part
from depthpose.web import Limits, make_app
from depthpose.web import pose as pose_tab

URL = "http://127.0.0.1:8000"


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_street(tmp_path_factory.mktemp("samples"))


@pytest.fixture(scope="module")
def truth(samples: Path) -> Rigid:
    return write_view(samples)


@pytest.fixture(scope="module")
def nets() -> tuple[FakestereoNet, GeoPoseNet]:
    return FakestereoNet.load("default"), GeoPoseNet.load("parts")


@pytest.fixture(scope="module")
def page(nets: tuple[FakestereoNet, GeoPoseNet]) -> Iterator[TestClient]:
    with TestClient(make_app(*nets), base_url=URL) as client:
        yield client


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Whatever a test does, nothing may be left where temporary files go."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield folder
    assert not list(folder.iterdir())


def ask(
    client: TestClient, kind: str, folder: Path, names: dict[str, str], **data: str
) -> Response:
    files = {field: (name, (folder / name).read_bytes()) for field, name in names.items()}
    return client.post(f"/estimate/{kind}", files=files, data=data)


def refusal(response: Response) -> tuple[int, str]:
    return response.status_code, response.json()["error"]


VIEW = {"depth": "depth.png", "mask": "mask.png", "camera": "view.json"}
VIEW_ALONE = {"depth": "depth.png", "camera": "view.json"}


def test_the_page_loads_nothing_from_elsewhere(page: TestClient) -> None:
    response = page.get("/")
    texts = [response.text]
    texts += [page.get(f"/assets/{name}").text for name in ("page.css", "viewer.js", "web.js")]
    assert all("://" not in text for text in texts)
    assert "default-src 'none'" in response.headers["content-security-policy"]
    for name in GeoPoseNet.load("parts").objects:
        assert f"<option>{name}</option>" in texts[0]


def test_one_image_becomes_the_depth_that_python_gives(
    page: TestClient, samples: Path, nets: tuple[FakestereoNet, GeoPoseNet]
) -> None:
    found = ask(page, "depth", samples, {"image": "left.png", "camera": "camera.json"}).json()
    assert found["ok"]
    names = [file["name"] for file in found["files"]]
    assert {"left.depth_m.npy", "left.right.png", "left.confidence.png", "left.cloud.ply"} <= set(
        names
    )
    assert found["scene"]["layers"][0]["count"] > 1000
    data = page.get("/" + found["folder"] + "left.depth_m.npy").content
    expected = nets[0].estimate(samples / "left.png", samples / "camera.json").depth_m
    assert expected is not None
    assert np.array_equal(np.load(io.BytesIO(data)), expected.numpy(), equal_nan=True)
    whole = zipfile.ZipFile(io.BytesIO(page.get("/" + found["folder"] + "all.zip").content))
    assert whole.namelist() == names
    assert whole.read("left.depth_m.npy") == data


def test_a_guess_is_not_coloured_as_a_good_answer(
    nets: tuple[FakestereoNet, GeoPoseNet], tmp_path: Path
) -> None:
    """A portrait had the warning twice, beside a green bar."""
    write_image(tmp_path / "noise.png", torch.rand(3, 94, 310, generator=torch.manual_seed(0)))
    guessing = FakestereoNet.load("default", allow_ood=True)
    with TestClient(make_app(guessing, nets[1]), base_url=URL) as client:
        found = ask(client, "depth", tmp_path, {"image": "noise.png"}, focal_px="180").json()
    assert not found["ok"]
    assert found["sentence"].startswith("Careful: out of distribution")
    assert "warning" not in dict(found["facts"])


def test_fields_do_what_a_camera_file_does(page: TestClient, samples: Path) -> None:
    fields = {"focal_px": "180.5", "cx_px": "150.25", "cy_px": "44.5"}
    camera = json.loads((samples / "camera.json").read_text())
    camera["K"] = [[180.5, 0, 150.25], [0, 180.5, 44.5], [0, 0, 1]]
    (samples / "square.json").write_text(json.dumps(camera))
    by_file = ask(page, "depth", samples, {"image": "left.png", "camera": "square.json"}).json()
    by_fields = ask(page, "depth", samples, {"image": "left.png"}, **fields).json()
    # A file that says no size, as many do, gets that of the image.
    (samples / "bare.txt").write_text("180.5 180.5 150.25 44.5")
    bare = ask(page, "depth", samples, {"image": "left.png", "camera": "bare.txt"}).json()
    answers = (by_file, by_fields, bare)
    ways = [page.get("/" + a["folder"] + "left.cloud.ply").content for a in answers]
    assert ways[0] == ways[1] == ways[2]


@pytest.mark.slow
def test_the_field_says_the_baseline_where_the_camera_file_has_none(
    page: TestClient, tmp_path: Path
) -> None:
    samples = write_street(tmp_path / "street", scale=0.125)
    rig = json.loads((samples / "camera.json").read_text())
    baseline_m = str(rig.pop("baseline_m"))
    (samples / "one.json").write_text(json.dumps(rig))
    clouds = []
    for name, fields in (
        ("camera.json", {"baseline_m": "9"}),  # its own counts
        ("one.json", {"baseline_m": baseline_m}),
        ("one.json", {"baseline_m": baseline_m, "cx_right_minus_left_px": "20"}),
    ):
        found = ask(page, "depth", samples, {**PAIR, "camera": name}, **fields).json()
        clouds.append(page.get("/" + found["folder"] + "left.cloud.ply").content)
    assert clouds[0] == clouds[1] != clouds[2]
    for fields, remedy in (
        ({}, "baseline"),
        ({"baseline_m": "12"}, "looks like centimetres; divide by 100"),
    ):
        status, said = refusal(
            ask(page, "depth", samples, {**PAIR, "camera": "one.json"}, **fields)
        )
        assert status == 400
        assert remedy in said


def test_the_field_says_the_unit_where_the_camera_file_has_no_word_for_it(
    page: TestClient, samples: Path, truth: Rigid
) -> None:
    camera = json.loads((samples / "view.json").read_text())
    K, unit_m = camera["K"], str(camera["depth_unit_m"])
    (samples / "bare.txt").write_text(f"{K[0][0]} {K[1][1]} {K[0][2]} {K[1][2]}")
    files = {**VIEW, "camera": "bare.txt"}
    found = ask(page, "pose", samples, files, object=PART, depth_unit_m=unit_m).json()
    assert_posed(page, found, truth, "depth")


def test_what_is_sent_in_chunks_has_no_size(page: TestClient) -> None:
    headers = {"content-length": "5", "transfer-encoding": "chunked"}
    response = page.post("/estimate/depth", headers=headers, content=b"x" * 5)
    status, said = refusal(response)
    assert status == 411
    assert "comes in chunks" in said


def test_a_guessed_focal_length_is_called_a_guess(page: TestClient, samples: Path) -> None:
    facts = dict(ask(page, "depth", samples, {"image": "left.png"}).json()["facts"])
    assert "guessed" in facts["focal length"]


PAIR = {"image": "left.png", "right": "right.png"}


@pytest.mark.parametrize(
    ("files", "data", "said"),
    [
        ({"right": "right.png"}, {}, "image: no file; choose a picture"),
        (PAIR, {}, "fill in the baseline in metres"),
        (PAIR, {"baseline_m": "120"}, "looks like millimetres; divide by 1000"),
        ({"image": "camera.json"}, {}, "'camera.json' is not a picture"),
        ({"image": "left.png", "camera": "left.png"}, {}, "is not a camera file"),
        ({"image": "left.png"}, {"focal_px": "wide"}, "focal_px is 'wide'; write a number"),
        ({"image": "left.png"}, {"focal_px": "4.2"}, "it looks like millimetres"),
        ({"image": "left.png"}, {"near_m": "9", "far_m": "3"}, "the colours go from 9 m to 3 m"),
    ],
)
def test_depth_refuses_with_a_remedy(
    page: TestClient, samples: Path, files: dict[str, str], data: dict[str, str], said: str
) -> None:
    status, text = refusal(ask(page, "depth", samples, files, **data))
    assert status == 400
    assert said in text
    assert tempfile.gettempdir() not in text


def test_a_damaged_file_is_named_and_nothing_of_ours_is_shown(
    page: TestClient, samples: Path
) -> None:
    sent = {"image": ("street.png", b"no picture")}
    status, text = refusal(page.post("/estimate/depth", files=sent, data={"focal_px": "500"}))
    assert status == 400
    assert text.startswith("street.png: not a readable picture")
    assert "0x" not in text
    assert "BytesIO" not in text


def test_a_focal_length_that_asks_for_a_huge_picture_is_refused(
    page: TestClient, samples: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("depthpose.web.depth._MAX_NETWORK_PIXELS", 1000)
    status, text = refusal(ask(page, "depth", samples, {"image": "left.png"}))
    assert (status, "more than this page computes" in text) == (400, True)


def test_weights_that_match_pairs_as_they_are_have_a_limit_too(
    nets: tuple[FakestereoNet, GeoPoseNet], samples: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: torch.Tensor) -> torch.Tensor:
        raise AssertionError("the work began")

    monkeypatch.setattr("depthpose.web.depth._MAX_NETWORK_PIXELS", 20_000)
    app = make_app(FakestereoNet(CallableMatcher(never)), nets[1])
    files = {**PAIR, "camera": "camera.json"}
    status, text = refusal(ask(TestClient(app, base_url=URL), "depth", samples, files))
    assert status == 400
    camera = json.loads((samples / "camera.json").read_text())
    assert text == (
        f"left has {camera['width']}x{camera['height']} pixels; these weights match pairs as they "
        "are, and this page computes 0.02 million at most; scale both images down, and the focal "
        "length with them, or use the command line"
    )


def test_the_matcher_may_want_a_larger_picture_than_the_generator(
    nets: tuple[FakestereoNet, GeoPoseNet], samples: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synthesiser = make_synthesiser(sure_of(3, "matched"))
    monkeypatch.setattr(LightMatcher, "work_size", lambda *_: (100 * 47, 100 * 155))
    app = make_app(FakestereoNet(nets[0].matcher, synthesiser), nets[1])
    files = {"image": "left.png", "camera": "camera.json"}
    status, text = refusal(ask(TestClient(app, base_url=URL), "depth", samples, files))
    assert (status, "more than this page computes" in text) == (400, True)


def page_without_matcher(plane: int, nets: tuple[FakestereoNet, GeoPoseNet]) -> TestClient:
    net = FakestereoNet(None, make_synthesiser(sure_of(plane)))
    return TestClient(make_app(net, nets[1]), base_url=URL)


def test_weights_without_a_matcher_answer_one_image_and_refuse_a_pair(
    nets: tuple[FakestereoNet, GeoPoseNet], samples: Path, page: TestClient
) -> None:
    client = page_without_matcher(3, nets)
    html = client.get("/").text
    assert "One image to depth in metres." in html
    assert 'name="right"' not in html
    assert 'name="right"' in page.get("/").text
    one = {"image": "left.png", "camera": "camera.json"}
    found = ask(client, "depth", samples, one).json()
    assert found["sentence"].endswith(" m. 0% are sky.")
    picture, depth = found["pictures"][:2]
    assert picture["caption"] == "the image"
    assert picture["size"] == depth["size"]
    assert "grey: sky or no answer" in depth["caption"]
    assert depth["scale"]["title"] == "depth [m]"
    assert [depth["scale"]["marks"][k] for k in (0, -1)] == [[0.0, "3"], [1.0, "80"]]
    assert 'placeholder="0.54"' not in html, "the value that makes depths 1.4 % too large"
    status, text = refusal(ask(client, "depth", samples, {**one, "right": "right.png"}))
    assert (status, "take one image alone: remove the right image" in text) == (400, True)


def test_examples_are_what_the_forms_take(page: TestClient, tmp_path: Path) -> None:
    for kind, named in (("depth", "camera image right"), ("pose", "camera depth mask")):
        found = page.get(f"/examples/{kind}").json()
        assert sorted(one["field"] for one in found["files"]) == named.split()
        for one in found["files"]:
            (tmp_path / one["name"]).write_bytes(b64decode(one["data"]))
        files = {one["field"]: one["name"] for one in found["files"]}
        answer = ask(page, kind, tmp_path, files, **found["fields"]).json()
        assert answer["ok"], answer["sentence"]
    assert page.get("/examples/kitchen").status_code == 404


def test_a_picture_of_the_sky_alone_is_said_to_be_one(
    nets: tuple[FakestereoNet, GeoPoseNet], samples: Path
) -> None:
    files = {"image": "left.png", "camera": "camera.json"}
    found = ask(page_without_matcher(0, nets), "depth", samples, files).json()
    assert found["sentence"] == (
        "No pixel got a depth from one image; 100% of the image is taken for sky."
    )
    assert found["scene"]["layers"][0]["count"] == 0
    assert "left.sky.png" in [file["name"] for file in found["files"]]


def test_terms_of_the_weights_stand_beside_the_answer(
    nets: tuple[FakestereoNet, GeoPoseNet], samples: Path, truth: Rigid, page: TestClient
) -> None:
    depth, pose = nets
    facts = {**pose.weights.facts, "terms": "For tests alone."}
    bound = make_app(
        FakestereoNet(depth.matcher, depth.synthesiser, terms="For research alone."),
        GeoPoseNet(replace(pose.weights, facts=facts)),
    )
    client = TestClient(bound, base_url=URL)
    image = {"image": "left.png", "camera": "camera.json"}
    assert ask(client, "depth", samples, image).json()["terms"] == "For research alone."
    assert ask(client, "pose", samples, VIEW, object=PART).json()["terms"] == "For tests alone."
    assert ask(page, "depth", samples, image).json()["terms"] == ""
    assert ask(page, "pose", samples, VIEW, object=PART).json()["terms"] == ""


def test_the_network_is_asked_once(
    nets: tuple[FakestereoNet, GeoPoseNet],
    samples: Path,
    truth: Rigid,
    page: TestClient,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[int] = []
    run_network = nets[1]._run_network

    def counted(*words: Any) -> Any:  # noqa: ANN401
        asked.append(1)
        return run_network(*words)

    monkeypatch.setattr(nets[1], "_run_network", counted)
    found = ask(page, "pose", samples, VIEW, object=PART).json()
    assert "votes" in [layer["name"] for layer in found["scene"]["layers"]]
    assert asked == [1]


def test_a_picture_of_too_many_pixels_is_refused(
    page: TestClient, samples: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("depthpose.web.answer.MAX_PIXELS", 1000)
    assert "scale it down" in refusal(ask(page, "depth", samples, {"image": "left.png"}))[1]


@pytest.mark.parametrize("suffix", ["npy", "pfm"])
def test_a_depth_map_of_floats_has_the_limit_of_a_picture(
    page: TestClient, tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("depthpose.web.answer.MAX_PIXELS", 1000)
    name = f"d.{suffix}"
    for columns, said in ((50, "focal length: without it"), (51, f"{name} has 51x20 pixels")):
        write_map(tmp_path / name, torch.ones(20, columns))
        response = ask(page, "pose", tmp_path, {"depth": name}, object=PART)
        assert refusal(response)[1].startswith(said)


def assert_right(page: TestClient, found: dict[str, Any], truth: Rigid, name: str) -> None:
    assert found["ok"], found["sentence"]
    (row,) = json.loads(page.get("/" + found["folder"] + "poses.json").content)
    T = torch.tensor(row["camera_from_model"])
    model = make_part(PART)
    off_m = adds_m(Rigid(T[:3, :3], T[:3, 3]), truth, model.vertices_m)
    assert float(off_m) < model.diameter_m / 20
    assert row["name"] == name


def assert_posed(page: TestClient, found: dict[str, Any], truth: Rigid, name: str) -> None:
    assert_right(page, found, truth, name)
    layers = {layer["name"]: layer for layer in found["scene"]["layers"]}
    assert layers["the object, as seen"]["count"] > 100
    assert layers["posed model"]["count"] > 1000
    assert layers["votes"]["count"] > 100
    assert len(found["tables"]) == 3


def test_a_depth_image_is_posed(page: TestClient, samples: Path, truth: Rigid) -> None:
    found = ask(page, "pose", samples, VIEW, object=PART).json()
    assert_posed(page, found, truth, "depth")
    assert [file["name"] for file in found["files"]] == [
        "depth.pose.ply",
        "depth.pose.png",
        "poses.json",
    ]


def test_boxes_of_a_detector_take_the_place_of_a_mask(
    page: TestClient, samples: Path, truth: Rigid, tmp_path: Path
) -> None:
    rows, columns = (read_image(samples / "mask.png")[0] > 0.5).nonzero().unbind(1)
    left, top = int(columns.min()) - 2, int(rows.min()) - 2
    bottom = int(rows.max()) + 3
    box = f"{left},{top},{int(columns.max()) + 3},{bottom}"
    files = {"depth": "depth.png", "camera": "view.json"}
    found = ask(page, "pose", samples, files, object=PART, box=box).json()
    assert_right(page, found, truth, "depth")
    (picture,) = found["pictures"]
    assert picture["caption"] == "depth image, near bright, with the posed model, boxes yellow"
    (tmp_path / "shown.png").write_bytes(page.get("/" + found["folder"] + picture["file"]).content)
    # The lower left corner: the box about the posed model is drawn over the upper one.
    red, green, blue = read_image(tmp_path / "shown.png")[:, bottom - 1, left].tolist()
    assert min(red, green) > 0.7, "the corner of the box is yellow"
    assert blue < 0.3
    both = ask(page, "pose", samples, files, object=PART, box=f"{box} 0,0,20,20").json()
    _, *shown = both["tables"]["found in this image"]
    assert [row[0] for row in shown] == ["depth_1", "depth_2"], "the refused one has a row"


@pytest.mark.parametrize(
    ("files", "box", "said"),
    [
        (VIEW, "1,2,30,40", "take it out where a mask or a cloud"),
        ({"depth": "depth.png", "camera": "view.json"}, "1,2,3", "box '1,2,3' is not X0,Y0,X1,Y1"),
        (
            {"depth": "depth.png", "camera": "view.json"},
            "900,1,990,50",
            "lies outside of the image",
        ),
    ],
)
def test_boxes_that_cannot_be_say_why(
    page: TestClient, samples: Path, files: dict[str, str], box: str, said: str
) -> None:
    assert said in ask(page, "pose", samples, files, object=PART, box=box).json()["error"]


def test_a_cloud_in_millimetres_is_posed_by_a_cad_file_that_the_weights_know(
    page: TestClient, samples: Path, truth: Rigid
) -> None:
    files = {"cloud": "cloud.ply", "cad": f"{PART}.stl"}
    data = {"cloud_unit": "mm", "object": "cad", "cad_unit": "mm"}
    found = ask(page, "pose", samples, files, **data).json()
    assert_posed(page, found, truth, "cloud")
    assert dict(found["facts"])["by"] == f"network; the CAD file is the weights' '{PART}'"


def test_another_object_is_refused_in_words(page: TestClient, samples: Path, truth: Rigid) -> None:
    found = ask(page, "pose", samples, VIEW, object="spool").json()
    assert not found["ok"]
    assert found["sentence"].startswith("Refused (")
    assert found["tables"] == {}
    assert [file["name"] for file in found["files"]] == [
        "depth.pose.ply",
        "depth.pose.png",
        "poses.json",
    ]
    seen = page.get("/" + found["folder"] + "depth.pose.ply").content
    layers = {layer["name"]: layer for layer in found["scene"]["layers"]}
    count = layers["the object, as seen"]["count"]
    assert f"element vertex {count}\n".encode() in seen
    assert "posed model" not in [layer["name"] for layer in found["scene"]["layers"]]


def test_a_depth_image_without_a_mask_is_searched(
    page: TestClient, samples: Path, truth: Rigid
) -> None:
    found = ask(page, "pose", samples, VIEW_ALONE, object=PART).json()
    (row,) = json.loads(page.get("/" + found["folder"] + "poses.json").content)
    assert row["object"] == PART
    assert row["status"] == "ok", row["reason"]
    off_m = torch.tensor(row["camera_from_model"])[:3, 3] - truth.t_m
    assert float(off_m.norm()) < 0.005


def test_every_instance_of_an_image_is_shown_and_taken_away(
    page: TestClient, tmp_path: Path
) -> None:
    """Two of one part, side by side: a row, a layer and a file for each, one zip of all."""
    poses = (pose_at(-0.1, 0.5, seed=1), pose_at(0.1, 0.55, seed=2))
    seen, mask = view_of(make_part(PART), *poses)
    wall = torch.full(mask.shape, 1.2)
    write_depth_png(tmp_path / "depth.png", torch.where(mask, seen.float(), wall), 0.0001)
    write_camera(tmp_path / "view.json", replace(CAMERA, depth_unit_m=0.0001))
    found = ask(page, "pose", tmp_path, VIEW_ALONE, object=PART).json()
    names = [row[0] for row in found["tables"]["found in this image"][1:]]
    assert names == ["depth_0", "depth_1"]
    files = {one["name"] for one in found["files"]}
    assert files == {"poses.json", "depth.pose.png", "depth_0.pose.ply", "depth_1.pose.ply"}
    assert "depth_1" in [layer["name"] for layer in found["scene"]["layers"]]
    zipped = zipfile.ZipFile(io.BytesIO(page.get("/" + found["folder"] + "all.zip").content))
    assert set(zipped.namelist()) == files
    rows = json.loads(zipped.read("poses.json"))
    places = torch.tensor([row["camera_from_model"] for row in rows])[:, :3, 3]
    assert float((places[0] - places[1]).norm()) > 0.1


def test_what_the_empty_frame_shows_is_not_found(page: TestClient, tmp_path: Path) -> None:
    """Of two of one part the empty frame shows one, which then belongs to the table."""
    seen, mask = view_of(make_part(PART), pose_at(-0.1, 0.5, seed=1), pose_at(0.1, 0.55, seed=2))
    wall = torch.full(mask.shape, 1.2)
    depth_m = torch.where(mask, seen.float(), wall)
    left = torch.arange(mask.shape[1]) < mask.shape[1] // 2
    write_depth_png(tmp_path / "depth.png", depth_m, 0.0001)
    write_depth_png(tmp_path / "empty.png", torch.where(left, depth_m, wall), 0.0001)
    write_camera(tmp_path / "view.json", replace(CAMERA, depth_unit_m=0.0001))
    names = VIEW_ALONE | {"empty_frame": "empty.png"}
    answer = ask(page, "pose", tmp_path, names, object=PART).json()
    (row,) = json.loads(page.get("/" + answer["folder"] + "poses.json").content)
    assert row["status"] == "ok", row["reason"]
    assert row["camera_from_model"][0][3] > 0

    write_depth_png(tmp_path / "empty.png", wall[:-1], 0.0001)
    status, message = refusal(ask(page, "pose", tmp_path, names, object=PART))
    assert status == 400
    assert "take both by one camera" in message


@pytest.mark.parametrize(
    ("files", "data", "said"),
    [
        ({"depth": "depth.png"}, {"object": PART}, "focal length: without it a depth image"),
        ({"depth": "depth.png", "mask": "mask.png"}, {"object": PART}, "focal length: without it"),
        (VIEW | {"mask": "left.png"}, {"object": PART}, "give the mask of this very image"),
        (VIEW, {"object": "teapot"}, "object 'teapot': the weights know"),
        (VIEW | {"cloud": "cloud.ply"}, {"object": PART, "cloud_unit": "mm"}, "choose one of"),
        ({"cloud": "cloud.ply"}, {"object": PART, "cloud_unit": "feet"}, "Known: 'cm', 'm', 'mm'"),
        (VIEW, {"object": "cad", "cad_unit": "mm"}, "cad: no file; choose a model file"),
        (
            VIEW | {"cad": f"{PART}.stl"},
            {"object": PART},
            f"object '{PART}' and the CAD file {PART}.stl are both given; choose 'the CAD file",
        ),
    ],
)
def test_pose_refuses_with_a_remedy(
    page: TestClient,
    samples: Path,
    truth: Rigid,
    files: dict[str, str],
    data: dict[str, str],
    said: str,
) -> None:
    status, text = refusal(ask(page, "pose", samples, files, **data))
    assert status == 400
    assert said in text


@pytest.mark.parametrize("files", [VIEW, VIEW_ALONE])
def test_a_cad_file_that_no_weights_know_is_registered(
    samples: Path,
    truth: Rigid,
    monkeypatch: pytest.MonkeyPatch,
    page: TestClient,
    files: dict[str, str],
) -> None:
    monkeypatch.setattr(pose_tab, "_MAX_SHAPE_DIFFERENCE", -1.0)
    cad = {"cad": f"{PART}.stl"}
    found = ask(page, "pose", samples, files | cad, object="cad", cad_unit="mm").json()
    assert dict(found["facts"])["by"].startswith("the CAD file alone")
    assert found["ok"], found["sentence"]
    assert found["terms"] == ""
    (row,) = json.loads(page.get("/" + found["folder"] + "poses.json").content)
    T = torch.tensor(row["camera_from_model"])
    off_m = adds_m(Rigid(T[:3, :3], T[:3, 3]), truth, make_part(PART).vertices_m)
    assert float(off_m) < 0.005


@pytest.mark.slow
def test_another_part_than_the_cad_file_is_refused(
    samples: Path, truth: Rigid, page: TestClient
) -> None:
    (samples / "rod.obj").write_text(
        "v 0 0 0\nv 0.5 0 0\nv 0 0.02 0\nv 0 0 0.02\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    files = VIEW | {"cad": "rod.obj"}
    found = ask(page, "pose", samples, files, object="cad", cad_unit="m").json()
    assert not found["ok"]
    assert found["sentence"].startswith("Refused")


def test_what_is_too_large_is_refused_before_it_is_read(
    nets: tuple[FakestereoNet, GeoPoseNet], samples: Path
) -> None:
    client = TestClient(make_app(*nets, Limits(upload_bytes=10_000)), base_url=URL)
    status, text = refusal(ask(client, "depth", samples, {"image": "left.png"}))
    assert status == 413
    assert "more than the 0 MB allowed" in text
    assert "--max-upload-mb" in text


def test_a_request_without_a_size_is_refused(page: TestClient) -> None:
    response = page.post("/estimate/depth", content=iter([b"data"]))
    assert refusal(response) == (
        411, "the request has no Content-Length, or comes in chunks; send it whole, with its size"
    )  # fmt: skip


def test_requests_from_other_hosts_are_refused(page: TestClient) -> None:
    status, text = refusal(page.get("/", headers={"host": "evil.example"}))
    assert (status, "not to 'evil.example'" in text) == (403, True)
    assert refusal(page.get("/", headers={"host": "[::1"}))[0] == 403
    assert refusal(page.post("/estimate/depth", headers={"origin": "null"}))[0] == 403
    status, text = refusal(page.post("/estimate/depth", headers={"origin": "http://evil.example"}))
    assert (status, "comes from another page" in text) == (403, True)
    assert page.get("/", headers={"origin": URL}).status_code == 200


def test_a_page_that_is_open_to_all_answers_to_any_name(
    nets: tuple[FakestereoNet, GeoPoseNet],
) -> None:
    client = TestClient(make_app(*nets, Limits(hosts=None)), base_url="http://robot.local:8000")
    assert client.get("/").status_code == 200


def test_only_the_last_answers_are_kept(page: TestClient, samples: Path, truth: Rigid) -> None:
    first, *_, last = [
        ask(page, "pose", samples, {"cloud": "cloud.ply"}, object=PART, cloud_unit="m").json()
        for _ in range(4)
    ]
    assert refusal(page.get("/" + first["folder"] + "poses.json"))[0] == 404
    assert page.get("/" + last["folder"] + "poses.json").status_code == 200
    assert refusal(page.get("/" + last["folder"] + "..%2Fother"))[0] == 404


def test_unknown_kinds_and_fields_are_refused(page: TestClient, samples: Path) -> None:
    assert refusal(ask(page, "sound", samples, {}, a="b"))[0] == 404
    said = refusal(ask(page, "depth", samples, {"weights": "left.png"}))[1]
    assert "'weights' is no file field of this page" in said


class Slow:
    """A matcher that waits for a word, and knows how many are at work."""

    def __init__(self) -> None:
        self.goes_on, self.began = threading.Event(), threading.Event()
        self.active, self.most = 0, 0

    def __call__(self, left: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
        self.active += 1
        self.most = max(self.most, self.active)
        self.began.set()
        assert self.goes_on.wait(60)
        self.active -= 1
        return torch.full(left.shape[1:], 8.0)


@pytest.mark.parametrize(("waiting", "statuses"), [(0, [200, 503]), (1, [200, 200])])
def test_one_computation_at_a_time(
    nets: tuple[FakestereoNet, GeoPoseNet], samples: Path, waiting: int, statuses: list[int]
) -> None:
    slow = Slow()
    app = make_app(FakestereoNet(CallableMatcher(slow)), nets[1], Limits(waiting=waiting))
    files = {**PAIR, "camera": "camera.json"}
    with TestClient(app, base_url=URL) as client, ThreadPoolExecutor(2) as pool:
        first = pool.submit(ask, client, "depth", samples, files)
        assert slow.began.wait(60)
        second = pool.submit(ask, client, "depth", samples, files)
        if waiting == 0:
            assert "try again later" in refusal(second.result(60))[1]
        slow.goes_on.set()
        found = [first.result(60).status_code, second.result(60).status_code]
    assert found == statuses
    assert slow.most == 1


def test_a_computation_that_takes_too_long_is_stopped_and_the_next_one_is_done(
    nets: tuple[FakestereoNet, GeoPoseNet], samples: Path
) -> None:
    calls = list[int]()
    stopped = threading.Event()

    def endless(left: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
        calls.append(1)
        try:
            while len(calls) == 1:
                time.sleep(0.01)
        finally:
            stopped.set()
        return torch.full(left.shape[1:], 8.0)

    app = make_app(FakestereoNet(CallableMatcher(endless)), nets[1], Limits(compute_s=1.0))
    files = {**PAIR, "camera": "camera.json"}
    with TestClient(app, base_url=URL) as client:
        status, text = refusal(ask(client, "depth", samples, files))
        assert status == 503
        assert text.startswith("the computation took more than 1 s and was stopped; send a smaller")
        assert stopped.is_set(), "it does not go on beside the next one"
        assert ask(client, "depth", samples, files).status_code == 200


@pytest.mark.parametrize("digits", [18, 19, 4401])
def test_a_size_of_any_number_of_digits_is_refused(page: TestClient, digits: int) -> None:
    found = page.post("/estimate/depth", headers={"Content-Length": "9" * digits}, content=b"")
    status, text = refusal(found)
    assert status == 413
    assert "more than the 64 MB allowed" in text


def test_a_fault_of_ours_is_said_and_leaves_nothing(
    nets: tuple[FakestereoNet, GeoPoseNet], samples: Path
) -> None:
    def broken(*_: torch.Tensor) -> torch.Tensor:
        raise RuntimeError("no memory")

    app = make_app(FakestereoNet(CallableMatcher(broken)), nets[1])
    client = TestClient(app, base_url=URL, raise_server_exceptions=False)
    status, text = refusal(ask(client, "depth", samples, {**PAIR, "camera": "camera.json"}))
    assert status == 500
    assert "RuntimeError: no memory" in text
