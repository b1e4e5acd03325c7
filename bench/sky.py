"""Depth and confidence in the sky of synthetic streets, which know it exactly.

python bench/sky.py --number 24
"""

import argparse
from dataclasses import replace

import torch
from torch import Tensor
from tqdm import tqdm

from depthpose import FakestereoNet
from depthpose.core.report import markdown_table
from depthpose.depth.config import StreetsConfig
from depthpose.depth.estimator.sky import SHARE, looks_like_sky
from depthpose.depth.streets import Streets
from depthpose.depth.types import StereoSample

SEED = 9
"""No weights were trained on streets of this seed."""


def measure(name: str, sees: str, streets: list[StereoSample]) -> dict[str, object]:
    """One row: what a network says of the sky and of the rest."""
    net = FakestereoNet.load(name)
    depths: list[Tensor] = []
    sky: list[Tensor] = []
    raw: list[Tensor] = []
    rest: list[Tensor] = []
    for street in tqdm(streets, f"{name}, {sees}"):
        seen = street.input if sees == "both" else replace(street.input, right=None)
        found, is_sky = net.estimate_pair(seen), sky_of(street)
        assert found.depth_m is not None
        assert found.confidence is not None
        lowered = looks_like_sky(seen.left) & (sees == "one")
        depths.append(found.depth_m[is_sky])
        sky.append(found.confidence[is_sky])
        raw.append(torch.where(lowered, found.confidence / SHARE, found.confidence)[is_sky])
        rest.append(found.confidence[~is_sky])
    depth_m = torch.cat(depths).nan_to_num(torch.inf).sort().values
    tenth_m, median_m = (float(depth_m[int(q * len(depth_m))]) for q in (0.1, 0.5))
    return {
        "weights": name,
        "sees": sees,
        "sky: nearest tenth below [m]": round(tenth_m, 1),
        "sky: median depth [m]": round(median_m, 1),
        "sky: median confidence without the rule": round(float(torch.cat(raw).median()), 2),
        "sky: median confidence": round(float(torch.cat(sky).median()), 2),
        "rest: mean confidence": round(float(torch.cat(rest).mean()), 2),
    }


def sky_of(street: StereoSample) -> Tensor:
    """Pixels of a street without any depth."""
    assert street.truth.depth_m is not None
    return street.truth.depth_m.isnan()


def main() -> None:
    """Print how well the rule of thumb finds the sky, and a row for each network."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--weights", nargs="+", default=["default", "kitti-nc"])
    parser.add_argument("--number", type=int, default=24, help="streets")
    parser.add_argument("--scale", type=float, default=0.5, help="size as a share of KITTI's")
    options = parser.parse_args()
    made = Streets(StreetsConfig(seed=SEED, scale=options.scale))
    streets = [made[k] for k in tqdm(range(options.number), "streets")]
    is_sky = torch.cat([sky_of(street).flatten() for street in streets])
    said = torch.cat([looks_like_sky(street.input.left).flatten() for street in streets])
    print(
        f"sky: {float(is_sky.float().mean()):.1%} of the pixels; the rule finds "
        f"{float(said[is_sky].float().mean()):.1%} of it, and takes "
        f"{float(said[~is_sky].float().mean()):.1%} of the rest for sky"
    )
    rows = [measure(name, sees, streets) for name in options.weights for sees in ("one", "both")]
    print(markdown_table(rows))


if __name__ == "__main__":
    main()
