"""Which objects of which images an evaluation asks for (``test_targets_bop19.json``)."""

from dataclasses import dataclass
from pathlib import Path

from depthpose.pose.bop.parse import integer, read_rows


@dataclass(frozen=True, kw_only=True, order=True)
class Target:
    """So many instances of an object in an image."""

    scene_id: int
    image_id: int
    object_id: int
    count: int


def read_targets(path: str | Path) -> list[Target]:
    """Read a list of targets.

    Raises:
        InputError: it is missing or damaged.
    """
    path = Path(path)
    targets = []
    for row_number, row in enumerate(read_rows(path)):
        source = f"{path}: entry {row_number}"
        scene, image, wanted, count = (
            integer(row, key, source) for key in ("scene_id", "im_id", "obj_id", "inst_count")
        )
        targets.append(Target(scene_id=scene, image_id=image, object_id=wanted, count=count))
    return targets
