import json
import math
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from depthpose.core.errors import InputError
from depthpose.core.files import read_json, read_key_values, read_text, write_json
from depthpose.core.files.disk import find_partners, normalise_stem, parse_yaml

JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=["Cs"])),
    lambda inner: st.lists(inner) | st.dictionaries(st.text("abcé"), inner),
    max_leaves=12,
)


@given(JSON)
def test_json_comes_back(tmp_path_factory: pytest.TempPathFactory, content: object) -> None:
    path = tmp_path_factory.mktemp("json") / "x.json"
    write_json(path, content)
    assert read_json(path) == content


def test_json_keeps_the_order_it_was_given(tmp_path: Path) -> None:
    write_json(tmp_path / "x.json", {"z": 1, "a": {"c": [1.5], "b": None}})
    text = (tmp_path / "x.json").read_text()
    assert list(json.loads(text)) == ["z", "a"]
    assert text.startswith('{\n  "z": 1,\n')
    assert text.endswith("}\n")


def test_text_loses_its_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "x.txt").write_bytes(b"\xef\xbb\xbfK\xc3\xb6ln")
    assert read_text(tmp_path / "x.txt") == "Köln"


def test_key_values_of_kitti_and_middlebury(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text(
        "# sensors\ncalib_time: 09-Jan-2012 13:57:47\ncamera: ZED 2\ndate: 9 May 2024\n\n"
        "P2: 7.2e+02 0 -1\nP_rect_02: 1 2\r\n"
        "cam0=[3997.684 0 1176.728; 0 3997.684 1011.728; 0 0 1]\ndoffs=131.111\nR0_rect:\n"
    )
    assert read_key_values(tmp_path / "calib.txt") == {
        "P2": [720.0, 0.0, -1.0],
        "P_rect_02": [1.0, 2.0],
        "cam0": [3997.684, 0, 1176.728, 0, 3997.684, 1011.728, 0, 0, 1],
        "doffs": [131.111],
    }


def test_numbers_survive_json_exactly(tmp_path: Path) -> None:
    values = [math.pi, 1e-308, 0.1, 1 / 3]
    write_json(tmp_path / "x.json", values)
    assert read_json(tmp_path / "x.json") == values


def test_yaml_may_refer_to_what_stands_above(tmp_path: Path) -> None:
    text = "a: &a [1, {b: &b 2}]\nc: [*a, *b]\n"
    assert parse_yaml(tmp_path / "x.yaml", text) == {"a": [1, {"b": 2}], "c": [[1, {"b": 2}], 2]}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: &a [*a]", r"x\.yaml: refers to itself \(\*a\); write it out"),
        ("[" * 60 + "]" * 60, "lists of lists, 50 deep"),
        (
            "a0: &a0 [1]\n"
            + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 9)),
            r"references \(\*name\) make more than 2000000 values",
        ),
        ("a: *b", r"refers to itself|not a readable YAML file"),
        ("a: [", "not a readable YAML file"),
        ("a: {b: 1,\n b: 2}", "line 2: key 'b' is given twice"),
    ],
)
def test_yaml_beyond_bounds_is_refused(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        parse_yaml(tmp_path / "x.yaml", text)


def test_a_name_that_is_not_utf8_goes_through_json(tmp_path: Path) -> None:
    name = os.fsdecode(b"n\xfe.png")
    write_json(tmp_path / "a.json", {name: "ä"})
    assert read_json(tmp_path / "a.json") == {name: "ä"}
    assert (tmp_path / "a.json").read_text(encoding="utf-8").count("\\udcfe") == 1


def test_what_follows_a_sign_of_comments_is_no_value(tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_text("# of today\nP2: 1 0 2  # the left camera\nfocal_px: 3 # px\n")
    assert read_key_values(path) == {"P2": [1, 0, 2], "focal_px": [3]}


def test_names_pair_however_their_accents_are_stored() -> None:
    composed, apart = "stra\u00dfe_\u00e9", "stra\u00dfe_e\u0301"
    assert composed != apart
    assert find_partners([composed, "b"], ["b", apart], "x") == [1, 0]
    assert normalise_stem(Path(f"{composed}.png")) == normalise_stem(Path(f"{apart}.jpg"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("P2: 7.2e2 0 6O9.5 1\nP2: 1 2 3\n", r"line 1, 'P2', has '6O9.5' among its numbers"),
        ("calib_time: 09-Jan-2012 13:57:47\ncalib_time: 1\n", "line 2 gives 'calib_time' again"),
    ],
)
def test_a_mistyped_number_and_a_repeated_key_are_refused(
    tmp_path: Path, text: str, message: str
) -> None:
    (tmp_path / "calib.txt").write_text(text)
    with pytest.raises(InputError, match=message):
        read_key_values(tmp_path / "calib.txt")
