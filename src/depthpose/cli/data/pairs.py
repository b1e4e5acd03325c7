"""``depthpose data rectify`` and ``data split``: pairs from the images of stereo cameras."""

import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import tyro

from depthpose.cli.arguments import NewPath, Source
from depthpose.core.errors import InputError
from depthpose.core.units import Unit, metres_of

if TYPE_CHECKING:  # --help must not load torch
    from torch import Tensor

    from depthpose.core.camera import RawPair, RectificationReport, Rectifier

_CHECKED_PAIRS = 8
"""Pairs whose rows are compared before anything is written."""
_MAX_OFFSET_PX = 0.5
"""Largest difference of rows in a rectified pair without a warning."""
_SIDES = ("left", "right")
_CALIBRATION_QUESTION = (
    "were the cameras moved since, or are the images scaled or cropped? Calibrate anew"
)


def rectify_pairs(
    left: tyro.conf.Positional[Source],
    right: tyro.conf.Positional[Source],
    camera: Path,
    out: NewPath,
    unit: Unit | None = None,
    fisheye: bool = False,
    keep: float = 0.0,
    check: bool = True,
) -> int:
    """Rectify raw stereo pairs by the calibration of their two cameras, with OpenCV.

    Writes left/NAME.png, right/NAME.png and camera.json: OUT is input for 'depth match'. First,
    corners of up to 8 pairs are matched and the differences of their rows printed: a warning above
    0.5 px, an error where most of these pairs are not rectified. Needs the extra 'opencv'.

        depthpose data rectify left.png right.png --camera stereo.yaml --out rectified
        depthpose data rectify 'raw/cam0/*.png' 'raw/cam1/*.png' --camera camchain.yaml --out out
        depthpose depth match rectified/left rectified/right --camera rectified/camera.json --out o

    Args:
        left: raw left image, a folder of them, or a quoted pattern such as 'left/*.png'.
        right: raw right image, folder or pattern; paired by their names, or the numbers in them.
        camera: calibration of both cameras: a camchain of Kalibr, a file of OpenCV's K1, D1, K2,
            D2, R, T (YAML, XML, JSON), or a folder with its intrinsics.yml and extrinsics.yml or
            with left.yaml and right.yaml of ROS.
        out: folder for the results.
        unit: unit of the translation between the cameras, that of the calibration board (default
            m).
        fisheye: the lenses are fisheyes (OpenCV's cv2.fisheye); ROS and Kalibr files have it.
        keep: 0 keeps only what the raw images show, 1 all of it, with black borders.
        check: refuse what is swapped or differs by more than a row.
    """
    from tqdm import tqdm

    from depthpose.cli.depth.inputs import list_pairs
    from depthpose.core.camera import make_rectifier, read_raw_pair, write_camera
    from depthpose.core.files import image_size, write_image
    from depthpose.core.run_folder import claim_folder, claim_names

    # Refuse what cannot be rectified, before anything is written.
    unit_m = metres_of(unit) if unit else None
    calibration = read_raw_pair(camera, unit_m=unit_m, is_fisheye=fisheye or None)
    pairs = list_pairs(left, right)
    result_folders = {(out / side).resolve() for side in _SIDES}
    if any(path.parent.resolve() in result_folders for pair in pairs for path in pair):
        raise InputError(
            f"--out {out}: the inputs lie in its left or right, where the results would be written "
            "over them; choose another folder"
        )
    rectifier = make_rectifier(calibration, image_size(pairs[0][0]), keep)
    _check_rows(rectifier, pairs, is_refused=check)

    settings = {"command": "data rectify", "keep": keep, **_list_calibration_settings(calibration)}
    claim_folder(out, settings, [*_SIDES, "camera.json"])
    claim_names(out, {pair[0].stem: pair for pair in pairs})

    for pair in tqdm(pairs, unit=" pairs", leave=False, disable=None):
        views = _read_rectified(rectifier, pair)
        for side, view in zip(_SIDES, views, strict=True):
            write_image(out / side / f"{pair[0].stem}.png", view)
    write_camera(out / "camera.json", rectifier.rig)
    print(f"{out}: {len(pairs)} pairs in left and right, their camera in camera.json")
    return 0


def _list_calibration_settings(calibration: "RawPair") -> dict[str, Any]:
    """List the JSON values of the calibration of a raw pair."""
    settings: dict[str, Any] = {"right_from_left": calibration.right_from_left.matrix().tolist()}
    for side, raw in zip(_SIDES, (calibration.left, calibration.right), strict=True):
        settings[side] = {
            "K": raw.K.tolist(),
            "D": list(raw.distortion),
            "is_fisheye": raw.is_fisheye,
        }
    return settings


def _read_rectified(rectifier: "Rectifier", pair: tuple[Path, Path]) -> "tuple[Tensor, Tensor]":
    """Read a raw pair, left and right, and rectify it."""
    from depthpose.core.files import read_image

    left, right = pair
    return rectifier.rectify(read_image(left), read_image(right), [str(left), str(right)])


def split_pairs(files: tyro.conf.Positional[tuple[Source, ...]], out: NewPath) -> int:
    """Part pictures and videos that hold both views of a stereo camera.

    Finds whether the views are side by side, one above the other or one after the other (.mpo), and
    which is the left one. Writes left/NAME.png and right/NAME.png: OUT is input for 'depth match',
    or for 'data rectify' where the views are raw.

        depthpose data split street.jps drive.mp4 --out parted

    Args:
        files: pictures, videos, folders or quoted patterns.
        out: folder for the results.
    """
    from depthpose.cli.depth.inputs import list_images_and_videos
    from depthpose.core.camera import order_views
    from depthpose.core.files import write_image
    from depthpose.core.files.disk import refuse_equal_stems
    from depthpose.core.run_folder import claim_folder, claim_names

    sources = list_images_and_videos(files, out)
    refuse_equal_stems(sources)
    claim_folder(out, {"command": "data split"}, _SIDES)

    def is_split(name: str) -> bool:
        """Whether an earlier run wrote the views of a picture, or of a video's first frame."""
        files = (f"{name}.png", f"{name}_000000.png")
        return any((out / _SIDES[0] / file).is_file() for file in files)

    claim_names(out, {source.stem: source for source in sources}, is_finished=is_split)
    count = 0
    for source in sources:
        for name, images in _read_two_view_pictures(source):
            first, second = images if len(images) == 2 else _split_picture(images[0], source, name)
            for side, view in zip(_SIDES, order_views(first, second), strict=True):
                write_image(out / side / f"{name}.png", view)
            count += 1
    print(f"{out}: {count} pairs in left and right")
    return 0


def _read_two_view_pictures(source: Path) -> Iterator[tuple[str, Sequence["Tensor"]]]:
    """Read a picture, or each frame of a video: its name, and its images.

    One image holds both views; of .mpo there are two.
    """
    from depthpose.core.files import VIDEO_SUFFIXES, read_video
    from depthpose.core.files.images import read_views

    if source.suffix.lower() not in VIDEO_SUFFIXES:
        yield source.stem, read_views(source)
        return
    for name, frame in read_video(source):
        yield name, [frame]


def _split_picture(picture: "Tensor", source: Path, name: str) -> "tuple[Tensor, Tensor]":
    """Split a picture into its two views, side by side or one above the other.

    ``source``: its file; ``name``: name of the picture or frame, for the error.

    Raises:
        InputError: no two views are found in it.
    """
    from depthpose.core.camera import find_two_views, split_halves

    layout = find_two_views(picture)
    if layout is None:
        raise InputError(
            f"{source}: {name} does not look like two views of one scene, side by side or one "
            "above the other; leave it out"
        )
    return split_halves(picture, layout)


def _check_rows(
    rectifier: "Rectifier", pairs: Sequence[tuple[Path, Path]], *, is_refused: bool
) -> None:
    """Print by how much the rows of some rectified pairs differ.

    Args:
        rectifier: rectifies them.
        pairs: the raw pairs.
        is_refused: raise an error where most of them are swapped or not rectified; else warn.

    Raises:
        InputError: most pairs are swapped or not rectified, and ``is_refused`` is set.
    """
    # Which rectified pixels the raw left image shows; the maps hold the raw pixel of each.
    rig = rectifier.rig
    raw_x, raw_y = rectifier.left_tables
    is_in_width = (raw_x >= 0) & (raw_x <= rig.width - 1)
    is_in_height = (raw_y >= 0) & (raw_y <= rig.height - 1)
    is_visible = is_in_width & is_in_height
    print(
        f"rectified camera: {rig.width}x{rig.height}, fx {float(rig.K[0, 0]):.1f} px, baseline "
        f"{rig.baseline_m:.4f} m; the raw images show {is_visible.mean():.1%} of the left view"
    )
    reports = _compare_rows(rectifier, pairs)
    judged = [report for report in reports if report.is_rectified is not None]
    if not judged:
        message = f"depthpose: the rows cannot be checked: {reports[0].message}"
        print(message, file=sys.stderr)
        return

    # The median over pairs; pairs without any match have no offset.
    matched = [report for report in judged if report.matches] or judged
    offset_px = median(abs(report.vertical_offset_px) for report in matched)
    spread_px = median(report.vertical_spread_px for report in matched)
    difference = f"they differ by {offset_px:.2f} px, with a spread of {spread_px:.2f} px"
    if not math.isfinite(offset_px):
        difference = "no difference is common to their matches"
    match_count = sum(report.matches for report in judged)
    message = f"rows of {len(judged)} pairs: {difference} ({match_count} matches)"

    # An error where most pairs are wrong, a warning where the rows differ a little.
    reason = _explain_wrong_pairs(judged)
    if reason and is_refused:
        raise InputError(
            f"{message}: {reason}. Nothing was written (--no-check writes all the same)"
        )
    print(message)
    if not reason and offset_px > _MAX_OFFSET_PX:
        reason = (
            f"that is above {_MAX_OFFSET_PX:g} px, which costs depth far away; "
            f"{_CALIBRATION_QUESTION}"
        )
    if reason:
        print(f"depthpose: {reason}", file=sys.stderr)


def _explain_wrong_pairs(reports: Sequence["RectificationReport"]) -> str:
    """Explain why most pairs are swapped or not rectified; empty where most are rectified."""
    swapped_count = sum(bool(report.is_swapped) for report in reports)
    wrong_count = sum(report.is_wrong for report in reports)
    if 2 * swapped_count > len(reports):
        return "left and right look swapped (disparities are negative); exchange LEFT and RIGHT"
    if 2 * wrong_count > len(reports):
        return (
            "they are not rectified by it, so this is not the calibration of these images, or "
            f"LEFT and RIGHT are exchanged; {_CALIBRATION_QUESTION}"
        )
    return ""


def _compare_rows(
    rectifier: "Rectifier", pairs: Sequence[tuple[Path, Path]]
) -> list["RectificationReport"]:
    """Rectify some pairs, spread over all, and compare the rows of what matches in them."""
    from depthpose.core.camera import check_rectified

    count = min(_CHECKED_PAIRS, len(pairs))
    checked_pairs = [pairs[k * len(pairs) // count] for k in range(count)]
    reports: list[RectificationReport] = []
    for pair in checked_pairs:
        left, right = _read_rectified(rectifier, pair)
        reports.append(check_rectified(left, right, rectifier.rig.cx_right_minus_left_px))
    return reports
