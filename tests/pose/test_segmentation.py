"""Laws of segmentation: network, weights, parts, sizes, overlap, loss."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from depthpose.core.checkpoint import LicenceNotice, read_checkpoint, save_checkpoint
from depthpose.core.errors import InputError
from depthpose.pose.metrics import count_overlap, intersection_over_union
from depthpose.pose.networks.fcn import FCN, SegmentationConfig
from depthpose.pose.segmentation import (
    SegmentationWeights,
    Segmenter,
    find_connected_parts,
    label_parts,
    predict_probabilities,
    write_segmentation,
)
from depthpose.pose.train.config import SegmentationTraining
from depthpose.pose.train.masks import LabelledImage, SegmentationTask

TINY = SegmentationConfig(widths=(4, 4, 8, 8), long_side_px=96)


def tiny_weights(config: SegmentationConfig = TINY) -> SegmentationWeights:
    torch.manual_seed(0)
    network = FCN(2, config).eval()
    return SegmentationWeights(network=network, objects=("cat", "can"), numbers=(6, 5))


@pytest.mark.parametrize(("stride", "levels"), [(8, 3), (16, 2), (32, 1)])
def test_each_stride_scores_its_levels_at_every_pixel(
    stride: Literal[8, 16, 32], levels: int
) -> None:
    network = FCN(2, SegmentationConfig(stride=stride, widths=(4, 4, 8, 8)))
    assert len(network.scores) == levels
    assert network(torch.rand(2, 3, 64, 96)).shape == (2, 3, 64, 96)


def test_finer_levels_begin_without_a_say_and_the_enlargement_bilinear() -> None:
    torch.manual_seed(0)
    network = FCN(2, TINY).eval()
    image = torch.rand(1, 3, 64, 64)
    coarse = network.scores[0](network.encoder(image)[-1])
    twice = F.interpolate(coarse, scale_factor=2, mode="bilinear")
    # Away from the border, where the convolution sees nothing and the interpolation repeats.
    found = network.enlarge[0](coarse)
    torch.testing.assert_close(found[..., 1:-1, 1:-1], twice[..., 1:-1, 1:-1])


def loss_of(network: FCN, size: tuple[int, int], labels: Tensor, object_weight: float) -> Tensor:
    config = replace(SegmentationTraining(), object_weight=object_weight)
    batch = LabelledImage(torch.rand(len(labels), 3, *size), labels)
    (update,) = SegmentationTask(network, config, {6: "cat", 5: "can"}).step(batch)
    return update.loss


def test_every_weight_learns() -> None:
    network = FCN(2, TINY)
    loss_of(network, (64, 64), torch.randint(3, (2, 64, 64)), 2.0).backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in network.parameters())
    finest = network.scores[2].get_parameter("weight").grad
    assert finest is not None
    assert float(finest.abs().sum()) > 0


def test_the_loss_weighs_objects_as_a_sum_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    logits, labels = torch.randn(1, 3, 2, 2), torch.tensor([[[0, 1], [2, 0]]])
    each = -logits.log_softmax(1).gather(1, labels[:, None])[0, 0]
    weight = torch.tensor([[1.0, 5.0], [5.0, 1.0]])
    network = FCN(2, TINY)
    monkeypatch.setattr(network, "forward", lambda _: logits)
    assert torch.isclose(loss_of(network, (2, 2), labels, 5.0), (each * weight).sum() / 12)


def test_weights_come_back_with_their_objects(tmp_path: Path) -> None:
    weights = tiny_weights()
    write_segmentation(tmp_path / "w.safetensors", weights)
    read = Segmenter.load(tmp_path / "w.safetensors").weights
    assert (read.objects, read.numbers, read.network.config) == (("cat", "can"), (6, 5), TINY)
    image = torch.rand(1, 3, 32, 32)
    assert torch.equal(read.network(image), weights.network(image))


def test_half_weights_are_half_as_large_and_near(tmp_path: Path) -> None:
    weights = tiny_weights()
    write_segmentation(tmp_path / "w.safetensors", weights)
    write_segmentation(tmp_path / "h.safetensors", weights, with_half=True)
    sizes = [(tmp_path / f"{n}.safetensors").stat().st_size for n in "wh"]
    assert sizes[1] < 0.75 * sizes[0]
    read = Segmenter.load(tmp_path / "h.safetensors").weights
    image = torch.rand(1, 3, 32, 32)
    torch.testing.assert_close(read.network(image), weights.network(image), rtol=0.05, atol=0.05)


def test_weights_whose_objects_have_no_numbers_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    write_segmentation(path, tiny_weights())
    held = read_checkpoint(path)
    save_checkpoint(path, replace(held, config={**held.config, "numbers": [1]}))
    with pytest.raises(InputError, match="names 2 objects and 1 numbers"):
        Segmenter.load(path)


def painted(shape: tuple[int, int], *boxes: tuple[int, int, int, int]) -> Tensor:
    mask = torch.zeros(shape, dtype=torch.bool)
    for top, left, bottom, right in boxes:
        mask[top:bottom, left:right] = True
    return mask


def test_the_largest_part_is_kept_or_every_large_one() -> None:
    mask = painted((40, 60), (2, 2, 10, 10), (20, 20, 35, 50), (38, 58, 39, 59))
    one = find_connected_parts(mask, TINY)
    assert torch.equal(one, painted((40, 60), (20, 20, 35, 50))[None])
    several = replace(TINY, with_one_instance=False, min_share=0.001)
    parts = find_connected_parts(mask, several)
    assert parts.sum((1, 2)).tolist() == [64, 450]  # 1 pixel of 2,400 is below the share
    assert find_connected_parts(mask & False, TINY).shape == (0, 40, 60)


def test_pixels_that_touch_at_a_corner_are_one_part() -> None:
    mask = painted((8, 8), (0, 0, 2, 2), (2, 2, 4, 4))
    assert (
        len(find_connected_parts(mask, replace(TINY, with_one_instance=False, min_share=0.0))) == 1
    )


def test_parts_have_numbers_and_sizes() -> None:
    mask = painted((8, 9), (0, 0, 2, 2), (5, 4, 8, 9))
    label, pixels = label_parts(mask)
    assert pixels.tolist() == [0, 4, 15]
    assert torch.equal(label > 0, mask)
    assert [int((label == k).sum()) for k in (1, 2)] == [4, 15]
    assert label_parts(mask & False)[1].tolist() == [0]


class Painter(FCN):
    """A network that answers by colour: red is class 1, green class 2."""

    def forward(self, image: Tensor) -> Tensor:
        return 20 * torch.stack([torch.zeros_like(image[:, 0]), image[:, 0], image[:, 1]], 1)


@pytest.mark.parametrize("size", [(72, 96), (96, 51), (200, 333), (33, 20)])
def test_masks_have_the_size_and_place_of_the_image(size: tuple[int, int]) -> None:
    weights = replace(tiny_weights(), network=Painter(2, TINY))
    height, width = size
    red = painted(size, (height // 4, width // 4, height // 2, width // 2))
    green = painted(size, (height // 2, width // 2, height, width))
    image = torch.stack([red, green, red & False]).float()
    found = Segmenter(weights).segment(image)
    table = torch.zeros(2, 2).long()
    for name, truth in (("cat", red), ("can", green)):
        (best,) = found.masks[name]
        assert best.shape == size
        table += count_overlap(best.long(), truth.long(), 2)
        assert float(found.scores[name][0]) > 0.8
    assert float(intersection_over_union(table)[1]) > 0.8


def test_an_object_that_is_not_seen_has_no_mask() -> None:
    weights = replace(tiny_weights(), network=Painter(2, TINY))
    found = Segmenter(weights).segment(torch.zeros(3, 48, 64))
    assert found.masks == {}


def test_a_picture_of_other_values_than_0_to_1_is_refused() -> None:
    weights = replace(tiny_weights(), network=Painter(2, TINY))
    with pytest.raises(InputError, match=r"the image must lie in \[0, 1\], got 128 .. 128"):
        Segmenter(weights).segment(torch.full((3, 48, 64), 128.0))


def test_probabilities_add_up_to_one_and_the_network_runs_from_a_file(tmp_path: Path) -> None:
    bound = replace(tiny_weights(), facts={"terms": "For research alone."})
    write_segmentation(tmp_path / "w.safetensors", bound)
    with pytest.warns(LicenceNotice, match="For research alone"):
        segmenter = Segmenter.load(tmp_path / "w.safetensors")
    assert segmenter.weights.objects == ("cat", "can")
    probability = predict_probabilities(segmenter.weights.network, torch.rand(3, 50, 70))
    torch.testing.assert_close(probability.sum(0), torch.ones(50, 70))


def test_overlap_of_a_worked_example() -> None:
    found, truth = torch.tensor([[0, 1, 1, 2]]), torch.tensor([[0, 1, 2, 2]])
    iou = intersection_over_union(count_overlap(found, truth, 4))
    assert iou[:3].tolist() == [1.0, 0.5, 0.5]
    assert bool(iou[3].isnan())
