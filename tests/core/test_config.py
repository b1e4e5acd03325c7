from dataclasses import dataclass, field
from pathlib import Path

import pytest

from depthpose.core.config import config_from_dict, config_to_dict, read_config, write_config
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
    record = config_to_dict(Outer(home=Path("p")))
    assert record == {"name": "x", "home": "p", "inner": {"rate": 0.1, "sizes": [1, 2]}}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nam: y", r"unknown key 'nam'; did you mean 'name'\? Known: 'home', 'inner', 'name'"),
        ("inner: {ratte: 1}", r"unknown key 'inner.ratte'; did you mean 'rate'\?"),
        ("name: 3", "name is 3, which is not of type"),
        ("inner: {sizes: many}", "inner.sizes"),
        ("inner: {rate: fast}", "could not convert string to float"),
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


def test_a_missing_config_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.yaml"):
        read_config(tmp_path / "none.yaml", Outer)


def test_the_source_is_named() -> None:
    with pytest.raises(InputError, match=r"^the weights' config: unknown key"):
        config_from_dict({"z": 1}, Inner, source="the weights' config")
