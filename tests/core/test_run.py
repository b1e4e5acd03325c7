import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from depthpose.core.devices import computes_bf16, device_of_process, usable_device
from depthpose.core.environment import describe_environment
from depthpose.core.errors import InputError
from depthpose.core.files.images import refuse_among_inputs
from depthpose.core.loop import LoopConfig, TrainingConfig, TrainingRun
from depthpose.core.processes import ProcessRank, find_rank, wait_for
from depthpose.core.run_folder import (
    claim_folder,
    claim_names,
    is_result_finished,
    note_result,
    read_settings,
    read_sources,
    refuse_to_replace,
)


def test_a_folder_remembers_its_settings(tmp_path: Path) -> None:
    claim_folder(tmp_path / "run", {"a": 1, "b": [2, 3]})
    claim_folder(tmp_path / "run", {"a": 1, "b": [2, 3]})
    assert read_settings(tmp_path / "run") == {"a": 1, "b": [2, 3]}


def test_other_settings_are_refused_and_nothing_is_lost(tmp_path: Path) -> None:
    claim_folder(tmp_path, {"a": 1})
    (tmp_path / "result.npy").touch()
    with pytest.raises(InputError, match="made with a = 1, but now it is 2"):
        claim_folder(tmp_path, {"a": 2})
    assert read_settings(tmp_path) == {"a": 1}


def test_a_run_that_left_no_result_binds_no_other_to_its_settings(tmp_path: Path) -> None:
    claim_folder(tmp_path, {"focal_px": 700})
    claim_names(tmp_path, {"x": tmp_path / "x.png"})
    claim_folder(tmp_path, {"focal_px": 721})
    assert read_settings(tmp_path) == {"focal_px": 721}
    claim_names(tmp_path, {"x": tmp_path / "other/x.png"})


def test_an_input_that_has_changed_is_refused(tmp_path: Path) -> None:
    out, image = tmp_path / "out", tmp_path / "x.png"
    image.write_bytes(b"one")
    claim_folder(out, {"a": 1})
    claim_names(out, {"x": image})
    claim_names(out, {"x": image})
    image.write_bytes(b"mended")
    claim_names(out, {"x": image})
    (out / "x.y.depth_m.npy").touch()  # of another input, x.y
    claim_names(out, {"x": image}, [".depth_m.npy"])
    image.write_bytes(b"mended again")
    claim_names(out, {"x": image}, [".depth_m.npy"])
    (out / "x.depth_m.npy").touch()
    claim_names(out, {"x": image}, [".depth_m.npy"])
    image.write_bytes(b"another")
    with pytest.raises(InputError, match=r"x\.png: has changed since its result 'x'"):
        claim_names(out, {"x": image}, [".depth_m.npy"])
    with pytest.raises(InputError, match=r"x\.png: has changed since its result 'x'"):
        claim_names(out, {"x": image}, is_finished=lambda _: True)
    claim_names(out, {"x": image}, is_finished=lambda _: False)
    assert read_sources(out)["x"][0] == str(image.resolve())


def test_a_new_setting_counts_as_another(tmp_path: Path) -> None:
    claim_folder(tmp_path, {"a": 1})
    (tmp_path / "result.npy").touch()
    with pytest.raises(InputError, match="made with b = None, but now it is 2"):
        claim_folder(tmp_path, {"a": 1, "b": 2})


def test_a_file_in_the_place_of_a_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file")
    with pytest.raises(InputError, match="out: is a file, but a folder is needed there; choose"):
        claim_folder(tmp_path / "out", {"a": 1})


def test_a_folder_of_others_has_no_settings(tmp_path: Path) -> None:
    assert read_settings(tmp_path) is None


@pytest.mark.parametrize("content", ["[1]", "null"])
def test_a_foreign_record_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "run.json").write_text(content)
    with pytest.raises(InputError, match="not a record of a run"):
        claim_folder(tmp_path, {"a": 1})
    with pytest.raises(InputError, match="has no 'settings'"):
        read_settings(tmp_path)


def test_what_no_run_wrote_is_never_written_over(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("mine")
    with pytest.raises(InputError, match=r"report\.html: is there already, and no run of this"):
        claim_folder(tmp_path, {"a": 1}, ["rows.json", "report.html"])
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    claim_folder(tmp_path, {"a": 1}, ["rows.json"])
    claim_folder(tmp_path, {"a": 1}, ["rows.json", "report.html"])  # from here on the run's own


def test_a_foreign_list_of_sources_is_refused(tmp_path: Path) -> None:
    (tmp_path / "sources.json").write_text("{}")
    with pytest.raises(InputError, match=r"sources\.json: is there already"):
        claim_folder(tmp_path, {"a": 1})


def test_a_result_never_takes_the_name_of_a_file_that_is_there(tmp_path: Path) -> None:
    claim_folder(tmp_path, {"a": 1})
    claim_names(tmp_path, {"x": tmp_path / "x.png"}, [".color.png"])
    for name in ("x.color.png", "y.color.png", "z.txt"):
        (tmp_path / name).touch()
    claim_names(tmp_path, {"x": tmp_path / "x.png", "z": tmp_path / "z.png"}, [".color.png"])
    with pytest.raises(InputError, match=r"y\.color\.png: is there already, and no run of this"):
        claim_names(tmp_path, {"y": tmp_path / "y.png"}, [".color.png"])


def test_frames_of_a_video_take_no_name_either(tmp_path: Path) -> None:
    claim_folder(tmp_path, {"a": 1})
    (tmp_path / "drive_000003.color.png").touch()
    claim_names(tmp_path, {"drive": tmp_path / "drive.png"}, [".color.png"])
    (tmp_path / "drive2_000003.color.png").touch()
    with pytest.raises(InputError, match=r"drive2_000003\.color\.png: is there already"):
        claim_names(tmp_path, {"drive2": tmp_path / "drive2.mp4"}, [".color.png"], ["drive2"])


def test_results_among_inputs_are_refused(tmp_path: Path) -> None:
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    refuse_among_inputs(tmp_path, files, files)
    refuse_among_inputs(tmp_path / "out", [tmp_path], files)
    for word in (tmp_path, str(tmp_path / "*.png")):
        with pytest.raises(InputError, match="the inputs lie there, and a second run would take"):
            refuse_among_inputs(tmp_path, [word], files)


def test_a_file_is_not_replaced_without_consent(tmp_path: Path) -> None:
    refuse_to_replace(tmp_path / "w.safetensors")
    (tmp_path / "w.safetensors").touch()
    with pytest.raises(InputError, match=r"w\.safetensors: is there already; delete it, or give"):
        refuse_to_replace(tmp_path / "w.safetensors")


def test_the_environment_names_versions_and_date() -> None:
    facts = describe_environment()
    assert {"date", "python", "depthpose", "torch", "numpy", "machine"} <= facts.keys()


def test_the_shard_is_read_from_the_launcher(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK"):
        monkeypatch.delenv(name, raising=False)
    assert find_rank() == ProcessRank(rank=0, world=1)
    assert device_of_process("cuda") == "cuda"
    monkeypatch.setenv("RANK", "2")
    monkeypatch.setenv("WORLD_SIZE", "4")
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert find_rank() == ProcessRank(rank=2, world=4)
    assert [device_of_process(name) for name in ("cuda", "cuda:3", "cpu")] == [
        "cuda:1",
        "cuda:3",
        "cpu",
    ]


@pytest.mark.parametrize(("rank", "world"), [("4", "4"), ("-1", "2"), ("x", "2"), ("0", "")])
def test_a_rank_that_cannot_be_is_refused(
    monkeypatch: pytest.MonkeyPatch, rank: str, world: str
) -> None:
    monkeypatch.setenv("RANK", rank)
    monkeypatch.setenv("WORLD_SIZE", world)
    with pytest.raises(InputError, match="let torchrun or accelerate launch set them"):
        find_rank()


def test_waiting_ends_when_all_is_there() -> None:
    asked: list[str] = []

    def is_there(name: str) -> bool:
        asked.append(name)
        return len(asked) > 3

    wait_for(["a", "b"], is_there)
    assert asked[:2] == ["a", "b"]


def test_waiting_in_vain_names_what_is_missing() -> None:
    with pytest.raises(InputError, match="1 of 2 are missing, first 'b': another process may have"):
        wait_for(["a", "b"], lambda name: name == "a", timeout_s=0.1)


def test_a_nested_setting_is_named_by_its_path_and_a_new_one_may_be_off(tmp_path: Path) -> None:
    claim_folder(tmp_path, {"pairs": {"limit": 3}})
    (tmp_path / "result.npy").touch()
    claim_folder(tmp_path, {"pairs": {"limit": 3, "later": None, "share": 0.0}})
    with pytest.raises(InputError, match=r"pairs\.share = None, but now it is 0\.5"):
        claim_folder(tmp_path, {"pairs": {"limit": 3, "share": 0.5}})
    with pytest.raises(InputError, match=r"pairs\.limit = 3, but now it is 4"):
        claim_folder(tmp_path, {"pairs": {"limit": 4}})


def test_a_device_that_cannot_compute_is_refused() -> None:
    with pytest.raises(InputError, match=r"device 'meta' cannot be used here .* take 'cpu'"):
        usable_device("meta")


@pytest.mark.parametrize("name", ["foo", "cuda:x", ""])
def test_what_is_no_device_is_refused_in_a_short_line(name: str) -> None:
    said = f"device '{name}' cannot be used here (no such name); take cpu, cuda or cuda:1"
    for use in (usable_device, computes_bf16):
        with pytest.raises(InputError, match=f"^{re.escape(said)}$"):
            use(name)


@pytest.mark.parametrize("name", ["vulkan", "hpu"])
def test_the_reason_of_a_missing_device_is_one_sentence(name: str) -> None:
    with pytest.raises(InputError, match="cannot be used here") as error:
        usable_device(name)
    assert len(str(error.value)) < 200


@pytest.mark.parametrize("content", [None, "", '{"a": ['])
def test_results_of_which_the_source_is_lost_are_made_again(
    tmp_path: Path, content: str | None
) -> None:
    out, source = tmp_path / "out", tmp_path / "a.png"
    source.write_bytes(b"1")
    claim_folder(out, {"x": 1})
    claim_names(out, {"a": source}, [".npy"])
    (out / "a.npy").write_bytes(b"2")
    note_result(out, "a", [out / "a.npy"])
    claim_names(out, {"a": source}, [".npy"])
    assert is_result_finished(out, "a", ["a.npy"])
    record = out / "sources.json"
    record.unlink() if content is None else record.write_text(content)
    claim_names(out, {"a": source}, [".npy"])
    assert not is_result_finished(out, "a", ["a.npy"])
    assert read_sources(out)["a"][0] == str(source)


def test_a_damaged_record_of_settings_says_what_to_do(tmp_path: Path) -> None:
    claim_folder(tmp_path / "out", {"x": 1})
    (tmp_path / "out" / "run.json").write_text("{")
    with pytest.raises(InputError, match="not known any more: choose another folder, or delete"):
        claim_folder(tmp_path / "out", {"x": 1})


@dataclass(frozen=True, kw_only=True)
class NetTraining(TrainingConfig):
    start: str | None = None


def test_a_finished_training_says_how_to_train_on(tmp_path: Path) -> None:
    run = TrainingRun(folder=tmp_path)
    run.claim(NetTraining(), ("net",))
    (tmp_path / "net.safetensors").write_bytes(b"1")
    longer = NetTraining(loop=LoopConfig(steps=9))
    said = rf"train on from its weights, give a new --out and --start {tmp_path}/net\.safetensors"
    with pytest.raises(InputError, match=said):
        run.claim(longer, ("net",))
