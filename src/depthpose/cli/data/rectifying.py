"""``depthpose data rectify``."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from depthpose.cli.help import group
from depthpose.core.errors import InputError
from depthpose.core.units import Unit, metres_of

if TYPE_CHECKING:
    from torch import Tensor

    from depthpose.core.camera import RawCamera, RawPair, RectificationReport, Rectifier

_LOOKED_AT = 8
"""Pairs that are checked before anything is written."""
_WARN_PX = 0.5
_SIDES = ("left", "right")
_ASK = "were the cameras moved since, or are the images scaled or cropped? Calibrate anew"


@group
class RectifyOptions:
    """What the calibration says, and what is kept of the images."""

    unit: Unit | None = None
    """of the translation between the cameras: that of the calibration board (default m)."""
    fisheye: bool = False
    """the lenses are fisheyes (OpenCV's cv2.fisheye); ROS and Kalibr files have it."""
    keep: float = 0.0
    """0 keeps only what the raw images show, 1 all of it, with black borders."""
    check: bool = True
    """refuse what is swapped or differs by more than a row."""

    def read(self, camera: Path) -> "RawPair":
        """Read the calibration of both cameras."""
        from depthpose.core.camera import read_raw_pair

        return read_raw_pair(
            camera,
            unit_m=metres_of(self.unit) if self.unit else None,
            is_fisheye=self.fisheye or None,
        )


def rectify(
    left: tyro.conf.Positional[str],
    right: tyro.conf.Positional[str],
    camera: Path,
    out: Path,
    rectifying: RectifyOptions = RectifyOptions(),
) -> int:
    """Rectify raw stereo pairs by the calibration of their two cameras, with OpenCV.

    Writes left/NAME.png, right/NAME.png and camera.json, the camera of the rectified pairs: OUT is
    input for 'depth match' and 'data check'. First, corners of up to 8 pairs are
    matched and the differences of their rows printed: a warning above 0.5 px, an error where most
    of these pairs are not rectified. Needs the extra 'opencv'.

        depthpose data rectify left.png right.png --camera stereo.yaml --out rectified
        depthpose data rectify 'raw/cam0/*.png' 'raw/cam1/*.png' --camera camchain.yaml --out out
        depthpose depth match rectified/left rectified/right --camera rectified/camera.json --out o

    Args:
        left: raw left image, a folder of them, or a quoted pattern such as 'left/*.png'.
        right: raw right image, folder or pattern; images are paired by their names, or the numbers
            in them.
        camera: calibration of both cameras: a camchain of Kalibr, a file of OpenCV's K1, D1, K2,
            D2, R, T (YAML, XML, JSON), or a folder with its intrinsics.yml and extrinsics.yml or
            with left.yaml and right.yaml of ROS.
        out: folder for the results.
    """
    from depthpose.cli.depth.matching import list_pairs
    from depthpose.core.camera import make_rectifier
    from depthpose.core.files import image_size
    from depthpose.core.run import claim_folder, claim_names

    calibration = rectifying.read(camera)
    lefts, rights = list_pairs(left, right)
    _refuse_own_results(out, [*lefts, *rights])
    rectifier = make_rectifier(calibration, image_size(lefts[0]), rectifying.keep)
    pairs = list(zip(lefts, rights, strict=True))
    _check_rows(rectifier, pairs, is_refused=rectifying.check)
    claim_folder(out, _settings(calibration, rectifying.keep), [*_SIDES, "camera.json"])
    claim_names(out, {first.stem: (first, second) for first, second in pairs})
    _write_rectified(rectifier, pairs, out)
    print(f"{out}: {len(pairs)} pairs in left and right, their camera in camera.json")
    return 0


def _write_rectified(rectifier: "Rectifier", pairs: list[tuple[Path, Path]], out: Path) -> None:
    from tqdm import tqdm

    from depthpose.core.camera import write_camera
    from depthpose.core.files import write_image

    for first, second in tqdm(pairs, unit=" pairs", leave=False, disable=None):
        for side, image in zip(_SIDES, _rectified(rectifier, first, second), strict=True):
            write_image(out / side / f"{first.stem}.png", image)
    write_camera(out / "camera.json", rectifier.rig)


def _rectified(rectifier: "Rectifier", first: Path, second: Path) -> tuple["Tensor", "Tensor"]:
    from depthpose.core.files import read_image

    images = [read_image(path) for path in (first, second)]
    for path, image in zip((first, second), images, strict=True):
        rectifier.refuse_other_size(image, str(path))
    return rectifier.rectify(*images)


def _check_rows(
    rectifier: "Rectifier", pairs: list[tuple[Path, Path]], *, is_refused: bool
) -> None:
    """Check some rectified pairs, spread over all, and say by how much their rows differ."""
    from statistics import median

    from depthpose.core.camera import check_rectified

    rig = rectifier.rig
    print(
        f"rectified camera: {rig.width}x{rig.height}, fx {float(rig.K[0, 0]):.1f} px, baseline "
        f"{rig.baseline_m:.4f} m; the raw images show {rectifier.seen_share:.1%} of the left view"
    )
    count = min(_LOOKED_AT, len(pairs))
    some = [pairs[k * len(pairs) // count] for k in range(count)]
    reports = [
        check_rectified(*_rectified(rectifier, *pair), rig.cx_right_minus_left_px) for pair in some
    ]
    known = [report for report in reports if report.is_rectified is not None]
    if not known:
        _warn(f"the rows cannot be checked: {reports[0].message}")
        return
    measured = [report for report in known if report.matches] or known
    offset_px = median(abs(report.vertical_offset_px) for report in measured)
    said = (
        f"rows of {len(known)} pairs: they differ by {offset_px:.2f} px, with a spread of "
        f"{median(report.vertical_spread_px for report in measured):.2f} px "
        f"({sum(report.matches for report in known)} matches)"
    )
    wrong = _what_is_wrong(known)
    if wrong and is_refused:
        raise InputError(f"{said}: {wrong}. Nothing was written (--no-check writes all the same)")
    print(said)
    if wrong or offset_px > _WARN_PX:
        _warn(wrong or f"that is above {_WARN_PX:g} px, which costs depth far away; {_ASK}")


def _what_is_wrong(known: "list[RectificationReport]") -> str | None:
    """Say what is wrong with more than half of the pairs."""
    if 2 * sum(bool(report.is_swapped) for report in known) > len(known):
        return "left and right look swapped (disparities are negative); exchange LEFT and RIGHT"
    if 2 * sum(report.is_wrong for report in known) > len(known):
        return (
            "they are not rectified by it, so this is not the calibration of these images, or "
            f"LEFT and RIGHT are exchanged; {_ASK}"
        )
    return None


def _warn(said: str) -> None:
    print(f"depthpose: {said}", file=sys.stderr)


def _refuse_own_results(out: Path, files: list[Path]) -> None:
    homes = {(out / side).resolve() for side in _SIDES}
    if any(path.parent.resolve() in homes for path in files):
        raise InputError(
            f"--out {out}: the inputs lie in its left or right, where the results would be written "
            "over them; choose another folder"
        )


def _settings(calibration: "RawPair", keep: float) -> dict[str, object]:
    def lens(one: "RawCamera") -> dict[str, object]:
        return {"K": one.K.tolist(), "D": list(one.distortion), "is_fisheye": one.is_fisheye}

    return {
        "command": "data rectify",
        "left": lens(calibration.left),
        "right": lens(calibration.right),
        "right_from_left": calibration.right_from_left.matrix().tolist(),
        "keep": keep,
    }
