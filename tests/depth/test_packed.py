"""Datasets in tar shards: what is read of them is what is read of the folder."""

import json
import os
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path

import fsspec
import pytest
import torch
from tests.synthetic_street import write_pairs

from depthpose.cli import main
from depthpose.core.checkpoint import read_checkpoint
from depthpose.core.errors import InputError
from depthpose.depth.datasets import (
    Dataset,
    check_dataset,
    open_dataset,
    pack_frames,
    read_lidar_depth,
)

CONFIG = """
generator: {encoder_width: 0.1, widths: [4, 4, 4, 4], planes: 6, disparity_px: [1, 32],
  virtual_focal_px: 130.0}
with_frozen_stem: false
encoder_rate: 1.0
pairs: {truth: disparity, augment: {crop_px: [32, 64]}}
loop: {steps: 60, batch_size: 2, save_every_steps: 5, device: cpu}
"""


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pairs(tmp_path_factory.mktemp("packed") / "pairs", (0.2, 0.2, 0.25, 0.2))


@pytest.fixture(scope="module")
def streets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """KITTI's raw layout with LiDAR, sky and a calibration for each date."""
    folder = tmp_path_factory.mktemp("streets") / "raw"
    made = ["data", "make", "streets", "--out", str(folder), "--number", "2", "--scale", "0.1"]
    assert main([*made, "--with-lidar"]) == 0
    return folder


def packed(folder: Path, out: Path, *words: str) -> Path:
    assert main(["data", "pack", str(folder), "--out", str(out), *words]) == 0
    return out


def assert_same(one: Dataset, other: Dataset) -> None:
    assert [frame.name for frame in one.frames] == [frame.name for frame in other.frames]
    for index, frame in enumerate(one.frames):
        a, b = one[index], other[index]
        assert torch.equal(a.input.left, b.input.left)
        assert a.input.right is not None
        assert b.input.right is not None
        assert torch.equal(a.input.right, b.input.right)
        assert repr(a.input.camera) == repr(b.input.camera)
        for name in ("disparity_px", "depth_m", "is_sky"):
            first, second = getattr(a.truth, name), getattr(b.truth, name)
            assert (first is None) == (second is None)
            if first is not None:
                torch.testing.assert_close(first, second, rtol=0, atol=0, equal_nan=True)
        if frame.velodyne is not None:
            found = [read_lidar_depth(f, "camera_z") for f in (frame, other.frames[index])]
            torch.testing.assert_close(*found, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("kind", ["pairs", "streets"])
def test_shards_give_what_the_folder_gives(
    kind: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    folder = request.getfixturevalue(kind)
    home = packed(folder, tmp_path / "shards")
    assert open_dataset(home).layout == "packed shards"
    assert_same(open_dataset(folder), open_dataset(home))
    with tarfile.open(home / "000000.tar") as tar:
        keys = tar.getnames()
    assert [name.split(".")[0] for name in keys] == sorted(name.split(".")[0] for name in keys)
    assert keys[0] == "00000000.left.png", "WebDataset's key and ending"
    assert not list(home.rglob(".part-*"))


def test_a_full_shard_is_closed(pairs: Path, tmp_path: Path) -> None:
    assert pack_frames(open_dataset(pairs).frames, tmp_path, 1) == 4
    assert_same(open_dataset(pairs), open_dataset(tmp_path))


def test_a_second_call_removes_what_a_killed_one_left(pairs: Path, tmp_path: Path) -> None:
    half = tmp_path / ".part-0123456789ab.tar"
    half.write_bytes(b"half")
    pack_frames(open_dataset(pairs).frames, tmp_path, 1)
    assert not half.exists()


def test_shards_of_a_store_come_when_they_are_read(
    pairs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pack_frames(open_dataset(pairs).frames, tmp_path / "shards", 1)
    store = fsspec.filesystem("memory")
    store.put(str(tmp_path / "shards"), "/bucket/streets", recursive=True)
    monkeypatch.setenv("DEPTHPOSE_CACHE", str(tmp_path / "cache"))
    found = open_dataset("memory://bucket/streets")
    (cache,) = (tmp_path / "cache/shards").iterdir()
    assert not list(cache.glob("*.tar")), "nothing is fetched before it is read"
    found.read_input(2)
    assert [path.name for path in cache.glob("*.tar")] == ["000002.tar"]
    assert_same(open_dataset(pairs), found)
    store.rm("/bucket/streets", recursive=True)
    assert_same(open_dataset(pairs), found)
    with pytest.raises(InputError, match=r"memory://bucket/streets: holds no index\.json"):
        open_dataset(Path("memory://bucket/streets"))


def test_packed_pairs_are_checked(pairs: Path, tmp_path: Path) -> None:
    home = packed(pairs, tmp_path / "shards")
    assert check_dataset(home).is_ok


def test_damaged_shards_are_refused(pairs: Path, tmp_path: Path) -> None:
    home = packed(pairs, tmp_path / "shards")
    shard, index = home / "000000.tar", home / "index.json"
    whole, rows = shard.read_bytes(), json.loads(index.read_text())
    shard.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(
        InputError, match=r"000000\.tar: (ends within|holds no file|not a readable)"
    ):
        open_dataset(home).read_input(3)
    shard.write_bytes(b"no tar" * 1000)
    with pytest.raises(InputError, match=r"000000\.tar: not a readable tar shard"):
        open_dataset(home).read_input(0)
    shard.unlink()
    with pytest.raises(InputError, match=r"000000\.tar: no such file"):
        open_dataset(home).read_input(0)
    for change, said in (
        ({"left": "../../secret.png"}, "names a file outside of the folder"),
        ({"left": 3}, "is not as 'depthpose data pack' writes it"),
        ({"wrong": "x"}, "is not as 'depthpose data pack' writes it"),
        ({"style": "rav"}, "frame 0 has the style 'rav'; did you mean 'raw'"),
    ):
        index.write_text(json.dumps({"frames": [rows["frames"][0] | change]}))
        with pytest.raises(InputError, match=said):
            open_dataset(home)


@pytest.mark.parametrize("content", ["{", "[]", "{}", '{"url": 3}', '{"url": ""}'])
def test_a_damaged_address_of_shards_is_refused(pairs: Path, tmp_path: Path, content: str) -> None:
    home = packed(pairs, tmp_path / "shards")
    (home / "000000.tar").unlink()
    (home / "source.json").write_text(content)
    with pytest.raises(InputError, match=r"source\.json: (not a readable JSON|must be .*ADDRESS)"):
        open_dataset(home).read_input(0)


def test_what_is_there_is_not_packed_over(
    pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    home = packed(pairs, tmp_path / "shards")
    assert main(["data", "pack", str(pairs), "--out", str(home)]) == 2
    assert "is there already" in capsys.readouterr().err
    assert main(["data", "pack", str(pairs), "--out", str(tmp_path / "x"), "--shard-mb", "0"]) == 2
    assert "--shard-mb 0: give 1 or more" in capsys.readouterr().err
    assert main(["data", "pack", str(pairs), "--out", str(pairs)]) == 2
    assert "is the dataset itself" in capsys.readouterr().err
    assert main(["data", "pack", str(home), "--out", str(tmp_path / "x")]) == 2
    assert "is packed already" in capsys.readouterr().err


@pytest.mark.slow
def test_a_killed_training_on_shards_has_the_weights_of_the_folder(
    pairs: Path, tmp_path: Path
) -> None:
    home = packed(pairs, tmp_path / "shards")
    (tmp_path / "c.yaml").write_text(CONFIG)
    words = [sys.executable, "-m", "depthpose", "depth", "train", "select", "--resume"]
    words += ["--config", str(tmp_path / "c.yaml"), "--data"]
    whole = [*words, str(pairs), "--out", str(tmp_path / "whole")]
    subprocess.run(whole, check=True, capture_output=True)
    killed = [*words, str(home), "--out", str(tmp_path / "killed")]
    process = subprocess.Popen(killed, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 300
    while not (tmp_path / "killed/state.pt").exists():
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    subprocess.run(killed, check=True, capture_output=True)
    one, other = (
        read_checkpoint(tmp_path / name / "generator.safetensors").state
        for name in ("whole", "killed")
    )
    assert all(torch.equal(one[key], other[key]) for key in one)
