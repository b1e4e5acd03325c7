import csv
import errno
import io
import json
import os
import tarfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
from tests.core.engine.doubles import InProcessEngine, reverse_work, unpacked, write_texts

from depthpose.core.engine import (
    JobInputs,
    ShardedJob,
    ShardRecord,
    list_inputs,
    read_records,
    read_shard,
    run_job,
)
from depthpose.core.engine.inputs import Block
from depthpose.core.engine.shards import Computation
from depthpose.core.errors import InputError


def job_of(tmp_path: Path, words: list[str], **changed: object) -> ShardedJob:
    work = reverse_work(str(tmp_path / "log"))
    given = {"out": str(tmp_path / "out"), "settings": {"way": "back"}, "block_size": 2} | changed
    inputs = list_inputs(words, work.input_format) if words else []
    return ShardedJob(computation=work, inputs=inputs, **given)  # pyright: ignore[reportArgumentType]


def calls(tmp_path: Path) -> list[str]:
    return (tmp_path / "log").read_text().split()


def write_tar(path: Path, members: dict[str, str]) -> Path:
    with tarfile.open(path, "w") as tar:
        for name, text in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(text)
            tar.addfile(info, io.BytesIO(text.encode()))
    return path


def test_every_input_has_its_result_in_one_shard(tmp_path: Path) -> None:
    texts = {"a": "one", "b.v1": "two", "b.v1.back": "three", "c": "four", "d": "five"}
    folder = write_texts(tmp_path / "in", texts)
    done = run_job(job_of(tmp_path, [str(folder)]), InProcessEngine())
    assert [len(one.entries) for one in done] == [2, 2, 1]
    wanted = {
        name: {"back.txt": text[::-1].encode(), "length": str(len(text)).encode()}
        for name, text in texts.items()
    }
    assert unpacked(tmp_path / "out") == wanted
    rows = list(csv.DictReader((tmp_path / "out" / "manifest.csv").read_text().splitlines()))
    assert {row["name"]: row["reason"] for row in rows} == dict.fromkeys(texts, "")
    assert [row["shard"] for row in rows] == [f"00000{k}.tar" for k in (0, 0, 1, 1, 2)]
    assert calls(tmp_path).count("start") == 1, "what the work needs is loaded once"


def test_a_shard_has_the_same_bytes_whenever_it_is_made(tmp_path: Path) -> None:
    folder = write_texts(tmp_path / "in", {"a": "one", "b": "two"})
    for out in ("x", "y"):
        run_job(job_of(tmp_path, [str(folder)], out=str(tmp_path / out)), InProcessEngine())
    one, other = (tmp_path / out / "shards" / "000000.tar" for out in ("x", "y"))
    assert one.read_bytes() == other.read_bytes()


def test_a_rerun_does_what_is_missing_and_nothing_else(tmp_path: Path) -> None:
    folder = write_texts(tmp_path / "in", {name: name * 3 for name in "abcdef"})
    job = job_of(tmp_path, [str(folder)])
    with pytest.raises(InputError, match="the double died"):
        run_job(job, InProcessEngine(dies_at=1))
    assert calls(tmp_path) == ["start", "a", "b"]
    run_job(job, InProcessEngine())
    assert calls(tmp_path) == ["start", "a", "b", "start", "c", "d", "e", "f"]
    run_job(job, InProcessEngine())
    assert len(calls(tmp_path)) == 8, "where nothing is left, nothing starts"
    assert list(unpacked(tmp_path / "out")) == list("abcdef")


def test_what_is_made_from_a_changed_input_is_made_anew(tmp_path: Path) -> None:
    folder = write_texts(tmp_path / "in", {name: name * 3 for name in "abcd"})
    job = job_of(tmp_path, [str(folder)])
    run_job(job, InProcessEngine())
    changed = write_texts(folder, {"c": "new"}) / "c.txt"
    after_ns = (tmp_path / "out/shards/000001.tar").stat().st_mtime_ns + 1_000_000
    os.utime(changed, ns=(after_ns, after_ns))
    run_job(job, InProcessEngine())
    assert calls(tmp_path) == ["start", "a", "b", "c", "d", "start", "c", "d"]
    assert unpacked(tmp_path / "out")["c"]["back.txt"] == b"wen"


def test_a_shard_without_its_record_is_written_anew(tmp_path: Path) -> None:
    folder = write_texts(tmp_path / "in", {"a": "one"})
    job = job_of(tmp_path, [str(folder)])
    run_job(job, InProcessEngine())
    shards = tmp_path / "out" / "shards"
    whole = (shards / "000000.tar").read_bytes()
    (shards / "000000.json").unlink()
    (shards / "000000.tar").write_bytes(whole[:100])
    (shards / ".part-123456.tar").write_bytes(b"half")
    run_job(job, InProcessEngine())
    assert (shards / "000000.tar").read_bytes() == whole
    assert sorted(path.name for path in shards.iterdir()) == ["000000.json", "000000.tar"]


def test_inputs_that_are_new_get_shards_of_their_own(tmp_path: Path) -> None:
    folder = write_texts(tmp_path / "in", {"b": "1", "d": "2", "f": "3"})
    run_job(job_of(tmp_path, [str(folder)]), InProcessEngine())
    write_texts(folder, {"a": "4", "e": "5"})
    run_job(job_of(tmp_path, [str(folder)]), InProcessEngine())
    assert calls(tmp_path) == ["start", "b", "d", "f", "start", "a", "e"]
    named = [[name for name, _ in one.entries] for one in read_records(str(tmp_path / "out"))]
    assert named == [["b", "d"], ["f"], ["a", "e"]]


def test_a_failure_stops_no_other_and_is_tried_again(tmp_path: Path) -> None:
    folder = write_texts(tmp_path / "in", {"a": "one", "b": "bad", "c": "two"})
    done = run_job(job_of(tmp_path, [str(folder)], block_size=3), InProcessEngine())
    assert done[0].failures == [("b", f"{folder / 'b.txt'}: is bad")]
    assert list(unpacked(tmp_path / "out")) == ["a", "c"]
    (folder / "b.txt").write_text("mended")
    done = run_job(job_of(tmp_path, [str(folder)], block_size=3), InProcessEngine())
    assert not done[0].failures
    assert list(unpacked(tmp_path / "out")) == ["a", "b", "c"]


def test_an_input_that_is_not_there_is_named(tmp_path: Path) -> None:
    (tmp_path / "list.csv").write_text("text\nno.txt\n")
    done = run_job(job_of(tmp_path, [str(tmp_path / "list.csv")]), InProcessEngine())
    ((name, reason),) = done[0].failures
    assert name == "no"
    assert f"{tmp_path}/no.txt" in reason


def test_a_folder_of_other_settings_or_other_files_is_refused(tmp_path: Path) -> None:
    folder = write_texts(tmp_path / "in", {"a": "one"})
    run_job(job_of(tmp_path, [str(folder)]), InProcessEngine())
    with pytest.raises(InputError, match="made with way = 'back', but now it is 'forth'"):
        run_job(job_of(tmp_path, [str(folder)], settings={"way": "forth"}), InProcessEngine())
    other = write_texts(tmp_path / "other", {"a": "one"})
    with pytest.raises(InputError, match=r"'a' is the result of .*in/a.txt, not of .*other/a.txt"):
        run_job(job_of(tmp_path, [str(other)]), InProcessEngine())


def test_tar_shards_are_inputs_too(tmp_path: Path) -> None:
    tars = [
        write_tar(tmp_path / "0.tar", {"x/1.txt": "one", "x/1.json": "{}", "x/2.txt": "two"}),
        write_tar(tmp_path / "1.tar", {"3.text.txt": "three", "4.json": "{}"}),
    ]
    done = run_job(job_of(tmp_path, [], tars=list(map(str, tars))), InProcessEngine())
    assert [one.shard for one in done] == ["000000.tar", "000001.tar"]
    assert [name for one in done for name, _ in one.entries] == ["x/1", "x/2", "3", "4"]
    found = unpacked(tmp_path / "out")
    assert {name: files["back.txt"] for name, files in found.items()} == {
        "x/1": b"eno", "x/2": b"owt", "3": b"eerht",
    }  # fmt: skip
    assert "'4' has no text; a sample holds text" in done[1].failures[0][1]


def test_a_tar_that_is_damaged_or_leads_out_of_the_folder_fails_alone(tmp_path: Path) -> None:
    good = write_tar(tmp_path / "0.tar", {"1.txt": "one"})
    cut = tmp_path / "1.tar"
    cut.write_bytes(write_tar(tmp_path / "w.tar", {"2.txt": "two" * 999}).read_bytes()[:2000])
    evil = write_tar(tmp_path / "2.tar", {"../../evil.txt": "three"})
    done = run_job(job_of(tmp_path, [], tars=[str(good), str(cut), str(evil)]), InProcessEngine())
    assert not done[0].failures
    assert "not an intact tar file" in done[1].failures[0][1]
    assert "is no name of a result" in done[2].failures[0][1]
    assert not list(tmp_path.rglob("evil*"))


def test_two_samples_of_one_name_are_said(tmp_path: Path) -> None:
    tars = [str(write_tar(tmp_path / f"{k}.tar", {"1.txt": "one"})) for k in range(2)]
    with pytest.raises(InputError, match=r"000000.tar and 000001.tar hold two results called '1'"):
        run_job(job_of(tmp_path, [], tars=tars), InProcessEngine())


def test_a_damaged_plan_is_made_again_and_a_damaged_record_of_settings_refused(
    tmp_path: Path,
) -> None:
    folder = write_texts(tmp_path / "in", {"b": "one", "c": "two", "d": "three"})
    run_job(job_of(tmp_path, [str(folder)]), InProcessEngine())
    plan = tmp_path / "out" / "plan.jsonl"
    for text in ("no plan\n", plan.read_text()[:-5]):
        plan.write_text(text)
        before = len(calls(tmp_path))
        run_job(job_of(tmp_path, [str(folder)]), InProcessEngine())
        assert calls(tmp_path)[before:] == [], "the same blocks, and their shards are there"
    plan.unlink()
    write_texts(tmp_path / "in", {"a": "new"})
    job = job_of(tmp_path, [str(folder)])
    run_job(job, InProcessEngine())
    assert unpacked(tmp_path / "out").keys() == {"a", "b", "c", "d"}, "blocks are others now"
    (tmp_path / "out" / "run.json").write_text("{")
    with pytest.raises(InputError, match=r"run.json: not a readable JSON file"):
        run_job(job, InProcessEngine())


def test_a_shard_whose_record_names_other_results_is_refused(tmp_path: Path) -> None:
    (tmp_path / "shards").mkdir()
    write_tar(tmp_path / "shards/s.tar", {"a.length": "1"})
    entries, endings = (("b", ""),), ("length",)
    done = ShardRecord(shard="s.tar", entries=entries, endings=endings, stamp=(), block=0)
    with pytest.raises(InputError, match=r"holds 'a\.length', which its record does not name"):
        list(read_shard(str(tmp_path), done))


def test_what_engines_lose_is_missed(tmp_path: Path) -> None:
    folder = write_texts(tmp_path / "in", {"a": "one", "b": "two", "c": "three"})
    job = job_of(tmp_path, [str(folder)])

    class Forgetful(InProcessEngine):
        def __call__(
            self, blocks: Sequence[Block], work: Computation, out: str
        ) -> Iterator[ShardRecord]:
            return super().__call__(blocks[:1], work, out)

    with pytest.raises(InputError, match="1 of 2 shards are missing, first 000001"):
        run_job(job, Forgetful())
    assert json.loads((tmp_path / "out" / "shards" / "000000.json").read_text())


def test_a_full_disk_for_temporary_files_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker's error must be one of ours: Ray starts others again and again."""

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    home = write_texts(tmp_path / "in", {"a": "abc"})
    job = job_of(tmp_path, [str(home)])
    monkeypatch.setattr("depthpose.core.engine.shards.tarfile.TarFile.addfile", refuse)
    with pytest.raises(InputError, match=r"depthpose-.*cannot be written: No space left on device"):
        run_job(job, InProcessEngine())


def flip(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[600] ^= 1
    file.write_bytes(data)
    os.utime(file, ns=(1, 1))


@pytest.mark.parametrize(
    ("name", "damage"),
    [("shards/000001.tar", flip)]
    + [
        (f"shards/000001.{kind}", damage)
        for kind in ("tar", "json")
        for damage in (Path.unlink, lambda p: os.truncate(p, 40), lambda p: p.write_bytes(b""))
    ],
)
def test_a_damaged_shard_or_record_is_made_again_and_no_other(
    tmp_path: Path, name: str, damage: Callable[[Path], object]
) -> None:
    folder = write_texts(tmp_path / "in", {"a": "one", "b": "two", "c": "three"})
    job = job_of(tmp_path, [str(folder)])
    run_job(job, InProcessEngine())
    path = tmp_path / "out" / name
    good, shard = unpacked(tmp_path / "out"), (tmp_path / "out/shards/000001.tar").read_bytes()
    damage(path)
    before = len(calls(tmp_path))
    run_job(job, InProcessEngine())
    assert calls(tmp_path)[before:] == ["start", "c"]
    assert unpacked(tmp_path / "out") == good
    assert (tmp_path / "out/shards/000001.tar").read_bytes() == shard


def test_a_job_that_was_copied_is_not_done_again(tmp_path: Path) -> None:
    folder = write_texts(tmp_path / "in", {"a": "one", "b": "two", "c": "three"})
    job = job_of(tmp_path, [str(folder)])
    run_job(job, InProcessEngine())
    for shard in (tmp_path / "out" / "shards").glob("*.tar"):
        os.utime(shard, ns=(1, 1))
    before = len(calls(tmp_path))
    run_job(job, InProcessEngine())
    assert calls(tmp_path)[before:] == []


def test_links_and_names_that_are_there_twice_are_said(tmp_path: Path) -> None:
    twice, link = tmp_path / "twice.tar", tmp_path / "link.tar"
    with tarfile.open(twice, "w") as tar:
        for text in (b"one", b"two"):
            info = tarfile.TarInfo("1.txt")
            info.size = len(text)
            tar.addfile(info, io.BytesIO(text))
    with tarfile.open(link, "w") as tar:
        for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE):
            info = tarfile.TarInfo("2.txt")
            info.type, info.linkname = kind, "/etc/passwd"
            tar.addfile(info)
    (one, other) = run_job(job_of(tmp_path, [], tars=[str(twice), str(link)]), InProcessEngine())
    assert "holds '1.txt' twice; keep one of the two" in one.failures[-1][1]
    assert "'2.txt' is a link or device, and no file" in other.failures[-1][1]


def test_an_empty_tar_is_named_and_the_others_are_done(tmp_path: Path) -> None:
    empty, full = tmp_path / "empty.tar", tmp_path / "full.tar"
    tarfile.open(empty, "w").close()
    with tarfile.open(full, "w") as tar:
        info = tarfile.TarInfo("1.txt")
        info.size = 3
        tar.addfile(info, io.BytesIO(b"one"))
    job = job_of(tmp_path, [], tars=[str(empty), str(full)])
    (one, other) = run_job(job, InProcessEngine())
    assert "holds no file; pack inputs into it, or leave it out" in one.failures[0][1]
    assert other.entries == (("1", ""),)
    with (
        pytest.raises(InputError, match="holds no file"),
        JobInputs(
            listed=[], tars=[str(empty)], input_format=job.computation.input_format
        ).open_first(),
    ):
        pass
