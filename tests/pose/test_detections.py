"""Files of detectors, and what their boxes and classes become."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from depthpose.core.errors import InputError
from depthpose.pose.datasets import (
    Detection,
    encode_rle,
    group_by_image,
    mask_from_box,
    name_objects,
    parse_box,
    parse_labels,
    read_detections,
    read_labels,
    write_detections,
)

OBJECTS = ("bracket", "gear")


def written(path: Path, content: object) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_a_box_is_all_pixels_that_it_touches() -> None:
    mask = mask_from_box(parse_box("1.5,0,3,2"), 4, 5)
    assert mask.nonzero().tolist() == [[0, 1], [0, 2], [1, 1], [1, 2]]
    assert bool(mask_from_box((0, 0, 5, 4), 4, 5).all())
    # A part that reaches out of the image has a box that does.
    assert mask_from_box((-4.0, 2.0, 6.0, 9.0), 6, 5)[2:].all()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("1,2,3", "is not X0,Y0,X1,Y1"),
        ("1,2,3,x", "is not X0,Y0,X1,Y1"),
        ("30,2,10,20", "the right edge is to lie right of the left edge"),
        ("1,20,10,20", "the bottom below the top"),
        ("1,2,inf,20", "the right edge is to lie right"),
    ],
)
def test_a_box_that_is_none_is_refused(text: str, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        parse_box(text)


def test_a_box_of_a_larger_image_is_refused() -> None:
    with pytest.raises(InputError, match="its centre lies outside of the image of 640x480 pixels"):
        mask_from_box((700, 100, 900, 200), 480, 640)


def test_results_of_coco_are_read(tmp_path: Path) -> None:
    mask = torch.zeros(4, 6, dtype=torch.bool)
    mask[1:3, 2:5] = True
    counts, height, width = encode_rle(mask)
    rows = [
        {"image_id": 12, "category_id": 1, "bbox": [10, 20, 30, 40.5], "score": 0.8},
        {"image_id": "left/000013.png", "name": "gear", "bbox": [1, 2, 3, 4],
         "segmentation": {"size": [height, width], "counts": list(counts)}},
    ]  # fmt: skip
    boxed, masked = read_detections(written(tmp_path / "d.json", rows))
    assert (boxed.box, boxed.score, boxed.object_id) == ((10, 20, 40, 60.5), 0.8, 1)
    assert (boxed.image_id, boxed.image) == (12, None)
    assert (masked.object, masked.image, masked.box, masked.score) == ("gear", "000013", None, 1)
    assert torch.equal(masked.mask(4, 6), mask)
    with pytest.raises(InputError, match="mask of a detection is 6x4, but the image 5x4"):
        masked.mask(4, 5)


def test_annotations_of_coco_name_images_and_classes(tmp_path: Path) -> None:
    content = {
        "images": [{"id": 3, "file_name": "frames/a.png"}],
        "categories": [{"id": 9, "name": "bracket"}],
        "annotations": [{"id": 1, "image_id": 3, "category_id": 9, "bbox": [0, 0, 2, 2]}],
    }
    (detection,) = read_detections(written(tmp_path / "d.json", content))
    assert (detection.object, detection.image, detection.image_id) == ("bracket", "a", 3)


def test_lines_of_yolo_are_shares_of_the_image(tmp_path: Path) -> None:
    path = written(tmp_path / "a.txt", "2 0.5 0.25 0.5 0.5 0.9\n\n0 0.5 0.5 1 1\n")
    first, second = read_detections(path, (640, 480))
    assert (first.object_id, first.box, first.score) == (2, (160, 0, 480, 240), 0.9)
    assert (second.box, second.score, second.image) == ((0, 0, 640, 480), 1, "a")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("0 0.5 0.5 0.1", "line 1: 4 numbers, where class cx cy w h"),
        ("0 0.1 0.1 0.2 0.1 0.2 0.2 0.1 0.2", "polygons are to be turned into boxes"),
        ("0 320 240 50 60", "boxes in pixels go into JSON"),
        ("cat 0.5 0.5 0.1 0.1", "line 1: invalid literal"),
        ("0 0.5 0.5 0 0.1", "shares of the image from 0 to 1"),
    ],
)
def test_damaged_lines_of_yolo_are_refused(tmp_path: Path, content: str, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        read_detections(written(tmp_path / "a.txt", content), (640, 480))


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        ({"category_id": 1}, "entry 0: a detection has neither of a box and a mask"),
        ({"category_id": 1, "bbox": [-1, -1, -1, -1]}, "neither of a box and a mask"),
        ({"category_id": 1, "bbox": [5, 5, 0, 9]}, "entry 0: box 5,5,5,14: the right edge"),
        ({"category_id": 1, "bbox": [5, 5, 9]}, "where 4 numbers belong"),
        ({"bbox": [5, 5, 9, 9]}, "category_id is None"),
        ({"category_id": 1, "segmentation": [[1, 2, 3]]}, "the segmentation is a polygon"),
    ],
)
def test_damaged_entries_are_refused(tmp_path: Path, row: dict[str, object], reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        read_detections(written(tmp_path / "d.json", [row]))


def test_text_without_a_size_and_other_endings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="an image whose size is not known here"):
        read_detections(written(tmp_path / "a.txt", "0 0.5 0.5 0.1 0.1"))
    with pytest.raises(InputError, match=r"json"):
        read_detections(written(tmp_path / "a.xml", "<x/>"))


def test_boxes_are_written_as_bop_shares_them(tmp_path: Path) -> None:
    detection = Detection(object_id=4, scene_id=1, image_id=2, score=0.5, box=(1, 2, 4, 8))
    write_detections(tmp_path / "d.json", [detection])
    (again,) = read_detections(tmp_path / "d.json")
    assert vars(again) == vars(detection)
    with pytest.raises(InputError, match="detection of 'gear' has no scene_id"):
        write_detections(tmp_path / "d.json", [Detection(object="gear", box=(1, 2, 4, 8))])


def test_labels_name_objects() -> None:
    assert parse_labels("1=bracket, 2=gear,3=", OBJECTS) == {"1": "bracket", "2": "gear", "3": ""}
    for text, reason in (
        ("1", "'1' is not CLASS=OBJECT"),
        ("1=bracket,1=gear", "class 1 is named twice"),
        ("1=braket", "no known object; did you mean 'bracket'"),
    ):
        with pytest.raises(InputError, match=reason):
            parse_labels(text, OBJECTS)


def detection_of(label: int | str) -> Detection:
    box = (0.0, 0.0, 1.0, 1.0)
    if isinstance(label, int):
        return Detection(object_id=label, box=box)
    return Detection(object=label, box=box)


def names(labels: list[int | str], given: dict[str, str], wanted: str | None = None) -> list[str]:
    detections = [detection_of(label) for label in labels]
    return [str(d.object) for d in name_objects(detections, given, OBJECTS, wanted, "d.json")]


def test_classes_become_objects() -> None:
    assert names(["gear", "bracket"], {}) == ["gear", "bracket"]
    assert names([1, 2, 7], {"1": "bracket", "2": "gear", "7": ""}) == ["bracket", "gear"]
    assert names(["person", "gear"], {"person": "bracket"}) == ["bracket", "gear"]
    # One object is asked for, and all is one class: no other reading is left.
    assert names([5, 5], {}, "gear") == ["gear", "gear"]
    assert names(["person", "gear"], {}, "gear") == ["gear"]


def test_a_class_that_is_no_object_is_refused() -> None:
    with pytest.raises(InputError, match=r"class 1 is a number without a name; .* --labels 1=bra"):
        names([1], {})
    with pytest.raises(InputError, match="class 2 is a number without a name"):
        names([1, 2], {"1": "gear"}, "gear")
    with pytest.raises(InputError, match=r"class 'gears' is no known object; did you mean 'gear'"):
        names(["gears"], {})


def test_detections_find_their_images() -> None:
    box = (0.0, 0.0, 1.0, 1.0)
    by_number = Detection(object="gear", box=box, image_id=12)
    by_name = Detection(object="gear", box=box, image="b")
    found = group_by_image([by_number, by_name], ["000012", "b", "c"], "d.json")
    assert found == {"000012": [by_number], "b": [by_name], "c": []}
    # All are of one image, and there is one: its name does not matter.
    assert group_by_image([by_number, by_number], ["x"], "d.json") == {"x": [by_number] * 2}
    with pytest.raises(InputError, match=r"no detection is of 'x' or another image; .* of 12"):
        group_by_image([by_number], ["x", "y"], "d.json")
    with pytest.raises(InputError, match="entry 0 does not say of which image it is"):
        group_by_image([detection_of("gear")], ["x", "y"], "d.json")
    scenes = [Detection(object="gear", box=box, scene_id=k, image_id=1) for k in (1, 2)]
    with pytest.raises(InputError, match="detections of several scenes; name the dataset by --b"):
        group_by_image(scenes, ["x"], "d.json")


def test_a_label_map_keeps_its_numbers(tmp_path: Path) -> None:
    values = np.zeros((8, 10), np.uint8)
    values[1:6, 2:7] = 2
    values[0, 9] = 1  # a single pixel of another object is one
    Image.fromarray(values).save(tmp_path / "grey.png")
    shown = Image.fromarray(values, "P")
    shown.putpalette([k for k in range(256) for _ in range(3)])
    shown.save(tmp_path / "palette.png")
    for name in ("grey.png", "palette.png"):
        labels = read_labels(tmp_path / name, [1, 2])
        assert torch.equal(labels, torch.from_numpy(values).long()), name
        assert read_labels(tmp_path / name).unique().tolist() == [0, 1]  # what is seen, counted
    with pytest.raises(InputError, match="25 pixels have the number 2, which the labels do not"):
        read_labels(tmp_path / "grey.png", [1])
