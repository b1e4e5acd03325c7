"""Which lens a camera file names: a pinhole, a fisheye that can be undistorted, or none of both.

The coefficients do not say it: four numbers are k1, k2, p1, p2 of a pinhole as well as k1 to k4 of
a fisheye, and a fisheye whose coefficients are 0 still bends what it shows.
"""

import re
from collections.abc import Mapping
from typing import Any

from depthpose.core.errors import InputError

_PINHOLE = {
    "pinhole", "simplepinhole", "perspective", "rectified", "undistorted", "linear", "none", "",
}  # fmt: skip
"""Projections without distortion; a model of distortion, of any lens, may stand beside them."""
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
"""Lenses that are neither, and how their images become those of a pinhole."""
_STRANGE = re.compile("fisheye|omnidir|omnicam|equirect|equidist|panoram|spherical|cylind")
"""Parts of names of lenses that no list holds, and that are no pinhole's."""
_SURE_KEYS = ("distortionmodel", "distortiontype", "projectionmodel")
"""Keys that name the lens alone; others may name the maker's product too."""
_KEYS = (
    "cameramodel", "cameratype", "lensmodel", "modeltype", "lenstype", "model", "type",
    "projectiontype", "projection", "camera1type", "lens",
)  # fmt: skip
_FLAGS = ("fisheyemodel", "isfisheye", "fisheye")
_REALSENSE = ("none", "modifiedbrownconrady", "inversebrownconrady", "ftheta", "brownconrady",
              "kannalabrandt4")  # fmt: skip
"""Models of librealsense (``rs2_distortion``) in the order of their numbers."""


def is_fisheye_lens(names: Mapping[str, Any], owner: str = "its") -> bool | None:
    """Say whether the lens that a camera file names is an equidistant fisheye, or a pinhole.

    Args:
        names: values of the file by name; names in small letters and digits alone.
        owner: whose lens it is, for the error.

    Returns:
        None where the file names no lens, or a projection alone (a pinhole of any distortion).

    Raises:
        InputError: the lens is neither, or two names contradict each other.
    """
    kind_of: dict[str, tuple[str, bool]] = {}
    for key in (*_SURE_KEYS, *_KEYS):
        value = names.get(key)
        if isinstance(value, int) and not isinstance(value, bool) and "ppx" in names:
            value = _REALSENSE[value] if 0 <= value < len(_REALSENSE) else None
        if not isinstance(value, str):
            continue
        word = re.sub(r"[^a-z0-9]", "", value.lower())
        word = re.sub(r"^(rs2?)?distortion|(camera|lens|model)+$", "", word)
        if word in _REFUSED or word.startswith("mei") or _is_strange(word, key):
            raise _refused(f"{owner} {_shown(key)} is {value!r}", _REFUSED.get(word, _BY_ITS_TOOL))
        if word in _RADIAL or word in _FISHEYE:
            kind_of[key] = value, word in _FISHEYE
    kind_of |= {key: (str(names[key]), True) for key in _FLAGS if _is_set(names.get(key))}
    for key, value in names.items():
        inner = value.get("xi") if isinstance(value, Mapping) else value if key == "xi" else None
        if _is_set(inner):
            raise _refused(
                f"{owner} xi is {inner}, of MEI's omnidirectional model", _OMNIDIRECTIONAL
            )
    kinds = {is_fisheye for _, is_fisheye in kind_of.values()}
    if len(kinds) == 2:
        named_kinds = " and ".join(
            f"{_shown(key)} {value!r}" for key, (value, _) in kind_of.items()
        )
        raise InputError(f"{owner} lens is named twice, as {named_kinds}; keep the true one")
    return kinds.pop() if kinds else None


def _is_strange(word: str, key: str) -> bool:
    is_known = word in _PINHOLE or word in _RADIAL or word in _FISHEYE
    return not is_known and (key in _SURE_KEYS or _STRANGE.search(word) is not None)


def _is_set(value: object) -> bool:
    """Whether a flag is true or a coefficient is not 0; OpenCV writes either as a matrix too."""
    if isinstance(value, Mapping):
        value = value.get("data")
    if isinstance(value, list):
        value = value[0] if value else None
    try:
        return float(str(value)) != 0
    except ValueError:
        return str(value).strip().lower() in ("true", "yes", "on")


def _shown(key: str) -> str:
    """Spell a normalised key as files do."""
    words = re.sub("(distortion|camera1?|lens|projection|fisheye)(?=model|type)", r"\1_", key)
    return re.sub("^is", "is_", words)


def _refused(what: str, remedy: str) -> InputError:
    """Make the error of a lens that is no pinhole and no equidistant fisheye."""
    return InputError(
        f"{what}, and only pinholes and the equidistant fisheye (Kannala and Brandt, cv2.fisheye) "
        f"are understood; {remedy}, and give the camera of the result, or calibrate it as one of "
        "the two (in Kalibr: pinhole-radtan, pinhole-equi)"
    )
