import os
from collections.abc import Callable
from pathlib import Path

import pytest

from depthpose.core.run_folder import RESULTS, is_result_finished, note_result, read_results


def make(folder: Path, name: str = "a") -> list[Path]:
    files = [folder / f"{name}.npy", folder / "sub" / f"{name}.png"]
    for number, file in enumerate(files):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(bytes(range(100 + number)))
    note_result(folder, name, files)
    return files


def flip(file: Path) -> None:
    """Change a byte; size and name stay."""
    data = bytearray(file.read_bytes())
    data[50] ^= 1
    file.write_bytes(data)
    os.utime(file, ns=(1, 1))


DAMAGES: dict[str, Callable[[Path], object]] = {
    "deleted": Path.unlink,
    "emptied": lambda file: file.write_bytes(b""),
    "cut": lambda file: os.truncate(file, 99),
    "grown": lambda file: file.write_bytes(file.read_bytes() + b"x"),
    "flipped": flip,
    "a folder": lambda file: (file.unlink(), file.mkdir()),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.parametrize("which", [0, 1])
def test_whatever_is_damaged_is_noticed(
    tmp_path: Path, damage: Callable[[Path], object], which: int
) -> None:
    files = make(tmp_path)
    make(tmp_path, "other")
    assert is_result_finished(tmp_path, "a", ["a.npy"])
    damage(files[which])
    assert not is_result_finished(tmp_path, "a", ["a.npy"])
    assert is_result_finished(tmp_path, "other", ["other.npy"])


@pytest.mark.parametrize("damage", [Path.unlink, lambda file: os.truncate(file, 9)])
def test_a_result_of_which_the_note_is_lost_is_made_again(
    tmp_path: Path, damage: Callable[[Path], object]
) -> None:
    make(tmp_path)
    damage(tmp_path / RESULTS)
    assert not is_result_finished(tmp_path, "a", ["a.npy"]), "no file is known to be whole"
    make(tmp_path)
    assert is_result_finished(tmp_path, "a", ["a.npy"])


def test_what_was_not_noted_is_not_finished_with_it(tmp_path: Path) -> None:
    make(tmp_path)
    (tmp_path / "a.ply").write_bytes(b"of another run")
    assert not is_result_finished(tmp_path, "a", ["a.npy", "a.ply"])


def test_a_file_with_another_time_is_made_again(tmp_path: Path) -> None:
    files = make(tmp_path)
    os.utime(files[0], ns=(5, 5))
    assert not is_result_finished(tmp_path, "a", ["a.npy"])


def test_what_a_killed_process_left_of_its_line_harms_no_other(tmp_path: Path) -> None:
    make(tmp_path)
    with (tmp_path / RESULTS).open("ab") as file:
        file.write(b'{"name": "half", "fil')
    files = make(tmp_path, "next")
    noted = read_results(tmp_path)
    assert "half" not in noted
    assert [tmp_path / file for file in noted["next"]] == files
    (tmp_path / RESULTS).write_bytes(b"\xff\x00 [1]\n3\n")
    assert not read_results(tmp_path)


def test_a_result_can_be_marked_as_to_be_made_again(tmp_path: Path) -> None:
    make(tmp_path)
    note_result(tmp_path, "a", [])
    assert not is_result_finished(tmp_path, "a", ["a.npy"])
