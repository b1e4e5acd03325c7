"""Disparity to depth and back, matches to estimates, warping, maps at other sizes."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import fields

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.errors import InputError, Notice
from depthpose.depth.config import GeneratorConfig, SelectionConfig
from depthpose.depth.types import DepthEstimate, Map, Mask, Match, StereoInput
from depthpose.depth.visible import texture, without_picture

_UNIT_MISTAKES = {
    1000.0: "is its depth in millimetres (divide by 1000), or its disparity in shares of the width "
    "(multiply by it)?",
    256.0: "is its depth metres x 256, as KITTI's PNG holds it (divide by 256)?",
    1 / 256: "is its disparity pixels x 256, as KITTI's PNG holds it (divide by 256)?",
}
"""Likely mistakes, by the factor by which a prediction lies farther than the truth."""
_POSSIBLE_MISTAKES = {
    1000 / 256: "is it a PNG of millimetres, read as metres x 256?",
    256 / 1000: "is its truth a PNG of millimetres, read as metres x 256?",
    1 / 16: "is its disparity pixels x 16, as OpenCV's matchers give it?",
    1 / 5.4: "is it of monodepth2, trained with a baseline of 0.1 m (multiply its depth by 5.4)?",
}
"""Likely mistakes by factors that a poor estimate may have too."""
_MISTAKE_TOLERANCE = 1.4
"""Ratio to a factor of ``_UNIT_MISTAKES`` that is still that mistake: a poor estimate is never
wrong by 250 or 1000 in the median."""
_POSSIBLE_TOLERANCE = 1.1
"""Ratio to a factor of ``_POSSIBLE_MISTAKES`` that is still that mistake."""
_POOR_FACTOR = 3.0
"""Ratio of medians from which a notice is given: an estimate of the right scale has one near 1."""
_NEARLY_ALL = 0.9
"""Share of the pixels with a negative disparity from which the sign is wrong."""
_OPPOSITE_CORRELATION = -0.8
"""Correlation of the logarithms of prediction and truth, below which one is inverted."""
_given_notices: set[str] = set()
LEAST_PX = 0.01
"""Least disparity of a match, so that depth stays finite; also the disparity of the sky in a pair
without a rig."""
SKY_M = 10_000.0
"""Depth that the disparity of the sky stands for: protocols take a disparity of zero for no
prediction, or for a near point."""
_MIN_SKY_SHARE = 0.002
"""Least share of the image that is sky; fewer pixels are a lamp or a window, and keep the depth of
the match: 43 of them in a garage made an RMSE of 0.87 m, in place of 0.25 m."""
MOST_ENLARGED_PIXELS = 8_000_000
"""Largest image to which a smaller one is enlarged to reach the focal length of a network."""


def disparity_advice(predicted_px: Map, true_px: Map) -> str | None:
    """Name the unit or sign that a predicted disparity likely has in place of pixels; None: none.

    What a poor estimate could look like too is only a notice, once for each possible mistake.
    """
    is_compared = torch.isfinite(predicted_px) & torch.isfinite(true_px)
    if not bool(is_compared.any()):
        return None
    predicted_px = predicted_px[is_compared]
    true_px = true_px[is_compared]

    # What is certain: most signs, or a factor that no estimate has.
    negative_share = float((predicted_px < 0).float().mean())
    if negative_share > _NEARLY_ALL:
        return (
            f"{negative_share:.0%} of the disparities are negative: left and right were exchanged, "
            "or the sign is the other one; a left pixel at u is seen at u - disparity on the right"
        )
    median_px = float(predicted_px.median())
    depth_factor = float(true_px.median()) / median_px if median_px > 0 else 0.0
    mistake = _mistake_of_factor(depth_factor, _UNIT_MISTAKES, _MISTAKE_TOLERANCE)
    if mistake is not None:
        return f"it lies {depth_factor:.4g} times as far as the truth: {mistake}"

    # What is possible: a wrong scale, or inverse depth.
    if depth_factor > 0 and not 1 / _POOR_FACTOR < depth_factor < _POOR_FACTOR:
        question = _mistake_of_factor(depth_factor, _POSSIBLE_MISTAKES, _POSSIBLE_TOLERANCE)
        if question is None:
            question = "is it without a scale, or of another focal length or baseline?"
        times = f"{depth_factor:.3g} times as far as the truth in the median"
        _give_notice_once(f"lies {times}:", question)
    logs = torch.stack([predicted_px, true_px]).double().clamp_min(1e-3).log()
    if len(true_px) > 1 and float(logs.corrcoef()[0, 1]) < _OPPOSITE_CORRELATION:
        _give_notice_once("is the nearer the farther its truth is:", "is it inverse depth?")
    return None


def _mistake_of_factor(
    depth_factor: float, mistakes: Mapping[float, str], tolerance: float
) -> str | None:
    """Find the first mistake whose factor is met within a ratio of ``tolerance``."""
    for factor, question in mistakes.items():
        if factor / tolerance < depth_factor < factor * tolerance:
            return question
    return None


def _give_notice_once(statement: str, question: str) -> None:
    """Give a notice about a prediction, once for all frames of a data set."""
    if question not in _given_notices:
        _given_notices.add(question)
        warnings.warn(f"a prediction {statement} {question}", Notice, stacklevel=3)


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


_RELATIVE_STD_BY_CONFIDENCE = (
    (0.0, 0.5),
    (0.3, 0.1),
    (0.5, 0.07),
    (0.6, 0.05),
    (0.8, 0.03),
    (0.9, 0.02),
    (0.95, 0.015),
    (1.0, 0.005),
)
"""Pairs of confidence and standard deviation of a disparity, as a share of the disparity: the bound
of 68 % of the errors of `default` on 10 near scenes and 6 streets, synthetic and not trained on,
made to fall with the confidence."""
_MIN_STD_PX = 0.2
"""Standard deviation of the surest disparities of these scenes."""


def depth_deviation(
    depth_m: Float[Tensor, "*batch h w"], confidence: Float[Tensor, "*batch h w"], rig: StereoRig
) -> Float[Tensor, "*batch h w"]:
    """Give the standard deviation of a matched depth [m].

    It is ``z^2 / (fx B)`` times that of the disparity, which is a share of ``fx B / z`` that falls
    with the confidence, as measured on synthetic scenes. NaN where depth is NaN or not positive.
    """
    # The deviation of the disparity: linear between the measured confidences.
    table = torch.tensor(_RELATIVE_STD_BY_CONFIDENCE, dtype=depth_m.dtype, device=depth_m.device)
    confidences, relative_stds = table.T.contiguous()
    confidence = confidence.clamp(0, 1).contiguous()
    upper = torch.searchsorted(confidences, confidence).clamp(1, len(confidences) - 1)
    lower = upper - 1
    weight = (confidence - confidences[lower]) / (confidences[upper] - confidences[lower])
    relative_std = torch.lerp(relative_stds[lower], relative_stds[upper], weight)
    # Without the offset of the principal points, which shifts a disparity and does not blur it.
    focal_m_px = float(rig.K[0, 0]) * rig.baseline_m
    disparity_px = torch.where(depth_m > 0, focal_m_px / depth_m, torch.nan)
    disparity_std_px = (relative_std * disparity_px).clamp(min=_MIN_STD_PX)

    return depth_m.square() / focal_m_px * disparity_std_px


def warp_right_to_left(right: Float[Tensor, "c h w"], disparity_px: Map) -> Float[Tensor, "c h w"]:
    """Warp the right view to the left one: sample it at ``x - disparity`` for each left pixel x.

    Sampling is bilinear. NaN where the disparity is NaN or the sampled place lies outside the right
    view.
    """
    height, width = disparity_px.shape
    columns = torch.arange(width, device=right.device) - disparity_px
    rows = torch.arange(height, device=right.device)[:, None].expand(height, width)
    is_inside = (columns >= 0) & (columns <= width - 1)
    # grid_sample's coordinates: -1 and 1 are the centres of the outer pixels.
    x = 2 * columns.nan_to_num(0.0) / max(width - 1, 1) - 1
    y = 2 * rows / max(height - 1, 1) - 1
    grid = torch.stack([x, y], -1).to(right.dtype)
    sampled = F.grid_sample(right[None], grid[None], padding_mode="border", align_corners=True)
    return torch.where(is_inside, sampled[0], torch.nan)


def right_disparity_from_left(left_px: Map) -> Map:
    """Warp the disparity of the left view to the right one: pixel x moves to ``x - d``.

    Positions are rounded to whole pixels, and where several points fall on one pixel the nearest
    counts. NaN where none falls: where the left view is occluded or its disparity is unknown.
    """
    height, width = left_px.shape
    columns = (torch.arange(width, device=left_px.device) - left_px).round()
    is_inside = (columns >= 0) & (columns < width)
    rows = torch.arange(height, device=left_px.device)[:, None].expand(height, width)
    targets = (rows * width + columns.nan_to_num(0.0))[is_inside].long()
    empty = left_px.new_full((height * width,), -torch.inf)
    warped = empty.scatter_reduce(0, targets, left_px[is_inside], "amax")
    return torch.where(warped.isinf(), torch.nan, warped).reshape(height, width)


def size_at_focal_length(camera: Camera, focal_px: float) -> tuple[int, int]:
    """Give rows and columns at which the camera's image has ``focal_px``, with square pixels.

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
    """Resize one image, or a batch, bilinearly; with antialiasing where it shrinks.

    Values are clamped to [0, 1].
    """
    old_height, old_width = image.shape[-2:]
    if (old_height, old_width) == (height, width):
        return image
    images = image if image.ndim == 4 else image[None]
    shrinks = height < old_height or width < old_width
    resized = F.interpolate(images, (height, width), mode="bilinear", antialias=shrinks)
    return resized.clamp(0, 1).reshape(*image.shape[:-2], height, width)


def map_match(match: Match, change: Callable[[Tensor], Tensor]) -> Match:
    """Apply a function to each map that a match has, and give the new match."""
    maps = {field.name: getattr(match, field.name) for field in fields(match)}
    return Match(**{name: change(values) for name, values in maps.items() if values is not None})


def resize_match(match: Match, height: int, width: int) -> Match:
    """Resize a match to another size of its image; disparities scale by the ratio of the widths."""
    confidence = match.confidence
    if confidence is not None:
        confidence = resized_map(confidence, height, width)
    is_sky = match.is_sky
    if is_sky is not None:
        is_sky = resized_map(is_sky.float(), height, width) > 0.5
    old_width = match.disparity_px.shape[1]
    disparity_px = resized_map(match.disparity_px, height, width) * (width / old_width)
    return Match(disparity_px=disparity_px, confidence=confidence, is_sky=is_sky)


def resized_map(
    values: Float[Tensor, "_ _"], height: int, width: int
) -> Float[Tensor, "{height} {width}"]:
    """Resize a map bilinearly (``align_corners=False``), without antialiasing.

    Values stay as they are, so a disparity is still counted in pixels of the old width. Resize
    disparity, not depth, which is not linear between two pixels of a plane.
    """
    if values.shape == (height, width):
        return values
    return F.interpolate(values[None, None], (height, width), mode="bilinear")[0, 0]


def estimate_from_pair(pair: StereoInput, match: Match, warning: str = "") -> DepthEstimate:
    """Make the estimate of a rectified pair from its match; metres where the camera has a baseline.

    Pixels where the left image is blank (``without_picture`` of ``depth/visible.py``) have no
    depth. The confidence is 0 where either view is blank, and falls to 0 where the left view has no
    texture, for nothing can be matched there.
    """
    disparity_px = match.disparity_px
    rig = pair.camera if isinstance(pair.camera, StereoRig) else None
    left_is_blank = without_picture(pair.left).to(disparity_px.device)

    confidence = match.confidence
    if confidence is not None and pair.right is not None:
        right_blank = without_picture(pair.right).to(disparity_px)
        seen_blank = warp_right_to_left(right_blank[None], disparity_px)[0]
        right_is_blank = seen_blank.nan_to_num(0.0) > 0.5
        confidence = confidence * texture(pair.left).to(confidence)
        confidence = torch.where(left_is_blank | right_is_blank, 0.0, confidence)

    # The sky is as far away as SKY_M says.
    is_sky = None
    if match.is_sky is not None:
        is_sky = _without_small_sky(match.is_sky & ~left_is_blank)
        sky_px = LEAST_PX
        if rig is not None:
            sky_px = float(rig.K[0, 0]) * rig.baseline_m / SKY_M - rig.cx_right_minus_left_px
        disparity_px = torch.where(is_sky, sky_px, disparity_px)

    disparity_px = torch.where(left_is_blank, torch.nan, disparity_px)
    depth_m = None
    if rig is not None:
        depth_m = depth_from_disparity(disparity_px, rig)
        if is_sky is not None:
            depth_m = torch.where(is_sky, torch.nan, depth_m)
    return DepthEstimate(
        depth_m=depth_m,
        disparity_px=disparity_px,
        confidence=confidence,
        is_sky=is_sky,
        warning=warning,
        input=pair,
    )


def _without_small_sky(is_sky: Mask) -> Mask:
    """Give the pixels of the sky; none where they are so few that they are a lamp or a window."""
    return is_sky & (is_sky.float().mean() >= _MIN_SKY_SHARE)


def estimate_from_virtual(
    image: StereoInput,
    rig: GeneratorConfig | SelectionConfig,
    match: Match,
    right: Float[Tensor, "3 _ _"],
) -> DepthEstimate:
    """Make the estimate of one image from its match with a synthesised right view.

    Depth is the virtual rig's; the confidence of the sky is 0 on plain areas, because a bright wall
    looks the same.

    Args:
        image: the image and its camera.
        rig: config of the generator, which says the virtual rig.
        match: the match, at the size of the synthesised view.
        right: the synthesised view.

    Returns:
        Maps of the image's size; NaN where the image is blank, and as depth in the sky.
    """
    camera = image.camera
    assert camera is not None
    height, width = image.left.shape[1:]
    match = resize_match(match, height, width)
    disparity_px = match.disparity_px
    confidence = match.confidence
    # Depth x disparity, at the image's own focal length.
    focal_m_px = float(camera.K[0, 0]) * rig.virtual_baseline_m
    depth_m = torch.where(disparity_px > 0, focal_m_px / disparity_px, torch.nan)

    # The sky is as far away as SKY_M says.
    is_blank = without_picture(image.left).to(disparity_px.device)
    is_sky = None
    if match.is_sky is not None:
        is_sky = _without_small_sky(match.is_sky & ~is_blank)
        if confidence is not None:
            sky_confidence = confidence * texture(image.left).to(confidence)
            confidence = torch.where(is_sky, sky_confidence, confidence)
        depth_m = torch.where(is_sky, SKY_M, depth_m)
        disparity_px = torch.where(is_sky, focal_m_px / SKY_M, disparity_px)

    # Blank borders have no depth.
    depth_m = torch.where(is_blank, torch.nan, depth_m)
    disparity_px = torch.where(is_blank, torch.nan, disparity_px)
    if confidence is not None:
        confidence = torch.where(is_blank, 0.0, confidence)

    # Disparity is that of the camera's own baseline, where it has one.
    if isinstance(camera, StereoRig):
        disparity_px = disparity_from_depth(depth_m, camera)
    if is_sky is not None:
        depth_m = torch.where(is_sky, torch.nan, depth_m)
    return DepthEstimate(
        depth_m=depth_m,
        disparity_px=disparity_px,
        confidence=confidence,
        right=resize_image(right, height, width),
        is_sky=is_sky,
        input=image,
    )
