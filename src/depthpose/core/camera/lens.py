"""The lens model that a camera file names: a pinhole, an equidistant fisheye, or a refused one.

The coefficients do not tell it: four numbers may be k1, k2, p1, p2 of a pinhole, or k1 to k4 of a
fisheye, and a fisheye whose coefficients are 0 still distorts.
"""

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

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
    lenses = _read_named_lenses(fields, owner)
    _refuse_omnidirectional(fields, owner)
    kinds = {lens.is_fisheye for lens in lenses}
    if len(kinds) == 2:
        shown = " and ".join(f"{_spell_key(lens.key)} {lens.name!r}" for lens in lenses)
        raise InputError(f"{owner} lens is named twice, as {shown}; keep the true one")
    return kinds.pop() if kinds else None


class _NamedLens(NamedTuple):
    """A lens with distortion that a camera file names."""

    key: str  # key of the file
    name: str  # its value, as the file spells it
    is_fisheye: bool


def _read_named_lenses(fields: Mapping[str, Any], owner: str) -> list[_NamedLens]:
    """Read the lenses with distortion that a camera file names; arguments as above.

    Raises:
        InputError: a lens is neither a pinhole nor an equidistant fisheye.
    """
    lenses: list[_NamedLens] = []
    for key in (*_MODEL_KEYS, *_OTHER_KEYS):
        name = _read_lens_name(fields, key)
        if name is None:
            continue
        # Without what only says that it is a lens: "pinhole camera", "distortion ftheta".
        model = re.sub(r"[^a-z0-9]", "", name.lower())
        model = re.sub(r"^(rs2?)?distortion|(camera|lens|model)+$", "", model)
        if model in _REFUSED or model.startswith("mei") or _is_other_lens(model, key):
            remedy = _REFUSED.get(model, _BY_ITS_TOOL)
            raise _make_lens_error(f"{owner} {_spell_key(key)} is {name!r}", remedy)
        if model in _RADIAL or model in _FISHEYE:
            lenses.append(_NamedLens(key, name, is_fisheye=model in _FISHEYE))
    set_flags = [key for key in _FISHEYE_FLAGS if _is_set(fields.get(key))]
    flagged_lenses = [_NamedLens(key, str(fields[key]), is_fisheye=True) for key in set_flags]
    return [*lenses, *flagged_lenses]


def _read_lens_name(fields: Mapping[str, Any], key: str) -> str | None:
    """Read the name of a lens at a key; None where there is none.

    In files of librealsense, which have a ``ppx``, it may be the number of a model.
    """
    value = fields.get(key)
    is_realsense = "ppx" in fields
    if is_realsense and isinstance(value, int) and not isinstance(value, bool):
        return _REALSENSE[value] if 0 <= value < len(_REALSENSE) else None
    return value if isinstance(value, str) else None


def _refuse_omnidirectional(fields: Mapping[str, Any], owner: str) -> None:
    """Refuse a lens of MEI's model: only it has the coefficient xi, alone or among others."""
    for key, value in fields.items():
        xi = value if key == "xi" else None
        if isinstance(value, Mapping):
            xi = value.get("xi")
        if _is_set(xi):
            raise _make_lens_error(
                f"{owner} xi is {xi}, of MEI's omnidirectional model", _OMNIDIRECTIONAL
            )


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
