"""Masks as pictures and as COCO's run lengths."""

import json
from pathlib import Path

import pytest
import torch
from PIL import Image

from depthpose.core.errors import InputError
from depthpose.pose.datasets import encode_rle, mask_from_rle, read_mask

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
    assert torch.equal(mask_from_rle({"size": [2, 3], "counts": b"123"}, "mask"), MASK)


def test_a_mask_goes_through_run_lengths_and_back() -> None:
    mask = torch.rand(31, 17, generator=torch.Generator().manual_seed(0)) > 0.5
    counts, height, width = encode_rle(mask)
    entry = {"size": [height, width], "counts": list(counts)}
    assert torch.equal(mask_from_rle(entry, "mask"), mask)


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
