"""The tab Depth: an image or a pair, and its camera, to depth in metres."""

import math
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from depthpose.core.camera import StereoRig, camera_of, write_camera
from depthpose.core.camera.formats.facts import camera_keys
from depthpose.core.draw import draw_share
from depthpose.core.errors import InputError
from depthpose.core.files import image_size, read_exif_focal, read_image, write_image
from depthpose.depth.config import COLOR_RANGE_M, StreetsConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.predictions import OutputOptions, write_estimate
from depthpose.depth.stereo import NetworkMatcher
from depthpose.depth.synthetic import Streets
from depthpose.depth.types import DepthEstimate, DepthInput
from depthpose.report.depth import list_depth_facts, make_depth_scene
from depthpose.report.page import make_depth_color_bar, make_rising_color_bar
from depthpose.web.answer import (
    EXAMPLE_SEED,
    Answer,
    Form,
    ShownPicture,
    encode_example,
    refuse_large,
)

_MAX_NETWORK_PIXELS = 8_000_000
"""Most pixels of the image as networks get it, resized to their focal length."""
_PHONE_FOCAL_WIDTHS = 0.75
"""Focal length of a phone's main camera, in widths of the image."""
_GUESSED_ORIGIN = (
    f" (guessed as {_PHONE_FOCAL_WIDTHS} widths: the metres are as wrong as the guess)"
)
_MIN_SKY_SHARE = 0.5
"""Share of the sky from which a pair without a depth is not taken for a wrong one."""


def answer_depth(form: Form, net: FakestereoNet) -> Answer:
    """Estimate depth for a form: what the page shows, with files to download.

    Raises:
        InputError: a field or file is missing, wrong or too large.
    """
    start = time.perf_counter()
    depth_input, focal_origin = _read_input(form)

    # Refuse what cannot be drawn or matched, and what would take too long.
    near_m, far_m = _read_range(form)
    if depth_input.right is not None and net.matcher is None:
        raise InputError(
            "the weights of this page take one image alone: remove the right image, or start "
            "'depthpose serve' with --weights that have a matcher"
        )
    _refuse_large_inputs(depth_input, net)

    estimate = net.estimate_input(depth_input)
    seconds = time.perf_counter() - start
    assert estimate.depth_m is not None

    # The files for download, and what the page shows.
    folder = form.folder / "results"
    folder.mkdir()
    write_estimate(folder, estimate, OutputOptions(range_m=(near_m, far_m), cloud_m=far_m))
    write_image(folder / f"{depth_input.name}.input.jpg", depth_input.left)
    pictures = _list_pictures(estimate, (near_m, far_m))
    if estimate.confidence is not None:
        write_image(
            folder / f"{depth_input.name}.confidence.png", draw_share(1 - estimate.confidence)
        )
    # The warning is in the sentence already.
    facts = list_depth_facts(estimate, focal_origin)
    facts = [(name, value) for name, value in facts if name != "warning"]
    return Answer(
        is_ok=not estimate.warning,
        sentence=_describe_depth(estimate),
        facts=[*facts, ("computed in", f"{seconds:.2f} s")],
        pictures=pictures,
        scene=make_depth_scene(estimate, far_m),
        terms=net.terms,
        files={path.name: path.read_bytes() for path in sorted(folder.iterdir())},
    )


def _read_range(form: Form) -> tuple[float, float]:
    """Read the range of depth that the colours show [m]: of the brightest and the darkest one."""
    near_m = form.read_number("near_m")
    far_m = form.read_number("far_m")
    near_m = COLOR_RANGE_M[0] if near_m is None else near_m
    far_m = COLOR_RANGE_M[1] if far_m is None else far_m
    if not 0 < near_m < far_m:
        raise InputError(
            f"the colours go from {near_m:g} m to {far_m:g} m; give a near end above 0, and a far "
            "end beyond it"
        )
    return near_m, far_m


def _refuse_large_inputs(depth_input: DepthInput, net: FakestereoNet) -> None:
    """Refuse images that the networks would take in too large a size.

    The size follows from the focal length: networks resize images to the one they know.
    """
    assert depth_input.camera is not None
    height, width = depth_input.left.shape[1:]
    focal_px = float(depth_input.camera.K[0, 0])

    # Rows and columns as the generator takes one image, and as the matcher takes both.
    sizes: list[tuple[int, int]] = []
    camera = depth_input.camera
    is_matched = True
    if depth_input.right is None and net.synthesiser is not None:
        config = net.synthesiser.config
        sizes += net.virtual_sizes(depth_input)
        virtual_height, virtual_width = sizes[0]
        virtual_size = (virtual_width, virtual_height)
        camera = camera_of(config.virtual_focal_px, virtual_size) or camera
        is_matched = config.answer != "own"  # else depth is the generator's, without a matcher
    if is_matched and isinstance(net.matcher, NetworkMatcher):
        sizes.append(net.matcher.work_size(camera))
    elif is_matched:
        sizes.append((camera.height, camera.width))

    rows, columns = max(sizes, key=math.prod)
    if (rows, columns) == (height, width) and rows * columns > _MAX_NETWORK_PIXELS:
        raise InputError(
            f"{depth_input.name} has {width}x{height} pixels; these weights match pairs as "
            f"they are, and this page computes {_MAX_NETWORK_PIXELS / 1e6:g} million at most; "
            "scale both images down, and the focal length with them, or use the command line"
        )
    if rows * columns > _MAX_NETWORK_PIXELS:
        raise InputError(
            f"a focal length of {focal_px:g} px for {width}x{height} pixels "
            f"would be resized to {columns}x{rows}, more than this page computes; is it in "
            f"millimetres? A phone's is about {_PHONE_FOCAL_WIDTHS} widths"
        )


def _read_input(form: Form) -> tuple[DepthInput, str]:
    """Read the picture or pair with its camera.

    Returns:
        The input, and words for the page on where its focal length is from; empty where the user
        gave it.
    """
    path = form.require_file("image")
    width, height = image_size(path)
    refuse_large(path.name, width, height)
    has_right = "right" in form.files
    focal_px = form.read_number("focal_px")
    baseline_m = form.read_number("baseline_m")
    if has_right and baseline_m is None and "camera" not in form.files:
        raise InputError(
            "baseline: the depth of a pair needs the distance of its two cameras; fill in the "
            "baseline in metres (of KITTI's 2011_09_26: 0.5327), or choose a camera file that has "
            "it"
        )

    # A focal length that is not given is that of the EXIF, or guessed; EXIF of a pair is not read.
    origin = ""
    if focal_px is None and "camera" not in form.files:
        exif = None if has_right else read_exif_focal(path)
        if exif is None:
            focal_px = _PHONE_FOCAL_WIDTHS * width
            origin = _GUESSED_ORIGIN
        else:
            focal_px, tags = exif
            origin = f" (EXIF: {tags})"

    # The camera, by its file or by the fields.
    doffs_px = form.read_number("cx_right_minus_left_px")
    keys = form.make_pinhole_keys((width, height), focal_px) | {
        "baseline_m": baseline_m,
        "cx_right_minus_left_px": None if baseline_m is None else doffs_px,
        "mount_height_m": form.read_number("mount_height_m"),
        "tilt_deg": form.read_number("tilt_deg"),
    }
    camera = form.make_camera(keys, (width, height))
    if baseline_m is not None and not isinstance(camera, StereoRig):  # of a file without one
        with_baseline = camera_keys(camera) | {
            "baseline_m": baseline_m,
            "cx_right_minus_left_px": doffs_px or 0.0,
        }
        camera = camera_of(with_baseline, (width, height)) or camera

    right = None
    if has_right:
        right_path = form.require_file("right")
        refuse_large(right_path.name, *image_size(right_path))
        right = read_image(right_path)
    depth_input = DepthInput(name=path.stem, left=read_image(path), right=right, camera=camera)
    return depth_input, origin


def _list_pictures(estimate: DepthEstimate, range_m: tuple[float, float]) -> list[ShownPicture]:
    """List the pictures that the page shows of an estimate."""
    name = estimate.input.name
    near_m, far_m = range_m
    grey = "grey: none" if estimate.is_sky is None else "grey: sky or no answer"
    colours = f"near bright and far dark, {near_m:g} m to {far_m:g} m by the logarithm"
    depth = ShownPicture(
        file=f"{name}.color.png",
        caption=f"depth: {colours}; {grey}",
        values=f"{name}.depth_m.npy",
        unit="m",
        scale=make_depth_color_bar(*range_m),
    )
    pictures = [ShownPicture(file=f"{name}.input.jpg", caption="the image"), depth]
    if estimate.right is not None:
        pictures.append(ShownPicture(file=f"{name}.right.png", caption="right view, synthesised"))
    if estimate.confidence is not None:
        confidence = ShownPicture(
            file=f"{name}.confidence.png",
            caption="confidence: bright is high, dark low",
            values=f"{name}.confidence.npy",
            scale=make_rising_color_bar("confidence", 1.0),
        )
        pictures.append(confidence)
    return pictures


def _describe_depth(estimate: DepthEstimate) -> str:
    """Describe in a sentence how much of the image has a depth, and how far half of it is."""
    assert estimate.depth_m is not None
    finite_m = estimate.depth_m[estimate.depth_m.isfinite()]
    is_pair = estimate.input.right is not None
    images = "both images" if is_pair else "one image"
    is_sky = estimate.is_sky
    sky_share = 0.0 if is_sky is None else float(is_sky.float().mean())
    warning = f"Careful: {estimate.warning}. " if estimate.warning else ""
    if len(finite_m) == 0:
        ending = f"; {sky_share:.0%} of the image is taken for sky." if is_sky is not None else "."
        if is_pair and sky_share < _MIN_SKY_SHARE:
            ending = ": is the pair rectified, and are left and right as they should be?"
        return f"{warning}No pixel got a depth from {images}{ending}"
    share = len(finite_m) / estimate.depth_m.numel()
    median_m = float(finite_m.median())
    sky_text = f" {sky_share:.0%} are sky." if is_sky is not None else ""
    return (
        f"{warning}Depth from {images} for {share:.0%} of the pixels; half of these are nearer "
        f"than {median_m:.2f} m.{sky_text}"
    )


def make_depth_example() -> dict[str, Any]:
    """Render the example of the tab, as JSON: a street of half KITTI's size, and its rig."""
    pair = Streets(StreetsConfig(seed=EXAMPLE_SEED, scale=0.5))[1].input
    assert pair.right is not None
    assert pair.camera is not None
    with TemporaryDirectory(prefix="depthpose-") as name:
        folder = Path(name)
        write_image(folder / "image.png", pair.left)
        write_image(folder / "right.png", pair.right)
        write_camera(folder / "camera.json", pair.camera)
        return encode_example(folder, {})
