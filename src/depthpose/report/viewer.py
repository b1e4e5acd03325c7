"""``--view``: what a command finds, live in Rerun's viewer or in a recording for it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxtyping import Float
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.errors import InputError, import_extra
from depthpose.core.run import refuse_to_replace

if TYPE_CHECKING:  # a command of depth must not load what poses need, nor the other way round
    from depthpose.depth.types import DepthEstimate, StereoInput
    from depthpose.pose.estimator.inputs import AnyInput
    from depthpose.pose.types import ObjectModel, PoseEstimate

LIVE = "live"
_RECORDING = ".rrd"
_MOST_POINTS = 100_000
_SEEN, _POSED, _KEYPOINTS = (90, 150, 255), (255, 160, 60), (60, 220, 120)
_OTHER = (170, 90, 220)


class Viewer:
    """A window of Rerun, or a file that it opens later. Inputs follow each other on a timeline.

    Args:
        where: ``live`` opens the window; FILE.rrd is written in its place.

    Raises:
        InputError: another word, or a folder that does not exist.
        MissingExtraError: Rerun is not installed.
    """

    def __init__(self, where: str) -> None:
        path = Path(where)
        if where != LIVE and path.suffix != _RECORDING:
            raise InputError(
                f"--view {where}: say live for a window, or FILE{_RECORDING} for a recording"
            )
        if where != LIVE and not path.parent.is_dir():
            raise InputError(f"--view {where}: there is no folder {path.parent}; make it first")
        if where != LIVE:
            refuse_to_replace(path)
        self._rerun = import_extra("rerun", "rerun-sdk", "view", "--view")
        self._stream: Any = self._rerun.RecordingStream("depthpose")
        if where == LIVE:
            self._stream.spawn()
        else:
            self._stream.save(path)
        self._count = 0

    def show_depth(self, pair: "StereoInput", estimate: "DepthEstimate") -> None:
        """Show an image, its depth before the camera, the right view and the confidence."""
        rr = self._rerun
        self._next(pair.name)
        if (camera := pair.camera) is not None:
            size = [camera.width, camera.height]
            self._log("camera", rr.Pinhole(image_from_camera=camera.K.numpy(), resolution=size))
        self._log("camera/image", rr.Image(_bytes(pair.left)))
        if estimate.depth_m is not None:
            depth_m = estimate.depth_m.nan_to_num(0.0).cpu().numpy()  # 0: no reading
            self._log("camera/depth", rr.DepthImage(depth_m, meter=1.0))
        if estimate.right is not None:
            self._log("right", rr.Image(_bytes(estimate.right)))
        if estimate.confidence is not None:
            grey = estimate.confidence.nan_to_num(0.0).expand(3, -1, -1)
            self._log("confidence", rr.Image(_bytes(grey)))

    def show_pose(
        self, pose_input: "AnyInput", estimate: "PoseEstimate", model: "ObjectModel"
    ) -> None:
        """Show the cloud, the posed model and its keypoints; or why there is no pose."""
        from depthpose.pose.cloud import object_points

        rr = self._rerun
        self._next(pose_input.name)
        self._log("seen", rr.Clear(recursive=True))
        self._log("posed", rr.Clear(recursive=True))
        self._log("seen", self._points(object_points(pose_input, model.diameter_m), _SEEN))
        pose = estimate.camera_from_model
        if pose is None:
            self._log(
                "reason", rr.TextLog(f"{pose_input.name}: {estimate.status}: {estimate.reason}")
            )
            return
        posed_m = pose.apply(model.vertices_m.to(pose.R))
        if len(model.faces):
            mesh = rr.Mesh3D(
                vertex_positions=posed_m.numpy(),
                triangle_indices=model.faces.numpy(),
                albedo_factor=_POSED,
            )
            self._log("posed/model", mesh)
        else:
            self._log("posed/model", self._points(posed_m, _POSED))
        for k, other in enumerate(estimate.alternatives):
            other_m = other.camera_from_model.apply(model.vertices_m.to(pose.R))
            self._log(f"posed/alternative {k + 1}", self._points(other_m, _OTHER))
            said = f"{pose_input.name}: {other.difference}, {other.probability:.0%}"
            self._log("alternatives", rr.TextLog(said))
        keypoints_m = pose.apply(model.keypoints_m.to(pose.R))
        radius_m = 0.02 * model.diameter_m
        self._log("posed/keypoints", self._points(keypoints_m, _KEYPOINTS, radius_m))

    def show_step(self, progress: Any) -> None:  # noqa: ANN401 - of any training
        """Draw a training's numbers as curves over its steps."""
        self._stream.set_time("step", sequence=progress.step)
        for name, value in progress.numbers.items():
            self._log(name, self._rerun.Scalars([float(value)]))

    def close(self) -> None:
        """Write what is not written yet; a window stays open."""
        self._stream.flush()
        self._stream.disconnect()

    def _next(self, name: str) -> None:
        self._stream.set_time("input", sequence=self._count)
        self._count += 1
        self._log("input", self._rerun.TextLog(name))

    def _log(self, name: str, what: Any) -> None:  # noqa: ANN401
        self._stream.log(name, what)

    def _points(
        self, points_m: Float[Tensor, "n 3"], color: tuple[int, int, int], radius_m: float = 0.001
    ) -> Any:  # noqa: ANN401
        some = take_evenly(points_m, _MOST_POINTS).cpu().numpy()
        return self._rerun.Points3D(some, colors=color, radii=radius_m)


@contextmanager
def open_viewer(where: str | None) -> Iterator[Viewer | None]:
    """Open what ``--view`` names; None where it names nothing."""
    viewer = None if where is None else Viewer(where)
    try:
        yield viewer
    finally:
        if viewer is not None:
            viewer.close()


def _bytes(image: Float[Tensor, "3 h w"]) -> Any:  # noqa: ANN401 - an array
    return (255 * image.clamp(0, 1)).round().byte().permute(1, 2, 0).cpu().numpy()
