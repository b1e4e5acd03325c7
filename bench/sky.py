"""The sky that networks find in synthetic streets, compared with the exact labels.

python bench/sky.py --weights default kitti-nc --number 24
"""

import argparse
from dataclasses import replace

import torch
from torch import Tensor
from tqdm import tqdm

from depthpose import FakestereoNet
from depthpose.depth.config import StreetsConfig
from depthpose.depth.synthetic import Streets
from depthpose.depth.types import StereoSample
from depthpose.report.page import markdown_table

SEED = 90
"""No weights were trained on streets of this seed."""
CAP_M = 80.0


def measure(name: str, input: str, streets: list[StereoSample]) -> dict[str, object]:
    """One row: a network's depth in the sky and elsewhere; no depth counts as far."""
    net = FakestereoNet.load(name, allow_ood=True)
    depths: dict[bool, list[Tensor]] = {True: [], False: []}
    sure: dict[bool, list[Tensor]] = {True: [], False: []}
    for street in tqdm(streets, f"{name}, {input}"):
        assert street.truth.is_sky is not None
        seen = street.input if input == "both" else replace(street.input, right=None)
        found = net.estimate_pair(seen, with_check=False)
        assert found.depth_m is not None
        assert found.confidence is not None
        for is_sky in (True, False):
            part = street.truth.is_sky == is_sky
            depths[is_sky].append(found.depth_m[part].nan_to_num(torch.inf))
            sure[is_sky].append(found.confidence[part])
    sky_m, rest_m = torch.cat(depths[True]), torch.cat(depths[False])
    return {
        "weights": name,
        "input": input,
        "sky nearer than 80 m": f"{float((sky_m < CAP_M).float().mean()):.1%}",
        "rest without depth": f"{float(rest_m.isinf().float().mean()):.2%}",
        "sky: median confidence": round(float(torch.cat(sure[True]).median()), 2),
        "rest: mean confidence": round(float(torch.cat(sure[False]).mean()), 2),
    }


def main() -> None:
    """Print a row for each network and number of views."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--weights", nargs="+", default=["default", "kitti-nc"])
    parser.add_argument("--number", type=int, default=24, help="streets")
    parser.add_argument("--scale", type=float, default=0.5, help="size as a share of KITTI's")
    options = parser.parse_args()
    rendered = Streets(StreetsConfig(seed=SEED, scale=options.scale))
    streets = [rendered[k] for k in tqdm(range(options.number), "streets")]
    rows = [measure(name, input, streets) for name in options.weights for input in ("one", "both")]
    print(markdown_table(rows))


if __name__ == "__main__":
    main()
