"""Conversion of files, arrays or pictures to the colour image of a view."""

import warnings
from collections.abc import Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import AnyLens, camera_of, check_image_matches_camera
from depthpose.core.errors import InputError, Notice
from depthpose.core.files import AnyPicture, rgb_from_picture
from depthpose.core.rigid import Rigid
from depthpose.pose.inputs import AnyArray, rigid_input
from depthpose.pose.types import ColorImage, ObjectModel, ViewInput


def add_color(
    view: ViewInput,
    models: Sequence[ObjectModel],
    color: AnyPicture | None,
    camera: AnyLens | None = None,
    color_from_depth: Rigid | AnyArray | None = None,
) -> ViewInput:
    """Return a view with its colour image.

    A notice names the models whose files have no colours: depth alone decides about these.

    Args:
        view: the whole depth image, not a window.
        models: the objects that may be in it.
        color: a file, a picture of Pillow's, an array or a tensor; RGB or grey. None: the view is
            returned unchanged.
        camera: of the colour image; None: the image is aligned to the depth image, pixel by pixel.
        color_from_depth: transform from the depth camera's frame to the colour camera's, or its
            4x4 matrix in metres; None: both frames are one.

    Raises:
        InputError: the image cannot be read, or is of another size than its camera or, without one,
            than the depth image; a camera or transform is given without an image; the transform is
            not rigid.
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
    color: AnyPicture,
    view: ViewInput,
    camera: AnyLens | None = None,
    color_from_depth: Rigid | AnyArray | None = None,
) -> ColorImage:
    """Convert a picture to the colour image of a view.

    With ``camera`` the picture may have any size, and another place than the depth camera. Without
    it the picture must be aligned to the depth image: it has its size and its intrinsic matrix, and
    no transform. Arguments and errors are those of :func:`add_color`.
    """
    rgb = rgb_from_picture(color, f"{view.name}: the colour image")
    height, width = rgb.shape[1:]

    # A colour camera of its own.
    if camera is not None:
        K = _read_color_intrinsics(camera, width, height, view)
        transform = None
        if color_from_depth is not None:
            transform = rigid_input(color_from_depth, "color_from_depth", "color_from_depth")
        return ColorImage(rgb=rgb, K=K, color_from_depth=transform)

    # No camera: aligned to the depth image, pixel by pixel.
    if color_from_depth is not None:
        raise InputError(
            f"{view.name}: color_from_depth is given, so the colour image is of another "
            "camera; give that too: color_camera= (--color-camera)"
        )
    depth_height, depth_width = view.depth_m.shape
    if (height, width) != (depth_height, depth_width):
        raise InputError(
            f"{view.name}: the colour image is {width}x{height} and the depth image "
            f"{depth_width}x{depth_height}; give the image aligned to the depth, or the colour "
            "camera: color_camera= (--color-camera)"
        )
    return ColorImage(rgb=rgb, K=view.K)


def _read_color_intrinsics(
    camera: AnyLens, width: int, height: int, view: ViewInput
) -> Float[Tensor, "3 3"]:
    """Read the intrinsic matrix of the camera of a ``width`` x ``height`` colour image.

    Raises:
        InputError: the camera is of images of another size.
    """
    color_camera = camera_of(camera, (width, height))
    assert color_camera is not None
    check_image_matches_camera(color_camera, width, height, f"{view.name}: the colour image")
    return color_camera.K.to(view.K)
