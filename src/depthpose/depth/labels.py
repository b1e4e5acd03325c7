"""Pseudo-truth of pairs: disparity by a matcher, where both views agree."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import torch

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError
from depthpose.core.files import atomic_write, write_depth_png, write_image
from depthpose.core.files.disk import read_text
from depthpose.core.run_folder import claim_folder, claim_names, is_result_finished, note_result
from depthpose.depth.config import Settings
from depthpose.depth.datasets import Dataset
from depthpose.depth.disparity import left_right_difference
from depthpose.depth.estimator import FakestereoNet, check_rectified_pair
from depthpose.depth.types import DepthInput, Map


@dataclass(frozen=True, kw_only=True)
class LabelConfig(Settings):
    """Limits within which a matched disparity becomes truth."""

    largest_difference_px: Annotated[float, "[0, inf)"] = 1.0
    """Largest difference of the disparities of both views at one point, at the image's size."""
    largest_share: Annotated[float, "[0, inf)"] = 0.03
    """The same limit as a share of the disparity; the larger of both limits holds."""
    least_confidence: Annotated[float, "[0, 1)"] = 0.5
    """Least confidence of the matcher in the left view, where it has one."""


def label_pairs(
    net: FakestereoNet,
    dataset: Dataset,
    config: LabelConfig,
    folder: Path,
    settings: dict[str, object],
    *,
    failures: list[InputError] | None = None,
) -> Iterator[tuple[str, float]]:
    """Write pairs with pseudo-truth to a plain folder; yield each name and its labelled share.

    ``left/`` and ``right/`` repeat the images, ``disp_occ/`` holds the disparity, ``calib.txt``
    the rigs. A rerun continues with the pairs that are not finished; pairs of another folder may be
    added, if their names differ. Frames without right view or calibration are left out.

    Args:
        net: matches the pairs; it must not be trained on frames of an evaluation.
        dataset: the pairs.
        config: where a matched disparity becomes truth.
        folder: where the labelled pairs go.
        settings: all settings that the result depends on.
        failures: errors of single pairs are appended to it; None: the first one is raised.

    Raises:
        InputError: no frame has a right view and a calibration, the folder holds a label of another
            image of that name or was made by other settings, no calibration can be read, or a pair
            that cannot be matched.
    """
    frames = dataset.frames
    usable = [index for index, frame in enumerate(frames) if frame.right and frame.calibration]
    if not usable:
        raise InputError(f"{dataset.name}: no frame has a right view and a calibration to match by")
    claim_folder(folder, settings, ("left", "right", "disp_occ", "calib.txt"))
    sources = {frames[index].name: frames[index].list_input_files() for index in usable}
    claim_names(folder, sources, is_finished=partial(_is_labelled, folder))

    # The rigs first: calib.txt names all of them before there is any label.
    rigs: dict[int, StereoRig] = {}
    for index in usable:
        try:
            rigs[index] = _read_named_rig(dataset, index)
        except InputError as error:
            _keep_or_raise(error, failures)
    if failures and not rigs:
        raise failures[0]
    rigs_by_name = {frames[index].name: rig for index, rig in rigs.items()}
    _write_calibration(folder / "calib.txt", rigs_by_name)

    # Then each pair that an earlier run has not finished.
    for index in rigs:
        name = frames[index].name
        if _is_labelled(folder, name):
            continue
        try:
            pair = dataset.read_input(index)
            check_rectified_pair(pair)
            labelled_px = label_pair(net, pair, config)
        except InputError as error:
            _keep_or_raise(error, failures)
            continue
        assert pair.right is not None
        files = [folder / part / f"{name}.png" for part in ("left", "right", "disp_occ")]
        write_image(files[0], pair.left)
        write_image(files[1], pair.right)
        write_depth_png(files[2], labelled_px)
        note_result(folder, name, files)
        yield name, float(labelled_px.isfinite().float().mean())


def _keep_or_raise(error: InputError, failures: list[InputError] | None) -> None:
    """Append an error to ``failures``; raise it where that is None."""
    if failures is None:
        raise error
    failures.append(error)


def _read_named_rig(dataset: Dataset, index: int) -> StereoRig:
    """Read the rig of a frame, whose name can stand in calib.txt.

    Raises:
        InputError: the name is not UTF-8, or the calibration cannot be read.
    """
    name = dataset.frames[index].name
    if any("\ud800" <= letter <= "\udfff" for letter in name):  # bytes that are no UTF-8
        raise InputError(f"{name!r}: not a name in UTF-8, as calib.txt needs; rename the file")
    rig = dataset.read_rig(index)
    assert rig is not None, "the frame has a calibration"
    return rig


def _is_labelled(folder: Path, name: str) -> bool:
    """Whether an earlier run wrote all files of a pair."""
    return is_result_finished(folder, name, [f"disp_occ/{name}.png"])


def label_pair(net: FakestereoNet, pair: DepthInput, config: LabelConfig) -> Map:
    """Estimate the disparity of the left view [px] where it is sure enough to serve as truth.

    The pair is matched from left to right and from right to left. NaN where the two disagree, in
    the sky, and where the confidence is too low.
    """
    assert pair.right is not None
    mirrored = replace(pair, left=pair.right.flip(-1), right=pair.left.flip(-1))
    estimate = net.estimate_input(pair)
    mirrored_estimate = net.estimate_input(mirrored)

    left_px = estimate.disparity_px
    right_px = mirrored_estimate.disparity_px.flip(-1)
    difference_px = left_right_difference(left_px, right_px)
    limit_px = (config.largest_share * left_px).clamp(min=config.largest_difference_px)
    is_labelled = difference_px <= limit_px
    if estimate.confidence is not None:
        is_labelled &= estimate.confidence >= config.least_confidence
    if estimate.is_sky is not None:
        is_labelled &= ~estimate.is_sky
    return torch.where(is_labelled, left_px, torch.nan)


def _write_calibration(path: Path, rigs: Mapping[str, StereoRig]) -> None:
    """Write ``calib.txt``, one line for each pair, by name; lines of other pairs are kept.

    A line holds name, width, height, fx, cx, cy, baseline [m], fy, and cx of the right camera less
    that of the left one; all but name, width, height and baseline [px].
    """
    try:
        existing_lines = read_text(path).splitlines() if path.is_file() else []
    except InputError:  # damaged: the lines of these pairs are made again
        existing_lines = []
    lines: dict[str, str] = {}
    for line in existing_lines:
        name, *numbers = line.rsplit(maxsplit=8) or [""]  # a name may hold spaces
        if len(numbers) == 8:
            lines[name] = line

    for name, rig in rigs.items():
        K = rig.K
        cx_difference_px = rig.cx_right_minus_left_px
        values = (K[0, 0], K[0, 2], K[1, 2], rig.baseline_m, K[1, 1], cx_difference_px)
        numbers = " ".join(f"{float(value):.9g}" for value in values)
        lines[name] = f"{name} {rig.width} {rig.height} {numbers}"
    if list(lines.values()) == existing_lines:
        return  # a file that is written again counts as changed
    with atomic_write(path) as part:
        part.write_text("\n".join(lines.values()) + "\n")
