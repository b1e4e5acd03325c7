from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from depthpose.cli import main
from depthpose.core.camera.pinhole import intrinsics
from depthpose.core.errors import InputError
from depthpose.core.render import rasterize
from depthpose.depth.config import NearConfig
from depthpose.depth.datasets import open_dataset, write_scene
from depthpose.depth.disparity import disparity_from_depth, warp_right_to_left
from depthpose.depth.synthetic import SyntheticFrame, make_near, render_near
from depthpose.depth.synthetic.near import NearScene, _NearSceneBuilder

SMALL = NearConfig(
    columns_px=(144.0, 192.0), infrared_share=0.0, border_share=0.0, jpeg_share=0.0,
    rectification_error_px=0.0,
)  # fmt: skip


@cache
def drawn(index: int) -> SyntheticFrame:
    """A frame of :data:`SMALL`, which no test changes."""
    return render_near(SMALL, index)


def test_scenes_are_near_and_of_all_kinds() -> None:
    scenes: list[NearScene] = [make_near(NearConfig(), index) for index in range(30)]
    assert {made.kind for made in scenes} == {"room", "table", "bin", "shelf", "wall"}
    baselines_m = [made.rig.baseline_m * made.metres_per_unit for made in scenes]
    assert 0.0099 < min(baselines_m) < 0.03
    assert 0.2 < max(baselines_m) < 0.5401


def test_disparities_reach_up_to_half_of_the_width() -> None:
    shares: list[float] = []
    for index in range(8):
        frame = drawn(index)
        known = frame.disparity_px[frame.disparity_px.isfinite()]
        shares.append(float(known.max()) / frame.rig.width)
        assert float(known.min()) > 0
    assert max(shares) < 0.55
    assert max(shares) > 0.2
    assert min(shares) < 0.15


def test_truth_warps_the_right_view_to_the_left_one() -> None:
    for index in (1, 4, 7):
        frame = drawn(index)
        warped = warp_right_to_left(frame.right, frame.disparity_px)
        seen = ~frame.occluded & warped.isfinite().all(0)
        error = (warped - frame.left).abs().mean(0)[seen]
        shifted = warp_right_to_left(frame.right, frame.disparity_px + 3)
        other = (shifted - frame.left).abs().mean(0)[seen & shifted.isfinite().all(0)]
        assert float(error.median()) < 0.04
        assert float(error.mean()) < float(other.mean())


def test_metres_are_those_of_the_rig() -> None:
    frame = drawn(2)
    expected_px = disparity_from_depth(frame.depth_m, frame.rig)
    known = frame.disparity_px.isfinite()
    torch.testing.assert_close(frame.disparity_px[known], expected_px[known], rtol=1e-5, atol=1e-4)
    assert float(frame.depth_m[known].min()) > 0.04


def test_dots_are_seen_by_both_cameras_at_the_same_place() -> None:
    """On a plain surface the dots alone tell where a pixel is seen by the other camera."""
    infrared = replace(SMALL, infrared_share=1.0, dots_share=1.0)
    plain = replace(infrared, dots_share=0.0)
    found = False
    for index in range(3):
        with_dots, without = render_near(infrared, index), render_near(plain, index)
        added = [
            a / a.mean() - b / b.mean()
            for a, b in ((with_dots.left, without.left), (with_dots.right, without.right))
        ]
        warped = warp_right_to_left(added[1], with_dots.disparity_px)
        seen = ~with_dots.occluded & warped.isfinite().all(0)
        both = torch.stack([added[0].mean(0)[seen], warped.mean(0)[seen]])
        if float(added[0].std()) < 0.1:
            continue
        found = True
        assert float(both.corrcoef()[0, 1]) > 0.5
        assert torch.equal(with_dots.left[0], with_dots.left[1])
    assert found


def test_black_borders_have_no_truth() -> None:
    frame = render_near(replace(SMALL, border_share=1.0), 3)
    is_black = (frame.left == 0).all(0)
    whole = is_black.all(0) | is_black.all(1)[:, None]
    assert bool(whole.any())
    assert bool(frame.disparity_px[whole].isnan().all())


def test_a_scene_is_written_and_read_with_its_own_rig(tmp_path: Path) -> None:
    frame = drawn(5)
    write_scene(tmp_path, "near_5", frame)
    (sample,) = [open_dataset(tmp_path)[0]]
    assert torch.equal(sample.input.left, frame.left)
    truth_px = sample.truth.disparity_px
    assert truth_px is not None
    torch.testing.assert_close(truth_px, frame.disparity_px, equal_nan=True)
    rig = open_dataset(tmp_path).read_rig(0)
    assert rig is not None
    assert rig.baseline_m == pytest.approx(frame.rig.baseline_m)
    assert torch.allclose(rig.K, frame.rig.K)


def test_the_command_adds_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "near"
    assert main(["data", "make", "near", "--out", str(out), "--number", "1", "--first", "12"]) == 0
    before = (out / "near_0000_000012/disp0.pfm").read_bytes()
    assert main(["data", "make", "near", "--out", str(out), "--number", "1", "--first", "12"]) == 0
    assert "0 scenes made, 1 were there" in capsys.readouterr().out
    assert (out / "near_0000_000012/disp0.pfm").read_bytes() == before


def test_unusable_numbers_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="index is -1"):
        render_near(SMALL, -1)
    assert main(["data", "make", "near", "--out", str(tmp_path / "n"), "--number", "0"]) == 2
    assert "--number 0" in capsys.readouterr().err


def test_an_open_room_fills_the_view() -> None:
    open_rooms = 0
    for seed in range(8):
        builder = _NearSceneBuilder(np.random.default_rng(seed), 1.0, (0.5, 0.35), 0.3)
        builder.add_room(8.0)
        is_open = builder.last_backdrop_id == 2  # a floor and a back wall alone
        open_rooms += is_open
        if is_open:
            corners = torch.from_numpy(builder.builder.finish().corners)
            raster = rasterize(corners, intrinsics(100, 100, 49.5, 34.5), 100, 70)
            assert bool(raster.depth_m.isfinite().all())
    assert open_rooms > 0
