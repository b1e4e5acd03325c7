"""Known backgrounds of objects: an empty frame, or a bin rendered at its pose."""

from dataclasses import dataclass, replace

from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.core.camera import AnyLens
from depthpose.core.errors import InputError
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid
from depthpose.core.units import Unit
from depthpose.pose.frame import is_on_background
from depthpose.pose.inputs import AnyArray, depth_input, rigid_input
from depthpose.pose.mesh import AnyModel, drawn_triangles, read_model
from depthpose.pose.types import KnownBackground, ObjectModel, ViewInput

_LEAST_ON_SHARE = 0.01
"""Least share of the compared readings that lie on the right background; with fewer it is another
one."""
_MOST_BEHIND_SHARE = 0.5
"""Largest share of the compared readings behind the right background: no camera sees through it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedBin:
    """A bin or table of a known shape at a known pose."""

    model: ObjectModel  #: its shape
    camera_from_model: Rigid  #: its pose

    @classmethod
    def load(
        cls, cad: AnyModel, camera_from_model: Rigid | AnyArray, unit: Unit | None = None
    ) -> "PosedBin":
        """Read the CAD file of a bin, and place it at its pose.

        Args:
            cad: STL, PLY, OBJ, GLB, or a mesh of trimesh or Open3D.
            camera_from_model: its pose, or the 4x4 matrix in metres.
            unit: of the numbers in the file; None of GLB, which has metres.

        Raises:
            InputError: the file cannot be read, or the pose is no rigid transform.
        """
        pose = rigid_input(camera_from_model, "the pose of the bin")
        return cls(model=read_model(cad, unit), camera_from_model=pose)

    def draw(
        self, K: Float[Tensor, "3 3"], height: int, width: int
    ) -> Float[Tensor, "{height} {width}"]:
        """Render the depth [m] of the bin in a camera's image; NaN in pixels beside it.

        Args:
            K: intrinsic matrix of the camera.
            height: of the image [px].
            width: of the image [px].

        Raises:
            InputError: the bin is not in view.
        """
        corners_m = self.camera_from_model.double().apply(drawn_triangles(self.model).double())
        raster = rasterize(corners_m, K.double(), width, height, with_barycentric=False)
        if not bool(raster.depth_m.isfinite().any()):
            middle_m = corners_m.flatten(0, 1).mean(0)
            x, y, z = middle_m.tolist()
            raise InputError(
                f"the bin is not in view: at its pose its middle is at ({x:.3g}, {y:.3g}, {z:.3g}) "
                "m in the camera frame (x right, y down, z forward); give its pose "
                "camera_from_model in metres, and the unit of its CAD file"
            )
        return raster.depth_m.float()


AnyBackground = AnyArray | PosedBin
"""An empty frame (a depth image without the objects, by the camera of the view), or a bin."""


def add_background(
    view: ViewInput,
    background: AnyBackground | None,
    camera: AnyLens | None = None,
    unit: Unit | None = None,
) -> ViewInput:
    """Return a view with the background before which its objects lie.

    Args:
        view: depth and camera.
        background: an empty frame, or a bin at its pose; None: the view is returned unchanged.
        camera: of the empty frame, for its unit of depth.
        unit: of the depth of an empty frame, where its camera says none.

    Raises:
        InputError: a file cannot be read, the empty frame is of another size, hardly any reading of
            the view lies on the background, or most lie behind it.
    """
    if background is None:
        return view

    # The depth of the background in the pixels of the view.
    height, width = view.depth_m.shape
    if isinstance(background, PosedBin):
        label = "the bin"
        background_m = background.draw(view.K, height, width)
        remedy = "give its pose in this camera, camera_from_model in metres"
    else:
        label = "the empty frame"
        background_m, _ = depth_input(background, camera, label, unit)
        remedy = "take it again by this camera, where it stands now"
    if background_m.shape != view.depth_m.shape:
        raise InputError(
            f"{view.name}: {label} has {background_m.shape[1]}x{background_m.shape[0]} pixels, the "
            f"depth image {width}x{height}; take both by one camera and in one size"
        )

    is_seen = is_on_background(view.depth_m, background_m)
    _refuse_wrong_background(view, background_m, is_seen, label, remedy)
    return replace(view, background=KnownBackground(depth_m=background_m, is_seen=is_seen))


def _refuse_wrong_background(
    view: ViewInput,
    background_m: Float[Tensor, "h w"],
    is_seen: Bool[Tensor, "h w"],
    label: str,
    remedy: str,
) -> None:
    """Raise an :class:`InputError` where a background does not fit the readings of a view.

    Args:
        view: the depth image.
        background_m: depth of the background in the same pixels; NaN where it is not known.
        is_seen: whether the reading of the view lies on it.
        label: what errors call the background.
        remedy: what errors advise.
    """
    is_compared = (view.depth_m > 0) & background_m.isfinite()
    if not bool(is_compared.any()):
        raise InputError(
            f"{view.name}: no pixel has a reading both in the depth image and in {label}; {remedy}"
        )

    # No camera sees through it.
    is_behind = is_compared & ~is_seen & (view.depth_m > background_m)
    behind_share = float(is_behind[is_compared].double().mean())
    if behind_share > _MOST_BEHIND_SHARE:
        gap_m = (view.depth_m - background_m)[is_behind]
        gap_mm = 1000 * float(gap_m.median())
        raise InputError(
            f"{view.name}: {behind_share:.0%} of the readings lie behind {label}, {gap_mm:.3g} "
            f"mm in the median, and no camera sees through it; {remedy}"
        )

    # Objects leave some of it free.
    on_share = float(is_seen[is_compared].double().mean())
    if on_share < _LEAST_ON_SHARE:
        raise InputError(
            f"{view.name}: {on_share:.1%} of the readings lie on {label}, as if it were not there; "
            f"{remedy}, or omit it"
        )
