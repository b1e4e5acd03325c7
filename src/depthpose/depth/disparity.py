"""Disparity to depth and back, matches to estimates, warping, maps at other sizes."""

import warnings
from collections.abc import Callable
from dataclasses import fields

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.errors import InputError, Notice
from depthpose.depth.config import GeneratorConfig, SelectionConfig
from depthpose.depth.types import DepthEstimate, Map, Match, StereoInput
from depthpose.depth.visible import texture, without_picture

_MISTAKES = {
    1000.0: "is its depth in millimetres (divide by 1000), or its disparity in shares of the width "
    "(multiply by it)?",
    256.0: "is its depth metres x 256, as KITTI's PNG holds it (divide by 256)?",
    1 / 256: "is its disparity pixels x 256, as KITTI's PNG holds it (divide by 256)?",
}
"""What was likely meant, by how many times farther than the truth a prediction lies."""
_DOUBTS = {
    1000 / 256: "is it a PNG of millimetres, read as metres x 256?",
    256 / 1000: "is its truth a PNG of millimetres, read as metres x 256?",
    1 / 16: "is its disparity pixels x 16, as OpenCV's matchers give it?",
    1 / 5.4: "is it of monodepth2, trained with a baseline of 0.1 m (multiply its depth by 5.4)?",
}
"""What may have been meant by a scale that a poor estimate could have too."""
_MISTAKE_FACTOR = 1.4
"""No estimate is wrong by 250 or 1000 in the median, and a slip is met to within this factor."""
_DOUBT_FACTOR = 1.1  # to within which a scale of ``_DOUBTS`` is met
_POOR_FACTOR = 3.0
"""A median so far off is told of: an estimate of the right scale has one near 1."""
_NEARLY_ALL = 0.9
_OPPOSITE_CORRELATION = -0.8  # of the logarithms of prediction and truth
_given_doubts: set[str] = set()
LEAST_PX = 0.01
"""Of a corrected disparity in use: depth stays finite. It is what a pair without a rig has in the
sky."""
SKY_M = 10_000.0
"""What the disparity of the sky says: protocols take a disparity of zero for none, or for near."""
_LEAST_SKY = 0.002
"""Of the image; fewer pixels are a lamp or a window, at the match's depth: 43 in a garage were
0.87 m of RMSE, and 0.25 m without them."""
MOST_ENLARGED_PIXELS = 8_000_000
"""An image is not enlarged beyond this to reach the focal length of a network."""


def disparity_advice(predicted_px: Map, true_px: Map) -> str | None:
    """Say that a prediction is of another unit or sign than pixels; None where it seems not.

    What a poor estimate could be too is a notice, and None.
    """
    counts = torch.isfinite(predicted_px) & torch.isfinite(true_px)
    if not bool(counts.any()):
        return None
    predicted_px = predicted_px[counts]
    true_px = true_px[counts]
    negative = float((predicted_px < 0).float().mean())
    if negative > _NEARLY_ALL:
        return (
            f"{negative:.0%} of the disparities are negative: left and right were exchanged, or "
            "the sign is the other one; a left pixel at u is seen at u - disparity on the right"
        )
    median_px = float(predicted_px.median())
    farther = float(true_px.median()) / median_px if median_px > 0 else 0.0
    for factor, question in _MISTAKES.items():
        if factor / _MISTAKE_FACTOR < farther < factor * _MISTAKE_FACTOR:
            return f"it lies {farther:.4g} times as far as the truth: {question}"
    doubts: list[str] = []
    if farther > 0 and not 1 / _POOR_FACTOR < farther < _POOR_FACTOR:
        likely = (
            q
            for factor, q in _DOUBTS.items()
            if factor / _DOUBT_FACTOR < farther < factor * _DOUBT_FACTOR
        )
        question = next(likely, "is it without a scale, or of another focal length or baseline?")
        doubts.append(f"lies {farther:.3g} times as far as the truth in the median: {question}")
    both = torch.stack([predicted_px, true_px]).double().clamp_min(1e-3).log()
    if len(true_px) > 1 and float(both.corrcoef()[0, 1]) < _OPPOSITE_CORRELATION:
        doubts.append("is the nearer the farther its truth is: is it inverse depth?")
    for doubt in doubts:
        question = doubt.partition(":")[2]
        if question not in _given_doubts:
            _given_doubts.add(question)  # of a whole data set once
            warnings.warn(f"a prediction {doubt}", Notice, stacklevel=2)
    return None


def depth_from_disparity(
    disparity_px: Float[Tensor, "*batch h w"], rig: StereoRig
) -> Float[Tensor, "*batch h w"]:
    """Triangulate a rectified pair: ``depth = fx B / (disparity + cx_right - cx_left)``.

    An error of e px at depth z is one of ``e z^2 / (fx B)`` metres: it grows with the square.
    NaN comes out where the disparity is NaN, or puts the point at infinity or behind the camera.
    """
    shifted_px = disparity_px + rig.cx_right_minus_left_px
    depth_m = float(rig.K[0, 0]) * rig.baseline_m / shifted_px
    return torch.where(shifted_px > 0, depth_m, torch.nan)


def disparity_from_depth(
    depth_m: Float[Tensor, "*batch h w"], rig: StereoRig
) -> Float[Tensor, "*batch h w"]:
    """Undo :func:`depth_from_disparity`; NaN where depth is NaN or not positive."""
    disparity_px = float(rig.K[0, 0]) * rig.baseline_m / depth_m - rig.cx_right_minus_left_px
    return torch.where(depth_m > 0, disparity_px, torch.nan)


_DEVIATIONS = ((0.0, 0.5), (0.3, 0.1), (0.5, 0.07), (0.6, 0.05), (0.8, 0.03), (0.9, 0.02),
               (0.95, 0.015), (1.0, 0.005))  # fmt: skip
"""Deviation of a disparity, as a share of it, by its confidence: 68 % of the errors of `default` on
10 near scenes and 6 streets, synthetic and not trained on, made to fall with the confidence."""
_LEAST_DEVIATION_PX = 0.2
"""Of what is surest on these."""


def depth_deviation(
    depth_m: Float[Tensor, "*batch h w"], confidence: Float[Tensor, "*batch h w"], rig: StereoRig
) -> Float[Tensor, "*batch h w"]:
    """Standard deviation of a matched depth: ``z^2 / (fx B)`` times that of the disparity [m].

    That of the disparity follows from the confidence, as measured on synthetic scenes. NaN where
    depth is.
    """
    knots = torch.tensor(_DEVIATIONS, dtype=depth_m.dtype, device=depth_m.device)
    confidences, shares = knots.T.contiguous()
    place = confidence.clamp(0, 1).contiguous()
    after = torch.searchsorted(confidences, place).clamp(1, len(confidences) - 1)
    between = (place - confidences[after - 1]) / (confidences[after] - confidences[after - 1])
    share = torch.lerp(shares[after - 1], shares[after], between)
    deviation_px = (share * disparity_from_depth(depth_m, rig)).clamp(min=_LEAST_DEVIATION_PX)
    return depth_m.square() / (float(rig.K[0, 0]) * rig.baseline_m) * deviation_px


def warp_right_to_left(right: Float[Tensor, "c h w"], disparity_px: Map) -> Float[Tensor, "c h w"]:
    """Look up, for each left pixel x, the right view at ``x - disparity`` (bilinear).

    NaN where the disparity is NaN or the pixel looked up lies outside the right view.
    """
    height, width = disparity_px.shape
    columns = torch.arange(width, device=right.device) - disparity_px
    rows = torch.arange(height, device=right.device)[:, None].expand(height, width)
    is_inside = (columns >= 0) & (columns <= width - 1)
    # grid_sample's corners: -1 and 1 are the centres of the outer pixels.
    grid = torch.stack(
        [2 * columns.nan_to_num(0.0) / max(width - 1, 1) - 1, 2 * rows / max(height - 1, 1) - 1], -1
    ).to(right.dtype)
    looked_up = F.grid_sample(right[None], grid[None], padding_mode="border", align_corners=True)
    return torch.where(is_inside, looked_up[0], torch.nan)


def right_disparity_from_left(left_px: Map) -> Map:
    """Carry the disparity of the left view over to the right one: pixel x goes to ``x - d``.

    The nearest point wins where several fall on one pixel. NaN where none does: what the left view
    does not see, or where its disparity is unknown. Points land on whole pixels, half a pixel from
    their place at most.
    """
    height, width = left_px.shape
    columns = (torch.arange(width, device=left_px.device) - left_px).round()
    is_inside = (columns >= 0) & (columns < width)
    rows = torch.arange(height, device=left_px.device)[:, None].expand(height, width)
    places = (rows * width + columns.nan_to_num(0.0))[is_inside].long()
    empty = left_px.new_full((height * width,), -torch.inf)
    carried = empty.scatter_reduce(0, places, left_px[is_inside], "amax")
    return torch.where(carried.isinf(), torch.nan, carried).reshape(height, width)


def size_at_focal_length(camera: Camera, focal_px: float) -> tuple[int, int]:
    """Rows and columns at which the camera's image has ``focal_px``, with square pixels.

    Raises:
        InputError: the image would be enlarged beyond :data:`MOST_ENLARGED_PIXELS`.
    """
    rows = max(round(camera.height * focal_px / float(camera.K[1, 1])), 1)
    columns = max(round(camera.width * focal_px / float(camera.K[0, 0])), 1)
    if rows * columns > max(MOST_ENLARGED_PIXELS, camera.height * camera.width):
        smallest_px = float(camera.K.diagonal()[:2].min())
        raise InputError(
            f"a focal length of {smallest_px:g} px would enlarge the image of "
            f"{camera.width}x{camera.height} to {columns}x{rows}; is it in millimetres? Give it in "
            "pixels: millimetres / width of the sensor in millimetres x columns of the image"
        )
    return rows, columns


def resize_image(
    image: Float[Tensor, "*batch 3 _ _"], height: int, width: int
) -> Float[Tensor, "*batch 3 {height} {width}"]:
    """Resize one image, or a batch, bilinearly, averaging where it shrinks."""
    size = image.shape[-2:]
    if size == (height, width):
        return image
    images = image if image.ndim == 4 else image[None]
    shrinks = height < size[0] or width < size[1]
    resized = F.interpolate(images, (height, width), mode="bilinear", antialias=shrinks)
    return resized.clamp(0, 1).reshape(*image.shape[:-2], height, width)


def changed_match(match: Match, change: Callable[[Tensor], Tensor]) -> Match:
    """Give a match with each map that it has changed alike."""
    maps = {field.name: getattr(match, field.name) for field in fields(match)}
    return Match(**{name: change(values) for name, values in maps.items() if values is not None})


def resized_match(match: Match, height: int, width: int) -> Match:
    """Bring a match to another size of its image."""
    px = match.disparity_px
    confidence = match.confidence
    sky = match.is_sky
    return Match(
        disparity_px=resized_map(px, height, width) * (width / px.shape[1]),
        confidence=None if confidence is None else resized_map(confidence, height, width),
        is_sky=None if sky is None else resized_map(sky.float(), height, width) > 0.5,
    )


def resized_map(
    values: Float[Tensor, "_ _"], height: int, width: int
) -> Float[Tensor, "{height} {width}"]:
    """Bring a map to another size, bilinearly (pixel centres at halves), without averaging.

    Of disparity the values still are of the old width. It is what is interpolated, never depth:
    depth is not linear between two pixels.
    """
    if values.shape == (height, width):
        return values
    return F.interpolate(values[None, None], (height, width), mode="bilinear")[0, 0]


def estimate_from_pair(pair: StereoInput, match: Match, warning: str = "") -> DepthEstimate:
    """Give what was found in a rectified pair: metres where its camera has a baseline.

    There is no answer where the left image has no picture. The confidence is 0 where the right one
    has none, and falls to 0 where the left one is plain, for nothing can be matched there.
    """
    px = match.disparity_px
    depth_m = None
    is_sky = match.is_sky
    confidence = match.confidence
    blank = without_picture(pair.left).to(px.device)
    if is_sky is not None:
        is_sky = is_sky & ~blank
    if confidence is not None and pair.right is not None:
        right_blank = without_picture(pair.right).to(px)
        unseen = warp_right_to_left(right_blank[None], px)[0].nan_to_num(0.0) > 0.5
        confidence = confidence * texture(pair.left).to(confidence)
        confidence = torch.where(blank | unseen, 0.0, confidence)
    rig = pair.camera if isinstance(pair.camera, StereoRig) else None
    if is_sky is not None:
        is_sky = is_sky & (is_sky.float().mean() >= _LEAST_SKY)
        far_px = LEAST_PX
        if rig is not None:
            far_px = float(rig.K[0, 0]) * rig.baseline_m / SKY_M - rig.cx_right_minus_left_px
        px = torch.where(is_sky, far_px, px)
    px = torch.where(blank, torch.nan, px)
    if rig is not None:
        depth_m = depth_from_disparity(px, rig)
        depth_m = depth_m if is_sky is None else torch.where(is_sky, torch.nan, depth_m)
    return DepthEstimate(
        depth_m=depth_m,
        disparity_px=px,
        confidence=confidence,
        is_sky=is_sky,
        warning=warning,
        input=pair,
    )


def estimate_from_virtual(
    image: StereoInput,
    rig: GeneratorConfig | SelectionConfig,
    match: Match,
    right: Float[Tensor, "3 _ _"],
) -> DepthEstimate:
    """Convert a match at the virtual rig to depth of the image; NaN where that shows nothing.

    Sky on plain areas gets a confidence of 0, because a bright wall looks the same.
    """
    camera = image.camera
    assert camera is not None
    height, width = image.left.shape[1:]
    resized = resized_match(match, height, width)
    px = resized.disparity_px
    is_sky = resized.is_sky
    focal_m_px = float(camera.K[0, 0]) * rig.virtual_baseline_m
    depth_m = torch.where(px > 0, focal_m_px / px, torch.nan)

    # The sky is far away, and is no sky if it is only a few pixels.
    blank = without_picture(image.left).to(px.device)
    confidence = resized.confidence
    if is_sky is not None:
        is_sky = is_sky & ~blank
        is_sky = is_sky & (is_sky.float().mean() >= _LEAST_SKY)
        if confidence is not None:
            of_sky = confidence * texture(image.left).to(confidence)
            confidence = torch.where(is_sky, of_sky, confidence)
        depth_m = torch.where(is_sky, SKY_M, depth_m)
        px = torch.where(is_sky, focal_m_px / SKY_M, px)

    # Borders that show nothing have no depth.
    depth_m = torch.where(blank, torch.nan, depth_m)
    px = torch.where(blank, torch.nan, px)
    if confidence is not None:
        confidence = torch.where(blank, 0.0, confidence)
    return DepthEstimate(
        depth_m=depth_m if is_sky is None else torch.where(is_sky, torch.nan, depth_m),
        disparity_px=disparity_from_depth(depth_m, camera) if isinstance(camera, StereoRig) else px,
        confidence=confidence,
        right=resize_image(right, height, width),
        is_sky=is_sky,
        input=image,
    )
