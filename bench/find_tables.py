"""Search for known objects in depth alone, without masks, on synthetic tables and in piles.

    python bench/find_tables.py --weights parts --tables 20
    python bench/find_tables.py --weights parts --register --piles 20

``--register`` searches by the models alone, without the network. Real frames are those of
``bench/real.py``.

A synthetic table has two to all of the objects, each at most once, between other things; depth has
a sensor's errors. An instance counts if half its silhouette and 200 pixels are visible. An answer
is right if ADD (ADD-S where symmetries are declared or were found) to an instance of its object is
below 10 % of the diameter; it is wrong if neither it nor an alternative that it names is right for
any instance, however occluded. An instance is named if an answer or an alternative is right for it.
A pile has 20 of one object; an instance of it counts if 70 % of its silhouette is visible.
"""

import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from shared import make_parser

from depthpose.core.camera import Camera
from depthpose.core.checkpoint import find_weights
from depthpose.core.rigid import Rigid
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.mesh import sample_surface
from depthpose.pose.metrics import add_m, adds_m
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.registration import Registration
from depthpose.pose.synthetic import make_frames
from depthpose.pose.types import ObjectModel, PoseEstimate
from depthpose.report.page import format_markdown_table

SEED = 0x7AB1E  # of the synthetic frames; no training has it
RIGHT = 0.1  # largest error of a right answer, in diameters
PILE = 20  # objects of a pile
MIN_VISIBLE_PX = 200
MIN_VISIBLE = 0.5  # share of the silhouette of an object on a table
MIN_VISIBLE_IN_PILE = 0.7
SURFACE_POINTS = 1000
Row = dict[str, Any]


class Instance(NamedTuple):
    """An object in a frame.

    ``is_wanted``: whether it is visible enough to be found. ``is_adds``: whether it is measured by
    ADD-S, though no symmetry is declared.
    """

    model: ObjectModel
    pose: Rigid
    is_wanted: bool
    is_adds: bool = False


class Frame(NamedTuple):
    """Depth, camera, the true instances, and the models to search for; None: those of instances."""

    name: str
    depth_m: torch.Tensor
    K: torch.Tensor
    instances: list[Instance]
    searched: list[ObjectModel] | None = None

    @property
    def models(self) -> list[ObjectModel]:
        """The models to search for, each once."""
        models = self.searched or [instance.model for instance in self.instances]
        return list({model.name: model for model in models}.values())


def synthetic_frames(models: Sequence[ObjectModel], count: int, pile: int) -> Iterator[Frame]:
    """Generate frames of tables, or of piles of ``pile`` objects where that is not 0."""
    config = ObjectsConfig(seed=SEED, distance_m=(0.6, 1.0), frame_pile=pile)
    min_visible = MIN_VISIBLE_IN_PILE if pile else MIN_VISIBLE
    model_of_number = {model.number: model for model in models}
    for frame in make_frames(models, config, count, 0):
        instances: list[Instance] = []
        for frame_object in frame.objects:
            visible_px = int(frame_object.visible.sum())
            visible_share = visible_px / int(frame_object.silhouette.sum())
            is_wanted = visible_px >= MIN_VISIBLE_PX and visible_share >= min_visible
            model = model_of_number[frame_object.number]
            instances.append(Instance(model, frame_object.camera_from_model, is_wanted))
        searched = None if pile else list(models)
        yield Frame(f"frame {frame.number}", frame.depth_m, frame.K, instances, searched)


def count_answers(frame: Frame, estimates: Sequence[PoseEstimate]) -> Row:
    """Count the instances that are found or named, and the answers that fit none."""
    found: set[int] = set()
    named: set[int] = set()
    wrong: list[str] = []
    for estimate in estimates:
        pose = estimate.camera_from_model
        assert pose is not None
        poses = [pose, *(alternative.camera_from_model for alternative in estimate.alternatives)]
        has_match = False
        for index, instance in enumerate(frame.instances):
            if instance.model.name != estimate.object:
                continue
            errors = [error_in_diameters(pose, instance) for pose in poses]
            if errors[0] < RIGHT:
                found.add(index)
            if min(errors) < RIGHT:
                named.add(index)
                has_match = True
        if not has_match:
            wrong.append(f"{estimate.object} ({estimate.certainty or 0:.2f})")

    wanted = {index for index, instance in enumerate(frame.instances) if instance.is_wanted}
    missed = [frame.instances[index].model.name for index in sorted(wanted - found)]
    return {
        "frame": frame.name,
        "instances": len(wanted),
        "right": len(wanted & found),
        "named": len(wanted & named),
        "missed": len(missed),
        "wrong": len(wrong),
        "which": "; ".join(
            [*(f"missed {name}" for name in missed), *(f"wrong {name}" for name in wrong)]
        ),
    }


def error_in_diameters(pose: Rigid, instance: Instance) -> float:
    """Compute ADD, or ADD-S of a symmetric object, in diameters."""
    points_m, _ = sample_surface(instance.model, SURFACE_POINTS)
    is_adds = instance.is_adds or not instance.model.symmetries.is_none
    metric = adds_m if is_adds else add_m
    return float(metric(pose, instance.pose, points_m)) / instance.model.diameter_m


def main() -> None:
    """Search all frames for their objects; print the counts of each frame and of all."""
    parser = make_parser(__doc__)
    parser.add_argument("--weights", nargs="+", default=["parts"])
    parser.add_argument("--register", action="store_true", help="without the network")
    parser.add_argument("--tables", type=int, default=20)
    parser.add_argument("--piles", type=int, default=0, help="in place of tables")
    options = parser.parse_args()

    torch.set_num_threads(1)
    count = options.piles or options.tables
    pile = PILE if options.piles else 0
    for name in options.weights:
        network = GeoPoseNet.load(find_weights(name))
        rows: list[Row] = []
        for frame in synthetic_frames(network.weights.models, count, pile):
            height, width = frame.depth_m.shape
            camera = Camera(width=width, height=height, K=frame.K)
            estimator = prepared_registration(frame.models) if options.register else network
            names = sorted(model.name for model in frame.models)
            began_s = time.perf_counter()
            began_cpu_s = time.process_time()
            answers = estimator.find(frame.depth_m, camera, names)
            estimates = [estimate for estimate in answers if estimate.is_posed]
            wall_s = time.perf_counter() - began_s
            cpu_s = time.process_time() - began_cpu_s
            rows.append({**count_answers(frame, estimates), "s": wall_s, "cpu s": cpu_s})
            print(rows[-1], flush=True)
        columns = ("instances", "right", "named", "missed", "wrong", "s", "cpu s")
        total = {column: sum(row[column] for row in rows) for column in columns}
        print(format_markdown_table([{"weights": name, "frames": len(rows), **total}]))


_PREPARED: dict[tuple[str, ...], Registration] = {}


def prepared_registration(models: Sequence[ObjectModel]) -> Registration:
    """Prepare the registration of some models, once for each choice of them."""
    by_name = {model.name: model for model in models}
    key = tuple(sorted(by_name))
    if key not in _PREPARED:
        _PREPARED[key] = Registration([by_name[name] for name in key])
        _PREPARED[key].prepare()
    return _PREPARED[key]


if __name__ == "__main__":
    main()
