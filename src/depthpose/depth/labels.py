"""Truth for pairs that have none: what a matcher finds in both views, kept where they agree."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError
from depthpose.core.files import atomic_write, write_depth_png, write_image
from depthpose.core.files.disk import read_text
from depthpose.core.run import claim_folder, claim_names, is_whole, note_result
from depthpose.depth.config import Settings
from depthpose.depth.datasets import Dataset
from depthpose.depth.disparity import warp_right_to_left
from depthpose.depth.estimator import FakestereoNet, refuse_unrectified
from depthpose.depth.types import Map, StereoInput


@dataclass(frozen=True, kw_only=True)
class LabelConfig(Settings):
    """What counts as known."""

    largest_difference_px: Annotated[float, "[0, inf)"] = 1.0
    """Of the disparities of both views at one point, at the image's size."""
    largest_share: Annotated[float, "[0, inf)"] = 0.03
    """Of the same in shares of the disparity; the larger of both limits holds."""
    least_confidence: Annotated[float, "[0, 1)"] = 0.5
    """Of the matcher in the left view, where it has one."""


def label_pairs(
    net: FakestereoNet,
    dataset: Dataset,
    config: LabelConfig,
    folder: Path,
    settings: dict[str, object],
    *,
    failures: list[InputError] | None = None,
) -> Iterator[tuple[str, float]]:
    """Write a plain folder of pairs with pseudo-truth, and yield each name and what share is known.

    ``left/`` and ``right/`` repeat the images, ``disp_occ/`` holds the disparity, ``calib.txt``
    the rigs. A rerun goes on where it was; pairs of another folder may be added, if their names are
    others. Frames without right view or calibration are left out. What is wrong with a pair goes to
    ``failures``, or without these is raised. A network that has seen evaluation frames must not be
    used. ``config`` says what counts as known, ``settings`` all that decides the result.

    Raises:
        InputError: no frame has both, the folder holds a label of another image of that name or was
            made by other settings, no calibration can be read, or a pair that cannot be matched.
    """
    frames = dataset.frames
    usable = [n for n, frame in enumerate(frames) if frame.right and frame.calibration]
    if not usable:
        raise InputError(f"{dataset.name}: no frame has a right view and a calibration to match by")
    claim_folder(folder, settings, ("left", "right", "disp_occ", "calib.txt"))
    sources = {frames[n].name: frames[n].seen_files() for n in usable}
    claim_names(
        folder, sources, is_finished=lambda name: is_whole(folder, name, [f"disp_occ/{name}.png"])
    )
    rigs: dict[int, StereoRig] = {}

    def fail(error: InputError) -> None:
        if failures is None:
            raise error
        failures.append(error)

    # The rigs first: calib.txt names all of them before any label is there.
    for number in usable:
        name = frames[number].name
        if any("\ud800" <= letter <= "\udfff" for letter in name):  # bytes that are no UTF-8
            fail(InputError(f"{name!r}: not a name in UTF-8, as calib.txt needs; rename the file"))
            continue
        try:
            rig = dataset.read_rig(number)
        except InputError as error:
            fail(error)
            continue
        assert rig is not None
        rigs[number] = rig
    if failures and not rigs:
        raise failures[0]
    _write_calibration(folder / "calib.txt", {frames[n].name: rig for n, rig in rigs.items()})

    # Then each pair that an earlier run has not finished.
    for number in rigs:
        name = frames[number].name
        if is_whole(folder, name, [f"disp_occ/{name}.png"]):
            continue
        try:
            pair = dataset.read_input(number)
            refuse_unrectified(pair)
            labelled_px = label_pair(net, pair, config)
        except InputError as error:
            fail(error)
            continue
        assert pair.right is not None
        files = [folder / place / f"{name}.png" for place in ("left", "right", "disp_occ")]
        write_image(files[0], pair.left)
        write_image(files[1], pair.right)
        write_depth_png(files[2], labelled_px)
        note_result(folder, name, files)
        yield name, float(labelled_px.isfinite().float().mean())


def label_pair(net: FakestereoNet, pair: StereoInput, config: LabelConfig) -> Map:
    """Match a pair both ways [px]; NaN where they disagree, in the sky, or where it is not sure."""
    assert pair.right is not None
    mirrored = replace(pair, left=pair.right.flip(-1), right=pair.left.flip(-1))
    estimate, mirrored_estimate = (
        net.estimate_pair(views, with_check=False) for views in (pair, mirrored)
    )
    left_px = estimate.disparity_px
    right_px = mirrored_estimate.disparity_px.flip(-1)
    limit_px = (config.largest_share * left_px).clamp(min=config.largest_difference_px)
    is_known = (left_px - warp_right_to_left(right_px[None], left_px)[0]).abs() <= limit_px
    if estimate.confidence is not None:
        is_known &= estimate.confidence >= config.least_confidence
    if estimate.is_sky is not None:
        is_known &= ~estimate.is_sky
    return torch.where(is_known, left_px, torch.nan)


def _write_calibration(path: Path, rigs: Mapping[str, StereoRig]) -> None:
    """Write the line of each pair, and keep the lines of other pairs."""
    try:
        existing_lines = read_text(path).splitlines() if path.is_file() else []
    except InputError:  # damaged: the lines of these pairs are made again
        existing_lines = []
    parts = [line.rsplit(maxsplit=8) for line in existing_lines]
    lines = {
        part[0]: line for part, line in zip(parts, existing_lines, strict=True) if len(part) == 9
    }
    for name, rig in rigs.items():
        K = rig.K
        shift_px = rig.cx_right_minus_left_px
        values = (K[0, 0], K[0, 2], K[1, 2], rig.baseline_m, K[1, 1], shift_px)
        numbers = " ".join(f"{float(value):.9g}" for value in values)
        lines[name] = f"{name} {rig.width} {rig.height} {numbers}"
    if list(lines.values()) == existing_lines:
        return  # a file that is written again counts as changed
    with atomic_write(path) as part:
        part.write_text("\n".join(lines.values()) + "\n")
