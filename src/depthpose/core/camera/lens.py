"""The lens model that a camera file names: a pinhole, an equidistant fisheye, or a refused one.

The coefficients do not tell it: four numbers may be k1, k2, p1, p2 of a pinhole, or k1 to k4 of a
fisheye, and a fisheye whose coefficients are 0 still distorts.
"""

import re
from collections.abc import Mapping
from typing import Any

from depthpose.core.errors import InputError

_PINHOLE = {
    "pinhole", "simplepinhole", "perspective", "rectified", "undistorted", "linear", "none", "",
}  # fmt: skip
"""Projections without distortion. Under another key a file may name a model of distortion."""
_RADIAL = {
    "plumbbob", "radtan", "radialtangential", "rationalpolynomial", "rational", "thinprism",
    "brownconrady", "inversebrownconrady", "modifiedbrownconrady", "brown", "simpleradial",
    "radial", "opencv", "fullopencv", "polynomial", "standard",
}  # fmt: skip
"""Pinholes with a distortion of OpenCV's ``cv2.undistort`` (Brown 1971), by any name."""
_FISHEYE = {
    "equidistant", "equi", "fisheye", "kannalabrandt", "kannalabrandt4", "kannalabrandt8", "kb",
    "kb4", "kb8", "opencvfisheye", "simplefisheye", "simpleradialfisheye", "radialfisheye",
}  # fmt: skip
"""The equidistant fisheye of Kannala and Brandt (2006): OpenCV's ``cv2.fisheye``."""
_OMNIDIRECTIONAL = "undistort the images by cv2.omnidir.undistortImage (opencv-contrib)"
_BY_ITS_TOOL = "undistort the images by the tool that calibrated it"
_BY_COLMAP = "undistort the images by 'colmap image_undistorter'"
_CUBE = "cut views of a pinhole out of its panorama (as faces of a cube, with a K each)"
_REFUSED = {
    "mei": _OMNIDIRECTIONAL, "omni": _OMNIDIRECTIONAL, "omnidirectional": _OMNIDIRECTIONAL,
    "omnidir": _OMNIDIRECTIONAL, "unified": _OMNIDIRECTIONAL, "ucm": _OMNIDIRECTIONAL,
    "catadioptric": _OMNIDIRECTIONAL, "ds": _BY_ITS_TOOL, "doublesphere": _BY_ITS_TOOL,
    "eucm": _BY_ITS_TOOL, "extendedunified": _BY_ITS_TOOL, "scaramuzza": _BY_ITS_TOOL,
    "ocam": _BY_ITS_TOOL, "ocamcalib": _BY_ITS_TOOL, "ftheta": _BY_ITS_TOOL,
    "atan": _BY_ITS_TOOL, "division": _BY_ITS_TOOL, "stereographic": _BY_ITS_TOOL,
    "equisolid": _BY_ITS_TOOL, "orthographic": _BY_ITS_TOOL, "fov": _BY_COLMAP,
    "thinprismfisheye": _BY_COLMAP, "radtanthinprismfisheye": _BY_COLMAP,
    "simpledivision": _BY_COLMAP, "equirectangular": _CUBE, "panorama": _CUBE,
    "panoramic": _CUBE, "spherical": _CUBE, "cylindrical": _CUBE,
}  # fmt: skip
"""Lens models that are refused, and how their images are undistorted."""
_OTHER_LENS = re.compile("fisheye|omnidir|omnicam|equirect|equidist|panoram|spherical|cylind")
"""Parts of names of wide lenses, for names that are in no list."""
_MODEL_KEYS = ("distortionmodel", "distortiontype", "projectionmodel")
"""Keys that name a lens model."""
_OTHER_KEYS = (
    "cameramodel", "cameratype", "lensmodel", "modeltype", "lenstype", "model", "type",
    "projectiontype", "projection", "camera1type", "lens",
)  # fmt: skip
"""Keys that name a lens model, or the maker's product."""
_FISHEYE_FLAGS = ("fisheyemodel", "isfisheye", "fisheye")
_REALSENSE = ("none", "modifiedbrownconrady", "inversebrownconrady", "ftheta", "brownconrady",
              "kannalabrandt4")  # fmt: skip
"""Models of librealsense (``rs2_distortion``) in the order of their numbers."""


def is_fisheye_lens(fields: Mapping[str, Any], owner: str = "its") -> bool | None:
    """Whether the lens that a camera file names is an equidistant fisheye, and no pinhole.

    Args:
        fields: values of the file by its keys, in lower case, letters and digits only.
        owner: whose lens it is, for the error.

    Returns:
        None where the file names no lens, or only a projection without distortion.

    Raises:
        InputError: the lens is neither, or two names contradict each other.
    """
    named_lenses: dict[str, tuple[str, bool]] = {}  # by key the name, and whether it is a fisheye
    for key in (*_MODEL_KEYS, *_OTHER_KEYS):
        value = fields.get(key)
        is_realsense = "ppx" in fields
        if is_realsense and isinstance(value, int) and not isinstance(value, bool):
            value = _REALSENSE[value] if 0 <= value < len(_REALSENSE) else None
        if not isinstance(value, str):
            continue
        lens = re.sub(r"[^a-z0-9]", "", value.lower())
        # Without what only says that it is a lens: "pinhole camera", "distortion ftheta".
        lens = re.sub(r"^(rs2?)?distortion|(camera|lens|model)+$", "", lens)
        if lens in _REFUSED or lens.startswith("mei") or _is_other_lens(lens, key):
            remedy = _REFUSED.get(lens, _BY_ITS_TOOL)
            raise _make_lens_error(f"{owner} {_spell_key(key)} is {value!r}", remedy)
        if lens in _RADIAL or lens in _FISHEYE:
            named_lenses[key] = (value, lens in _FISHEYE)
    for key in _FISHEYE_FLAGS:
        if _is_set(fields.get(key)):
            named_lenses[key] = (str(fields[key]), True)

    # The coefficient xi, alone or among those of a lens, is of MEI's model.
    for key, value in fields.items():
        xi = value if key == "xi" else None
        if isinstance(value, Mapping):
            xi = value.get("xi")
        if _is_set(xi):
            raise _make_lens_error(
                f"{owner} xi is {xi}, of MEI's omnidirectional model", _OMNIDIRECTIONAL
            )

    kinds = {is_fisheye for _, is_fisheye in named_lenses.values()}
    if len(kinds) == 2:
        shown = " and ".join(
            f"{_spell_key(key)} {name!r}" for key, (name, _) in named_lenses.items()
        )
        raise InputError(f"{owner} lens is named twice, as {shown}; keep the true one")
    return kinds.pop() if kinds else None


def _is_other_lens(lens: str, key: str) -> bool:
    """Whether a name is in no list, and is taken for a lens that is refused.

    Under a key that names a lens model every unknown name is; under others that of a wide lens.
    """
    is_listed = lens in _PINHOLE or lens in _RADIAL or lens in _FISHEYE
    return not is_listed and (key in _MODEL_KEYS or _OTHER_LENS.search(lens) is not None)


def _is_set(value: object) -> bool:
    """Whether a flag is true, or a coefficient (the first entry of a matrix or list) is not 0."""
    if isinstance(value, Mapping):
        value = value.get("data")
    if isinstance(value, list):
        value = value[0] if value else None
    try:
        return float(str(value)) != 0
    except ValueError:
        return str(value).strip().lower() in ("true", "yes", "on")


def _spell_key(key: str) -> str:
    """Spell a normalised key with underscores, as files do: ``distortion_model``."""
    words = re.sub("(distortion|camera1?|lens|projection|fisheye)(?=model|type)", r"\1_", key)
    return re.sub("^is", "is_", words)


def _make_lens_error(described: str, remedy: str) -> InputError:
    """Make the error of a lens that is no pinhole and no equidistant fisheye."""
    return InputError(
        f"{described}, and only pinholes and the equidistant fisheye (Kannala and Brandt, "
        f"cv2.fisheye) are understood; {remedy}, and give the camera of the result, or calibrate "
        "it as one of the two (in Kalibr: pinhole-radtan, pinhole-equi)"
    )
