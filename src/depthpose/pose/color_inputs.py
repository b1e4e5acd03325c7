"""Files, arrays or pictures to the colour image of a view."""

import warnings
from collections.abc import Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import AnyLens, Camera, camera_of, check_image_matches_camera
from depthpose.core.camera.camera_file import intrinsics_of
from depthpose.core.errors import InputError, Notice
from depthpose.core.files import Picture, as_tensor
from depthpose.core.rigid import Rigid
from depthpose.pose.inputs import AnyArray, rigid_input
from depthpose.pose.types import ColorImage, ObjectModel, ViewInput


def add_color(
    view: ViewInput,
    models: Sequence[ObjectModel],
    color: Picture | None,
    camera: AnyLens | None = None,
    color_from_depth: Rigid | AnyArray | None = None,
) -> ViewInput:
    """Give a view its colour image; without one, the view as it is.

    A notice names the models whose files have no colours: of these depth alone decides.

    Args:
        view: the whole depth image, not a window.
        models: those that are looked for.
        color: a file, a picture of Pillow's, an array or a tensor; RGB or grey.
        camera: of the colour image; None: it is of the depth camera's frame, pixel by pixel.
        color_from_depth: where the depth camera is in the colour camera's frame, or the 4x4 matrix
            in metres; None: both are at one place.

    Raises:
        InputError: the image is none, or of another size than its camera or, without one, than the
            depth image; a camera or transform is given without an image; a transform is none.
    """
    if color is None:
        if camera is not None or color_from_depth is not None:
            raise InputError(
                f"{view.name}: a colour camera is given, and no colour image; give color= "
                "(--color), or omit its camera"
            )
        return view
    colorless = [model.name for model in models if model.colors is None]
    if colorless:
        warnings.warn(
            f"the model file of {', '.join(colorless)} has no colours (or one alone), so depth "
            "alone decides among its copies; give a PLY with colours of its vertices, or an OBJ or "
            "GLB with a texture",
            Notice,
            stacklevel=3,
        )
    return replace(view, color=color_input(color, view, camera, color_from_depth))


def color_input(
    color: Picture,
    view: ViewInput,
    camera: AnyLens | None = None,
    color_from_depth: Rigid | AnyArray | None = None,
) -> ColorImage:
    """Take the colour image of a view: of its own camera, or else aligned to the depth image.

    With a camera of its own it may be of any size and place. Without one it has the pixels and the
    intrinsic matrix of the depth image, and no transform. Arguments and errors are those of
    :func:`add_color`.
    """
    rgb = as_tensor(color, f"{view.name}: the colour image")
    height, width = rgb.shape[1:]

    # Of a camera of its own.
    if camera is not None:
        K = _read_color_intrinsics(camera, width, height, view)
        transform = None
        if color_from_depth is not None:
            transform = rigid_input(color_from_depth, "color_from_depth", "color_from_depth")
        return ColorImage(rgb=rgb, K=K, color_from_depth=transform)

    # Of the depth camera: aligned to the depth image, pixel by pixel.
    if color_from_depth is not None:
        raise InputError(
            f"{view.name}: color_from_depth is given, so the colour image is of another "
            "camera; give that too: color_camera= (--color-camera)"
        )
    rows, columns = view.depth_m.shape
    if (height, width) != (rows, columns):
        raise InputError(
            f"{view.name}: the colour image is {width}x{height} and the depth image "
            f"{columns}x{rows}; give the image aligned to the depth, or the colour camera: "
            "color_camera= (--color-camera)"
        )
    return ColorImage(rgb=rgb, K=view.K)


def _read_color_intrinsics(
    camera: AnyLens, width: int, height: int, view: ViewInput
) -> Float[Tensor, "3 3"]:
    """Read the intrinsic matrix of a colour camera; raise if its images are of another size."""
    lens = camera if isinstance(camera, Camera) else camera_of(camera, (width, height))
    assert lens is not None
    check_image_matches_camera(lens, width, height, f"{view.name}: the colour image")
    return intrinsics_of(lens.K).to(view.K)
