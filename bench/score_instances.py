"""Real instances one by one: exact masks, a detector's boxes, scans in place of models, a network.

Sections ``masks``, ``boxes``, ``scans`` and ``networks`` of ``bench/real.py``: two instances of
LineMOD, five scans of the bunny, ten instances of YCB, a basket and a bottle twice
(``bench/real_poses.py``). The limits of registration were developed on all of them, so none is held
back.
"""

from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from real_poses import RealCase, real_cases
from score import Job, Row, Section, accepts, errors_of, is_right, median, use_seed
from shared import group_rows, with_cpu_seconds
from torch import Tensor

from depthpose import GeoPoseNet, Registration
from depthpose.pose.types import ViewInput

WEIGHTS = "ycb"


class Region(NamedTuple):
    """How an image says where the object is: by its mask or its box, grown by a margin."""

    kind: Literal["mask", "box"]
    margin_px: int = 0

    def __str__(self) -> str:
        return f"{self.kind} + {self.margin_px} px"


EXACT = Region("mask")
ROUGH = (Region("box", 5), Region("box", 15), Region("mask", 8))


def mask_jobs(samples: Path, seeds: int) -> list[Job]:
    """Pose every instance by its exact mask; a bunny by its cloud."""
    return [partial(pose_instance, samples, name, EXACT, seeds) for name in cases(samples)]


def network_jobs(samples: Path, seeds: int) -> list[Job]:
    """Pose every instance of YCB by the shipped weights."""
    names = [name for name in cases(samples) if name.startswith("ycb")]
    return [partial(pose_by_network, samples, name, seeds) for name in names]


def box_jobs(samples: Path, seeds: int) -> list[Job]:
    """Pose every instance of an image by boxes and by a grown mask in place of the exact one."""
    if not accepts(Registration.estimate, "box"):
        print("boxes: estimate takes no box=; a mask of the box's pixels is given")
    views = [
        name for name, case in cases(samples).items() if isinstance(case.sample.input, ViewInput)
    ]
    return [
        partial(pose_instance, samples, name, region, seeds) for region in ROUGH for name in views
    ]


def scan_jobs(samples: Path, seeds: int) -> list[Job]:
    """Pose the instances of which there is a textured scan by it, without and with colour."""
    scanned = [name for name, case in cases(samples).items() if scan_of(samples, case).is_file()]
    jobs: list[Job] = [partial(pose_scan, samples, name, seeds, False) for name in scanned]
    if not accepts(Registration.estimate, "color"):
        print("scans: estimate takes no color=; its row is left out")
        return jobs
    return jobs + [partial(pose_scan, samples, name, seeds, True) for name in scanned]


def pose_instance(samples: Path, name: str, region: Region, seeds: int) -> list[Row]:
    """Pose one instance by a mask, a box or a grown mask."""
    case = cases(samples)[name]
    arguments = arguments_of(case, region)
    rows = pose_by_seeds(registration_of(samples, name), arguments, case, seeds)
    return [{"set": name.split()[0], "region": str(region), **row} for row in rows]


def pose_by_network(samples: Path, name: str, seeds: int) -> list[Row]:
    """Pose one instance by its mask with the shipped weights of YCB."""
    case = cases(samples)[name]
    arguments = {**arguments_of(case, EXACT), "object": case.model.name}
    rows = pose_by_seeds(network(), arguments, case, seeds)
    return [{"set": WEIGHTS, **row} for row in rows]


def pose_scan(samples: Path, name: str, seeds: int, with_color: bool) -> list[Row]:
    """Pose one instance by the textured mesh of its object."""
    case = cases(samples)[name]
    arguments = arguments_of(case, EXACT)
    if with_color:
        arguments["color"] = case.color
    registration = registration_by_file(scan_of(samples, case))
    rows = pose_by_seeds(registration, arguments, case, seeds)
    return [{"set": "with colour" if with_color else "depth alone", **row} for row in rows]


def pose_by_seeds(
    estimator: Registration | GeoPoseNet, arguments: Row, case: RealCase, seeds: int
) -> list[Row]:
    """Estimate an instance by each seed, and measure each answer."""
    rows = list[Row]()
    estimator.estimate(**arguments)  # the first in a process loads what is compiled
    for seed in range(seeds):
        use_seed(estimator, seed)
        estimate, cpu_s = with_cpu_seconds(lambda: estimator.estimate(**arguments))
        errors = errors_of(estimate, case.sample.truth.camera_from_model, case.model)
        rows.append({"instance": case.name, "seed": seed, **errors, "cpu_s": cpu_s})
    return rows


def arguments_of(case: RealCase, region: Region) -> Row:
    """Give the arguments of ``estimate``: depth, camera and the object's region, or a cloud."""
    view = case.sample.input
    if isinstance(view, ViewInput):
        return {"depth": view.depth_m, "camera": view.K, **region_of(view.mask, region)}
    return {"cloud": view.points_m, "unit": "m"}


def region_of(mask: Tensor, region: Region) -> Row:
    """Give the argument of ``estimate`` that says where the object is."""
    margin_px = region.margin_px
    if region.kind == "mask":
        return {"mask": grown(mask, margin_px) if margin_px else mask}
    height, width = mask.shape
    rows, columns = mask.nonzero().unbind(1)
    top = max(0, int(rows.min()) - margin_px)
    left = max(0, int(columns.min()) - margin_px)
    bottom = min(height, int(rows.max()) + 1 + margin_px)
    right = min(width, int(columns.max()) + 1 + margin_px)
    if accepts(Registration.estimate, "box"):
        return {"box": (left, top, right, bottom)}
    filled = torch.zeros_like(mask)
    filled[top:bottom, left:right] = True
    return {"mask": filled}


def grown(mask: Tensor, pixels: int) -> Tensor:
    """Grow a mask by a number of pixels on all sides."""
    size = 2 * pixels + 1
    is_near = torch.nn.functional.max_pool2d(mask[None].float(), size, 1, pixels)[0]
    return is_near > 0


@cache
def cases(samples: Path) -> dict[str, RealCase]:
    """Give the instances by their names."""
    return {case.name: case for case in real_cases(samples / "pose")}


def scan_of(samples: Path, case: RealCase) -> Path:
    """Give the path of the textured mesh of an instance's object; only some of YCB have one."""
    is_ycb = case.name.startswith("ycb")
    file = f"obj_{case.model.number:06d}.ply" if is_ycb else "none"
    return samples / "pose/ycb_textured" / file


@cache
def registration_of(samples: Path, name: str) -> Registration:
    """Prepare the model of an instance once in a process."""
    registration = Registration([cases(samples)[name].model])
    registration.prepare()
    return registration


@cache
def network() -> GeoPoseNet:
    """Load the weights once in a process."""
    return GeoPoseNet.load(WEIGHTS)


@cache
def registration_by_file(path: Path) -> Registration:
    """Prepare a scan once in a process."""
    registration = Registration.load(path, unit="mm")
    registration.prepare()
    return registration


def table(rows: Sequence[Row]) -> list[Row]:
    """Count by set, and in all."""
    return [*lines_by("set", rows), line("all", rows)]


def lines_by(column: str, rows: Sequence[Row]) -> list[Row]:
    """Count the rows of each value of a column, such as the region."""
    return [line(value, value_rows) for (value,), value_rows in group_rows(rows, column).items()]


def line(name: str, rows: Sequence[Row]) -> Row:
    """Count right answers, sure ones, and those that are sure and wrong."""
    sure = [row for row in rows if row["status"] == "ok"]
    return {
        "set": name,
        "use": "choice",
        "n": len(rows),
        "right (ADD-S)": sum(is_right(row["adds"]) for row in rows),
        "right (ADD)": sum(is_right(row["add"]) for row in rows),
        "right or named (ADD)": sum(row["named"] for row in rows),
        "ok": len(sure),
        "ok, wrong (ADD-S)": sum(not is_right(row["adds"]) for row in sure),
        "refused": sum(row["add"] is None for row in rows),
        "median CPU s": median([row["cpu_s"] for row in rows]),
    }


MASKS = Section("Real instances with exact masks", mask_jobs, table)
NETWORKS = Section("YCB with exact masks, by a network", network_jobs, partial(lines_by, "set"))
SCANS = Section(
    "Textured scans in place of models, exact masks", scan_jobs, partial(lines_by, "set")
)
BOXES = Section(
    "A detector's box, or a mask grown, in place of the mask", box_jobs, partial(lines_by, "region")
)
