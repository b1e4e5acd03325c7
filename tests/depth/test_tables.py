from dataclasses import replace

import pytest

from depthpose.depth.evaluate import EvaluationRow
from depthpose.thesis.depth import TABLES, join_published

OURS = EvaluationRow(
    method="net",
    weights="w",
    protocol="eigen-raw",
    dataset="kitti",
    cap_m=80.0,
    frames=697,
    pixels=12,
    coverage=1.0,
    metrics={
        "abs_rel": 0.15, "sq_rel": 1.0, "rmse": 5.0, "rmse_log": 0.2, "d1": 0.8, "d2": 0.9,
        "d3": 0.95, "right_l1": 0.1,
    },
)  # fmt: skip


def test_every_printed_row_is_there() -> None:
    counts = {number: len(table.rows) for number, table in TABLES.items()}
    assert counts == {"2.1": 12, "2.2": 4, "2.3": 4}
    for table in TABLES.values():
        for own in table.thesis_rows:
            assert [row.cap_m for row in table.rows if row.method == own] == [80, 50]


def test_printed_numbers_are_possible() -> None:
    for table in TABLES.values():
        for row in table.rows:
            e = row.errors
            assert 0 < e["abs_rel"] < e["sq_rel"] < e["rmse"] < 10
            assert e["abs_rel"] / 2 < e["rmse_log"]
            assert 0.6 < e["d1"] < e["d2"] < e["d3"] < 1


def test_a_smaller_cap_has_smaller_errors() -> None:
    for table in TABLES.values():
        by_cap = {(row.method, row.cap_m): row.errors for row in table.rows}
        for (method, cap_m), near in by_cap.items():
            if cap_m == 50:
                far = by_cap[method, 80]
                assert near["abs_rel"] < far["abs_rel"]
                assert near["rmse"] < far["rmse"]


def test_tables_2_1_and_2_3_share_the_row_without_fine_tuning() -> None:
    for cap_m in (80, 50):
        rows = [
            next(
                r
                for r in TABLES[n].rows
                if r.method == TABLES[n].thesis_rows[0] and r.cap_m == cap_m
            )
            for n in ("2.1", "2.3")
        ]
        assert rows[0].errors == rows[1].errors


def test_our_row_follows_the_printed_ones_and_then_the_difference() -> None:
    rows = join_published(TABLES["2.1"], [("thesis, Ours", OURS)])
    assert [row["source"] for row in rows] == ["published"] * 8 + ["ours", "difference"] + [
        "published"
    ] * 4
    difference = rows[9]
    assert difference["abs_rel"] == pytest.approx(0.15 - 0.141)
    assert difference["rmse"] == pytest.approx(5.0 - 5.20)
    assert difference["protocol"] == "eigen-raw"
    assert rows[8] == {"source": "ours"} | OURS.columns()
    columns = [list(row) for row in (rows[0], rows[8], difference)]
    assert columns[0] == [
        "source", "method", "weights", "cap_m", "abs_rel", "sq_rel", "rmse", "rmse_log", "d1",
        "d2", "d3", "protocol", "note",
    ]  # fmt: skip
    assert columns[1] == [*columns[0][:-1], "dataset", "frames", "pixels", "coverage", "right_l1"]
    assert columns[2] == columns[0][:-1]


def test_each_weights_of_table_2_3_has_its_own_row() -> None:
    table = TABLES["2.3"]
    rows = join_published(table, [(own, OURS) for own in table.thesis_rows])
    differences = [row["abs_rel"] for row in rows if row["source"] == "difference"]
    assert differences == pytest.approx([0.15 - 0.141, 0.15 - 0.126])


def test_another_protocol_is_said_in_the_difference() -> None:
    other = replace(OURS, protocol="eigen-raw-camera")
    rows = join_published(TABLES["2.2"], [("thesis, Ours", other)])
    assert {row["protocol"] for row in rows} == {
        "eigen-raw", "eigen-raw-camera", "eigen-raw-camera against eigen-raw",
    }  # fmt: skip


def test_baselines_and_other_caps_have_no_difference() -> None:
    ours = [("", OURS), ("thesis, Ours", replace(OURS, cap_m=30.0))]
    rows = join_published(TABLES["2.2"], ours)
    assert [row["source"] for row in rows].count("ours") == 2
    assert "difference" not in {row["source"] for row in rows}


def test_the_row_of_other_truth_is_marked() -> None:
    protocols = {row.method: row.protocol for row in TABLES["2.1"].rows}
    assert protocols.pop("Fu et al. [24] (ResNet)") == "post-processed truth"
    assert set(protocols.values()) == {"eigen-raw"}
