"""A camera is taken in the form that a caller has it in."""

import numpy as np
import pytest
import torch

from depthpose.core.camera import AnyLens, Camera, StereoRig, camera_of, choose_lens
from depthpose.core.errors import InputError

ROWS = [[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]]
SIZE = (64, 48)
BOP = {"fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5, "depth_scale": 0.1}


@pytest.mark.parametrize(
    "given",
    [
        ROWS,
        np.array(ROWS),
        np.array(ROWS, np.float32),
        torch.tensor(ROWS),
        torch.tensor(ROWS, dtype=torch.float64),
        {"K": ROWS},
        {"K": torch.tensor(ROWS)},
        {"width": 64, "height": np.int64(48), "K": np.array(ROWS)},
        BOP,
    ],
    ids=["list", "array", "float32", "tensor", "float64", "dict", "of a tensor", "whole", "bop"],
)
def test_every_form_of_a_camera_is_the_same_camera(given: AnyLens) -> None:
    camera = camera_of(given, SIZE)
    assert camera is not None
    assert (camera.width, camera.height) == SIZE
    assert camera.K.dtype == torch.float64
    assert camera.K.tolist() == ROWS


def test_a_dict_with_a_baseline_is_a_rig() -> None:
    rig = camera_of({"K": ROWS, "baseline_m": 0.2}, SIZE)
    assert isinstance(rig, StereoRig)
    assert rig.baseline_m == 0.2


def test_a_focal_length_has_its_principal_point_at_the_centre() -> None:
    camera = camera_of(60.0, SIZE)
    assert isinstance(camera, Camera)
    assert camera.K.tolist() == ROWS


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"K": ROWS, "widht": 64}, "unknown key 'widht'; did you mean 'width'"),
        ({"K": ROWS[:2]}, r"'K' is .*; write \[\[fx"),
        (ROWS[:2], r"K is \(2, 3\), not 3x3"),
        (np.array(ROWS) * 4 - np.diag([0, 0, 3.0]), "lies outside the image of 64x48"),
        ([[0.9, 0.0, 0.5], [0.0, 1.2, 0.5], [0.0, 0.0, 1.0]], "looks normalised"),
        (0.5, "focal_px is 0.5: not a focal length in pixels"),
    ],
)
def test_what_is_no_camera_of_the_image_is_refused(given: AnyLens, message: str) -> None:
    with pytest.raises(InputError, match=message):
        camera_of(given, SIZE)


def test_a_focal_length_stands_alone() -> None:
    assert choose_lens(ROWS, None) == ROWS
    assert choose_lens(None, 60.0) == 60.0
    with pytest.raises(InputError, match="camera and focal_px are both given"):
        choose_lens(ROWS, 60.0)


@pytest.mark.parametrize("focal_px", [np.float32(707), np.int64(707), torch.tensor(707.0)])
def test_a_focal_length_may_be_a_number_of_numpy_or_torch(focal_px: object) -> None:
    camera = camera_of(focal_px, (64, 48))  # pyright: ignore[reportArgumentType]
    assert camera is not None
    assert float(camera.K[0, 0]) == 707
