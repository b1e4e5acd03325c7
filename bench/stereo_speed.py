"""Processor time of PSMNetMatcher and of the network as it is trained: same weights and process.

    python bench/stereo_speed.py [--size 256x512 375x1242] [--weights published_kitti2015.tar]

Without --weights they are random, and differences mean less. With a left and right image
(--pair LEFT RIGHT) their lower part is matched instead of noise.
"""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F
from shared import least_seconds, make_parser, report, setting, size_of, with_cpu_seconds
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from depthpose.core.checkpoint import read_torch_file
from depthpose.core.files import read_image
from depthpose.depth.config import MatcherConfig
from depthpose.depth.stereo import (
    PSMNet,
    PSMNetMatcher,
    normalise,
    psmnet_from_published,
)
from depthpose.depth.stereo.network_matcher import pad_top_right
from depthpose.depth.stereo.psmnet import expected_disparity
from depthpose.depth.weights import read_matcher

Pair = tuple[Tensor, Tensor]


def network_for(weights: Path | None) -> PSMNet:
    """Read the authors' file or one of ours; random weights where there is none."""
    if weights is None:
        torch.manual_seed(0)
        return PSMNet().eval()
    if weights.suffix == ".safetensors":
        network = read_matcher(weights)
        assert isinstance(network, PSMNet), f"{weights}: this measures PSMNet"
        return network
    return psmnet_from_published(read_torch_file(weights)["state_dict"], align_corners=True)


def random_pair(size: tuple[int, int], generator: torch.Generator) -> Pair:
    """Make smooth noise and the same shifted by 20 px."""
    rows, columns = size
    coarse = torch.rand(1, 3, rows // 4 + 1, columns // 4 + 8, generator=generator)
    wide = F.interpolate(coarse, (rows, columns + 20), mode="bicubic")[0].clamp(0, 1)
    return wide[..., :columns].contiguous(), wide[..., 20:].contiguous()


def pair_for(size: tuple[int, int], files: list[Path] | None) -> Pair:
    """Cut the pair from the middle bottom of two files, or make one."""
    if not files:
        return random_pair(size, torch.Generator().manual_seed(0))
    images = [read_image(file) for file in files]
    height, width = size
    start = max(0, (images[0].shape[-1] - width) // 2)
    left, right = (image[:, -height:, start : start + width].contiguous() for image in images)
    return left, right


def plain_match(network: PSMNet, pair: Pair) -> Tensor:
    """Run the network module by module on contiguous tensors, padded as the matcher pads."""
    height, width = pair[0].shape[-2:]
    rows, columns = (max(256, -(-side // 16) * 16) for side in (height, width))
    padding = (0, columns - width, rows - height, 0)
    dtype = next(network.parameters()).dtype
    left, right = (F.pad(normalise(image.to(dtype)), padding)[None].contiguous() for image in pair)
    with torch.inference_mode():
        return network(left, right)[-1][0, -height:, :width]


def peak_flops(dtype: torch.dtype) -> float:
    """Measure the most operations a second [FLOP/s] of a matrix product, by two libraries.

    The second is a 1x1 convolution, which is the same product through oneDNN.
    """
    first, second = torch.randn(2, 4096, 1024).to(dtype)
    product_s = least_seconds(lambda: first @ second.T, 5)
    x = torch.randn(1, 512, 64, 128).to(dtype).contiguous(memory_format=torch.channels_last)
    kernel = torch.randn(512, 512, 1, 1).to(dtype).contiguous(memory_format=torch.channels_last)
    convolution_s = least_seconds(lambda: F.conv2d(x, kernel), 5)
    return max(2 * 4096 * 4096 * 1024 / product_s, 2 * 512 * 512 * 64 * 128 / convolution_s)


def plain_flops(network: PSMNet, pair: Pair) -> int:
    """Count the operations of the plain network, without computing anything."""
    with torch.device("meta"):
        network_without_values = PSMNet(network.config).eval()
    with FlopCounterMode(display=False) as counter:
        plain_match(network_without_values, (pair[0].to("meta"), pair[1].to("meta")))
    return counter.get_total_flops()


def exact_match(network: PSMNet, pair: Pair) -> Tensor:
    """Run the network in float64, some rows at a time: all at once would take 16 GB at 375x1242."""
    double = PSMNet(network.config).double().eval()
    double.load_state_dict(network.state_dict())
    double.rows = 32
    height, width = pair[0].shape[-2:]
    left, right = (pad_top_right(normalise(image.double()), network.config)[None] for image in pair)
    size = (network.config.max_disparity_px, left.shape[-2], left.shape[-1])
    align = network.config.align_corners
    with torch.no_grad():
        cost = double.costs(left, right)[-1][0, 0].permute(1, 2, 0)
        disparity_px, _ = expected_disparity(cost, size, align_corners=align, with_confidence=False)
    return disparity_px[-height:, :width]


def measure_pair(network: PSMNet, size: str, pair: Pair, options: argparse.Namespace) -> list[dict]:
    """Time every variant on one pair."""
    if options.exact:
        reference_px = exact_match(network, pair)
    else:
        reference_px = plain_match(network, pair).double()
    variants = {
        "plain eager": None,
        "ours fp32": MatcherConfig(with_confidence=False),
        "ours fp32 + confidence": MatcherConfig(),
        "ours bf16": MatcherConfig(with_confidence=False, precision="bf16"),
    }
    flops = plain_flops(network, pair)
    rows: list[dict] = []
    for name, config in variants.items():
        times = measure_variant(network, pair, config, options.repeats, reference_px)
        row = {"size": size, "what": name, **times}
        rows.append(row)
        peak = peak_flops(torch.bfloat16 if "bf16" in name else torch.float32)
        row["ratio"] = rows[0]["seconds"] / row["seconds"]
        row["gflop"] = flops / 1e9
        row["peak_gflops"] = peak / 1e9
        row["share_of_peak"] = flops / row["seconds"] / peak
    return rows


def measure_variant(
    network: PSMNet, pair: Pair, config: MatcherConfig | None, repeats: int, reference_px: Tensor
) -> dict[str, float]:
    """Time one variant, its first run apart, and compare it with the reference disparity."""

    def first_run() -> tuple[Callable[[], Tensor], Tensor]:
        if config is None:
            match = partial(plain_match, network, pair)
        else:
            matcher = PSMNetMatcher(network, config)

            def match() -> Tensor:
                return matcher.match(*pair).disparity_px

        return match, match()

    (match, disparity_px), first_s = with_cpu_seconds(first_run)
    difference_px = (disparity_px.double() - reference_px).abs()
    return {
        "seconds": least_seconds(match, repeats),
        "first_seconds": first_s,
        "max_px": float(difference_px.max()),
        "mean_px": float(difference_px.mean()),
    }


def main() -> None:
    """Print a table and write out/bench/stereo_speed.json."""
    parser = make_parser(__doc__)
    parser.add_argument("--size", nargs="+", default=["256x512", "375x1242"])
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--pair", nargs=2, type=Path)
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--exact", action="store_true", help="compare with float64: a minute more")
    options = parser.parse_args()
    network = network_for(options.weights)
    print(f"{setting()}; differences from {'float64' if options.exact else 'the plain network'};")
    print("share_of_peak: the plain network's operations a second against the best product's")
    rows = []
    for size in options.size:
        pair = pair_for(size_of(size), options.pair)
        rows += measure_pair(network, size, pair, options)
    report("stereo_speed", rows)


if __name__ == "__main__":
    main()
