import re
from pathlib import Path

import pytest
import torch

from depthpose.core.camera import Camera, StereoRig, write_camera
from depthpose.core.errors import InputError
from depthpose.web.answer import Form, remove_paths, write_upload


def form(folder: Path, **fields: str) -> Form:
    return Form(folder=folder, fields=fields, files={})


@pytest.mark.parametrize(
    ("sent", "kept"),
    [
        ("street.png", "street.png"),
        ("../../etc/street.PNG", "street.PNG"),
        ("C:\\photos\\my street.jpg", "my_street.jpg"),
        ("..hidden.png", "hidden.png"),
        ("straße 深.png", "stra_e_.png"),
        ("a" * 200 + ".png", "a" * 60 + ".png"),
    ],
)
def test_a_file_keeps_a_harmless_name_in_its_own_folder(
    tmp_path: Path, sent: str, kept: str
) -> None:
    path = write_upload(tmp_path, "image", sent, b"bytes")
    assert path == tmp_path / "image" / kept
    assert path.read_bytes() == b"bytes"


@pytest.mark.parametrize("sent", ["street.exe", "street", ".png", "street.png.sh"])
def test_another_type_is_refused_with_those_that_are_taken(tmp_path: Path, sent: str) -> None:
    with pytest.raises(InputError, match=r"image: '.*' is not a picture; this field takes \.png"):
        write_upload(tmp_path, "image", sent, b"")
    assert not list(tmp_path.iterdir())


def test_a_field_that_no_form_has_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'weights' is no file field of this page"):
        write_upload(tmp_path, "weights", "a.png", b"")


def test_numbers_are_read_as_people_type_them(tmp_path: Path) -> None:
    sent = form(tmp_path, a=" 0.54 ", b="0,54", c="", d="  ")
    assert [sent.read_number(name) for name in "abcde"] == [0.54, 0.54, None, None, None]


@pytest.mark.parametrize("text", ["half", "nan", "inf", "1e999", "1 2"])
def test_what_is_no_number_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match=re.escape(f"far is {text!r}; write a number")):
        form(tmp_path, far=text).read_number("far")


def test_a_missing_file_says_what_is_wanted(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"mask: no file; choose a mask \(\.png"):
        form(tmp_path).require_file("mask")


def test_fields_and_a_file_make_the_same_camera(tmp_path: Path) -> None:
    K = torch.tensor([[700.0, 0, 300], [0, 700, 100], [0, 0, 1]], dtype=torch.float64)
    rig = StereoRig(width=640, height=200, K=K, baseline_m=0.5)
    write_camera(tmp_path / "rig.json", rig)
    sent = Form(folder=tmp_path, fields={}, files={"camera": tmp_path / "rig.json"})
    keys = {"width": 640, "height": 200, "K": K.tolist(), "baseline_m": 0.5, "depth_unit_m": None}
    for found in (sent.make_camera({}), form(tmp_path).make_camera(keys)):
        assert isinstance(found, StereoRig)
        assert torch.equal(found.K, K)
        assert (found.width, found.height, found.baseline_m) == (640, 200, 0.5)
    del keys["baseline_m"]
    assert type(form(tmp_path).make_camera(keys)) is Camera


def test_messages_name_files_as_the_user_knows_them(tmp_path: Path) -> None:
    said = f"{tmp_path}/image/a.png is 2x2, {tmp_path}/the camera fields: no, /image/b.png"
    assert remove_paths(said, tmp_path) == "a.png is 2x2, the camera fields: no, /image/b.png"
