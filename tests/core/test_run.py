from pathlib import Path

import pytest

from depthpose.core.errors import InputError
from depthpose.core.run import claim_folder, environment, read_settings


def test_a_folder_remembers_its_settings(tmp_path: Path) -> None:
    claim_folder(tmp_path / "run", {"a": 1, "b": [2, 3]})
    claim_folder(tmp_path / "run", {"a": 1, "b": [2, 3]})
    assert read_settings(tmp_path / "run") == {"a": 1, "b": [2, 3]}


def test_other_settings_are_refused_and_nothing_is_lost(tmp_path: Path) -> None:
    claim_folder(tmp_path, {"a": 1})
    with pytest.raises(InputError, match="made with a = 1, but now it is 2"):
        claim_folder(tmp_path, {"a": 2})
    assert read_settings(tmp_path) == {"a": 1}


def test_a_new_setting_counts_as_another(tmp_path: Path) -> None:
    claim_folder(tmp_path, {"a": 1})
    with pytest.raises(InputError, match="made with b = None, but now it is 2"):
        claim_folder(tmp_path, {"a": 1, "b": 2})


def test_a_folder_of_others_has_no_settings(tmp_path: Path) -> None:
    assert read_settings(tmp_path) is None


def test_a_foreign_record_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("[1]")
    with pytest.raises(InputError, match="not a record of a run"):
        claim_folder(tmp_path, {"a": 1})
    with pytest.raises(InputError, match="has no 'settings'"):
        read_settings(tmp_path)


def test_the_environment_names_versions_and_date() -> None:
    facts = environment()
    assert {"date", "python", "depthpose", "torch", "numpy", "machine"} <= facts.keys()
