"""One command at a time in a folder: the other waits, and is refused in the end."""

import errno
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest
from tests.core.forked import hold, start
from tests.core.loop_task import ToySamples, ToyTask

from depthpose.core.errors import InputError
from depthpose.core.loop import LoopConfig, TrainingRun, releases_folder
from depthpose.core.run_folder import (
    claim_folder,
    held_folders,
    lock_folder,
    read_settings,
    release_folders,
)


@contextmanager
def holder(
    folder: Path, seconds: int, settings: str = "1", **environment: str
) -> Iterator[BaseProcess]:
    """Start a process that claims a folder, and wait until it has."""
    said = folder.parent / f"{folder.name}.said"
    process = start(hold, folder, seconds, settings, said=said, environment=environment)
    deadline = time.monotonic() + 60
    while not (said.exists() and said.read_text().endswith("held\n")):
        assert process.is_alive() or seconds == 0, said.read_text()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    try:
        yield process
    finally:
        process.kill()
        process.join()
        release_folders()


def test_a_second_command_is_refused_until_the_first_is_gone(tmp_path: Path) -> None:
    refused = pytest.raises(InputError, match="another command is writing there")
    with holder(tmp_path, 600), refused:
        lock_folder(tmp_path, is_shared=False, timeout_s=0.3)
    claim_folder(tmp_path, {"a": 1})
    release_folders()


def test_a_second_command_waits_for_one_that_ends(tmp_path: Path) -> None:
    with holder(tmp_path, 1) as process:
        began = time.monotonic()
        lock_folder(tmp_path, is_shared=False, timeout_s=60.0)
        process.join()
        assert process.exitcode == 0
        assert time.monotonic() - began < 60


def test_processes_of_one_launch_share_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "1")
    with holder(tmp_path, 600, WORLD_SIZE="2", RANK="0"):
        claim_folder(tmp_path, {"a": 1})
        release_folders()
        with pytest.raises(InputError, match="another command is writing there"):
            lock_folder(tmp_path, is_shared=False, timeout_s=0.2)


def test_a_folder_that_is_let_go_is_free(tmp_path: Path) -> None:
    claim_folder(tmp_path, {"a": 1})
    claim_folder(tmp_path, {"a": 1})
    release_folders()
    with holder(tmp_path, 0) as process:
        process.join()
        assert process.exitcode == 0


def test_a_training_lets_its_folder_go(tmp_path: Path) -> None:
    """Not after its last step, but when its weights are measured and written."""
    config = LoopConfig(steps=1, batch_size=2, device="cpu")

    @releases_folder
    def stage(config: LoopConfig, run: TrainingRun) -> Path:
        claim_folder(run.folder, {"a": 1})
        run.train(ToyTask(), ToySamples(), config)
        assert held_folders() == {run.folder}
        return run.folder

    stage(config, TrainingRun(folder=tmp_path.resolve()))
    assert not held_folders()
    with holder(tmp_path, 0) as process:
        process.join()
        assert process.exitcode == 0


@pytest.mark.parametrize("settings", ["11", "01", "011", "010"])
def test_a_folder_that_is_claimed_again_stays_locked(tmp_path: Path, settings: str) -> None:
    refused = pytest.raises(InputError, match="another command is writing there")
    with holder(tmp_path, 600, settings), refused:
        lock_folder(tmp_path, is_shared=False, timeout_s=0.3)
    assert read_settings(tmp_path) == {"a": int(settings[-1])}


def test_a_command_within_another_releases_its_own_folders_alone(tmp_path: Path) -> None:
    claim_folder(tmp_path / "one", {"a": 1})
    before = held_folders()
    claim_folder(tmp_path / "two", {"a": 1})
    release_folders(but=before)
    assert held_folders() == before
    assert len(before) == 1


def test_a_claim_that_is_refused_holds_nothing(tmp_path: Path) -> None:
    claim_folder(tmp_path, {"a": 1})
    (tmp_path / "result.npy").touch()
    release_folders()
    with pytest.raises(InputError, match="made with a = 1, but now it is 2"):
        claim_folder(tmp_path, {"a": 2})
    assert not held_folders()


def test_a_lock_that_cannot_be_opened_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a folder that has become read-only."""

    def refuse(*_: object) -> int:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("depthpose.core.run_folder.os.open", refuse)
    with pytest.raises(InputError, match="cannot be written: Read-only file system"):
        lock_folder(tmp_path, is_shared=False)


def test_half_files_go_when_the_folder_is_ours_alone(tmp_path: Path) -> None:
    claim_folder(tmp_path, {"a": 1})
    release_folders()
    half = tmp_path / ".part-0123456789ab.png"
    half.write_bytes(b"half")
    with holder(tmp_path, 600, RANK="0", WORLD_SIZE="2"), pytest.MonkeyPatch.context() as patch:
        patch.setenv("RANK", "1")
        patch.setenv("WORLD_SIZE", "2")
        claim_folder(tmp_path, {"a": 1})
        assert half.exists(), "another process of the launch may be writing it"
    claim_folder(tmp_path, {"a": 1})
    release_folders()
    assert not half.exists()
