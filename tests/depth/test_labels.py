"""Pseudo-truth of pairs: what both views agree on, and nothing else."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tests.synthetic_street import make_street, write_pairs
from torch import Tensor

from depthpose import FakestereoNet
from depthpose.cli import main
from depthpose.core.errors import InputError
from depthpose.depth.datasets import open_dataset
from depthpose.depth.labels import LabelConfig, label_pair, label_pairs
from depthpose.depth.stereo import CallableMatcher


def brightness_matcher() -> FakestereoNet:
    """Disparity is brightness x 10: right where both views are drawn with it."""
    return FakestereoNet(CallableMatcher(lambda left, _: 10 * left.mean(0)), with_check=False)


def test_what_both_views_say_is_kept_and_the_rest_is_unknown() -> None:
    """Disparity 4 everywhere; the right view claims 8 in its columns 10 to 19."""
    left = torch.full((3, 6, 40), 0.4)
    right = left.clone()
    right[..., 10:20] = 0.8
    pair = replace(make_street(0.1).input, left=left, right=right, camera=None)
    known_px = label_pair(brightness_matcher(), pair, LabelConfig())
    row = known_px[0]
    assert bool(row[:4].isnan().all()), "outside the right view"
    assert torch.equal(row[4:14], torch.full((10,), 4.0))
    assert bool(row[14:24].isnan().all())
    assert torch.equal(row[24:], torch.full((16,), 4.0))


def test_an_unsure_matcher_labels_nothing() -> None:
    class Unsure:
        def match(self, left: Tensor, right: Tensor, camera: object = None):  # noqa: ANN202, ARG002
            from depthpose.depth.types import Match

            size = left.shape[1:]
            return Match(disparity_px=torch.full(size, 4.0), confidence=torch.full(size, 0.2))

    pair = replace(
        make_street(0.1).input, left=torch.rand(3, 6, 20), right=torch.rand(3, 6, 20), camera=None
    )
    net = FakestereoNet(Unsure(), with_check=False)
    assert bool(label_pair(net, pair, LabelConfig()).isnan().all())
    assert not bool(label_pair(net, pair, LabelConfig(least_confidence=0.1)).isnan().all())


def test_the_sky_is_no_label() -> None:
    """Its disparity agrees in both views and is sure; it is that of no thing."""

    class SeesSky:
        def match(self, left: Tensor, right: Tensor, camera: object = None):  # noqa: ANN202, ARG002
            from depthpose.depth.types import Match

            is_sky = torch.zeros(left.shape[1:], dtype=torch.bool)
            is_sky[:2] = True
            return Match(disparity_px=torch.full(left.shape[1:], 4.0), is_sky=is_sky)

    views = {"left": torch.rand(3, 6, 20), "right": torch.rand(3, 6, 20)}
    pair = replace(make_street(0.1).input, camera=None, **views)
    known_px = label_pair(FakestereoNet(SeesSky(), with_check=False), pair, LabelConfig())
    assert bool(known_px[:2].isnan().all())
    assert bool((known_px[2:, 4:] == 4).all())


def test_a_labelled_folder_trains_and_is_gone_on_with(tmp_path: Path) -> None:
    dataset = open_dataset(write_pairs(tmp_path / "pairs", (0.2, 0.25)))
    out = tmp_path / "out"
    settings: dict[str, object] = {"weights": "none"}
    labelled = label_pairs(brightness_matcher(), dataset, LabelConfig(), out, settings)
    assert next(labelled)[0] == "00"  # and no more of it
    rest = list(label_pairs(brightness_matcher(), dataset, LabelConfig(), out, settings))
    assert [name for name, _ in rest] == ["01"]
    found = open_dataset(out)
    for index in range(2):
        one, other = dataset.read_rig(index), found.read_rig(index)
        assert one is not None
        assert other is not None
        assert other.baseline_m == pytest.approx(one.baseline_m, rel=1e-6)
        torch.testing.assert_close(found.read_input(index).left, dataset.read_input(index).left)
        assert found.read_truth(index).disparity_px is not None
    with pytest.raises(InputError, match="weights"):
        list(label_pairs(brightness_matcher(), dataset, LabelConfig(), out, {"weights": "other"}))


def test_pairs_without_calibration_are_refused(tmp_path: Path) -> None:
    folder = write_pairs(tmp_path / "pairs", (0.1,))
    (folder / "calib.txt").unlink()
    with pytest.raises(InputError, match="no frame has a right view and a calibration"):
        list(label_pairs(brightness_matcher(), open_dataset(folder), LabelConfig(), tmp_path, {}))


@pytest.mark.parametrize("keep", [0, 1000], ids=["no image", "cut off"])
def test_a_pair_that_cannot_be_read_stops_no_other(keep: int, tmp_path: Path) -> None:
    folder, out = write_pairs(tmp_path / "pairs", (0.1, 0.1)), tmp_path / "out"
    damaged = folder / "left/00.png"
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[:keep])
    failures: list[InputError] = []

    def label() -> list[str]:
        made = label_pairs(brightness_matcher(), open_dataset(folder), LabelConfig(), out, {},
                           failures=failures)  # fmt: skip
        return [name for name, _ in made]

    assert label() == ["01"]
    assert [str(failure).partition(": ")[0] for failure in failures] == [str(damaged)]
    damaged.write_bytes(whole)
    assert label() == ["00"]


def test_the_command_says_what_it_did_and_what_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakestereoNet, "load", lambda *_, **__: brightness_matcher())
    folder, out = write_pairs(tmp_path / "pairs", (0.15, 0.15)), tmp_path / "out"
    damaged = folder / "left/00.png"
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[:1000])
    words = ["data", "label", str(folder), "--out", str(out)]
    assert main(words) == 1
    said = capsys.readouterr()
    assert said.err.count(f"depthpose: failed: {damaged}") == 1
    assert "1 pairs labelled, " in said.out
    assert "; 1 failed, the others were labelled before" in said.out
    assert [path.name for path in (out / "disp_occ").iterdir()] == ["01.png"]
    damaged.write_bytes(whole)
    assert main(words) == 0
    assert [frame.name for frame in open_dataset(out).frames] == ["00", "01"]


def test_where_no_pair_can_be_read_the_reason_is_said_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_pairs(tmp_path / "pairs", (0.1, 0.1))
    (folder / "calib.txt").write_text("focal_px: none\n")
    assert main(["data", "label", str(folder), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("calib.txt") == 1


@pytest.mark.parametrize(
    "changes", [{"largest_difference_px": -1.0}, {"largest_share": -0.1}, {"least_confidence": 1.0}]
)
def test_limits_that_keep_nothing_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(InputError, match="must be"):
        LabelConfig(**changes)


def test_labels_keep_the_whole_rig_and_names_with_blanks(tmp_path: Path) -> None:
    folder = write_pairs(tmp_path / "pairs", (0.2, 0.25))
    for side in ("left", "right"):
        (folder / side / "01.png").rename(folder / side / "image 1.png")
    (folder / "calib.txt").write_text(
        "focal_px: 100\nfocal_y_px: 101\ncx: 30\ncy: 20\nbaseline_m: 0.2\n"
        "cx_right_minus_left_px: 3.5\n"
    )
    dataset = open_dataset(folder)
    list(label_pairs(brightness_matcher(), dataset, LabelConfig(), tmp_path / "out", {}))
    found = open_dataset(tmp_path / "out")
    assert [frame.name for frame in found.frames] == ["00", "image 1"]
    for index in range(2):
        rig = found.read_rig(index)
        assert rig is not None
        assert rig.cx_right_minus_left_px == pytest.approx(3.5)
        assert torch.equal(rig.K, torch.tensor([[100.0, 0, 30], [0, 101, 20], [0, 0, 1]]).to(rig.K))


def test_labels_of_two_folders_go_into_one_if_their_names_differ(tmp_path: Path) -> None:
    one, other = (write_pairs(tmp_path / name, (0.2,)) for name in ("one", "other"))
    out = tmp_path / "out"
    list(label_pairs(brightness_matcher(), open_dataset(one), LabelConfig(), out, {}))
    with pytest.raises(InputError, match="'00' is the result of"):
        list(label_pairs(brightness_matcher(), open_dataset(other), LabelConfig(), out, {}))
    for side in ("left", "right"):
        (other / side / "00.png").rename(other / side / "02.png")
    lines = (other / "calib.txt").read_text().replace("00 ", "02 ")
    (other / "calib.txt").write_text(lines)
    list(label_pairs(brightness_matcher(), open_dataset(other), LabelConfig(), out, {}))
    found = open_dataset(out)
    assert [found.read_input(index).name for index in range(2)] == ["00", "02"]


@pytest.mark.parametrize("place", ["left", "right", "disp_occ"])
def test_a_label_of_which_a_file_is_damaged_is_made_again(tmp_path: Path, place: str) -> None:
    dataset = open_dataset(write_pairs(tmp_path / "pairs", (0.1, 0.1)))
    out = tmp_path / "out"

    def label() -> list[str]:
        made = label_pairs(brightness_matcher(), dataset, LabelConfig(), out, {})
        return [name for name, _ in made]

    first, other = label()
    file = out / place / f"{first}.png"
    good = file.read_bytes()
    for damaged in (None, good[:-9], b""):
        file.unlink() if damaged is None else file.write_bytes(damaged)
        assert label() == [first]
        assert file.read_bytes() == good
    calibration = (out / "calib.txt").read_text()
    (out / "calib.txt").write_text(calibration[:-30])
    assert label() == []
    assert (out / "calib.txt").read_text() == calibration
    assert other != first


def test_a_name_that_is_not_utf8_is_refused_by_itself(tmp_path: Path) -> None:
    dataset = open_dataset(write_pairs(tmp_path / "pairs", (0.2, 0.25)))
    names = [os.fsdecode(b"n\xfe"), "größe 5"]
    frames = [replace(frame, name=n) for frame, n in zip(dataset.frames, names, strict=True)]
    text = (tmp_path / "pairs/calib.txt").read_text()
    (tmp_path / "pairs/calib.txt").write_text(text.replace("01 ", "größe 5 "))
    dataset, failures = replace(dataset, frames=frames), []
    labelled = label_pairs(brightness_matcher(), dataset, LabelConfig(), tmp_path / "out", {},
                           failures=failures)  # fmt: skip
    assert [name for name, _ in labelled] == ["größe 5"]
    assert "not a name in UTF-8, as calib.txt needs; rename" in str(failures[0])
