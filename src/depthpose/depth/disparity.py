"""Disparity to depth and back, matches to estimates, warping, resizing, mistaken units."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.errors import InputError, Notice
from depthpose.depth.config import GeneratorConfig, SelectionConfig
from depthpose.depth.types import DepthEstimate, Map, Mask, Match, StereoInput
from depthpose.depth.visible import find_blank_borders, measure_texture

_UNIT_MISTAKES = {
    1000.0: "is its depth in millimetres (divide by 1000), or its disparity in shares of the width "
    "(multiply by it)?",
    256.0: "is its depth metres x 256, as KITTI's PNG holds it (divide by 256)?",
    1 / 256: "is its disparity pixels x 256, as KITTI's PNG holds it (divide by 256)?",
}
"""Certain mistakes, by the ratio of predicted to true depth that they cause."""
_POSSIBLE_MISTAKES = {
    1000 / 256: "is it a PNG of millimetres, read as metres x 256?",
    256 / 1000: "is its truth a PNG of millimetres, read as metres x 256?",
    1 / 16: "is its disparity pixels x 16, as OpenCV's matchers give it?",
    1 / 5.4: "is it of monodepth2, trained with a baseline of 0.1 m (multiply its depth by 5.4)?",
}
"""Possible mistakes, by ratios that a poor estimate may have too."""
_MISTAKE_TOLERANCE = 1.4
"""A ratio within this factor of one of ``_UNIT_MISTAKES`` is that mistake: no estimate, however
poor, is wrong by 250 or 1000 in the median."""
_POSSIBLE_TOLERANCE = 1.1
"""A ratio within this factor of one of ``_POSSIBLE_MISTAKES`` may be that mistake."""
_POOR_RATIO = 3.0
"""Ratio of median depths from which a notice is given: that of a good estimate is near 1."""
_NEGATIVE_SHARE = 0.9
"""Share of the pixels with a negative disparity from which the sign is wrong."""
_OPPOSITE_CORRELATION = -0.8
"""Correlation of the logarithms of prediction and truth, below which one is inverted."""
_given_notices: set[str] = set()
"""Questions that were asked in a notice already."""
MIN_DISPARITY_PX = 0.01
"""Least disparity of a match, so that depth stays finite; also the disparity of the sky in a pair
without a rig."""
SKY_M = 10_000.0
"""Depth that the disparity of the sky stands for: protocols take a disparity of zero for no
prediction, or for a near point."""
_MIN_SKY_SHARE = 0.002
"""Least share of the image that is sky; fewer pixels are a lamp or a window, and keep the depth of
the match: 43 of them in a garage made an RMSE of 0.87 m, in place of 0.25 m."""
MAX_ENLARGED_PIXELS = 8_000_000
"""Most pixels of an image that is enlarged to reach the focal length of a network."""


def find_unit_mistake(predicted_px: Map, true_px: Map) -> str | None:
    """Find the mistake of unit or sign in a predicted disparity, by its truth.

    Returns:
        The mistake and its remedy, as a sentence for an error; None where there is none, or only
        one that a poor estimate could look like too. Of such a one a notice is given, once.
    """
    is_compared = torch.isfinite(predicted_px) & torch.isfinite(true_px)
    if not bool(is_compared.any()):
        return None
    predicted_px = predicted_px[is_compared]
    true_px = true_px[is_compared]

    # Certain mistakes: nearly all signs, or a ratio that no estimate has.
    negative_share = float((predicted_px < 0).float().mean())
    if negative_share > _NEGATIVE_SHARE:
        return (
            f"{negative_share:.0%} of the disparities are negative: left and right were exchanged, "
            "or the sign is the other one; a left pixel at u is seen at u - disparity on the right"
        )
    median_px = float(predicted_px.median())
    depth_ratio = float(true_px.median()) / median_px if median_px > 0 else 0.0
    mistake = _find_mistake(depth_ratio, _UNIT_MISTAKES, _MISTAKE_TOLERANCE)
    if mistake is not None:
        return f"it lies {depth_ratio:.4g} times as far as the truth: {mistake}"

    # Possible mistakes: a wrong scale, or inverse depth.
    if depth_ratio > 0 and not 1 / _POOR_RATIO < depth_ratio < _POOR_RATIO:
        question = _find_mistake(depth_ratio, _POSSIBLE_MISTAKES, _POSSIBLE_TOLERANCE)
        if question is None:
            question = "is it without a scale, or of another focal length or baseline?"
        times = f"{depth_ratio:.3g} times as far as the truth in the median"
        _give_notice_once(f"lies {times}:", question)
    logarithms = torch.stack([predicted_px, true_px]).double().clamp_min(1e-3).log()
    if len(true_px) > 1 and float(logarithms.corrcoef()[0, 1]) < _OPPOSITE_CORRELATION:
        _give_notice_once("is the nearer the farther its truth is:", "is it inverse depth?")
    return None


def _find_mistake(
    depth_ratio: float, mistakes: Mapping[float, str], tolerance: float
) -> str | None:
    """Find the first of ``mistakes`` whose ratio is ``depth_ratio``, within a factor; or None."""
    for ratio, question in mistakes.items():
        if ratio / tolerance < depth_ratio < ratio * tolerance:
            return question
    return None


def _give_notice_once(statement: str, question: str) -> None:
    """Give a notice about a prediction, once for all frames of a dataset.

    ``statement`` goes on from "a prediction"; ``question`` asks for a mistake.
    """
    if question not in _given_notices:
        _given_notices.add(question)
        warnings.warn(f"a prediction {statement} {question}", Notice, stacklevel=3)


def depth_from_disparity(
    disparity_px: Float[Tensor, "*batch h w"], rig: StereoRig
) -> Float[Tensor, "*batch h w"]:
    """Compute depth [m] by triangulation: ``depth = fx B / (disparity + cx_right - cx_left)``.

    An error of e px at depth z is one of ``e z^2 / (fx B)`` metres: it grows with the square.
    NaN comes out where the disparity is NaN, or puts the point at infinity or behind the camera.
    """
    shifted_px = disparity_px + rig.cx_right_minus_left_px
    depth_m = float(rig.K[0, 0]) * rig.baseline_m / shifted_px
    return torch.where(shifted_px > 0, depth_m, torch.nan)


def disparity_from_depth(
    depth_m: Float[Tensor, "*batch h w"], rig: StereoRig
) -> Float[Tensor, "*batch h w"]:
    """Compute disparity [px]: ``disparity = fx B / depth - (cx_right - cx_left)``.

    NaN where depth is NaN or not positive.
    """
    disparity_px = float(rig.K[0, 0]) * rig.baseline_m / depth_m - rig.cx_right_minus_left_px
    return torch.where(depth_m > 0, disparity_px, torch.nan)


_DISPARITY_STD_BY_CONFIDENCE = (
    (0.0, 0.5),
    (0.3, 0.1),
    (0.5, 0.07),
    (0.6, 0.05),
    (0.8, 0.03),
    (0.9, 0.02),
    (0.95, 0.015),
    (1.0, 0.005),
)
"""Pairs of a confidence, and the standard deviation of a disparity as a share of the disparity: the
bound of 68 % of the errors of `default` on 10 near scenes and 6 streets, synthetic and not trained
on, made to fall with the confidence."""
_MIN_STD_PX = 0.2
"""Standard deviation of the surest disparities of these scenes."""


def depth_std_from_confidence(
    depth_m: Float[Tensor, "*batch h w"], confidence: Float[Tensor, "*batch h w"], rig: StereoRig
) -> Float[Tensor, "*batch h w"]:
    """Estimate the standard deviation of a matched depth [m] from the match's confidence, 0..1.

    The standard deviation of the disparity d = fx B / z is ``max(share(confidence) d, 0.2 px)``,
    with shares measured on synthetic scenes; that of the depth z is ``z^2 / (fx B)`` times this.
    NaN where depth is NaN or not positive.
    """
    # The share: linear between the measured confidences.
    table = torch.tensor(_DISPARITY_STD_BY_CONFIDENCE, dtype=depth_m.dtype, device=depth_m.device)
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

    Sampling is bilinear. NaN where the disparity is NaN, or ``x - disparity`` lies outside the
    right view.
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

    Positions are rounded to whole pixels. Where several left pixels fall on one right pixel, the
    nearest point counts, of the largest disparity. NaN where none falls.
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
    """Compute the rows and columns to which to resize a camera's image, for a focal length.

    Afterwards fx and fy are both ``focal_px``.

    Raises:
        InputError: the image would be enlarged beyond :data:`MAX_ENLARGED_PIXELS`.
    """
    rows = max(round(camera.height * focal_px / float(camera.K[1, 1])), 1)
    columns = max(round(camera.width * focal_px / float(camera.K[0, 0])), 1)
    if rows * columns > max(MAX_ENLARGED_PIXELS, camera.height * camera.width):
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
    """Resize RGB images in [0, 1], one or a batch, bilinearly; with antialiasing where they shrink.

    Values are clamped to [0, 1].
    """
    old_height, old_width = image.shape[-2:]
    if (old_height, old_width) == (height, width):
        return image
    images = image if image.ndim == 4 else image[None]
    shrinks = height < old_height or width < old_width
    resized = F.interpolate(images, (height, width), mode="bilinear", antialias=shrinks)
    return resized.clamp(0, 1).reshape(*image.shape[:-2], height, width)


def apply_to_maps(match: Match, function: Callable[[Tensor], Tensor]) -> Match:
    """Apply a function to each map of a match; maps that are None stay None."""
    maps = {name: values for name, values in vars(match).items() if isinstance(values, Tensor)}
    return replace(match, **{name: function(values) for name, values in maps.items()})


def resize_match(match: Match, height: int, width: int) -> Match:
    """Resize a match to another size of its image; disparities scale by the ratio of the widths."""
    confidence = match.confidence
    if confidence is not None:
        confidence = resize_map(confidence, height, width)
    is_sky = match.is_sky
    if is_sky is not None:
        is_sky = resize_map(is_sky.float(), height, width) > 0.5
    old_width = match.disparity_px.shape[1]
    disparity_px = resize_map(match.disparity_px, height, width) * (width / old_width)
    return replace(match, disparity_px=disparity_px, confidence=confidence, is_sky=is_sky)


def resize_map(
    values: Float[Tensor, "_ _"], height: int, width: int
) -> Float[Tensor, "{height} {width}"]:
    """Resize a map bilinearly (``align_corners=False``), without antialiasing.

    Values stay as they are, so a disparity is still counted in pixels of the old width. Resize
    disparity, not depth, which is not linear between two pixels of a plane.
    """
    if values.shape == (height, width):
        return values
    return F.interpolate(values[None, None], (height, width), mode="bilinear")[0, 0]


def join_warnings(*warnings: str) -> str:
    """Join the warnings about an estimate to one text; empty ones are left out."""
    return "; ".join(warning for warning in warnings if warning)


def estimate_from_pair(pair: StereoInput, match: Match) -> DepthEstimate:
    """Make the estimate of a rectified pair from its match; metres where the camera has a baseline.

    Where the left image is blank (``find_blank_borders`` of ``depth/visible.py``), disparity and
    depth are NaN. The confidence is 0 where either view is blank, and falls to 0 where the left
    view has no texture, for nothing can be matched there.

    Args:
        pair: the images, and their rig where it is known.
        match: the match, at the size of the images.
    """
    disparity_px = match.disparity_px
    rig = pair.camera if isinstance(pair.camera, StereoRig) else None
    left_is_blank = find_blank_borders(pair.left).to(disparity_px.device)

    confidence = match.confidence
    if confidence is not None and pair.right is not None:
        # Blankness of the right view at the pixel that each left pixel is matched with.
        right_blank = find_blank_borders(pair.right).to(disparity_px)
        matched_blank = warp_right_to_left(right_blank[None], disparity_px)[0]
        right_is_blank = matched_blank.nan_to_num(0.0) > 0.5
        confidence = confidence * measure_texture(pair.left).to(confidence)
        confidence = torch.where(left_is_blank | right_is_blank, 0.0, confidence)

    # The sky has the disparity of a point SKY_M away.
    is_sky = None
    if match.is_sky is not None:
        is_sky = _discard_small_sky(match.is_sky & ~left_is_blank)
        sky_px = MIN_DISPARITY_PX
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
        warning=match.warning,
        input=pair,
    )


def _discard_small_sky(is_sky: Mask) -> Mask:
    """Return the mask of the sky; empty where it is so small that it is a lamp or a window."""
    return is_sky & (is_sky.float().mean() >= _MIN_SKY_SHARE)


def estimate_from_virtual(
    image: StereoInput,
    generator_config: GeneratorConfig | SelectionConfig,
    match: Match,
    right: Float[Tensor, "3 _ _"],
) -> DepthEstimate:
    """Make the estimate of one image from its match with a synthesised right view.

    Depth is computed by the virtual baseline, at which the view was synthesised. The confidence of
    the sky is 0 on plain areas, because a bright wall looks the same.

    Args:
        image: the image and its camera.
        generator_config: holds the baseline of the virtual rig.
        match: the match, at the size of the synthesised view.
        right: the synthesised view.

    Returns:
        The estimate, at the size of the image. Disparity and depth are NaN where the image is
        blank, and depth is NaN in the sky too. Disparity is that of the camera's own baseline where
        it has one, else that of the virtual one.
    """
    camera = image.camera
    assert camera is not None
    height, width = image.left.shape[1:]
    match = resize_match(match, height, width)
    disparity_px = match.disparity_px
    confidence = match.confidence
    # depth = f B / disparity, with the image's own focal length f and the virtual baseline B.
    focal_m_px = float(camera.K[0, 0]) * generator_config.virtual_baseline_m
    depth_m = torch.where(disparity_px > 0, focal_m_px / disparity_px, torch.nan)

    # The sky has the disparity of a point SKY_M away.
    is_blank = find_blank_borders(image.left).to(disparity_px.device)
    is_sky = None
    if match.is_sky is not None:
        is_sky = _discard_small_sky(match.is_sky & ~is_blank)
        if confidence is not None:
            sky_confidence = confidence * measure_texture(image.left).to(confidence)
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
        warning=match.warning,
        input=image,
    )
