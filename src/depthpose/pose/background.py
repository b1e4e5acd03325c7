"""Known backgrounds of objects: an empty frame, or a bin drawn at its pose."""

from dataclasses import dataclass, replace

from jaxtyping import Float
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

_LEAST_ON_BACKGROUND = 0.01
"""Share of the readings in the pixels of a background: where fewer lie on it, it is a wrong one."""
_MOST_BEHIND = 0.5
"""Share of them: where more lie behind it, it is not there, since no camera sees through a bin."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedBin:
    """A bin or table whose CAD file and pose are known."""

    model: ObjectModel  #: of the bin
    camera_from_model: Rigid  #: its pose

    @classmethod
    def load(
        cls, cad: AnyModel, camera_from_model: Rigid | AnyArray, unit: Unit | None = None
    ) -> "PosedBin":
        """Read the CAD file of a bin.

        Args:
            cad: STL, PLY, OBJ, GLB, or a mesh of trimesh or Open3D.
            camera_from_model: its pose, or the 4x4 matrix in metres.
            unit: of the numbers in the file; None of GLB, which has metres.

        Raises:
            InputError: a file that cannot be read, or a pose that is none.
        """
        pose = rigid_input(camera_from_model, "the pose of the bin")
        return cls(model=read_model(cad, unit), camera_from_model=pose)

    def draw(
        self, K: Float[Tensor, "3 3"], height: int, width: int
    ) -> Float[Tensor, "{height} {width}"]:
        """Draw the depth [m] of the bin in a camera's image, NaN where it is not visible.

        Args:
            K: intrinsic matrix of the camera.
            height: rows of the image.
            width: its columns.

        Raises:
            InputError: the bin is not in view.
        """
        corners_m = self.camera_from_model.double().apply(drawn_triangles(self.model).double())
        raster = rasterize(corners_m, K.double(), width, height, with_barycentric=False)
        if not bool(raster.depth_m.isfinite().any()):
            x, y, z = corners_m.flatten(0, 1).mean(0).tolist()
            raise InputError(
                f"the bin is not in view: at its pose its middle is at ({x:.3g}, {y:.3g}, {z:.3g}) "
                "m in the camera frame (x right, y down, z forward); give its pose "
                "camera_from_model in metres, and the unit of its CAD file"
            )
        return raster.depth_m.float()


AnyBackground = AnyArray | PosedBin
"""An empty frame (a depth image without the objects, by the camera of the view), or a bin."""


def with_background(
    view: ViewInput,
    background: AnyBackground | None,
    camera: AnyLens | None = None,
    unit: Unit | None = None,
) -> ViewInput:
    """Give a view the background before which its objects lie; None: the view as it is.

    Args:
        view: depth and camera.
        background: an empty frame, or a bin at its pose.
        camera: of the empty frame, for its unit of depth.
        unit: of an empty frame, where its camera says none.

    Raises:
        InputError: a file that cannot be read, an empty frame of another size, or a background on
            which no reading of the view lies, or behind which most do.
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

    # Does the background fit the view? Some readings lie on it, and no camera sees through it.
    is_compared = (view.depth_m > 0) & background_m.isfinite()
    if not bool(is_compared.any()):
        raise InputError(
            f"{view.name}: no pixel has a reading both in the depth image and in {label}; {remedy}"
        )
    is_seen = is_on_background(view.depth_m, background_m)
    is_behind = is_compared & ~is_seen & (view.depth_m > background_m)

    # What lies behind it, and what on it.
    behind_share = float(is_behind[is_compared].double().mean())
    if behind_share > _MOST_BEHIND:
        off_mm = 1000 * float((view.depth_m - background_m)[is_behind].median())
        raise InputError(
            f"{view.name}: {behind_share:.0%} of the readings lie behind {label}, {off_mm:.3g} "
            f"mm in the median, and no camera sees through it; {remedy}"
        )
    on_share = float(is_seen[is_compared].double().mean())
    if on_share < _LEAST_ON_BACKGROUND:
        raise InputError(
            f"{view.name}: {on_share:.1%} of the readings lie on {label}, as if it were not there; "
            f"{remedy}, or omit it"
        )
    return replace(view, background=KnownBackground(depth_m=background_m, is_seen=is_seen))
