from pathlib import Path

import pytest
import torch
from tests.written import bench_module
from torch.nn import functional as F

from depthpose.core.files import write_image
from depthpose.depth.datasets import Dataset, open_dataset

DUPLICATES = bench_module("duplicates")
find_duplicates, similarity_matrix = DUPLICATES.find_duplicates, DUPLICATES.similarity_matrix
H, W = 120, 400


def street(seed: int) -> torch.Tensor:
    """Blocks of light and dark under a bright sky: as unlike another seed's as two streets."""
    noise = torch.rand(1, 3, 18, 60, generator=torch.Generator().manual_seed(seed))
    sky_to_road = torch.linspace(0.4, 0, H)[:, None]
    return F.interpolate(noise, (H, W), mode="bilinear")[0] * 0.6 + sky_to_road


def write_set(home: Path, images: dict[str, torch.Tensor]) -> Dataset:
    for name, image in images.items():
        write_image(home / "left" / f"{name}.png", image)
    return open_dataset(home)


def test_the_same_view_is_found_again(tmp_path: Path) -> None:
    base = street(1)
    driven_on = F.interpolate(base[None, :, 6:-6, 20:-20], (H, W), mode="bilinear")[0]
    ours = {"same": base, "darker": 0.5 * base, "turned": base.roll(8, 2), "on": driven_on}
    first = write_set(tmp_path / "one", ours | {"other": street(2)})
    found = find_duplicates(first, write_set(tmp_path / "two", {"eval": base, "far": street(3)}))
    assert found[0].first == "same"
    assert found[0].similarity == pytest.approx(1, abs=1e-4)
    assert {(pair.first, pair.second) for pair in found} == {(name, "eval") for name in ours}


def test_the_most_similar_pair_is_named_though_it_is_no_duplicate(tmp_path: Path) -> None:
    first = write_set(tmp_path / "one", {"a": street(4), "b": street(5)})
    second = write_set(tmp_path / "two", {"c": street(6)})
    found = find_duplicates(first, second)
    assert len(found) == 1
    assert found[0].similarity == float(similarity_matrix(first, second).max()) < 0.3


def test_similarity_does_not_depend_on_the_order(tmp_path: Path) -> None:
    first = write_set(tmp_path / "one", {"a": street(4), "b": street(1).roll(8, 2)})
    second = write_set(tmp_path / "two", {"c": street(1), "d": street(5)})
    there, back = similarity_matrix(first, second), similarity_matrix(second, first)
    assert there.shape == (2, 2)
    assert torch.allclose(there, back.T, atol=0.1)  # the window moves over the other image
    assert int(there.argmax()) == int(back.T.contiguous().argmax())


def test_a_flat_picture_is_like_nothing(tmp_path: Path) -> None:
    first = write_set(tmp_path / "one", {"a": torch.full((3, H, W), 0.5)})
    assert float(similarity_matrix(first, first)) < 0.3


@pytest.mark.data
def test_known_overlaps_of_kitti_are_found_and_no_others(real: Path) -> None:
    home = real / "depth/street_pairs"
    others, evaluation = (
        open_dataset(home / name) for name in ("kitti_object_more", "kitti2015_eval_drives")
    )
    found = find_duplicates(others, evaluation)
    assert {pair.first for pair in found} == {"train_000007", "train_000009"}
    drive_0056 = {"000105", "000106", "000107", "000108", "000109", "000110", "000111"}
    assert {pair.second for pair in found} <= drive_0056


def test_the_script_lists_what_is_alike(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_set(tmp_path / "one", {"a": street(1), "b": street(2)})
    write_set(tmp_path / "two", {"c": street(3)})
    for second, said in (("two", "2 x 1 images: 0 pairs"), ("one", "2 x 2 images: 2 pairs")):
        folders = [str(tmp_path / "one"), str(tmp_path / second)]
        monkeypatch.setattr("sys.argv", ["duplicates.py", *folders])
        DUPLICATES.main()
        assert f"{said} of similarity 0.3 or more; the most similar: " in capsys.readouterr().out
