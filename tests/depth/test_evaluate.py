import json
import warnings
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import pytest
import torch
from PIL import Image

from depthpose.cli.depth.evaluate import measure_and_report
from depthpose.core.camera import Camera, StereoRig, write_camera
from depthpose.core.errors import InputError, Notice
from depthpose.core.files import write_depth_png, write_image, write_map
from depthpose.core.run_folder import note_result
from depthpose.core.runner import Job
from depthpose.depth.datasets import Dataset, check_dataset, open_dataset
from depthpose.depth.disparity import depth_from_disparity, resize_map
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.evaluate import FrameMetrics, evaluate, measure_frame, read_frame_result
from depthpose.depth.predictions import (
    OutputOptions,
    estimate_missing_depth,
    is_finished,
    read_disparity,
    read_estimate,
    write_estimate,
)
from depthpose.depth.protocols import clamped_depth_from_disparity
from depthpose.depth.stereo import CallableMatcher
from depthpose.depth.types import DepthEstimate, DepthInput
from depthpose.depth.unit_mistakes import find_unit_mistake

W, H = 64, 32


def rig() -> StereoRig:
    K = torch.tensor([[80.0, 0, 31], [0, 80, 15], [0, 0, 1]], dtype=torch.float64)
    return StereoRig(width=W, height=H, K=K, baseline_m=0.5)


def truth_px(k: int) -> torch.Tensor:
    return 2 + k + torch.arange(H * W).reshape(H, W) % 7 / 4


@pytest.fixture
def pairs(tmp_path: Path) -> Dataset:
    """Two pairs with exact disparity and depth, and one without truth."""
    home = tmp_path / "data"
    for k, name in enumerate("abc"):
        write_image(home / "left" / f"{name}.png", torch.rand(3, H, W))
        write_image(home / "right" / f"{name}.png", torch.rand(3, H, W))
        if name != "c":
            write_depth_png(home / "disp_occ" / f"{name}.png", truth_px(k))
            depth_m = depth_from_disparity(truth_px(k), rig())
            write_depth_png(home / "lidar_depth" / f"{name}.png", depth_m)
    write_camera(home / "camera.json", rig())
    return open_dataset(home)


def write_predictions(folder: Path, change: Callable[[torch.Tensor], torch.Tensor]) -> Path:
    for k, name in enumerate("abc"):
        write_map(folder / f"{name}.disparity_px.npy", change(truth_px(k)))
    return folder


def test_the_sky_of_a_prediction_is_shown_as_sky(pairs: Dataset, tmp_path: Path) -> None:
    """Its disparity is that of a point 10 km away, which is no depth."""
    is_sky = torch.zeros(H, W, dtype=torch.bool)
    is_sky[:5] = True
    disparity_px = torch.where(is_sky, 0.004, truth_px(0))
    depth_m = torch.where(is_sky, torch.nan, depth_from_disparity(truth_px(0), rig()))
    seen = pairs.read_input(0)
    estimate = DepthEstimate(input=seen, depth_m=depth_m, disparity_px=disparity_px, is_sky=is_sky)
    write_estimate(tmp_path / "p", estimate)
    again = read_estimate(tmp_path / "p", pairs.read_input(0))
    assert again.is_sky is not None
    assert torch.equal(again.is_sky, is_sky)
    shown = read_frame_result(pairs, 0, tmp_path / "p", "kitti-2015", None)[0].depth_m
    assert shown is not None
    assert torch.equal(shown.isnan(), is_sky)


def test_a_prediction_of_another_size_is_shown_at_that_of_the_truth(
    pairs: Dataset, tmp_path: Path
) -> None:
    """Its sky and its right view as well, so that the pictures of a report lie over each other."""
    is_sky = torch.zeros(H // 2, W // 2, dtype=torch.bool)
    is_sky[:5] = True
    estimate = DepthEstimate(
        input=pairs.read_input(0),
        depth_m=None,
        disparity_px=truth_px(0)[::2, ::2] / 2,
        confidence=torch.ones(H // 2, W // 2),
        right=torch.rand(3, H // 2, W // 2),
        is_sky=is_sky,
    )
    write_estimate(tmp_path / "p", estimate)
    without_right = replace(pairs.frames[0], right=None)  # a right image must have the drawn size
    single = replace(pairs, frames=[without_right])
    shown, error = read_frame_result(single, 0, tmp_path / "p", "kitti-2015", None)
    maps = (shown.depth_m, shown.confidence, shown.is_sky, shown.right, error.error)
    assert [None if values is None else values.shape[-2:] for values in maps] == 5 * [(H, W)]
    assert shown.depth_m is not None
    assert bool(shown.depth_m[:10].isnan().all())
    assert not bool(shown.depth_m[10:].isnan().any())


def test_perfect_disparity_has_no_error(pairs: Dataset, tmp_path: Path) -> None:
    folder = write_predictions(tmp_path / "p", lambda d: d)
    result = evaluate(pairs, folder, "kitti-2015")
    assert result.rows[0].metrics["epe_px"] == 0
    assert result.rows[0].metrics["d1_all"] == 0
    assert result.rows[0].frames == 2
    assert result.skipped == {"c": "no truth of the kind disparity"}


def test_perfect_disparity_has_perfect_depth(pairs: Dataset, tmp_path: Path) -> None:
    folder = write_predictions(tmp_path / "p", lambda d: d)
    for row in evaluate(pairs, folder, "eigen-improved").rows:
        assert row.metrics["abs_rel"] < 1e-3  # the truth is stored in steps of 1/256 m
        assert row.metrics["d1"] == 1.0
        assert row.coverage == 1.0


@pytest.fixture
def alone(tmp_path: Path) -> Dataset:
    """One image of a camera without baseline, and its LiDAR."""
    home = tmp_path / "alone"
    write_image(home / "left/a.png", torch.rand(3, H, W))
    write_depth_png(home / "lidar_depth/a.png", torch.full((H, W), 10.0))
    camera = Camera(width=W, height=H, K=rig().K)
    write_camera(home / "camera.json", camera)
    return open_dataset(home)


@pytest.mark.parametrize("ending", ["depth_m.npy", "depth_m.pfm", "depth.png", "png"])
def test_depth_of_one_camera_needs_no_baseline(alone: Dataset, tmp_path: Path, ending: str) -> None:
    write = write_depth_png if ending.endswith("png") else write_map
    write(tmp_path / "p" / f"a.{ending}", torch.full((H, W), 10.0))
    for row in evaluate(alone, tmp_path / "p", "eigen-raw-camera").rows:
        assert row.metrics["abs_rel"] == 0
        assert row.coverage == 1
    _, wrong = read_frame_result(alone, 0, tmp_path / "p", "eigen-raw-camera", 80.0)
    assert float(wrong.error.nanmean()) == 0


@pytest.mark.parametrize("step", [1, 2])
@pytest.mark.filterwarnings("error::depthpose.core.errors.Notice")
def test_without_a_baseline_a_disparity_beside_the_depth_does_not_count(
    alone: Dataset, tmp_path: Path, step: int
) -> None:
    """It is of the rig that the generator imitates; so an estimate of one image is written."""
    size = H // step, W // step
    write_map(tmp_path / "p/a.depth_m.npy", torch.full(size, 10.0))
    write_map(tmp_path / "p/a.disparity_px.npy", torch.full(size, 1.7))
    for row in evaluate(alone, tmp_path / "p", "eigen-raw-camera").rows:
        assert row.metrics["abs_rel"] == pytest.approx(0, abs=1e-6)
    _, wrong = read_frame_result(alone, 0, tmp_path / "p", "eigen-raw-camera", 80.0)
    assert float(wrong.error.nanmean()) == pytest.approx(0, abs=1e-5)


def test_a_prediction_that_is_missing_is_not_called_a_truth(alone: Dataset, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'a' has the truth and no right .* NAME\.depth\.png"):
        evaluate(alone, tmp_path, "eigen-raw-camera")
    write_map(tmp_path / "a.disparity_px.npy", torch.full((H, W), 4.0))
    with pytest.raises(InputError, match=r"a: no calibration of a pair, .*a\.depth_m\.npy"):
        evaluate(alone, tmp_path, "eigen-raw-camera")


@pytest.mark.parametrize("ending", ["depth_m.NPY", "depth_m.PFM", "PNG"])
def test_a_prediction_in_capitals_is_read(alone: Dataset, tmp_path: Path, ending: str) -> None:
    write = write_depth_png if ending == "PNG" else write_map
    write(tmp_path / "p" / f"a.{ending.lower()}", torch.full((H, W), 10.0))
    (tmp_path / "p" / f"a.{ending.lower()}").rename(tmp_path / "p" / f"a.{ending}")
    assert evaluate(alone, tmp_path / "p", "eigen-raw-camera").rows[0].metrics["abs_rel"] == 0


def test_negative_depth_is_refused(alone: Dataset, tmp_path: Path) -> None:
    write_map(tmp_path / "a.depth_m.npy", torch.full((H, W), -10.0))
    with pytest.raises(InputError, match=r"a\.depth_m\.npy: its depth is negative; save metres"):
        evaluate(alone, tmp_path, "eigen-raw-camera")


def test_a_notice_is_given_once_for_each_evaluation(pairs: Dataset, tmp_path: Path) -> None:
    far = write_predictions(tmp_path / "far", lambda px: px / 6)
    squeezed = tmp_path / "squeezed"
    for k, name in enumerate("abc"):
        squeezed_px = resize_map(truth_px(k), H, W // 2) / 2
        write_map(squeezed / f"{name}.disparity_px.npy", squeezed_px)
    for folder, said in ((far, "is it without a scale"), (squeezed, "of another aspect")):
        for _ in range(2):
            with pytest.warns(Notice, match=said) as notices:
                evaluate(pairs, folder, "kitti-2015")
            assert len(notices) == 1
            read_frame_result(pairs, 0, folder, "kitti-2015", None)


@pytest.mark.parametrize(("protocol", "count"), [("eigen-improved", 1), ("eigen-raw-camera", 0)])
def test_depth_of_a_plain_folder_is_not_taken_for_annotated(
    pairs: Dataset,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    protocol: str,
    count: int,
) -> None:
    folder = write_predictions(tmp_path / "p", lambda px: px)
    measure_and_report(pairs, [folder], protocol, (80.0,), tmp_path / "out", [])
    said = "the truth of 2 frames is lidar_depth/ of a folder of pairs: compare no numbers"
    assert capsys.readouterr().err.count(said) == count


def test_truth_of_both_views_has_the_size_of_the_image(pairs: Dataset, tmp_path: Path) -> None:
    write_depth_png(tmp_path / "noc.png", torch.full((H, W + 2), 3.0))
    frame = replace(pairs.frames[0], disparity_noc=tmp_path / "noc.png")
    folder = write_predictions(tmp_path / "p", lambda px: px)
    with pytest.raises(InputError, match=rf"noc\.png: is {W + 2}x{H}, but its left image is {W}x"):
        evaluate(replace(pairs, frames=[frame]), folder, "kitti-2015")


def test_what_a_poor_estimate_could_be_too_is_a_notice() -> None:
    true_px = 2 + torch.rand(40, 50)
    for factor, said in (
        (256 / 1000, "3.91 times .* PNG of millimetres"),
        (1000 / 256, "its truth a PNG of millimetres"),
        (16.0, "pixels x 16"),
        (5.4, "0.185 times .* monodepth2, trained with a baseline of 0.1 m"),
        (1 / 9, "9 times .* is it without a scale"),
    ):
        with pytest.warns(Notice, match=said):
            assert find_unit_mistake(factor * true_px, true_px) is None
    with pytest.warns(Notice, match="is it inverse depth"):
        assert find_unit_mistake(6 / true_px, true_px) is None
    for fair in (1.2 * true_px, true_px + torch.randn(40, 50) / 4, torch.full((40, 50), 3.0)):
        assert find_unit_mistake(fair, true_px) is None


@pytest.mark.parametrize("unknown", [0.0, -1.0, 64.0, 65535.0, 1e30])
@pytest.mark.parametrize("kind", ["npy", "pfm", "tif"])
def test_what_no_disparity_can_be_is_no_truth(
    pairs: Dataset, tmp_path: Path, unknown: float, kind: str
) -> None:
    home = tmp_path / "data"
    for k, name in enumerate("ab"):
        (home / "disp_occ" / f"{name}.png").unlink()
        true_px = truth_px(k)
        true_px[:, 20:] = unknown
        if kind == "tif":
            Image.fromarray(true_px.numpy()).save(home / "disp_occ" / f"{name}.tif")
        else:
            write_map(home / "disp_occ" / f"{name}.{kind}", true_px)
    folder = write_predictions(tmp_path / "p", lambda px: px)
    found = evaluate(open_dataset(home), folder, "kitti-2015")
    assert found.rows[0].metrics["epe_px"] == 0
    assert {row.pixels for row in found.per_frame} == {20 * H}


def test_views_with_numbered_names_are_pairs_and_others_are_named(tmp_path: Path) -> None:
    for name in ("left_0001", "left_0010"):
        write_image(tmp_path / "left" / f"{name}.png", torch.rand(3, H, W))
        write_image(
            tmp_path / "right" / f"{name.replace('left', 'right')}.png", torch.rand(3, H, W)
        )
    write_camera(tmp_path / "camera.json", rig())
    partners = {f.name: f.right.name for f in open_dataset(tmp_path).frames if f.right}
    assert partners == {"left_0001": "right_0001.png", "left_0010": "right_0010.png"}
    (tmp_path / "right/right_0010.png").rename(tmp_path / "right/right_0011.png")
    (problem,) = [p for p in check_dataset(tmp_path).problems if p.kind == "missing"]
    assert (problem.path.name, problem.message[:31]) == ("right", "holds no file of a frame's name")


def test_a_png_of_kitti_is_disparity_where_disparity_is_measured(
    pairs: Dataset, tmp_path: Path
) -> None:
    for k, name in enumerate("abc"):
        write_depth_png(tmp_path / "p" / f"{name}.png", truth_px(k))
    assert evaluate(pairs, tmp_path / "p", "kitti-2015").rows[0].metrics["epe_px"] == 0


@pytest.mark.filterwarnings("ignore:a prediction lies")
def test_a_prediction_of_half_the_size_is_scaled(pairs: Dataset, tmp_path: Path) -> None:
    for name in "abc":
        write_map(tmp_path / "p" / f"{name}.disparity_px.npy", torch.full((H // 2, W // 2), 3.0))
    whole = write_predictions(tmp_path / "w", lambda d: torch.full_like(d, 6.0))
    half = evaluate(pairs, tmp_path / "p", "kitti-2015").rows
    assert half == evaluate(pairs, whole, "kitti-2015").rows


def test_a_prediction_of_another_shape_is_stretched_with_a_notice_or_refused(
    pairs: Dataset, tmp_path: Path
) -> None:
    def written(folder: str, change: Callable[[torch.Tensor], torch.Tensor]) -> Path:
        for k, name in enumerate("abc"):
            write_map(tmp_path / folder / f"{name}.disparity_px.npy", change(truth_px(k)))
        return tmp_path / folder

    with pytest.raises(InputError, match=rf"is {H}x{W}, and its truth {W}x{H}: it is transposed"):
        evaluate(pairs, written("turned", lambda px: px.T.contiguous()), "kitti-2015")
    top, left = 4, 3
    cut = written("cut", lambda px: px[top:, left:-left].contiguous())
    with pytest.raises(InputError, match=rf"cut out at column {left}, row {top} .* NaN around it"):
        evaluate(pairs, cut, "kitti-2015")
    squeezed = written("squeezed", lambda px: resize_map(px, H, W // 2) / 2)
    with pytest.warns(Notice, match="of another aspect, so it is stretched"):
        found = evaluate(pairs, squeezed, "kitti-2015")
    # Columns alone were squeezed: rows, which are as many as before, scale no disparity.
    plain = written("plain", lambda px: resize_map(resize_map(px, H, W // 2), H, W))
    expected = evaluate(pairs, plain, "kitti-2015").rows[0].metrics["epe_px"]
    assert found.rows[0].metrics["epe_px"] == pytest.approx(expected, abs=1e-4)


def test_depth_files_of_others_count_as_disparity(pairs: Dataset, tmp_path: Path) -> None:
    for k, name in enumerate("abc"):
        depth_m = depth_from_disparity(truth_px(k), rig())
        write_map(tmp_path / "p" / f"{name}.depth_m.npy", depth_m)
    assert evaluate(pairs, tmp_path / "p", "kitti-2015").rows[0].metrics["epe_px"] < 1e-5


def test_pixels_without_prediction_lower_the_coverage(pairs: Dataset, tmp_path: Path) -> None:
    def leave_out(d: torch.Tensor) -> torch.Tensor:
        return torch.where(torch.arange(W) < W // 4, torch.nan, d)

    row = evaluate(pairs, write_predictions(tmp_path / "p", leave_out), "kitti-2015").rows[0]
    assert row.coverage == 0.75
    assert row.metrics["epe_px"] == 0


@pytest.mark.parametrize("nothing", [0.0, -3.0])
def test_depth_of_zero_or_below_is_an_answer_and_a_wrong_one(
    pairs: Dataset, tmp_path: Path, nothing: float
) -> None:
    """The published script clamps it to 0.001 m; left out, half a map scored as a whole one."""
    for k, name in enumerate("abc"):
        depth_m = 1.05 * depth_from_disparity(truth_px(k), rig())
        spoilt_m = torch.where(torch.arange(W) < W // 2, nothing, depth_m)
        write_map(tmp_path / "p" / f"{name}.depth_m.npy", spoilt_m)
    for row in evaluate(pairs, tmp_path / "p", "eigen-improved").rows:
        assert row.coverage == 1.0
        assert row.metrics["abs_rel"] == pytest.approx((1 + 0.05) / 2, abs=2e-3)


@pytest.mark.parametrize("protocol", ["eigen-improved", "eigen-improved-garg", "eigen-raw-camera"])
def test_a_perfect_prediction_has_no_error_at_any_cap(
    pairs: Dataset, tmp_path: Path, protocol: str
) -> None:
    """Truth beyond the cap does not count; counted, a clamped perfect prediction was wrong."""
    folder = write_predictions(tmp_path / "p", lambda d: d)
    rows = evaluate(pairs, folder, protocol, caps_m=(80.0, 15.0, 12.0)).rows
    assert [row.metrics["abs_rel"] < 1e-3 for row in rows] == [True] * 3
    pixels = [row.pixels or 0 for row in rows]
    assert pixels[0] > pixels[1] > pixels[2]


def test_a_frame_without_any_usable_pixel_is_said(pairs: Dataset, tmp_path: Path) -> None:
    folder = write_predictions(tmp_path / "p", lambda d: torch.full_like(d, torch.nan))
    with pytest.raises(InputError, match="no prediction has a pixel where there is truth"):
        evaluate(pairs, folder, "kitti-2015")


def test_caps_have_a_row_each_and_clamp(pairs: Dataset, tmp_path: Path) -> None:
    folder = write_predictions(tmp_path / "p", lambda d: torch.full_like(d, 1e-3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Notice)  # that it is far from the truth
        rows = evaluate(pairs, folder, "eigen-raw-camera", caps_m=(80.0, 50.0, 15.0)).rows
    assert [row.cap_m for row in rows] == [80.0, 50.0, 15.0]
    assert rows[0].metrics["rmse"] > rows[1].metrics["rmse"] > rows[2].metrics["rmse"]
    assert (rows[2].pixels or 0) < (rows[0].pixels or 0)


def test_confidence_is_scored(pairs: Dataset, tmp_path: Path) -> None:
    def spoil(d: torch.Tensor) -> torch.Tensor:
        return d + torch.arange(W) / W

    folder = write_predictions(tmp_path / "p", spoil)
    for name in "abc":
        write_map(folder / f"{name}.confidence.npy", 1 - torch.arange(W).expand(H, W) / W)
    result = evaluate(pairs, folder, "kitti-2015")
    good = result.rows[0].metrics["ause"]
    assert result.rows[0].metrics["ause_share"] < 0.01
    errors = [row.metrics["epe_px"] for row in result.deciles]
    assert len(errors) == 10
    assert errors == sorted(errors, reverse=True)
    assert result.deciles[0].confidence_decile == 1
    assert len(evaluate(pairs, folder, "eigen-improved").deciles) == 20
    for name in "abc":
        write_map(folder / f"{name}.confidence.npy", torch.arange(W).expand(H, W) / W)
    assert good < 0.01 < evaluate(pairs, folder, "kitti-2015").rows[0].metrics["ause"]


def test_the_clamp_follows_the_published_script() -> None:
    disparity_px = torch.tensor([[0.0, -1.0, 1e-9, 400.0, 1e9, torch.nan]])
    clamped_m = clamped_depth_from_disparity(disparity_px, rig(), 80.0)[0]
    assert clamped_m[:5].tolist() == pytest.approx([1e-3, 1e-3, 80.0, 0.1, 1e-3])
    assert bool(torch.isnan(clamped_m[5]))


@pytest.mark.parametrize(
    ("protocol", "message"),
    [
        ("eigen-rw", "did you mean 'eigen-raw'"),
        (
            "eigen-raw",
            r"none of its 3 frames has the truth that protocol 'eigen-raw' needs \(velodyne_x\)\. "
            r"--protocol eigen-raw-camera or eigen-improved or eigen-improved-garg or kitti-2015 "
            r"fits\.$",
        ),
    ],
)
def test_an_unusable_protocol_is_refused(
    pairs: Dataset, tmp_path: Path, protocol: str, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        evaluate(pairs, tmp_path, protocol)


def test_a_folder_without_any_truth_is_refused(pairs: Dataset, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none of its 1 frames.*Choose another folder\.$"):
        evaluate(replace(pairs, frames=pairs.frames[2:]), tmp_path, "eigen-raw")


def test_a_missing_prediction_is_named(pairs: Dataset, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no prediction for frame 'a'. Expected a\.disparity_px"):
        evaluate(pairs, tmp_path, "kitti-2015")


def test_depth_without_a_rig_cannot_be_compared(tmp_path: Path) -> None:
    write_map(tmp_path / "a.depth_m.npy", torch.ones(3, 3))
    with pytest.raises(InputError, match="depth becomes disparity by a rig"):
        read_disparity(tmp_path, "a", None)


def test_a_frame_without_right_view_and_prediction_is_skipped(
    pairs: Dataset, tmp_path: Path
) -> None:
    frames = [replace(frame, right=None) for frame in pairs.frames[:1]] + pairs.frames[1:2]
    write_map(tmp_path / "b.disparity_px.npy", truth_px(1))
    result = evaluate(replace(pairs, frames=frames), tmp_path, "kitti-2015")
    assert result.skipped == {"a": "no right view to match, and no prediction"}


def test_a_prediction_of_which_a_file_is_damaged_is_made_again(
    pairs: Dataset, tmp_path: Path
) -> None:
    calls: list[int] = []

    def answer(left: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
        calls.append(1)
        return torch.full(tuple(left.shape[-2:]), 3.0)

    net = FakestereoNet(CallableMatcher(answer))
    sources = {frame.name: frame.left for frame in pairs.frames}
    jobs = [Job(name=f.name, read=partial(pairs.read_input, i)) for i, f in enumerate(pairs.frames)]
    list(estimate_missing_depth(net, jobs, tmp_path, {}, sources))
    files = {path: path.read_bytes() for path in sorted(tmp_path.glob("a.*"))}
    assert len(files) == 5, list(files)
    for path, good in files.items():
        for damaged in (None, good[: len(good) // 2], b"", good[:-1] + b"?"):
            path.unlink() if damaged is None else path.write_bytes(damaged)
            calls.clear()
            list(estimate_missing_depth(net, jobs, tmp_path, {}, sources))
            assert len(calls) == 1, "this frame, and no other"
            assert path.read_bytes() == good


def test_predicting_goes_on_where_it_stopped(pairs: Dataset, tmp_path: Path) -> None:
    calls: list[int] = []

    def answer(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        calls.append(1)
        return torch.full(tuple(left.shape[-2:]), 3.0)

    net = FakestereoNet(CallableMatcher(answer))
    sources = {frame.name: frame.left for frame in pairs.frames}
    jobs = [Job(name=f.name, read=partial(pairs.read_input, i)) for i, f in enumerate(pairs.frames)]
    constant = {"method": "constant"}
    first = iter(estimate_missing_depth(net, jobs, tmp_path / "p", constant, sources))
    assert next(first) == "a"
    assert len(list(estimate_missing_depth(net, jobs, tmp_path / "p", constant, sources))) == 3
    assert len(calls) == 3
    with pytest.raises(InputError, match="Two settings never share a folder"):
        list(estimate_missing_depth(net, jobs, tmp_path / "p", {"method": "another"}, sources))
    others = {name: tmp_path / f"other/{name}.png" for name in sources}
    with pytest.raises(InputError, match="'a' is the result of"):
        list(estimate_missing_depth(net, jobs, tmp_path / "p", constant, others))


def test_disparity_alone_is_written_without_metres(tmp_path: Path) -> None:
    pair = DepthInput(name="x", left=torch.rand(3, H, W), right=None, camera=None)
    estimate = DepthEstimate(
        input=pair, depth_m=None, disparity_px=truth_px(0), right=torch.rand(3, H, W)
    )
    files = write_estimate(tmp_path, estimate)
    written = sorted(path.name for path in tmp_path.iterdir())
    assert written == ["x.color.png", "x.disparity_px.npy", "x.right.png"]
    note_result(tmp_path, "x", files)
    assert is_finished(tmp_path, "x")
    with pytest.raises(InputError, match="a cloud needs metres"):
        write_estimate(tmp_path, estimate, OutputOptions(cloud_m=80.0))


def test_an_estimate_is_read_back(tmp_path: Path) -> None:
    pair = DepthInput(name="x", left=torch.rand(3, H, W), right=None, camera=rig())
    depth_m = depth_from_disparity(truth_px(0), rig())
    right = torch.ones(3, H, W) / 255
    estimate = DepthEstimate(
        input=pair,
        depth_m=depth_m,
        disparity_px=truth_px(0),
        confidence=torch.rand(H, W),
        right=right,
    )
    write_estimate(tmp_path, estimate)
    again = read_estimate(tmp_path, replace(pair, camera=None))
    for one, other in (
        (again.depth_m, depth_m),
        (again.disparity_px, truth_px(0)),
        (again.confidence, estimate.confidence),
        (again.right, right),
    ):
        assert one is not None
        assert other is not None
        assert torch.allclose(one, other)
    (tmp_path / "x.depth_m.npy").unlink()
    from_rig = read_estimate(tmp_path, pair).depth_m
    assert from_rig is not None
    assert torch.allclose(from_rig, depth_m)
    assert read_estimate(tmp_path, replace(pair, camera=None)).depth_m is None


def test_the_columns_of_a_row_are_its_fields_in_order(pairs: Dataset, tmp_path: Path) -> None:
    folder = write_predictions(tmp_path / "p", lambda d: d)
    result = evaluate(pairs, folder, "eigen-improved")
    depth = ["abs_rel", "sq_rel", "rmse", "rmse_log", "d1", "d2", "d3"]
    first = ["protocol", "dataset"]
    counts = ["pixels", "coverage"]
    assert list(result.rows[0].columns()) == [*first, "cap_m", "frames", *counts, *depth]
    assert list(result.per_frame[0].columns()) == [*first, "frame", "cap_m", *counts, *depth]
    (row,) = evaluate(pairs, folder, "kitti-2015").rows
    assert list(row.columns()) == [*first, "frames", *counts, "epe_px", "d1_all"]


def test_a_measured_frame_survives_json(pairs: Dataset, tmp_path: Path) -> None:
    folder = write_predictions(tmp_path / "p", lambda d: d + 0.1)
    for name in "ab":
        write_map(folder / f"{name}.confidence.npy", torch.rand(H, W))
    for protocol in ("eigen-improved", "kitti-2015"):
        found = measure_frame(pairs, 0, folder, protocol, (80.0,))
        assert not isinstance(found, str)
        again = FrameMetrics(**json.loads(json.dumps(asdict(found[0]))))
        assert again == found[0]
        assert (again.frame, again.cap_m) == ("a", None if protocol == "kitti-2015" else 80.0)


def test_a_frame_beyond_the_cap_is_left_out_and_one_without_an_answer_counts_as_uncovered(
    pairs: Dataset, tmp_path: Path
) -> None:
    """Truth of 'b' lies at 8 m and more; of the predictions of 'a' and 'b' one is NaN alone."""
    home = tmp_path / "p"
    write_predictions(home, lambda px: px)
    a_m = depth_from_disparity(truth_px(0), rig())
    b_m = depth_from_disparity(truth_px(1), rig())
    nearest_a, nearest_b = float(a_m.min()), float(b_m.min())
    assert nearest_b < nearest_a
    cap_m = (nearest_a + nearest_b) / 2
    found = evaluate(pairs, home, "eigen-improved", (80.0, cap_m))
    assert [(row.cap_m, row.frames) for row in found.rows] == [(80.0, 2), (cap_m, 1)]
    alone = evaluate(pairs, home, "eigen-improved", (cap_m,))
    assert alone.skipped["a"] == "no truth within the caps and the crop"
    write_map(home / "a.disparity_px.npy", torch.full((H, W), torch.nan))
    (row,) = evaluate(pairs, home, "eigen-improved", (80.0,)).rows
    assert (row.frames, row.coverage) == (2, 0.5)
    assert row.metrics["abs_rel"] == pytest.approx(0, abs=1e-3)
    write_map(home / "b.disparity_px.npy", torch.full((H, W), torch.nan))
    with pytest.raises(InputError, match="no prediction has a pixel where there is truth"):
        evaluate(pairs, home, "eigen-improved", (80.0,))


def test_far_points_of_a_rig_with_principal_points_apart_are_no_mistake(tmp_path: Path) -> None:
    """At 30 m their disparity is 80 x 0.5 / 30 - 8, which is negative."""
    apart = replace(rig(), cx_right_minus_left_px=8.0)
    home, depth_m = tmp_path / "data", torch.full((H, W), 30.0)
    for side in ("left", "right"):
        write_image(home / side / "a.png", torch.rand(3, H, W))
    write_depth_png(home / "lidar_depth/a.png", depth_m)
    write_camera(home / "camera.json", apart)
    write_map(tmp_path / "p/a.depth_m.npy", depth_m)
    (row,) = evaluate(open_dataset(home), tmp_path / "p", "eigen-improved", (80.0,)).rows
    assert row.metrics["abs_rel"] == pytest.approx(0, abs=1e-4)
