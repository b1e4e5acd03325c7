"""A CAD part that no shipped network was trained on: a valve body, as STL in millimetres.

    python bench/own_part.py valve.stl
    depthpose pose train --cad valve.stl --unit mm --out my_part

Overlapping solids, as in many CAD files; 125 mm across, without symmetry.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import trimesh


def valve() -> Any:  # noqa: ANN401 - a Trimesh, which trimesh types as Geometry
    """A foot, a body upright on it, an outlet to one side, a lug and a stem off the middle."""

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


def main() -> None:
    """Write the part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("file", type=Path)
    file = parser.parse_args().file
    file.parent.mkdir(parents=True, exist_ok=True)
    mesh = valve()
    mesh.export(file)
    print(f"{file}: {len(mesh.faces)} faces, {np.round(mesh.extents, 1)} mm")


if __name__ == "__main__":
    main()
