import json
import pickle
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file
from torch import nn

from depthpose.core.checkpoint import (
    Checkpoint,
    add_terms,
    build_network,
    file_sha256,
    find_weights,
    join_terms,
    load_weights,
    read_checkpoint,
    read_published,
    read_torch_file,
    save_checkpoint,
)
from depthpose.core.errors import InputError


def saved(folder: Path, kind: str = "toy") -> Path:
    path = folder / "w.safetensors"
    state = nn.Linear(3, 2).state_dict()
    facts = {"licence": "MIT"}
    save_checkpoint(path, Checkpoint(kind=kind, config={"width": 3}, state=state, facts=facts))
    return path


def test_a_checkpoint_survives_the_file(tmp_path: Path) -> None:
    network = nn.Linear(3, 2)
    state = network.state_dict()
    made = Checkpoint(kind="toy", config={"width": 3}, state=state, facts={"licence": "MIT"})
    save_checkpoint(tmp_path / "w.safetensors", made)
    read = read_checkpoint(tmp_path / "w.safetensors", "toy")
    assert (read.kind, read.config, read.facts) == ("toy", {"width": 3}, {"licence": "MIT"})
    other = nn.Linear(3, 2)
    load_weights(other, read, "w")
    torch.testing.assert_close(other.weight, network.weight, rtol=0, atol=0)


def test_equal_weights_are_equal_files(tmp_path: Path) -> None:
    """A checksum names weights, and a rerun asks for the same: safetensors orders by chance."""
    state = nn.Linear(3, 2).state_dict()
    facts = {"licence": "MIT", "terms": "für alle \n\t\x7f", "trained_on": "a", "stage": "b"}
    for number in range(8):
        made = Checkpoint(kind="toy", config={"width": 3}, state=state, facts=facts)
        save_checkpoint(tmp_path / f"{number}.safetensors", made)
    assert len({file_sha256(path) for path in tmp_path.iterdir()}) == 1
    assert read_checkpoint(tmp_path / "0.safetensors").facts == facts


@pytest.mark.parametrize(
    ("every", "joined"),
    [
        ([], ""),
        (["", ""], ""),
        (["", "For research.", "For research."], "For research."),
        (["Cite us.", "", "For research."], "Cite us. For research."),
        (["Cite us.", "Cite us. For research."], "Cite us. For research."),
        (["Cite us. For research.", "Cite us."], "Cite us. For research."),
        (["commercial", "non-commercial"], "commercial non-commercial"),
    ],
)
def test_terms_of_all_parts_bind_the_whole_and_none_comes_twice(
    every: list[str], joined: str
) -> None:
    assert join_terms(*({"terms": terms} if terms else {} for terms in every)) == joined


def test_a_card_is_bound_by_what_the_weights_are_made_of(tmp_path: Path) -> None:
    state = nn.Linear(3, 2).state_dict()
    for name, terms in (("free", {}), ("bound", {"terms": "For research."})):
        made = Checkpoint(kind="toy", config={}, state=state, facts=terms)
        save_checkpoint(tmp_path / f"{name}.safetensors", made)
    free, bound = (tmp_path / f"{name}.safetensors" for name in ("free", "bound"))
    assert add_terms({"licence": "MIT"}, [free]) == {"licence": "MIT"}
    assert add_terms({"terms": "Cite us."}, [free, bound]) == {"terms": "Cite us. For research."}
    with pytest.raises(InputError, match="neither a file nor the name"):
        add_terms({}, ["nowhere"])


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


def _scramble(path: Path) -> None:
    path.write_bytes(b"\x00" * 64)


def _strip(path: Path) -> None:
    save_file({"a": torch.zeros(1)}, path)


def _spoil_config(path: Path) -> None:
    save_file({"a": torch.zeros(1)}, path, {"kind": "toy", "config": "{"})


def _list_config(path: Path) -> None:
    save_file({"a": torch.zeros(1)}, path, {"kind": "toy", "config": "[]"})


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_truncate, "not a readable safetensors file"),
        (_scramble, "not a readable safetensors file"),
        (_strip, "no 'kind' and 'config'.*depthpose weights import"),
        (_spoil_config, "its 'config' is not JSON"),
        (_list_config, "its 'config' is not a mapping"),
        (Path.unlink, "there is no such weights file"),
    ],
)
def test_a_bad_weights_file_is_refused(
    tmp_path: Path, spoil: Callable[[Path], None], message: str
) -> None:
    path = saved(tmp_path)
    spoil(path)
    with pytest.raises(InputError, match=message):
        read_checkpoint(path)


def test_weights_of_another_kind_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="kind 'toy', but 'psmnet' is needed"):
        read_checkpoint(saved(tmp_path), "psmnet")


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"weight": torch.zeros(2, 3)}, "bias is missing"),
        (
            {"weight": torch.zeros(2, 3), "bias": torch.zeros(2), "x": torch.zeros(1)},
            "x is unexpected",
        ),
        (
            {"weight": torch.zeros(2, 4), "bias": torch.zeros(2)},
            r"weight is \(2, 4\), not \(2, 3\)",
        ),
    ],
)
def test_loading_is_strict(state: dict[str, torch.Tensor], message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_weights(nn.Linear(3, 2), Checkpoint(kind="toy", config={}, state=state), "w")


def test_only_safetensors_are_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"end the name in \.safetensors"):
        save_checkpoint(tmp_path / "w.pt", Checkpoint(kind="toy", config={}, state={}))


class Harmful:
    def __reduce__(self) -> tuple[Callable[[str], object], tuple[str]]:
        return (pytest.fail, ("code in the checkpoint was run",))


def test_pickled_code_is_refused_and_not_run(tmp_path: Path) -> None:
    torch.save({"state_dict": Harmful()}, tmp_path / "bad.tar")
    with pytest.raises(InputError, match="could run code on loading"):
        read_torch_file(tmp_path / "bad.tar")
    (tmp_path / "bare.pkl").write_bytes(pickle.dumps(Harmful()))
    with pytest.raises(InputError, match=r"bare\.pkl"):
        read_torch_file(tmp_path / "bare.pkl")


def test_a_checkpoint_that_is_no_mapping_is_refused(tmp_path: Path) -> None:
    torch.save([torch.zeros(1)], tmp_path / "list.pt")
    with pytest.raises(InputError, match="holds a list"):
        read_torch_file(tmp_path / "list.pt")


def test_a_mapping_of_tensors_is_read(tmp_path: Path) -> None:
    torch.save({"state_dict": {"a": torch.arange(3)}}, tmp_path / "w.tar")
    assert read_torch_file(tmp_path / "w.tar")["state_dict"]["a"].tolist() == [0, 1, 2]


def test_an_unknown_name_says_where_weights_come_from() -> None:
    with pytest.raises(InputError, match="weights 'nope': neither a file nor the name"):
        find_weights("nope")


@pytest.mark.parametrize("name", ["kitti-nc", "linemod-nc", "bunny-nc", "ycb"])
def test_weights_that_stay_out_of_the_wheel_say_where_they_are(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("depthpose.core.checkpoint.SHIPPED", tmp_path)
    with pytest.raises(InputError, match=f"not in the wheel.*weights/{name}.safetensors from the"):
        find_weights(name)


def test_the_fingerprint_is_sha256(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    assert file_sha256(tmp_path / "a").startswith("ba7816bf8f01cfea")


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(noise=st.binary(max_size=200), cut=st.integers(0, 400), where=st.integers(0, 300))
def test_no_bytes_let_another_error_escape(
    tmp_path: Path, noise: bytes, cut: int, where: int
) -> None:
    whole = saved(tmp_path).read_bytes()
    path = tmp_path / "fuzz.safetensors"
    torch.save({"a": torch.zeros(4)}, tmp_path / "t.pt")
    torch_file = (tmp_path / "t.pt").read_bytes()
    for content in (noise, whole[:cut], whole[:where] + noise + whole[where:]):
        path.write_bytes(content)
        _only_input_error(lambda: read_checkpoint(path))
    for content in (noise, torch_file[:cut], torch_file[:where] + noise + torch_file[where + 9 :]):
        path.write_bytes(content)
        _only_input_error(lambda: read_torch_file(path))


def _only_input_error(read: Callable[[], object]) -> None:
    with suppress(InputError):
        read()


def test_metadata_is_text_that_others_can_read(tmp_path: Path) -> None:
    raw = saved(tmp_path).read_bytes()
    header = json.loads(raw[8 : 8 + int.from_bytes(raw[:8], "little")])
    assert header["__metadata__"]["kind"] == "toy"


class Drawn(nn.Module):
    """A network whose weights are drawn in every way that torch has."""

    def __init__(self) -> None:
        super().__init__()
        names = ("normal_", "uniform_", "trunc_normal_", "kaiming_normal_", "kaiming_uniform_")
        names += ("xavier_normal_", "xavier_uniform_", "orthogonal_")
        for name in names:
            self.register_parameter(name, nn.Parameter(torch.ones(8, 4)))
            getattr(nn.init, name)(self.get_parameter(name))


def test_a_network_is_built_without_drawing_its_weights() -> None:
    state = {name: weight.detach().clone() for name, weight in Drawn().named_parameters()}
    built = build_network(Drawn, Checkpoint(kind="toy", config={}, state=state), "w")
    for name, weight in built.named_parameters():
        assert torch.equal(weight, state[name])
    plain = Checkpoint(kind="toy", config={}, state=nn.Linear(3, 2).state_dict())
    before = torch.get_rng_state()
    build_network(lambda: nn.Linear(3, 2), plain, "w")
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.bfloat16])
def test_weights_that_are_no_numbers_are_refused_by_name(
    tmp_path: Path, value: float, dtype: torch.dtype
) -> None:
    state = {"a.weight": torch.ones(3, 4, dtype=dtype), "a.bias": torch.zeros(5, dtype=dtype)}
    state["a.bias"][2] = value
    path = tmp_path / "w.safetensors"
    save_checkpoint(path, Checkpoint(kind="toy", config={}, state=state))
    torch.save({"state_dict": state}, tmp_path / "w.pth")
    save_file(state, tmp_path / "published.safetensors")
    said = r"1 of the 5 numbers of 'a\.bias' are NaN or infinite"
    with pytest.raises(InputError, match=said):
        read_checkpoint(path)
    for name in ("w.pth", "published.safetensors"):
        with pytest.raises(InputError, match=said):
            read_published(tmp_path / name, "toy")


def test_a_sum_beyond_float32_is_no_damage(tmp_path: Path) -> None:
    state = {"large": torch.full((8,), 3e38), "count": torch.tensor(3)}
    path = tmp_path / "w.safetensors"
    save_checkpoint(path, Checkpoint(kind="toy", config={}, state=state))
    assert torch.equal(read_checkpoint(path).state["large"], state["large"])


def test_a_variance_below_zero_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    state = {"norm.running_var": torch.tensor([1.0, -1.0])}
    save_checkpoint(path, Checkpoint(kind="toy", config={}, state=state))
    with pytest.raises(InputError, match=r"'norm\.running_var' holds a variance below 0"):
        read_checkpoint(path)


def test_a_setting_that_is_no_number_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    save_checkpoint(path, Checkpoint(kind="toy", config={"limit": float("nan")}, state={}))
    with pytest.raises(InputError, match=r"its 'config' is not JSON \(NaN is not a JSON number\)"):
        read_checkpoint(path)
