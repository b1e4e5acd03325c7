from pathlib import Path

import fsspec
import pytest
from tests.core.engine.doubles import write_texts

from depthpose.core.engine import InputFormat, JobInputs, list_inputs
from depthpose.core.errors import InputError
from depthpose.core.files.stores import list_files, local_copy, publish, read_all

ONE = InputFormat(roles=("text",), suffixes=(".txt",))
TWO = InputFormat(roles=("left", "right"), suffixes=(".txt",))


def test_a_folder_a_pattern_and_a_url_list_the_same_files(tmp_path: Path) -> None:
    write_texts(tmp_path, {"b": "1", "a": "2", ".hidden": "3"})
    (tmp_path / "c.png").write_bytes(b"")
    named = [
        [(item.name, item.files) for item in list_inputs([word], ONE)]
        for word in (str(tmp_path), f"{tmp_path}/*.txt")
    ]
    assert named[0] == named[1]
    assert [name for name, _ in named[0]] == ["a", "b"]
    assert [i.name for i in list_inputs([f"file://{tmp_path}"], ONE)] == ["a", "b"]


def test_pairs_go_together_in_the_order_of_their_names(tmp_path: Path) -> None:
    left = write_texts(tmp_path / "l", {"1": "", "2": ""})
    right = write_texts(tmp_path / "r", {"1": "", "2": ""})
    items = list_inputs([str(left), str(right)], TWO)
    assert [tuple(Path(f).parent.name for f in item.files) for item in items] == [("l", "r")] * 2
    (right / "2.txt").unlink()
    with pytest.raises(InputError, match=r"hold 2 and 1 files, and no partner .* is there for '2'"):
        list_inputs([str(left), str(right)], TWO)
    with pytest.raises(InputError, match="an input has left and right"):
        list_inputs([str(left)], TWO)


def test_a_manifest_names_inputs_and_is_read_from_where_it_lies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = tmp_path / "list.csv"
    table.write_text("left,right,name\nl/1.txt,/r/1.txt,drive/1\nl/2.txt,s3://b/2.txt,\n")
    monkeypatch.chdir(tmp_path)
    for word in (str(table), "list.csv"):
        first, second = list_inputs([word], TWO)
        assert first.name == "drive/1"
        assert first.files == (f"{tmp_path}/l/1.txt", "/r/1.txt")
        assert (second.name, second.files[1]) == ("2", "s3://b/2.txt")


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("picture\na.txt\n", "row 1 has no 'text'; the columns are text"),
        ("text,name\na.txt,../../etc/passwd\n", "is no name of a result"),
        ("text,name\na.txt,/root\n", "is no name of a result"),
        ("text\na/x.txt\nb/x.txt\n", "would both be 'x'"),
    ],
)
def test_a_manifest_that_cannot_be_used_says_why(tmp_path: Path, table: str, said: str) -> None:
    (tmp_path / "list.csv").write_text(table)
    with pytest.raises(InputError, match=said):
        list_inputs([str(tmp_path / "list.csv")], ONE)


def test_a_manifest_without_a_line_names_nothing(tmp_path: Path) -> None:
    (tmp_path / "list.csv").write_text("text\n")
    with pytest.raises(InputError, match=r"list\.csv: name no input; a manifest needs a line"):
        JobInputs.find([str(tmp_path / "list.csv")], ONE)


def test_two_files_of_one_name_are_refused(tmp_path: Path) -> None:
    folders = [str(write_texts(tmp_path / f, {"same": ""})) for f in "ab"]
    with pytest.raises(InputError, match="give a manifest with a column 'name'"):
        list_inputs(folders, ONE)


def test_nothing_found_is_an_error(tmp_path: Path) -> None:
    for word in (str(tmp_path), str(tmp_path / "no"), f"{tmp_path}/*.txt", "memory://no/where"):
        with pytest.raises(InputError, match=r"no \.txt file there"):
            list_inputs([word], ONE)
    with pytest.raises(InputError, match=r"no \.tar.* file there"):
        JobInputs.find([str(tmp_path / "no.tar")], ONE)


def test_a_remote_file_is_copied_and_a_missing_one_refused(tmp_path: Path) -> None:
    fsspec.filesystem("memory").pipe("/bucket/a.txt", b"far")
    assert list_files("memory://bucket", (".txt",)) == ["memory:///bucket/a.txt"]
    assert local_copy("memory://bucket/a.txt", tmp_path).read_text() == "far"
    with pytest.raises(InputError, match="no such file"):
        local_copy("memory://bucket/b.txt", tmp_path)
    assert read_all("memory://bucket", ".txt") == {"a.txt": b"far"}
    assert read_all("memory://nothing", ".txt") == {}


def test_stores_that_may_show_half_a_file_take_no_results() -> None:
    with pytest.raises(InputError, match="ftp:// may show half a file"):
        publish(b"x", "ftp://host/file")
    with pytest.raises(InputError, match="cannot be listed"):
        list_files("nonsense://x", (".txt",))
