import json
import os
import random
import signal
import socket
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import pytest
import torch
from tests.core.forked import start
from tests.core.loop_task import ToySamples, ToyTask, train_toy, weights
from torch import Tensor

from depthpose.core.devices import PrecisionNotice, computes_bf16
from depthpose.core.errors import InputError, Notice
from depthpose.core.loop import (
    AdamConfig,
    Interrupted,
    LoopConfig,
    Progress,
    TrainingRun,
    ValidationResult,
    format_card,
    format_last_validation,
    make_sample_generator,
    read_metrics,
    shuffle_index,
    write_card,
)


def loop(**changes: object) -> LoopConfig:
    settings = {"steps": 12, "batch_size": 4, "save_every_steps": 4, "device": "cpu",
             "log_every_steps": 4, **changes}  # fmt: skip
    return LoopConfig(**settings)


def trained(folder: Path, config: LoopConfig, **words: object) -> ToyTask:
    task = ToyTask()
    run = TrainingRun(folder=folder, **words)  # pyright: ignore[reportArgumentType]
    run.train(task, ToySamples(), config)
    return task


def assert_equal(one: dict[str, Tensor], other: dict[str, Tensor]) -> None:
    assert one.keys() == other.keys()
    for name in one:
        assert torch.equal(one[name], other[name]), name


def assert_same_state(*folders: Path) -> None:
    one, other = (torch.load(f / "state.pt", weights_only=True)["modules"] for f in folders)
    for network in one:
        assert_equal(one[network], other[network])


def interrupted(folder: Path, config: LoopConfig, after: int, **words: object) -> None:
    def stop(progress: Progress) -> None:
        if progress.step == after:
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(Interrupted, match=r"stopped after step"):
        trained(folder, config, on_step=stop, **words)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"ema_decay": 0.9},
        {"accumulate": 2, "clip_norm": 0.1},
        pytest.param(
            {"precision": "bf16"},
            marks=pytest.mark.skipif(not computes_bf16("cpu"), reason="no arithmetic for bf16"),
        ),
    ],
)
def test_a_resumed_training_equals_an_uninterrupted_one(
    tmp_path: Path, changes: dict[str, object]
) -> None:
    whole = trained(tmp_path / "whole", loop(**changes))
    interrupted(tmp_path / "parts", loop(**changes), after=5)
    parts = trained(tmp_path / "parts", loop(**changes), resume=True)
    assert_equal(weights(whole), weights(parts))
    one, other = (
        [row for row in read_metrics(tmp_path / name) if "regressor/loss" in row][-1]
        for name in ("whole", "parts")
    )
    assert one == other


def test_what_was_stopped_is_finished_with_the_steps_so_far(tmp_path: Path) -> None:
    """Its weights are those of a training of so many steps, but for the schedule of the rate."""
    with pytest.raises(InputError, match="holds no state of a training"):
        trained(tmp_path / "none", loop(), finish=True)
    interrupted(tmp_path, loop(ema_decay=0.9), after=5)
    saved = torch.load(tmp_path / "state.pt", weights_only=True)
    finished = trained(tmp_path, loop(ema_decay=0.9), finish=True)
    for name, module in finished.modules.items():
        assert_equal(module.state_dict(), saved["average"][name])
    whole = trained(tmp_path, loop(ema_decay=0.9), resume=True)
    assert_equal(weights(whole), weights(trained(tmp_path / "whole", loop(ema_decay=0.9))))


def test_the_card_counts_the_steps_of_the_state_that_was_finished(tmp_path: Path) -> None:
    changes: dict[str, Any] = {"log_every_steps": 4, "validate_every_steps": 100}
    interrupted(tmp_path, loop(**changes), after=5)
    step = torch.load(tmp_path / "state.pt", weights_only=True)["step"]
    assert step > read_metrics(tmp_path)[-1]["step"]
    trained(tmp_path, loop(**changes), finish=True)
    write_card(tmp_path / "net.safetensors", "depth train view", 3.0, {}, "")
    assert f"- **Time**: {step} steps in 3 s on " in (tmp_path / "net.md").read_text()


def test_ctrl_c_twice_finishes_with_the_step_at_hand(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def press_twice(progress: Progress) -> None:
        for _ in range(2 if progress.step == 5 else 0):
            os.kill(os.getpid(), signal.SIGINT)

    trained(tmp_path, loop(log_every_steps=100), on_step=press_twice)
    assert torch.load(tmp_path / "state.pt", weights_only=True)["step"] == 6
    last = read_metrics(tmp_path)[-1]
    assert last["step"] == 6
    assert "held_out/one" in last, "the last step is validated as any last one is"
    assert "Press Ctrl-C again" in capfd.readouterr().err


def test_ctrl_c_once_stops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("depthpose.core.loop.loop.SECOND_CTRL_C_S", 0.1)

    def press(progress: Progress) -> None:
        if progress.step == 5:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Interrupted, match=r"stopped after step 6 of 12.*--finish makes weights"):
        trained(tmp_path, loop(), on_step=press)


def test_a_training_without_bf16_is_one_in_fp32_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exact = trained(tmp_path / "fp32", loop())
    monkeypatch.setattr("depthpose.core.devices.computes_bf16", lambda _: False)
    with pytest.warns(PrecisionNotice, match=r"no arithmetic for bf16 .*; fp32 is taken"):
        task = trained(tmp_path / "bf16", loop(precision="bf16"))
    assert_equal(weights(exact), weights(task))


def test_the_time_of_a_training_counts_the_runs_that_it_resumes(tmp_path: Path) -> None:
    interrupted(tmp_path, loop(), after=5)
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    assert 0 < state["seconds"] < 1000
    torch.save({**state, "seconds": 1000.0}, tmp_path / "state.pt")
    assert TrainingRun(folder=tmp_path, resume=True).train(ToyTask(), ToySamples(), loop()) > 1000
    del state["seconds"]  # as older versions left it
    torch.save(state, tmp_path / "state.pt")
    assert (
        0 < TrainingRun(folder=tmp_path, resume=True).train(ToyTask(), ToySamples(), loop()) < 1000
    )


def test_a_card_says_what_how_how_long_and_how_good(tmp_path: Path) -> None:
    folder = tmp_path / "my part"
    assert format_last_validation(folder, "Errors.") == (
        "Nothing was held out, so nothing was measured."
    )
    folder.mkdir()
    rows = [{"step": 4, "held_out/error": 0.5}, {"step": 8, "held_out/error": 1 / 3},
            {"step": 12, "net/loss": 0.1}]  # fmt: skip
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    trained(tmp_path / "run", loop(steps=12))
    (tmp_path / "run" / "state.pt").rename(folder / "state.pt")
    measured = format_last_validation(folder, "Errors (m).")
    assert measured == "Errors (m).\n\n| held out | |\n| --- | --- |\n| error | 0.3333 |"
    facts = {"trained_on": "kitti", "terms": "For research."}
    write_card(folder / "net.safetensors", "depth train view", 7300.0, facts, measured)
    title, empty, *lines = (folder / "net.md").read_text().splitlines()
    assert (title, empty) == ("# net", "")
    assert lines[:3] == [
        "- **Trained on**: kitti",
        "- **Terms**: For research.",
        "- **Command**: `depthpose depth train view --config config.yaml --out 'my part'`",
    ]
    assert lines[3].startswith("- **Time**: 12 steps in 2.0 h on Linux ")
    assert "\n".join(lines[5:]) == measured
    for seconds, said in ((3.4, "3 s"), (119.0, "119 s"), (300.0, "5 min")):
        write_card(folder / "net.safetensors", "", seconds, {}, "")
        assert f" steps in {said} on " in (folder / "net.md").read_text()
    assert format_card("net", {"licence": "MIT"}) == "# net\n\n- **Licence**: MIT\n"


def test_what_is_logged_is_the_mean_of_the_steps_since(tmp_path: Path) -> None:
    losses: dict[int, list[float]] = {}
    for every in (1, 5):
        trained(tmp_path / str(every), loop(steps=10, log_every_steps=every))
        rows = [row for row in read_metrics(tmp_path / str(every)) if "regressor/loss" in row]
        losses[every] = [row["regressor/loss"] for row in rows]
    assert len(losses[1]) == 10
    means = [sum(losses[1][:5]) / 5, sum(losses[1][5:]) / 5]
    assert losses[5] == pytest.approx(means, rel=1e-5)


def test_training_learns_and_says_so(tmp_path: Path) -> None:
    seen: list[Progress] = []
    task = trained(tmp_path, loop(steps=200, log_every_steps=20), on_step=seen.append)
    rows = [row for row in read_metrics(tmp_path) if "regressor/loss" in row]
    assert rows[-1]["regressor/loss"] < 0.3 * rows[0]["regressor/loss"]
    assert rows[0]["regressor/double"] == pytest.approx(2 * rows[0]["regressor/loss"])
    assert [p.step for p in seen] == list(range(1, 201))
    assert seen[-1].steps == 200
    assert (tmp_path / "pictures" / "0000200_grey.png").is_file()
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    board = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    drawn = [(e.step, e.value) for e in board.Scalars("regressor/loss")]
    assert drawn == [(r["step"], pytest.approx(r["regressor/loss"])) for r in rows]
    assert [e.step for e in board.Images("grey")] == [200]
    assert all(bool(t.isfinite().all()) for t in weights(task).values())


@pytest.mark.parametrize("limit", [None, 0.05])
def test_gradients_are_clipped_where_asked(tmp_path: Path, limit: float | None) -> None:
    task, norms = ToyTask(), []
    optimizer = task.optimizers["regressor"][0]

    def note(*_: object) -> None:
        grads = [p.grad.flatten() for p in task.modules["regressor"].parameters()]
        norms.append(float(torch.cat(grads).norm()))

    optimizer.register_step_pre_hook(note)
    TrainingRun(folder=tmp_path).train(task, ToySamples(), loop(clip_norm=limit))
    assert len(norms) == 12
    assert (max(norms) <= 0.05 * 1.001) == (limit is not None)


def test_lines_after_the_state_are_dropped_on_resume(tmp_path: Path) -> None:
    interrupted(tmp_path, loop(log_every_steps=1), after=6)
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"step": 9, "regressor/loss": 7.0}) + '\n{"step": 1')
    trained(tmp_path, loop(log_every_steps=1), resume=True)
    steps = [row["step"] for row in read_metrics(tmp_path) if "regressor/loss" in row]
    assert steps == list(range(1, 13))


@pytest.mark.parametrize(
    "line",
    [
        "",
        "[1]",
        "null",
        '{"loss": 1.0}',
        '{"step": "1"}',
        '{"step": 1.5}',
        '{"step": true}',
        '{"step": 2, "loss": "low"}',
        '{"step": 2, "loss": null}',
        '{"step": 2, "loss": 1' + "0" * 400 + "}",
        '{"step": 2, "loss": 1' + "0" * 5000 + "}",
        "[" * 100_000,
        '{"step": 1',
    ],
)
def test_a_damaged_line_of_metrics_is_named(tmp_path: Path, line: str) -> None:
    good = '{"step": 1, "loss": NaN}\n'
    (tmp_path / "metrics.jsonl").write_text(f"{good}{line}\n{good}")
    with pytest.raises(InputError, match=r"metrics\.jsonl: line 2 is no step .*Delete that line"):
        read_metrics(tmp_path)
    (tmp_path / "metrics.jsonl").write_text(good + line)  # a kill cuts the last one short
    assert [row["step"] for row in read_metrics(tmp_path)] == [1]


def test_metrics_that_are_no_text_are_named(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_bytes(b"\xff\xfe\n")
    with pytest.raises(InputError, match=r"metrics\.jsonl: not UTF-8 text"):
        read_metrics(tmp_path)


def test_the_average_of_weights_is_what_comes_out(tmp_path: Path) -> None:
    path: list[Tensor] = []
    task = ToyTask()

    def note(_: Progress) -> None:
        path.append(weights(task)["discriminator.weight"].clone())

    average = weights(task)["discriminator.weight"].clone()
    config = loop(steps=6, ema_decay=0.8, validate_every_steps=100)
    TrainingRun(folder=tmp_path, on_step=note).train(task, ToySamples(), config)
    for step, weight in enumerate(path):
        decay = min(0.8, (1 + step) / (10 + step))
        average = decay * average + (1 - decay) * weight
    torch.testing.assert_close(weights(task)["discriminator.weight"], average)


def test_validation_sees_the_average_and_leaves_the_weights(tmp_path: Path) -> None:
    class Watched(ToyTask):
        def validate(self) -> ValidationResult:
            seen.append(weights(self)["discriminator.weight"].clone())
            return super().validate()

    seen: list[Tensor] = []
    plain = trained(tmp_path / "plain", loop(ema_decay=0.8, validate_every_steps=100))
    task = Watched()
    config = loop(ema_decay=0.8, validate_every_steps=5)
    TrainingRun(folder=tmp_path / "watched").train(task, ToySamples(), config)
    assert_equal(weights(plain), weights(task))
    three = trained(tmp_path / "five", loop(steps=12, ema_decay=0.8), on_step=None)
    assert len(seen) == 3
    torch.testing.assert_close(seen[-1], weights(three)["discriminator.weight"])
    state = torch.load(tmp_path / "watched" / "state.pt", weights_only=True)
    assert not torch.equal(state["modules"]["discriminator"]["weight"], seen[-1])


def test_a_folder_with_a_state_is_not_overwritten(tmp_path: Path) -> None:
    trained(tmp_path, loop(steps=2))
    with pytest.raises(InputError, match=r"holds a training\. Add --resume"):
        trained(tmp_path, loop(steps=2))


def test_a_full_disk_keeps_the_last_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained(tmp_path, loop(steps=4))
    before = (tmp_path / "state.pt").read_bytes()

    def refuse(path: Path, _: bytes) -> None:
        path.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", refuse)
    with pytest.raises(InputError, match="No space left"):
        trained(tmp_path, loop(steps=8), resume=True)
    assert (tmp_path / "state.pt").read_bytes() == before
    assert not list(tmp_path.glob(".part-*"))


def step_of(state: Path) -> int:
    return torch.load(state, weights_only=True)["step"]


def test_the_last_two_states_are_kept(tmp_path: Path) -> None:
    trained(tmp_path, loop())
    assert step_of(tmp_path / "state.pt") == 12
    assert step_of(tmp_path / "state.before.pt") == 8


def flipped(state: Path) -> bytes:
    """Flip one bit of a weight, over which torch reads in silence."""
    data = bytearray(state.read_bytes())
    weight = torch.load(state, weights_only=True)["modules"]["regressor"]["0.weight"]
    data[data.index(weight.numpy().tobytes())] ^= 4
    return bytes(data)


DAMAGES: dict[str, Callable[[Path], bytes]] = {
    "cut": lambda state: state.read_bytes()[:-100],
    "empty": lambda _: b"",
    "flipped": flipped,
    "text": lambda _: b"no state",
}


@pytest.mark.parametrize("damage", [*DAMAGES, "gone"])
def test_a_damaged_state_falls_back_to_the_one_before_with_a_line(
    tmp_path: Path, damage: str
) -> None:
    whole = trained(tmp_path / "whole", loop())
    interrupted(tmp_path / "parts", loop(), after=5)
    last, before = (tmp_path / "parts" / name for name in ("state.pt", "state.before.pt"))
    assert (step_of(last), step_of(before)) == (6, 4)
    if damage == "gone":
        last.unlink()
    else:
        last.write_bytes(DAMAGES[damage](last))  # the other name keeps its own bytes
    with pytest.warns(Notice, match=r"goes on from state\.before\.pt, step 4") as said:
        interrupted(tmp_path / "parts", loop(), after=5, resume=True)
    assert "\n" not in str(said[0].message)
    # What was damaged is gone, and the state that held is still there.
    assert (step_of(last), step_of(before)) == (6, 4)
    parts = trained(tmp_path / "parts", loop(), resume=True)
    assert_equal(weights(whole), weights(parts))
    assert (step_of(last), step_of(before)) == (12, 8)


def test_a_disk_without_links_keeps_two_states_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(os, "link", refuse)
    trained(tmp_path, loop())
    assert (step_of(tmp_path / "state.pt"), step_of(tmp_path / "state.before.pt")) == (12, 8)


def wider(state: dict[str, Any]) -> None:
    state["modules"]["discriminator"]["weight"] = torch.zeros(1, 2)


def moved(state: dict[str, Any]) -> None:
    state["optimizers"]["discriminator"]["state"][0]["exp_avg"] = torch.zeros(7)


def grouped(state: dict[str, Any]) -> None:
    state["optimizers"]["discriminator"]["param_groups"][0]["params"] = [0]


def averaged(state: dict[str, Any]) -> None:
    state["average"]["discriminator"]["bias"] = torch.zeros(())


UNFIT: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "shape": (
        wider,
        r"discriminator: weight is \(1, 2\), not \(1, 1\); it is the state of another one",
    ),
    "optimiser": (
        moved,
        r"optimiser of discriminator: exp_avg of parameter 0 is \(7,\), not \(1, 1\)",
    ),
    "groups": (
        grouped,
        r"optimiser of discriminator: it moved groups of \[1\] parameters, not of \[2\]",
    ),
    "average": (averaged, r"average of discriminator: bias is \(\), not \(1,\)"),
    "no module": (
        lambda s: s["modules"].pop("discriminator"),
        "not a readable state of this training",
    ),
    "no tensor": (
        lambda s: s["modules"]["discriminator"].pop("bias"),
        "discriminator: bias is missing",
    ),
    "no scaler": (lambda s: s.pop("scaler"), r"has no \['scaler'\], so it is no state"),
    "step": (lambda s: s.update(step="x"), "its step is 'x', where a whole number belongs"),
    "seconds": (lambda s: s.update(seconds=[]), "not a readable state of this training"),
    "list": (lambda s: s.update(modules=[]), "not a readable state of this training"),
}


@pytest.mark.parametrize("name", UNFIT)
def test_the_state_of_another_training_is_explained(tmp_path: Path, name: str) -> None:
    trained(tmp_path, loop(steps=2, ema_decay=0.9))
    change, message = UNFIT[name]
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    change(state)
    torch.save(state, tmp_path / "state.pt")
    with pytest.raises(InputError, match=rf"state\.pt: .*{message}.*no state is left to go on"):
        trained(tmp_path, loop(steps=2, ema_decay=0.9), resume=True)


def test_a_loss_that_is_not_finite_stops_with_advice(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"loss is inf at step 0\. Start anew in another folder"):
        TrainingRun(folder=tmp_path).train(ToyTask(factor=float("inf")), ToySamples(), loop())


def test_nothing_to_train_on_is_refused(tmp_path: Path) -> None:
    class Nothing(ToySamples):
        def __len__(self) -> int:
            return 0

    with pytest.raises(InputError, match="no sample to train on"):
        TrainingRun(folder=tmp_path).train(ToyTask(), Nothing(), loop())


def test_half_precision_without_a_gpu_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'fp16' cannot be used here: it needs a GPU"):
        trained(tmp_path, loop(precision="fp16"))


def test_scaling_the_loss_changes_no_weight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The scaler of fp16, but in fp32: times a power of two and back is exact."""
    exact = trained(tmp_path / "fp32", loop(clip_norm=0.1))
    scaler = torch.amp.GradScaler
    monkeypatch.setattr("torch.amp.GradScaler", lambda device, enabled: scaler(device))  # noqa: ARG005
    assert_equal(weights(exact), weights(trained(tmp_path / "scaled", loop(clip_norm=0.1))))
    interrupted(tmp_path / "parts", loop(clip_norm=0.1), after=5)
    assert torch.load(tmp_path / "parts/state.pt", weights_only=True)["scaler"]["scale"] == 65536
    parts = trained(tmp_path / "parts", loop(clip_norm=0.1), resume=True)
    assert_equal(weights(exact), weights(parts))


@pytest.mark.skipif(not computes_bf16("cpu"), reason="no arithmetic for bf16")
def test_trainings_of_one_process_may_differ_in_precision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """accelerate keeps that of the first, and what would change it is private."""
    monkeypatch.delattr("accelerate.state.AcceleratorState._reset_state")
    exact = trained(tmp_path / "fp32", loop())
    rounded = trained(tmp_path / "bf16", loop(precision="bf16"))
    again = trained(tmp_path / "again", loop())
    assert_equal(weights(exact), weights(again))
    pairs = zip(weights(exact).values(), weights(rounded).values(), strict=True)
    assert not all(torch.equal(one, other) for one, other in pairs)


def test_a_device_beside_that_of_an_earlier_training_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**_: object) -> None:
        raise ValueError("AcceleratorState has already been initialized")

    monkeypatch.setattr("accelerate.Accelerator", refuse)
    with pytest.raises(InputError, match=r"device 'cpu' .* in a process of its own \(Accel"):
        trained(tmp_path, loop())


def test_each_epoch_is_a_shuffle_of_its_own() -> None:
    epochs = [[shuffle_index(20 * e + i, 20, 7) for i in range(20)] for e in range(2)]
    assert [sorted(epoch) for epoch in epochs] == [list(range(20))] * 2
    assert epochs[0] != epochs[1]
    assert epochs[0] != [shuffle_index(i, 20, 8) for i in range(20)]


def test_a_sample_index_draws_the_same_numbers_again() -> None:
    one, again, other = (torch.rand(4, generator=make_sample_generator(t, 1)) for t in (5, 5, 6))
    assert torch.equal(one, again)
    assert not torch.equal(one, other)


@pytest.mark.parametrize(
    ("schedule", "rates"),
    [
        ("constant", [1.0, 1.0, 1.0, 1.0]),
        ("constant-linear", [1.0, 1.0, 1.0, 0.5]),
        ("halving", [1.0, 0.5, 0.25, 0.125]),
        ("cosine", [1.0, 0.8535534, 0.5, 0.1464466]),
    ],
)
def test_schedules_by_hand(schedule: str, rates: list[float]) -> None:
    adam = AdamConfig(learning_rate=0.5, schedule=schedule)  # pyright: ignore[reportArgumentType]
    assert [adam.rate_at(s, 40) / 0.5 for s in (0, 10, 20, 30)] == pytest.approx(rates)


def test_warm_up_rises_from_zero() -> None:
    adam = AdamConfig(learning_rate=0.1, warmup_steps=4)
    assert [adam.rate_at(s, 40) for s in range(5)] == pytest.approx([0.025, 0.05, 0.075, 0.1, 0.1])


def test_epochs_become_steps() -> None:
    config = LoopConfig(epochs=20.0, batch_size=4, accumulate=2)
    assert config.total_steps(400, 1) == 1000
    assert config.total_steps(400, 2) == 500


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"epochs": 3.0}, "give one of the two"),
        ({"steps": None}, "give one of the two"),
        ({"batch_size": 0}, r"batch_size must be in \(0, inf\), got 0"),
        ({"workers": -1}, "workers must be in"),
        ({"seed": -1}, r"seed must be in \[0, 9223372036854775808\), got -1"),
        ({"seed": 2**63}, r"seed must be in \[0, 9223372036854775808\), got 9223372036854775808"),
        ({"ema_decay": 1.0}, r"ema_decay must be in \(0, 1\)"),
    ],
)
def test_bad_settings_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        loop(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"learning_rate": 0.0}, "learning_rate must be in"),
        ({"beta1": 1.0}, "beta1 must be in"),
    ],
)
def test_bad_settings_of_adam_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        AdamConfig(**changes)  # pyright: ignore[reportArgumentType]


def test_two_processes_equal_one_that_accumulates(tmp_path: Path) -> None:
    """Weights agree to float32 rounding; batch norm statistics are each process's own."""
    one, two = tmp_path / "one", tmp_path / "two"
    train_toy(one, 6, accumulate=2)
    _launch(two)
    states = [torch.load(f / "state.pt", weights_only=True)["modules"] for f in (one, two)]
    for network in states[0]:
        for name, tensor in states[0][network].items():
            if "running" not in name and "num_batches" not in name:
                torch.testing.assert_close(tensor, states[1][network][name], rtol=1e-5, atol=1e-6)
    # Adam's first moment is the mean of the gradients so far.
    loaded = [torch.load(f / "state.pt", weights_only=True)["optimizers"] for f in (one, two)]
    for name in loaded[0]:
        moments = [[s["exp_avg"] for s in side[name]["state"].values()] for side in loaded]
        assert moments[0]
        torch.testing.assert_close(*moments, rtol=1e-4, atol=1e-6)


def _launch(folder: Path) -> None:
    """Train in two processes; once more where a busy machine missed their rendezvous."""
    for attempt in range(2):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        launch = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
        said = [folder.with_name(f"{attempt}-{rank}.said") for rank in range(2)]
        both = [
            start(train_toy, folder, 6, said=said[rank],
                  environment={**launch, "RANK": str(rank), "LOCAL_RANK": str(rank)})
            for rank in range(2)
        ]  # fmt: skip
        for process in both:
            process.join(120)
            process.kill()
            process.join()
        if [process.exitcode for process in both] == [0, 0]:
            return
        assert attempt == 0, [path.read_text()[-3000:] for path in said]


@pytest.mark.slow
def test_a_signal_to_the_whole_job_saves_the_state(tmp_path: Path) -> None:
    """Schedulers signal every process of a job, the workers that make samples too."""
    folder, file = tmp_path / "run", tmp_path / "said"
    process = start(train_toy, folder, 4000, pause_s=0.05, workers=2, said=file)
    _wait_for_progress(folder, process)
    assert process.pid is not None
    os.killpg(process.pid, signal.SIGTERM)
    process.join(60)
    said = file.read_text()
    assert "stopped after step" in said, said[-2000:]
    step = torch.load(folder / "state.pt", weights_only=True)["step"]
    assert f"stopped after step {step} " in said


def test_a_kill_while_the_state_is_written_leaves_no_half_file(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    trained(whole, loop())
    interrupted(killed, loop(), after=5)
    before = (killed / "state.pt").read_bytes()
    process = start(train_toy, killed, 12, with_slow_disk=True, said=tmp_path / "said")
    deadline = time.monotonic() + 120
    while not list(killed.glob(".part-*.pt")) and time.monotonic() < deadline:
        time.sleep(0.02)
    process.kill()
    process.join()
    assert list(killed.glob(".part-*.pt"))
    assert (killed / "state.pt").read_bytes() == before
    trained(killed, loop(), resume=True)
    assert not list(killed.rglob(".part-*"))
    assert_same_state(whole, killed)


@pytest.mark.slow
def test_four_kills_change_nothing(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    steps = 200
    train_toy(whole, steps)
    moments, kills = random.Random(0), 0
    while kills < 4:
        process = start(train_toy, killed, steps, pause_s=0.1, said=tmp_path / "said")
        _wait_for_progress(killed, process)
        time.sleep(moments.uniform(0.0, 1.0))
        process.kill()
        process.join()
        kills += 1
        state = killed / "state.pt"
        reached = torch.load(state, weights_only=True)["step"]
        last = max((row["step"] for row in read_metrics(killed)), default=0)
        assert last - 3 <= reached <= steps  # what is lost is what came after the last save
    train_toy(killed, steps)
    assert_same_state(whole, killed)
    assert not list(killed.glob(".part-*"))


def _wait_for_progress(folder: Path, process: BaseProcess) -> None:
    """Let the process load and begin, so that the kill meets training, not importing."""
    state = folder / "state.pt"
    before = state.stat().st_mtime_ns if state.exists() else 0
    deadline = time.monotonic() + 240  # of a busy machine
    while time.monotonic() < deadline and process.is_alive():
        if state.exists() and state.stat().st_mtime_ns != before:
            return
        time.sleep(0.02)
    raise AssertionError("the training did not go on")
