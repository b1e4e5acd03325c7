"""Depth of the sky in synthetic streets, by the exact labels of their pixels.

    python bench/sky.py --weights default kitti-nc --number 24

The sky should be far (no depth counts as far), and everything else should have depth.
"""

from dataclasses import replace

import torch
from shared import make_parser
from torch import Tensor
from tqdm import tqdm

from depthpose import FakestereoNet
from depthpose.depth.config import StreetsConfig
from depthpose.depth.synthetic import Streets
from depthpose.depth.types import DepthSample
from depthpose.report.page import format_markdown_table

SEED = 90  # no weights were trained on streets of this seed
FAR_M = 80.0


def measure(name: str, input: str, streets: list[DepthSample]) -> dict[str, object]:
    """Measure a network's depth in the sky and elsewhere, from one view or from both."""
    net = FakestereoNet.load(name, allow_ood=True, with_check=False)
    sky_depths_m: list[Tensor] = []
    rest_depths_m: list[Tensor] = []
    sky_confidences: list[Tensor] = []
    rest_confidences: list[Tensor] = []
    for street in tqdm(streets, f"{name}, {input}"):
        is_sky = street.truth.is_sky
        assert is_sky is not None
        views = street.input if input == "both" else replace(street.input, right=None)
        estimate = net.estimate_input(views)
        assert estimate.depth_m is not None
        assert estimate.confidence is not None
        depth_m = estimate.depth_m.nan_to_num(torch.inf)
        sky_depths_m.append(depth_m[is_sky])
        rest_depths_m.append(depth_m[~is_sky])
        sky_confidences.append(estimate.confidence[is_sky])
        rest_confidences.append(estimate.confidence[~is_sky])
    is_near = torch.cat(sky_depths_m) < FAR_M
    is_missing = torch.cat(rest_depths_m).isinf()
    return {
        "weights": name,
        "input": input,
        "sky nearer than 80 m": f"{float(is_near.float().mean()):.1%}",
        "rest without depth": f"{float(is_missing.float().mean()):.2%}",
        "sky: median confidence": round(float(torch.cat(sky_confidences).median()), 2),
        "rest: mean confidence": round(float(torch.cat(rest_confidences).mean()), 2),
    }


def main() -> None:
    """Print a row for each network and number of views."""
    parser = make_parser(__doc__)
    parser.add_argument("--weights", nargs="+", default=["default", "kitti-nc"])
    parser.add_argument("--number", type=int, default=24, help="streets")
    parser.add_argument("--scale", type=float, default=0.5, help="size as a share of KITTI's")
    options = parser.parse_args()
    rendered = Streets(StreetsConfig(seed=SEED, scale=options.scale))
    streets = [rendered[k] for k in tqdm(range(options.number), "streets")]
    rows = [measure(name, input, streets) for name in options.weights for input in ("one", "both")]
    print(format_markdown_table(rows))


if __name__ == "__main__":
    main()
