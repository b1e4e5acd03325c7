"""A colour image as a caller has it: its frame, its camera, and what is refused."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tests.pose.synthetic_objects import bracket

from depthpose.core.camera import Camera
from depthpose.core.errors import InputError, Notice
from depthpose.core.rigid import Rigid, rotation_by
from depthpose.pose.color_inputs import add_color
from depthpose.pose.types import ObjectModel, SurfaceColors, ViewInput

K = torch.tensor([[50.0, 0, 8], [0, 50, 6], [0, 0, 1]])
VIEW = ViewInput(
    name="v",
    depth_m=torch.ones(12, 16),
    mask=torch.ones(12, 16).bool(),
    K=K,
    object="bracket",
)
RGB = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)


def colored() -> ObjectModel:
    one = torch.rand(50, 3)
    return replace(
        bracket(), colors=SurfaceColors(points_m=one, normals=one, rgb=one, spacing_m=1.0)
    )


def test_every_form_of_a_picture_is_the_same_image(tmp_path: Path) -> None:
    Image.fromarray(RGB).save(tmp_path / "rgb.png")
    given = [
        RGB,
        RGB.astype(np.float32) / 255,
        torch.from_numpy(RGB).permute(2, 0, 1),
        Image.fromarray(RGB),
        tmp_path / "rgb.png",
        str(tmp_path / "rgb.png"),
    ]
    for picture in given:
        view = add_color(VIEW, [colored()], picture)
        assert view.color is not None
        assert torch.allclose(view.color.rgb, torch.from_numpy(RGB).permute(2, 0, 1) / 255)
        assert view.color.K is VIEW.K
        assert view.color.color_from_depth is None
        assert view.depth_m is VIEW.depth_m


def test_without_a_picture_the_view_is_as_it_was() -> None:
    assert add_color(VIEW, [bracket()], None) is VIEW


def test_a_camera_of_its_own() -> None:
    wide = RGB.repeat(2, 0).repeat(2, 1)
    own = torch.tensor([[100.0, 0, 15], [0, 100, 12], [0, 0, 1]]).double()
    moved = torch.eye(4)
    moved[:3, 3] = torch.tensor([0.05, 0, 0])
    moved[:3, :3] = rotation_by(torch.tensor([0, 0, math.pi / 2]))
    cameras = (own, own.tolist(), Camera(width=32, height=24, K=own), {"K": own.tolist()}, 100.0)
    for camera in cameras:
        view = add_color(VIEW, [colored()], wide, camera, moved)
        assert view.color is not None
        assert float(view.color.K[0, 0]) == 100
        beside = view.color.color_from_depth
        assert isinstance(beside, Rigid)
        assert torch.allclose(beside.t_m, torch.tensor([0.05, 0, 0]).double())
        assert torch.allclose(beside.R.float(), moved[:3, :3])


@pytest.mark.parametrize(
    ("color", "camera", "moved", "said"),
    [
        (RGB[:6], None, None, r"v: the colour image is 16x6 and the depth image 16x12; give the"),
        (RGB, None, np.eye(4), r"color_from_depth is given, .* color_camera="),
        (None, 50.0, None, r"a colour camera is given, and no colour image"),
        (None, None, np.eye(4), r"a colour camera is given, and no colour image"),
        (RGB, Camera(width=32, height=24, K=K.double()), None, r"16x12 but its camera is 32x24"),
        (RGB, 50.0, np.eye(3), r"color_from_depth is a ndarray of shape \(3, 3\)"),
        (RGB, 50.0, 2 * np.eye(4), r"color_from_depth is no rigid transform"),
        (RGB[..., :2], None, None, r"v: the colour image is an array of shape \(12, 16, 2\)"),
        (RGB.astype(np.int32), None, None, r"v: the colour image is an array of int32"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(
    color: np.ndarray | None, camera: Camera | float | None, moved: np.ndarray | None, said: str
) -> None:
    with pytest.raises(InputError, match=said):
        add_color(VIEW, [colored()], color, camera, moved)


def test_a_model_without_colours_is_named() -> None:
    with pytest.warns(Notice, match=r"model file of bracket has no colours .*; give a PLY"):
        view = add_color(VIEW, [bracket(), colored()], RGB)
    assert view.color is not None
