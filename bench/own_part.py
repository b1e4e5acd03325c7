"""A CAD part that no shipped network was trained on: a valve body, as STL in millimetres.

    python bench/own_part.py valve.stl
    depthpose pose train --cad valve.stl --unit mm --out my_part
    python bench/own_part.py valve.stl --weights my_part/pose.safetensors

The part consists of overlapping solids, as many CAD files do; it is 125 mm across and has no
symmetry. With ``--weights`` it is posed in the held-out views of the training: by the network, by
registration, and by registration only where the network refuses.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from shared import make_parser

from depthpose.core.config import read_config
from depthpose.pose.config import EstimateConfig
from depthpose.pose.metrics import SUCCESS_SHARE
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.registration import Registration
from depthpose.pose.train.config import PoseTraining
from depthpose.pose.train.held_out import make_held_out_views, measure_add
from depthpose.pose.weights import PoseWeights, read_pose_weights
from depthpose.report.page import format_markdown_table

CONFIG = Path(__file__).parents[1] / "configs/pose/own-part.yaml"


def valve() -> Any:  # noqa: ANN401 - a Trimesh, which trimesh types as Geometry
    """Make a foot with an upright body, an outlet to one side, a lug and a stem off the middle."""

    def box(size_mm: tuple[float, float, float], at_mm: tuple[float, float, float]) -> object:
        solid = trimesh.creation.box(size_mm)
        return solid.apply_translation(at_mm)

    def tube(
        radius_mm: float,
        height_mm: float,
        at_mm: tuple[float, float, float],
        along: tuple[float, float, float] = (0, 0, 1),
    ) -> object:
        solid = trimesh.creation.cylinder(radius_mm, height_mm)
        solid.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], along))
        return solid.apply_translation(at_mm)

    return trimesh.util.concatenate([
        box((90, 56, 10), (0, 0, 5)),
        tube(22, 62, (-16, 2, 36)),
        tube(13, 52, (18, 2, 42), (1, 0, 0.25)),
        tube(18, 8, (46, 2, 49), (1, 0, 0.25)),
        box((16, 30, 14), (-22, -26, 30)),
        tube(8, 30, (-22, 8, 78)),
    ])  # fmt: skip


def measure(weights: PoseWeights, number: int) -> list[dict[str, Any]]:
    """Pose the held-out views by each method, and count answers."""
    config = read_config(CONFIG, PoseTraining)
    methods = {
        "network": GeoPoseNet(weights),
        "registration": Registration(weights.models),
        "both": GeoPoseNet(weights, EstimateConfig(register_refused=True)),
    }
    rows = []
    for share in (0.0, 0.3):
        held_out = dataclasses.replace(config.held_out, number=number)
        views = make_held_out_views(weights.models, config.objects, weights.cloud, held_out, share)
        samples = [views.view(index) for index in range(len(views))]
        for name, method in methods.items():
            estimates = method.estimate_many([sample.input for sample in samples])
            errors = [
                measure_add(
                    estimate.camera_from_model, sample.truth.camera_from_model, weights.models[0]
                )
                for estimate, sample in zip(estimates, samples, strict=True)
                if estimate.is_posed
            ]
            right = sum(error < SUCCESS_SHARE for error in errors)
            rows.append(
                {
                    "occluded": share,
                    "method": name,
                    "views": len(views),
                    "right": right / len(views),
                    "wrong": (len(errors) - right) / len(views),
                    "refused": 1 - len(errors) / len(views),
                }
            )
    return rows


def main() -> None:
    """Write the part, or measure weights of it."""
    parser = make_parser(__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--weights", help="of the part, trained by configs/pose/own-part.yaml")
    parser.add_argument("--number", type=int, default=500, help="of views at each occlusion")
    options = parser.parse_args()
    if options.weights:
        torch.set_num_threads(1)
        print(format_markdown_table(measure(read_pose_weights(options.weights), options.number)))
        return
    options.file.parent.mkdir(parents=True, exist_ok=True)
    mesh = valve()
    mesh.export(options.file)
    print(f"{options.file}: {len(mesh.faces)} faces, {np.round(mesh.extents, 1)} mm")


if __name__ == "__main__":
    main()
