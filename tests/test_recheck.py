"""The script that runs the quick tables of the results again."""

import sys
from pathlib import Path
from types import ModuleType

import pytest
from tests.written import bench_module


@pytest.fixture(scope="module")
def recheck() -> ModuleType:
    return bench_module("recheck")


def test_every_quick_table_is_found_in_the_results(recheck: ModuleType) -> None:
    """A heading, a column or a row that was renamed would be skipped without a word."""
    for table in recheck.TABLES:
        printed = table.printed()
        columns = set(printed[0])
        assert {*table.numbers, *table.key} <= columns, table.name
        firsts = {next(iter(line.values())) for line in printed}
        assert set(table.rows or ()) <= firsts, table.name


@pytest.mark.parametrize(
    ("printed", "now", "is_moved"),
    [
        ("0.472", 0.5411, True),  # PSMNet's AUSE, printed from an older window
        ("0.541", 0.5411, False),
        ("68.8 %", 0.6884, False),
        ("68.8 %", 0.697, True),
        (".278", 0.2784, False),
        ("22.219", 22.2189, False),
        ("1", 1.4, False),
        ("1", 1.6, True),
        ("0.5", None, True),
    ],
)
def test_a_number_has_moved_beyond_its_last_digit(
    recheck: ModuleType, printed: str, now: float | None, is_moved: bool
) -> None:
    assert recheck.has_moved(printed, now, 0.001) == is_moved


def test_what_moved_is_named_and_what_was_not_compared_too(recheck: ModuleType) -> None:
    text = (
        "## Results\n\nIn words.\n\n| method | cap | AbsRel | AUSE |\n| --- | --- | --- | --- |\n"
        "| `net` | 80 | 0.100 | 0.472 |\n| **net** | 50 | 0.090 | |\n| net | 30 | 1 | 1 |\n"
        "| other | 80 | 1 | 1 |\n\nEnd.\n"
    )
    table = recheck.Table(
        name="t", after="## Results", commands=(), files=(), key={"cap": "cap_m"},
        numbers={"AbsRel": "abs_rel", "AUSE": "ause"}, rows={"net": {"weights": "w"}},
    )  # fmt: skip
    rows = [
        {"weights": "w", "cap_m": 80.0, "abs_rel": 0.1001, "ause": 0.541},
        {"weights": "w", "cap_m": 50.0, "abs_rel": 0.2, "ause": 0.5},
    ]
    moved, compared, left_out = recheck.compare(table, recheck.printed_rows(text, "## Res"), rows)
    assert moved == [
        "net 80: AUSE is 0.541, printed 0.472",
        "net 50: AbsRel is 0.2, printed 0.090",
        "net 30: 0 rows are {'weights': 'w', 'cap_m': '30'}",
    ]
    assert (compared, left_out) == (3, ["other 80"])


@pytest.mark.slow
@pytest.mark.data
def test_a_table_of_real_frames_is_as_printed(
    recheck: ModuleType,
    real: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("DEPTHPOSE_DATA", str(real))
    monkeypatch.setattr(sys, "argv", ["recheck", "--only", "raw", "--out", str(tmp_path)])
    assert recheck.main() == 0
    assert "raw: 20 numbers, 0 moved" in capsys.readouterr().out
