"""Accuracy for frames whose sides are no multiples of those that the generator takes.

    python bench/frame_sizes.py --data PAIRS/kitti_object_more --weights painted.safetensors

Each way to bring a frame to sides that the U-Net takes is compared with the same truth: AbsRel and
d1 of the resulting depth (eigen-raw-camera, cap 80 m), and L1 of the generated right view.
"""

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from depthpose import FakestereoNet
from depthpose.core.camera import StereoRig
from depthpose.core.checkpoint import find_weights
from depthpose.depth.config import MatcherConfig
from depthpose.depth.datasets import Dataset, join_datasets, open_dataset
from depthpose.depth.disparity import focal_size, resize_image
from depthpose.depth.evaluate import evaluate
from depthpose.depth.predictions import predict
from depthpose.depth.stereo import make_matcher
from depthpose.depth.synthesis import UNetGenerator
from depthpose.depth.synthesis.synthesiser import SynthesisedViews, draw_right, pad_to_multiple
from depthpose.depth.weights import read_depth_weights, read_matcher
from depthpose.report.tables import markdown_table

Draw = Callable[[UNetGenerator, Tensor], Tensor]


def run(generator: UNetGenerator, left: Tensor) -> Tensor:
    """Generate views whose sides are multiples."""
    return (generator(2 * left - 1) + 1) / 2


def mirrored(generator: UNetGenerator, left: Tensor) -> Tensor:
    """Mirror the right and lower border up to multiples."""
    height, width = left.shape[-2:]
    padded = pad_to_multiple(left, generator.config.side_multiple_px)
    return run(generator, padded)[..., :height, :width]


def of_rows(count: int) -> Draw:
    """Resize to ``count`` rows (disparity is left alone), mirror the columns."""

    def draw(generator: UNetGenerator, left: Tensor) -> Tensor:
        height, width = left.shape[-2:]
        rows = resize_image(left[0], count, width)[None]
        return resize_image(mirrored(generator, rows)[0], height, width)[None]

    return draw


def of_crops(rows: int, columns: int) -> Draw:
    """Generate overlapping crops of the training's size, weighted less towards their borders."""

    def draw(generator: UNetGenerator, left: Tensor) -> Tensor:
        height, width = left.shape[-2:]
        down, across = min(rows, height), min(columns, width)
        total, weight = torch.zeros_like(left), torch.zeros_like(left[:, :1])
        ramp = torch.minimum(torch.arange(1, across + 1), torch.arange(across, 0, -1) / 2).float()
        fall = torch.minimum(torch.arange(1, down + 1), torch.arange(down, 0, -1)).float()
        counts = fall[:, None] * ramp
        for top in starts(height, down):
            for first in starts(width, across):
                window = (..., slice(top, top + down), slice(first, first + across))
                total[window] += draw_right(generator, left[window]) * counts
                weight[window] += counts
        return total / weight

    return draw


def starts(side: int, crop: int) -> list[int]:
    """Where crops begin that overlap by a half at least and end with the side."""
    count = 1 if side == crop else -(-(side - crop) // (crop // 2)) + 1
    return [round(k * (side - crop) / max(count - 1, 1)) for k in range(count)]


class Drawer:
    """A synthesiser that brings frames to size in a given way."""

    def __init__(self, generator: UNetGenerator, way: Draw) -> None:
        self.generator, self.way = generator, way
        self.config = generator.config

    @torch.no_grad()
    def draw(self, left: Tensor) -> SynthesisedViews:
        """Generate right views one by one."""
        right = [self.way(self.generator, image[None]).clamp(0, 1) for image in left]
        return SynthesisedViews(right=torch.cat(right))


def first_camera(dataset: Dataset) -> StereoRig:
    """Rig of the first frame."""
    rig = dataset.read_rig(0)
    assert rig is not None
    return rig


def measure(dataset: Dataset, net: FakestereoNet) -> dict[str, float]:
    """Numbers of one way, over all frames."""
    sources = {frame.name: frame.left for frame in dataset.frames}
    readers = {
        name: lambda k=k: replace(dataset.read_input(k), right=None)
        for k, name in enumerate(sources)
    }
    with tempfile.TemporaryDirectory() as home:
        for _ in tqdm(predict(net, readers, Path(home) / "p", {}, sources), total=len(sources)):
            pass
        (row,) = evaluate(dataset, Path(home) / "p", "eigen-raw-camera", (80.0,)).rows
    return {name: round(row.metrics[name], 4) for name in ("abs_rel", "rmse", "d1", "right_l1")}


def main() -> None:
    """Print a row for each way."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="pairs with LiDAR")
    parser.add_argument("--weights", required=True, help="with a U-Net generator")
    parser.add_argument("--matcher", default="default", help="weights of the matcher")
    parser.add_argument("--crop", type=int, nargs=2, default=(192, 448), help="of the training")
    parser.add_argument("--without", nargs="*", default=(), help="names of frames to leave out")
    options = parser.parse_args()
    generator = read_depth_weights(find_weights(options.weights)).generator
    network = read_matcher(find_weights(options.matcher))
    assert isinstance(generator, UNetGenerator)
    dataset = join_datasets([open_dataset(options.data)], options.without)
    rows, columns = options.crop
    multiple = generator.config.side_multiple_px
    height, _ = focal_size(first_camera(dataset), generator.config.virtual_focal_px)
    fewer = height // multiple * multiple
    more = fewer + multiple
    ways: dict[str, Draw] = {
        "as shipped: near a multiple resized, else mirrored": draw_right,
        "mirrored": mirrored,
        f"rows resized to {fewer}": of_rows(fewer),
        f"rows resized to {more}": of_rows(more),
        f"crops of {rows}x{columns}": of_crops(rows, columns),
    }
    matcher = make_matcher(network, MatcherConfig())
    found = []
    for name, draw in ways.items():
        net = FakestereoNet(matcher, Drawer(generator.eval(), draw))
        found.append({"way": name, **measure(dataset, net)})
        print(found[-1], flush=True)
    print(markdown_table(found))


if __name__ == "__main__":
    main()
