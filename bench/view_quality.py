"""Errors of generated right views, where the left view shows the scene and where it does not.

    python bench/view_quality.py --weights default runs/l1/fakestereo.safetensors --number 20

Synthetic streets of a seed that no weights were trained on, so occlusion is known: which points of
the right view are occluded in the left one, and the other way round. The first
streets become pictures: the real right view, and below it that of each generator.
"""

import argparse
from pathlib import Path

import torch
from torch import Tensor

from depthpose.core.checkpoint import find_weights
from depthpose.core.files import write_image
from depthpose.depth.config import StreetsConfig
from depthpose.depth.disparity import warp_right_to_left
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.synthetic import StreetFrame, draw_street
from depthpose.depth.types import DepthEstimate, StereoInput
from depthpose.report.page import markdown_table, write_table


def mean(values: Tensor, mask: Tensor) -> float:
    """Mean over a mask; NaN where it is empty."""
    return float(values[mask].double().mean())


def seen_by_left(frame: StreetFrame) -> Tensor:
    """Whether the left view shows the point of a right pixel: both disparities are one there."""
    mirrored = warp_right_to_left(
        frame.disparity_px.flip(-1)[None], frame.right_disparity_px.flip(-1)
    )[0].flip(-1)
    return (mirrored - frame.right_disparity_px).abs() < 1


def estimate_street(net: FakestereoNet, frame: StreetFrame) -> DepthEstimate:
    """Depth of the left view alone."""
    return net.estimate_pair(
        StereoInput(name="street", left=frame.left, right=None, camera=frame.rig)
    )


def measure(net: FakestereoNet, frame: StreetFrame) -> dict[str, float]:
    """L1 of the generated view and relative depth error, in visible and in occluded regions."""
    estimate = estimate_street(net, frame)
    assert estimate.right is not None
    assert estimate.depth_m is not None
    l1 = (estimate.right - frame.right).abs().mean(0)
    is_solid = torch.isfinite(frame.right_disparity_px)
    is_seen = seen_by_left(frame)
    relative = (estimate.depth_m - frame.depth_m).abs() / frame.depth_m
    counts = torch.isfinite(relative) & (frame.depth_m < 80)
    return {
        "right_l1_seen": mean(l1, is_solid & is_seen),
        "right_l1_disoccluded": mean(l1, is_solid & ~is_seen),
        "abs_rel_seen": mean(relative, counts & ~frame.occluded),
        "abs_rel_occluded": mean(relative, counts & frame.occluded),
    }


def draw_views(path: Path, nets: dict[str, FakestereoNet], frames: list[StreetFrame]) -> None:
    """Write real right views, a column for each street, and those of each generator below."""
    height, width = (min(frame.right.shape[k] for frame in frames) for k in (1, 2))
    columns = []
    for frame in frames:
        drawn = [estimate_street(net, frame).right for net in nets.values()]
        views = [frame.right, *(view for view in drawn if view is not None)]
        columns.append(torch.cat([view[:, :height, :width] for view in views], 1))
    write_image(path, torch.cat(columns, 2))


def main() -> None:
    """Measure each weights file on the same streets."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--weights", nargs="+", default=["default"])
    parser.add_argument("--number", type=int, default=20)
    parser.add_argument("--scale", type=float, default=0.5)
    parser.add_argument("--pictures", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    options = parser.parse_args()
    config = StreetsConfig(seed=9, scale=options.scale)
    nets = {
        name: FakestereoNet.load(find_weights(name), allow_ood=True) for name in options.weights
    }
    found: dict[str, list[dict[str, float]]] = {name: [] for name in nets}
    for index in range(options.number):
        frame = draw_street(config, index)
        for name, net in nets.items():
            found[name].append(measure(net, frame))
    first = [draw_street(config, index) for index in range(options.pictures)]
    draw_views(options.out / "view_quality.png", nets, first)
    rows = [
        {"weights": Path(name).stem, "streets": options.number}
        | {key: float(torch.tensor([r[key] for r in rows]).nanmean()) for key in rows[0]}
        for name, rows in found.items()
    ]
    write_table(options.out, rows, name="view_quality")
    print(markdown_table(rows))


if __name__ == "__main__":
    main()
