"""Both views in one picture: named, refused as one street, and parted."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from depthpose.cli import main
from depthpose.core.camera import find_two_views
from depthpose.core.errors import InputError
from depthpose.core.files import read_image, write_image
from depthpose.depth.estimator import FakestereoNet


@pytest.fixture(scope="module")
def views() -> tuple[torch.Tensor, torch.Tensor]:
    """A scene of patches, seen by a right camera 12 px further."""
    chance = torch.Generator().manual_seed(0)
    scene = torch.zeros(3, 240, 492)
    for rows, columns, share in ((12, 24, 0.5), (60, 123, 0.5)):
        noise = torch.rand(1, 3, rows, columns, generator=chance)
        scene += share * torch.nn.functional.interpolate(noise, (240, 492), mode="bicubic")[0]
    scene = scene.clamp(0, 1)
    return scene[..., :480].contiguous(), scene[..., 12:].contiguous()


def test_two_views_are_found_and_one_is_not(views: tuple[torch.Tensor, torch.Tensor]) -> None:
    left, right = views
    assert find_two_views(torch.cat([left, right], 2)) == "side by side"
    assert find_two_views(torch.cat([left, right], 1)) == "top and bottom"
    ramp = torch.linspace(0, 1, 200).expand(3, 120, -1)
    for one in (left, right, ramp, ramp.mT, torch.zeros(3, 100, 100), torch.rand(3, 90, 140)):
        assert find_two_views(one) is None


def test_one_image_of_two_views_is_refused_with_the_command(
    views: tuple[torch.Tensor, torch.Tensor],
) -> None:
    net = FakestereoNet.load("default", use="images")
    with pytest.raises(InputError, match="two views of one scene, side by side; 'depthpose data s"):
        net.estimate(torch.cat(views, 2), focal_px=300)


@pytest.mark.parametrize("kind", ["side.png", "above.png", "crossed.jps", "after.mpo"])
def test_views_are_parted(
    tmp_path: Path, views: tuple[torch.Tensor, torch.Tensor], kind: str
) -> None:
    left, right = views
    path, stem = tmp_path / kind, kind.partition(".")[0]
    one, other = (
        Image.fromarray((255 * view).round().byte().permute(1, 2, 0).numpy()) for view in views
    )
    if stem == "after":
        one.save(path, save_all=True, append_images=[other], quality=95)
    elif stem == "crossed":
        both = np.concatenate([np.asarray(other), np.asarray(one)], 1)
        Image.fromarray(both).save(path, "JPEG", quality=95)
    else:
        write_image(path, torch.cat(views, 2 if stem == "side" else 1))
    assert main(["data", "split", str(path), "--out", str(tmp_path / "out")]) == 0
    for side, view in (("left", left), ("right", right)):
        parted = read_image(tmp_path / "out" / side / f"{stem}.png")
        assert parted.shape == view.shape
        assert float((parted - view).abs().mean()) < 0.02


def test_a_picture_of_the_same_name_replaces_no_other(
    tmp_path: Path, views: tuple[torch.Tensor, torch.Tensor], capsys: pytest.CaptureFixture[str]
) -> None:
    for folder, pair in (("a", views), ("b", views[::-1])):
        (tmp_path / folder).mkdir()
        write_image(tmp_path / folder / "pic.png", torch.cat(pair, 2))
    words = ["data", "split", "--out", str(tmp_path / "out")]
    first = str(tmp_path / "a/pic.png")
    assert main([*words, first]) == main([*words, first]) == 0
    before = (tmp_path / "out/left/pic.png").read_bytes()
    assert main([*words, str(tmp_path / "b/pic.png")]) == 2
    assert "pic" in capsys.readouterr().err
    assert (tmp_path / "out/left/pic.png").read_bytes() == before


def test_one_view_is_not_parted(
    tmp_path: Path, views: tuple[torch.Tensor, torch.Tensor], capsys: pytest.CaptureFixture[str]
) -> None:
    write_image(tmp_path / "street.png", views[0])
    assert main(["data", "split", str(tmp_path / "street.png"), "--out", str(tmp_path / "o")]) == 2
    assert "does not look like two views of one scene" in capsys.readouterr().err
