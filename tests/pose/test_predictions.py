import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import jsonschema
import pytest
import torch

from depthpose.core.errors import InputError, Notice
from depthpose.core.rigid import Rigid, perturb
from depthpose.core.runner import run_jobs
from depthpose.pose.predictions import (
    VERSION,
    Place,
    PoseJob,
    PoseResults,
    Prediction,
    read_bop_results,
    read_earlier_predictions,
    read_predictions,
    write_bop_results,
    write_predictions,
)
from depthpose.pose.types import Alternative, Evidence, Identity, PoseEstimate, Status


def some_pose(seed: int) -> Rigid:
    generator = torch.Generator().manual_seed(seed)
    start = Rigid(torch.eye(3), torch.tensor([0.01, -0.02, 0.8]))
    return perturb(start, torch.randn(6, generator=generator))


def answer(name: str = "a", seed: int = 0) -> PoseEstimate:
    generator = torch.Generator().manual_seed(seed)
    return PoseEstimate(
        name=name,
        object="cat",
        status="ok",
        camera_from_model=some_pose(seed),
        keypoints_m=torch.randn(8, 3, generator=generator),
        covariance=torch.randn(6, 6, generator=generator),
        free_motions=torch.randn(1, 6, generator=generator),
        inlier_share=0.75,
        residual_m=0.002,
        evidence=Evidence(
            visible=40.0,
            supported=30.5,
            explained=30.5,
            unobserved=8.0,
            seen_through=1.5,
            bulging=0.0,
            beside=0.25,
            silhouette=4.0,
            continued=0.5,
            rms=0.75,
            noise_m=0.001,
        ),
        certainty=0.5,
        copy_certainty=0.375,
        identity=Identity(status="not excluded", size=1.02, size_deviation=0.01, reason="so"),
        alternatives=(
            Alternative(
                camera_from_model=some_pose(seed + 9),
                probability=0.375,
                difference="rotated by 180 degrees about the long axis",
                is_copy=True,
            ),
        ),
        seconds={"network": 0.015, "proposal": 0.007},
    )


def refusal(name: str = "b") -> PoseEstimate:
    reason = "the cloud has 3 points"
    return PoseEstimate(name=name, object="cat", status="too few points", reason=reason)


def test_estimates_go_out_and_come_back(tmp_path: Path) -> None:
    sent = [
        Prediction(estimate=answer(), place=Place(1, 20, 6)),
        Prediction(estimate=refusal(), place=Place(1, 20, 5)),
        Prediction(estimate=replace(answer("c", 1), free_motions=None, seconds={})),
    ]
    write_predictions(tmp_path, sent)
    for one, again in zip(sent, read_predictions(tmp_path), strict=True):
        assert one.place == again.place
        before, after = vars(one.estimate), vars(again.estimate)
        for name, value in before.items():
            if isinstance(value, torch.Tensor):
                assert torch.equal(value.double(), after[name]), name
            elif isinstance(value, Rigid):
                assert torch.equal(value.R.double(), after[name].R)
                assert torch.equal(value.t_m.double(), after[name].t_m)
            elif name == "alternatives":
                for own, other in zip(value, after[name], strict=True):
                    assert torch.equal(own.camera_from_model.R.double(), other.camera_from_model.R)
                    assert own.probability == other.probability
                    assert own.difference == other.difference
            else:
                assert value == after[name], name


def test_the_time_of_a_search_counts_once_for_its_image(tmp_path: Path) -> None:
    # Two objects of one search that took 2 s, in which one was registered, then a loose box.
    stages = {"cloud": 0.25, "icp": 0.5, "search": 2.0}
    in_box = {"segmentation": 0.125, "icp": 0.5, "search": 1.0}
    sent = [
        Prediction(estimate=replace(answer("a"), seconds=stages), place=Place(1, 20, 6)),
        Prediction(estimate=replace(refusal(), seconds={"search": 2.0}), place=Place(1, 20, 5)),
        Prediction(estimate=replace(answer("c", 1), seconds=in_box), place=Place(1, 20, 6)),
        Prediction(estimate=replace(answer("d", 2), seconds=stages), place=Place(1, 21, 6)),
    ]
    path = tmp_path / "ours_lm-test.csv"
    write_bop_results(path, sent)
    times = [float(line.rsplit(",", 1)[1]) for line in path.read_text().splitlines()[1:]]
    assert times == [3.125, 3.125, 2.0]


def test_a_distance_that_is_none_is_no_number_in_the_file(tmp_path: Path) -> None:
    lost = replace(answer(), residual_m=float("inf"))
    write_predictions(tmp_path, [Prediction(estimate=lost)])
    assert read_predictions(tmp_path)[0].estimate.residual_m is None


def test_the_csv_has_no_row_of_a_refusal_but_its_time(tmp_path: Path) -> None:
    by_votes = replace(answer("c", 1), seconds={}, evidence=None, certainty=None, alternatives=())
    slow = replace(refusal(), seconds={"segmentation": 0.1})
    sent = [
        Prediction(estimate=answer(), place=Place(1, 20, 6)),
        Prediction(estimate=slow, place=Place(1, 20, 5)),
        Prediction(estimate=by_votes, place=Place(2, 0, 6)),
    ]
    path = tmp_path / "ours_lm-test.csv"
    write_bop_results(path, sent)
    first, second = read_bop_results(path)
    assert first.place == (1, 20, 6)
    assert first.estimate.seconds == {"image": pytest.approx(0.122)}
    assert first.estimate.inlier_share == 0.5
    assert (second.estimate.seconds, second.estimate.inlier_share) == ({}, 0.75)
    assert first.estimate.camera_from_model is not None
    t_m = first.estimate.camera_from_model.t_m
    assert torch.allclose(t_m, some_pose(0).t_m.double(), atol=1e-7)
    write_bop_results(path, sent, with_alternatives=True)
    scores = [(p.place, p.estimate.inlier_share) for p in read_bop_results(path)]
    assert scores == [((1, 20, 6), 0.5), ((1, 20, 6), 0.375), ((2, 0, 6), 0.75)]
    with pytest.raises(InputError, match="a: belongs to no scene of a BOP dataset"):
        write_bop_results(path, [Prediction(estimate=answer())])


def test_finished_work_is_not_done_again(tmp_path: Path) -> None:
    asked: list[str] = []

    def estimate(names: Sequence[str]) -> list[PoseEstimate]:
        asked.extend(names)
        return [answer(name) for name in names]

    def jobs(*names: str) -> list[PoseJob[str]]:
        return [PoseJob(name=name, read=lambda name=name: name, object="cat") for name in names]

    run = run_jobs(jobs("a", "b", "c"), estimate, PoseResults[str](tmp_path))
    assert [next(run).job.name for _ in range(2)] == ["a", "b"]
    run.close()  # as an interrupt does
    assert [p.estimate.name for p in read_predictions(tmp_path)] == ["a", "b"]
    run = run_jobs(jobs("a", "b", "c", "d"), estimate, PoseResults[str](tmp_path), batch=2)
    assert [outcome.result is None for outcome in run] == [True, True, False, False]
    assert [p.estimate.name for p in read_predictions(tmp_path)] == ["a", "b", "c", "d"]
    assert asked == ["a", "b", "c", "d"]


@pytest.mark.parametrize("must_read", [False, True])
def test_what_cannot_be_read_is_an_estimate_unless_it_must_be(
    tmp_path: Path, must_read: bool
) -> None:
    def read() -> str:
        raise InputError("torn")

    job = PoseJob(name="a", read=read, object="cat")
    results = PoseResults[str](tmp_path, must_read=must_read)
    run = run_jobs([job], lambda names: [answer(name) for name in names], results)
    if must_read:
        with pytest.raises(InputError, match="torn"):
            next(run)
        assert read_predictions(tmp_path) == []
    else:
        next(run)
        assert results.predictions["a"].estimate.reason == "cannot be read: torn"


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    write_predictions(tmp_path, [Prediction(estimate=answer(), place=Place(1, 2, 3))])
    path = tmp_path / "poses.json"
    row = json.loads(path.read_text())[0]
    flipped = [[-1.0, 0.0, 0.0, 0.0], *row["camera_from_model"][1:]]
    for change, said in (
        ({"name": 3}, "name and object are 3 and 'cat'; write two words"),
        ({"status": "okay"}, "status 'okay': did you mean 'ok'"),
        ({"status": "votes do not meet"}, "an estimate that is ok or ambiguous has a camera"),
        ({"camera_from_model": None}, "an estimate that is ok or ambiguous has a camera"),
        ({"camera_from_model": flipped}, "camera_from_model is no rigid transform; write 4 rows"),
        ({"covariance": [[1.0, "x"]]}, "covariance is not 6 rows of 6 numbers"),
        ({"covariance": 7 * [6 * [0.0]]}, "covariance is not 6 rows of 6 numbers"),
        ({"camera_from_model": [[1.0, 0.0, 0.0, 0.0]]}, "is not 4 rows of 4 numbers"),
        ({"seconds": [0.1]}, "where names to numbers belong"),
        ({"im_id": None}, "im_id is None, where a number from 0 to 1000000000 belongs"),
    ):
        path.write_text(json.dumps([row | change]))
        with pytest.raises(InputError, match=rf"poses.json: entry 0: .*{said}"):
            read_predictions(tmp_path)
    path.write_text(json.dumps([row, row]))
    with pytest.raises(InputError, match="two estimates are called 'a'; keep one of them"):
        read_predictions(tmp_path)


@pytest.mark.parametrize("content", ["", "[{", "{}", '[{"name": 1}]'])
def test_damaged_results_are_made_again_with_a_notice(tmp_path: Path, content: str) -> None:
    assert read_earlier_predictions(tmp_path) == {}
    write_predictions(tmp_path, [Prediction(estimate=answer())])
    assert len(read_earlier_predictions(tmp_path)) == 1
    (tmp_path / "poses.json").write_text(content)
    with pytest.warns(Notice, match=r"poses\.json.* it is damaged, and made again"):
        assert read_earlier_predictions(tmp_path) == {}


def schema() -> dict[str, Any]:
    return json.loads((Path(__file__).parents[2] / "docs/poses.schema.json").read_text())


def test_the_schema_describes_what_is_written(tmp_path: Path) -> None:
    """Every kind of estimate is valid by it; another version, name or shape is not."""
    tracked = replace(answer("t", 2), tracking="tracked", camera_from_model=some_pose(2))
    sent = [
        Prediction(estimate=answer(), place=Place(1, 20, 6)),
        Prediction(estimate=refusal(), place=Place(1, 20, 5)),
        Prediction(estimate=tracked),
        Prediction(estimate=replace(answer("bare"), covariance=None, evidence=None, identity=None)),
        Prediction(estimate=replace(answer("far"), residual_m=torch.inf)),
        Prediction(estimate=answer("based").in_base(some_pose(5))),
    ]
    write_predictions(tmp_path, sent)
    rows = json.loads((tmp_path / "poses.json").read_text())
    validator = jsonschema.Draft202012Validator(schema())
    validator.check_schema(schema())
    assert [error.message for error in validator.iter_errors(rows)] == []
    broken = [
        {"version": 1},
        {"status": "fine"},
        {"camera_from_model": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]},
        {"certainty": 1.5},
        {"pose": None},
    ]
    for change in broken:
        assert not validator.is_valid([rows[0] | change]), change
    for name in ("version", "reason", "alternatives"):
        assert not validator.is_valid([{k: v for k, v in rows[0].items() if k != name}]), name


def test_a_pose_in_the_base_frame_comes_back(tmp_path: Path) -> None:
    base = some_pose(5)
    sent = [answer().in_base(base), refusal().in_base(base)]
    write_predictions(tmp_path, [Prediction(estimate=one) for one in sent])
    posed, refused = (p.estimate for p in read_predictions(tmp_path))
    assert posed.camera_from_model is not None
    assert posed.base_from_model is not None
    expected = base.double() @ posed.camera_from_model
    torch.testing.assert_close(posed.base_from_model.matrix(), expected.matrix())
    assert refused.base_from_model is None


def test_the_schema_knows_every_status() -> None:
    known = schema()["$defs"]["estimate"]["properties"]
    assert tuple(known["status"]["enum"]) == get_args(Status)
    assert known["version"] == {"const": VERSION}


def test_another_version_is_refused_and_none_is_taken(tmp_path: Path) -> None:
    write_predictions(tmp_path, [Prediction(estimate=answer())])
    (row,) = json.loads((tmp_path / "poses.json").read_text())
    assert row.pop("version") == VERSION
    (tmp_path / "poses.json").write_text(json.dumps([row]))
    assert read_predictions(tmp_path)[0].estimate.name == "a"
    (tmp_path / "poses.json").write_text(json.dumps([row | {"version": 1}]))
    with pytest.raises(InputError, match="entry 0: version is 1, and this depthpose reads 2"):
        read_predictions(tmp_path)


def test_estimates_become_a_data_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pandas")
    write_predictions(tmp_path, [Prediction(estimate=answer()), Prediction(estimate=refusal())])
    frame = read_predictions(tmp_path).to_frame()
    assert list(frame["name"]) == ["a", "b"]
    assert list(frame["status"]) == ["ok", "too few points"]
    assert frame["evidence.supported"][0] == 30.5
    assert frame["seconds.proposal"][0] == 0.007
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"a data frame needs pandas, .*: pip install pandas"):
        read_predictions(tmp_path).to_frame()
