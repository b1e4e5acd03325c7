"""What a caller hands over: camera files of others, units, run lengths, to one view in metres."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from depthpose.core.camera import Camera
from depthpose.core.errors import InputError
from depthpose.core.files import read_map, write_depth_png
from depthpose.pose.inputs import view_input

K = torch.tensor([[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]], dtype=torch.float64)
DEPTH_M = torch.linspace(0.5, 0.9, 48)[:, None].expand(48, 64).contiguous()
RUNS = {"size": [48, 64], "counts": [48 * 10, 48 * 20, 48 * 34]}
MASK = (torch.arange(64) // 10).clamp(max=3).expand(48, 64)
MASK = (MASK > 0) & (MASK < 3)


def whole(unit_m: float) -> torch.Tensor:
    return (DEPTH_M / unit_m).round().int()


@pytest.mark.parametrize(
    "text",
    [
        "50 50 31.5 23.5\n",
        "P2: 50 0 31.5 0 0 50 23.5 0 0 0 1 0\n",
        "camera_matrix: {data: [50, 0, 31.5, 0, 50, 23.5, 0, 0, 1]}\n",
        json.dumps({"width": 64, "height": 48, "K": K.tolist()}),
    ],
)
def test_a_camera_file_of_any_format_and_a_stored_depth_and_mask(tmp_path: Path, text: str) -> None:
    (tmp_path / "camera").write_text(text)
    (tmp_path / "mask.json").write_text(json.dumps(RUNS))
    write_depth_png(tmp_path / "d.png", DEPTH_M, 0.001)
    depth, mask, camera = (tmp_path / name for name in ("d.png", "mask.json", "camera"))
    view = view_input(depth, mask, camera, "part", "view", "mm")
    assert torch.equal(view.K, K)
    assert torch.equal(view.mask, MASK)
    torch.testing.assert_close(view.depth_m, DEPTH_M, atol=6e-4, rtol=0)


def test_a_unit_says_what_whole_numbers_and_floats_are() -> None:
    view = view_input(whole(0.001), RUNS, K, "part", "view", "mm")
    torch.testing.assert_close(view.depth_m, DEPTH_M, atol=6e-4, rtol=0)
    assert torch.equal(view.mask, MASK)
    view = view_input(1000 * DEPTH_M, MASK, K, "part", "view", "mm")
    torch.testing.assert_close(view.depth_m, DEPTH_M)
    tum = Camera(width=64, height=48, K=K, depth_unit_m=0.0002)
    view = view_input(whole(0.0002), MASK, tum, "part", "view")
    torch.testing.assert_close(view.depth_m, DEPTH_M, atol=2e-4, rtol=0)


def test_readings_out_of_range_are_no_readings() -> None:
    """ROS writes +inf beyond the largest distance of a sensor, and -inf below the least."""
    depth_m = DEPTH_M.clone()
    depth_m[0] = torch.inf
    depth_m[1] = -torch.inf
    view = view_input(depth_m, MASK, K, "part", "view")
    assert bool(view.depth_m[:2].isnan().all())
    assert torch.equal(view.depth_m[2:], DEPTH_M[2:])


def test_two_units_that_disagree_are_refused() -> None:
    tum = Camera(width=64, height=48, K=K, depth_unit_m=0.0002)
    with pytest.raises(
        InputError, match=r"unit mm is 0\.001 m, but its camera says .* 0\.0002; omit"
    ):
        view_input(whole(0.0002), MASK, tum, "part", "view", "mm")
    with pytest.raises(InputError, match=r"nothing says of what; .* 0\.0002 of TUM RGB-D, .* mm"):
        view_input(whole(0.001), MASK, K, "part", "view")


def test_a_crop_may_leave_the_centre_and_a_bare_matrix_may_not() -> None:
    off = K.clone()
    off[0, 2], off[1, 2] = 10.0, 7.5
    crop = Camera(width=64, height=48, K=off)
    assert torch.equal(view_input(DEPTH_M, MASK, crop, "part", "view").K, off)
    with pytest.raises(InputError, match="the principal point"):
        view_input(DEPTH_M, MASK, off, "part", "view")


@pytest.mark.parametrize(
    "kind",
    [
        "uint8",
        "uint16",
        "uint32",
        ">u2",
        "<u4",
        ">f4",
        ">f8",
        "longdouble",
        "int16",
        "torch.uint16",
    ],
)
def test_depth_of_any_type_of_number(kind: str) -> None:
    metres = np.full((4, 6), 2.0)
    depth: np.ndarray | torch.Tensor = metres.astype(kind.removeprefix("torch."))
    if kind.startswith("torch."):
        depth = torch.from_numpy(depth)
    camera = Camera(width=6, height=4, K=torch.tensor([[5.0, 0, 3], [0, 5, 2], [0, 0, 1]]).double())
    view = view_input(depth, None, camera, "cup", "x", "m")
    assert torch.equal(view.depth_m, torch.full((4, 6), 2.0))


def test_whole_numbers_of_any_file_need_their_unit(tmp_path: Path) -> None:
    units = whole(0.001).numpy()
    np.save(tmp_path / "d.npy", units.astype(np.uint16))
    Image.fromarray(units.astype(np.uint16)).save(tmp_path / "d.tif")
    for name in ("d.npy", "d.tif"):
        view = view_input(tmp_path / name, MASK, K, "part", "view", "mm")
        torch.testing.assert_close(view.depth_m, DEPTH_M, atol=6e-4, rtol=0)
        with pytest.raises(InputError, match=r"in whole numbers, and nothing says of what; give"):
            view_input(tmp_path / name, MASK, K, "part", "view")
    Image.fromarray(DEPTH_M.numpy()).save(tmp_path / "m.tiff")
    assert torch.equal(view_input(tmp_path / "m.tiff", MASK, K, "part", "view").depth_m, DEPTH_M)
    with pytest.raises(InputError, match=r"holds uint16, .* / 1000 are metres"):
        read_map(tmp_path / "d.npy")


def test_a_normalised_matrix_is_named() -> None:
    normalised = K / torch.tensor([[64.0], [48.0], [1.0]])
    with pytest.raises(InputError, match=r"K has fx 0\.78125 for 64x48 .* looks normalised"):
        view_input(DEPTH_M, MASK, normalised, "part", "view")
