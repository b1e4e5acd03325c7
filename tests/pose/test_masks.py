"""Masks as pictures and as COCO's run lengths."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from depthpose.cli.pose.file_jobs import make_mask_jobs
from depthpose.core.errors import InputError
from depthpose.core.files import write_depth_png
from depthpose.pose.datasets import (
    number_objects,
    read_labels,
    read_mask,
)
from depthpose.pose.inputs import labels_input, split_instances, view_input

MASK = torch.tensor([[False, True, False], [True, False, False]])
# Column by column: one of the background, two of the object, three of the background.
PLAIN = {"size": [2, 3], "counts": [1, 2, 3]}
PACKED = {"size": [2, 3], "counts": "123"}


@pytest.mark.parametrize(
    "content",
    [PLAIN, PACKED, [PACKED], {"id": 1, "segmentation": PLAIN}, [{"segmentation": PACKED}]],
)
def test_run_lengths_are_a_mask_as_the_picture_is(tmp_path: Path, content: object) -> None:
    (tmp_path / "m.json").write_text(json.dumps(content))
    Image.fromarray(MASK.numpy()).save(tmp_path / "m.png")
    assert torch.equal(read_mask(tmp_path / "m.json"), MASK)
    assert torch.equal(read_mask(tmp_path / "m.png"), MASK)


def test_pycocotools_hands_over_bytes() -> None:
    assert torch.equal(labels_input({"size": [2, 3], "counts": b"123"}, "mask"), MASK.long())


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ([PLAIN, PLAIN], "holds 2 masks, where one is needed; .* --masks, beside --bop"),
        ({"segmentation": [[1, 1, 2, 2, 3, 1]]}, "a polygon; turn it into run lengths by pycoco"),
        ({"size": [2, 3], "counts": [1, 2]}, "of 2x3 pixels: they do not add up to it"),
        ({"mask": 1}, r'no run lengths; write \{"size"'),
    ],
)
def test_what_is_not_one_mask_is_refused(tmp_path: Path, content: object, said: str) -> None:
    (tmp_path / "m.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=said):
        read_mask(tmp_path / "m.json")


LABELS = np.zeros((60, 80), np.uint8)
LABELS[10:30, 10:30] = 1
LABELS[20:50, 40:70] = 2
ONE = LABELS == 1
FULL = np.full((60, 80), 255, np.uint8)
PHOTO = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)


@pytest.mark.parametrize(
    "values",
    [
        LABELS,
        LABELS * 100,
        LABELS.astype(np.uint16) * 1000,
        np.stack([LABELS * 100] * 3, -1),
        np.stack([LABELS == 1, LABELS == 2, LABELS == 3], -1).astype(np.uint8) * 255,
        np.stack([*[LABELS * 100] * 3, FULL], -1),
    ],
    ids=["1 2", "100 200", "16 bit", "grey as RGB", "colours", "opaque"],
)
def test_a_label_map_is_several_masks_and_never_one(tmp_path: Path, values: np.ndarray) -> None:
    Image.fromarray(values).save(tmp_path / "m.png")
    labels = read_labels(tmp_path / "m.png")
    assert sorted(int((labels == k).sum()) for k in labels.unique()[1:]) == [400, 900]
    assert [int(mask.sum()) for mask in split_instances(labels)] == [900, 400]
    with pytest.raises(InputError, match=r"shows 2 objects, numbered .* px\), .* mask is of one"):
        read_mask(tmp_path / "m.png")


def test_soft_borders_and_compression_make_no_labels(tmp_path: Path) -> None:
    wide = Image.fromarray(ONE.astype(np.uint8) * 255).resize((160, 120), Image.Resampling.BICUBIC)
    wide.save(tmp_path / "m.png")
    assert read_labels(tmp_path / "m.png").unique().tolist() == [0, 1]
    Image.fromarray(ONE.astype(np.uint8) * 255).save(tmp_path / "m.jpg", quality=50)
    assert read_mask(tmp_path / "m.jpg").numpy().sum() == pytest.approx(400, abs=8)
    soft = Image.fromarray(LABELS * 120).resize((160, 120), Image.Resampling.BILINEAR)
    assert number_objects(np.asarray(soft)).unique().tolist() == [0, 120, 240]


@pytest.mark.parametrize("colour", [np.zeros((60, 80, 3), np.uint8), PHOTO, PHOTO * 0 + 255])
def test_a_mask_in_an_alpha_channel(tmp_path: Path, colour: np.ndarray) -> None:
    Image.fromarray(np.dstack([colour, FULL * ONE])).save(tmp_path / "m.png")
    assert np.array_equal(read_mask(tmp_path / "m.png").numpy(), ONE)


def test_an_array_of_labels_asks_which(tmp_path: Path) -> None:
    K = torch.tensor([[80.0, 0, 39.5], [0, 80, 29.5], [0, 0, 1]], dtype=torch.float64)
    depth_m = torch.full((60, 80), 0.7)
    with pytest.raises(InputError, match=r"numbered 1 \(400 px\), 2 \(900 px\), where one mask"):
        view_input(depth_m, LABELS.astype(np.int32), K, "part", "view")
    view = view_input(depth_m, LABELS == 2, K, "part", "view")
    assert int(view.mask.sum()) == 900
    # Of a file on the command line each number is an input, with its own name.
    Image.fromarray(LABELS).save(tmp_path / "m.png")
    write_depth_png(tmp_path / "d.png", depth_m, 0.001)
    (tmp_path / "camera.txt").write_text("80 80 39.5 29.5\n")
    given = (tmp_path / "d.png", tmp_path / "m.png", tmp_path / "camera.txt")
    jobs = make_mask_jobs(*given, "part", "mm", tmp_path / "out")
    assert [job.name for job in jobs] == ["d_1", "d_2"]
    assert [int(job.read().mask.sum()) for job in jobs] == [400, 900]


def test_what_compression_mixes_is_no_label_map(tmp_path: Path) -> None:
    Image.fromarray(LABELS * 100).save(tmp_path / "m.jpg", quality=95)
    with pytest.raises(InputError, match=r"a JPEG of more grey than white, .* save masks as PNG"):
        read_labels(tmp_path / "m.jpg")


def test_of_probabilities_those_above_a_half_are_the_object() -> None:
    likely = np.where(ONE, 0.9, 0.02)
    assert np.array_equal(labels_input(likely, "m").numpy(), ONE)
    for wrong in (np.where(ONE, 3.5, -3.5), np.where(ONE, 0.5, np.nan)):
        with pytest.raises(InputError, match=r"fractions outside \[0, 1\], or NaN; give True"):
            labels_input(wrong, "m")


def test_probabilities_in_a_file_are_those_of_an_array(tmp_path: Path) -> None:
    likely = np.where(ONE, 0.97, 0.02).astype(np.float32)
    Image.fromarray(likely).save(tmp_path / "m.tif")
    assert np.array_equal(read_labels(tmp_path / "m.tif").numpy(), ONE)
    Image.fromarray(LABELS.astype(np.float32)).save(tmp_path / "labels.tif")
    assert np.array_equal(read_labels(tmp_path / "labels.tif").numpy(), LABELS)
    likely[:5, :5] = np.nan
    Image.fromarray(likely).save(tmp_path / "nan.tif")
    with pytest.raises(InputError, match=r"nan.tif: the mask holds fractions outside .*, or NaN"):
        read_labels(tmp_path / "nan.tif")


def test_a_mask_is_of_one_image() -> None:
    for wrong in (ONE[None], ONE[0]):
        with pytest.raises(InputError, match=r"m: the mask is of shape .*, not \(h, w\); give"):
            labels_input(wrong, "m")


def test_sixteen_bits_with_a_transparent_value_keep_their_numbers(tmp_path: Path) -> None:
    values = np.zeros((20, 30), np.uint16)
    values[2:8, 2:8] = 300
    values[10:18, 10:18] = 1000
    path = tmp_path / "mask.png"
    Image.fromarray(values).save(path, transparency=65535)
    with Image.open(path) as image:
        assert image.info["transparency"] == 65535
    assert torch.equal(read_labels(path), torch.from_numpy(values.astype(np.int64)))
    # Where the transparent value occurs, it is background.
    Image.fromarray(np.where(values == 0, 500, values).astype(np.uint16)).save(
        path, transparency=500
    )
    assert torch.equal(read_labels(path), torch.from_numpy(values.astype(np.int64)))
