"""Example inputs of the page, rendered on the spot."""

from base64 import b64encode
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from depthpose.core.camera import Camera, write_camera
from depthpose.core.files import write_depth_png, write_image
from depthpose.depth.config import StreetsConfig
from depthpose.depth.synthetic import Streets
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.datasets.write import write_mask
from depthpose.pose.estimator import GeoPoseNet
from depthpose.pose.synthetic import make_frames

_SEED = 9
"""No weights were trained on streets or views of this seed."""
_SCALE = 0.5
"""Of a street, as a share of KITTI's size."""
_UNIT_M = 0.0001


def depth_example() -> dict[str, Any]:
    """Render a street: left and right image, and their rig."""
    pair = Streets(StreetsConfig(seed=_SEED, scale=_SCALE))[1].input
    assert pair.right is not None
    assert pair.camera is not None
    with TemporaryDirectory(prefix="depthpose-") as name:
        folder = Path(name)
        write_image(folder / "image.png", pair.left)
        write_image(folder / "right.png", pair.right)
        write_camera(folder / "camera.json", pair.camera)
        return _form(folder, {})


def pose_example(net: GeoPoseNet) -> dict[str, Any]:
    """Render a frame of the first object that the weights know, on a table: depth, mask, camera.

    Raises:
        InputError: weights without meshes.
    """
    model = net.weights.models[0]
    near_m = 4 * model.diameter_m
    config = ObjectsConfig(
        seed=_SEED, distance_m=(near_m, 1.5 * near_m), frame_objects=(1, 1), frame_clutter=(0, 0)
    )
    frame = next(make_frames((model,), config, 1))
    height, width = frame.depth_m.shape
    camera = Camera(width=width, height=height, K=frame.K.double(), depth_unit_m=_UNIT_M)
    with TemporaryDirectory(prefix="depthpose-") as name:
        folder = Path(name)
        write_depth_png(folder / "depth.png", frame.depth_m, _UNIT_M)
        write_mask(folder / "mask.png", frame.objects[0].visible)
        write_camera(folder / "camera.json", camera)
        return _form(folder, {"object": model.name})


def _form(folder: Path, fields: dict[str, str]) -> dict[str, Any]:
    """Give the content of a form; each file is named after its field."""
    files = [
        {"field": p.stem, "name": f"example-{p.name}", "data": b64encode(p.read_bytes()).decode()}
        for p in sorted(folder.iterdir())
    ]
    return {"files": files, "fields": fields}
