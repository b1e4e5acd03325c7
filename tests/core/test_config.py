import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import pytest

from depthpose.core.config import (
    ASCENDING,
    Settings,
    config_from_dict,
    config_to_dict,
    read_config,
    write_config,
)
from depthpose.core.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Inner:
    rate: float = 0.1
    """A rate."""

    sizes: tuple[int, ...] = (1, 2)
    """Some sizes."""

    def __post_init__(self) -> None:
        if self.rate < 0:
            raise InputError(f"rate must be 0 or more, got {self.rate}")


@dataclass(frozen=True, kw_only=True)
class Outer:
    name: str = "x"
    home: Path | None = None
    steps: int | None = None
    farthest_m: float = math.inf
    range_m: tuple[float, float] | None = None
    kinds: tuple[str, ...] = ()
    slopes: dict[str, float] = field(default_factory=dict)
    inner: Inner = field(default_factory=Inner)


def test_a_config_survives_the_file(tmp_path: Path) -> None:
    config = Outer(name="y", home=Path("a/b"), inner=Inner(rate=1e-4, sizes=(3,)))
    write_config(tmp_path / "c.yaml", config)
    assert read_config(tmp_path / "c.yaml", Outer) == config


def test_a_file_holds_differences_only(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("inner: {sizes: [4, 5]}\n")
    assert read_config(tmp_path / "c.yaml", Outer) == Outer(inner=Inner(sizes=(4, 5)))


def test_an_empty_file_is_the_default(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("# nothing\n")
    assert read_config(tmp_path / "c.yaml", Outer) == Outer()


def test_exponents_without_a_point_are_numbers(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("inner: {rate: 1e-4}\n")  # YAML 1.1 reads 1e-4 as text
    assert read_config(tmp_path / "c.yaml", Outer).inner.rate == 1e-4


def test_the_record_holds_plain_values() -> None:
    record = config_to_dict(Outer(home=Path("p"), inner=Inner(rate=0.2)))
    assert (record["home"], record["inner"]) == ("p", {"rate": 0.2, "sizes": [1, 2]})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nam: y", r"unknown key 'nam'; did you mean 'name'\? Known: 'farthest_m', 'home'"),
        ("inner: {ratte: 1}", r"unknown key 'inner.ratte'; did you mean 'rate'\?"),
        ("name: 3", "name is 3, which is not of type"),
        ("inner: {sizes: many}", r"inner.sizes is 'many', but a list is needed: write \[many\]"),
        ("inner: {sizes: }", "inner.sizes is None, but a list is needed: write its values in"),
        ("inner: {sizes: [1, true]}", r"inner.sizes\[1\] is True, but a whole number is needed"),
        ("kinds: active stereo", r"kinds is 'active stereo', .* write \[active stereo\]"),
        ("range_m: 0.6", r"range_m is 0.6, but a list of 2 values is needed: write \[0.6, 0.6\]"),
        ("range_m: {low: 1}", "range_m is .*, but a list of 2 values is needed: write its"),
        ("range_m: [1]", r"range_m is \[1\], but 2 values are needed: give so many"),
        ("range_m: [.nan, 1]", r"range_m\[0\] is nan, but a finite number is needed"),
        ("inner: {rate: fast}", "inner.rate is 'fast', but a number is needed"),
        ("inner: {rate: true}", "inner.rate is True, but a number is needed"),
        ("inner: {rate: [1]}", r"inner.rate is \[1\], but a number is needed"),
        ("inner: {rate: .nan}", "inner.rate is nan, but a finite number is needed"),
        ("inner: {rate: .inf}", "inner.rate is inf, but a finite number is needed"),
        ("inner: {rate: nan}", "inner.rate is 'nan', but a finite number is needed"),
        (f"inner: {{rate: 1{'0' * 400}}}", "inner.rate is 1000*, but a finite number is needed"),
        ("slopes: {a: .nan}", "slopes.a is nan, but a finite number is needed"),
        ("slopes: 3", "slopes is 3"),
        ("steps: true", "steps is True, but a whole number is needed: write one"),
        ("name: a\nname: b", "line 2: key 'name' is given twice"),
        ("inner: {rate: 1, sizes: [2], rate: 3}", "key 'rate' is given twice"),
        ("inner: {rate: -1}", "rate must be 0 or more, got -1.0"),
        ("[1, 2]", "holds a list, but a config is a mapping"),
        ("a: [", "not a readable YAML file"),
        ("inner: 3", "inner is 3"),
    ],
)
def test_a_bad_config_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_config(path, Outer)
    assert "c.yaml" in str(caught.value)


def test_what_defaults_allow_and_references_repeat_is_no_error(tmp_path: Path) -> None:
    text = (
        "steps: null\nrange_m: null\nfarthest_m: .inf\nslopes: {a: -1}\n"
        "inner: {<<: &one {rate: 0.2, sizes: [3]}, rate: 0.3}\n"
    )
    (tmp_path / "c.yaml").write_text(text)
    expected = Outer(slopes={"a": -1.0}, inner=Inner(rate=0.3, sizes=(3,)))
    assert read_config(tmp_path / "c.yaml", Outer) == expected


def test_a_missing_config_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.yaml"):
        read_config(tmp_path / "none.yaml", Outer)


def test_the_source_is_named() -> None:
    with pytest.raises(InputError, match=r"^the weights' config: unknown key"):
        config_from_dict({"z": 1}, Inner, source="the weights' config")


@dataclass(frozen=True, kw_only=True)
class Rules(Settings):
    span_px: Annotated[int | None, "[16, inf)", 16] = None
    range_m: Annotated[tuple[float, float] | None, "(0, inf)", ASCENDING] = None
    kind: Literal["near", "far"] | None = None


def test_settings_that_are_none_keep_to_every_rule() -> None:
    assert Rules().span_px is None


def test_the_error_of_a_rule_names_a_remedy() -> None:
    with pytest.raises(InputError, match="span_px must be a multiple of 16, got 40; take 48"):
        Rules(span_px=40)
    with pytest.raises(InputError, match=r"the lower end first, got \(2\.0, 1\.0\); swap the two"):
        Rules(range_m=(2.0, 1.0))
    with pytest.raises(InputError, match="kind"):
        Rules(kind="nera")  # pyright: ignore[reportArgumentType]
