"""One image to depth: synthesise its right view, match both, triangulate.

Images are brought to the virtual rig that the generator imitates: its focal length and baseline.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from operator import itemgetter

import torch

from depthpose.core.camera import camera_of, check_image_matches_camera, find_two_views
from depthpose.core.devices import refused_memory
from depthpose.core.errors import InputError
from depthpose.core.files.images import check_image
from depthpose.depth.config import SelectionConfig
from depthpose.depth.disparity import resize_image, resize_match, size_at_focal_length
from depthpose.depth.stereo import Matcher, match_in_usual_range
from depthpose.depth.synthesis import SynthesisedViews, Synthesiser
from depthpose.depth.triangulation import estimate_from_virtual, join_warnings
from depthpose.depth.types import DepthEstimate, DepthInput, Match, Views


@torch.no_grad()
def depth_from_images(
    synthesiser: Synthesiser,
    matcher: Matcher | None,
    images: Sequence[DepthInput],
    *,
    allow_ood: bool = False,
) -> list[DepthEstimate]:
    """Estimate depth of single images by the networks alone, without a correction by the mount.

    Args:
        synthesiser: left view to right view.
        matcher: pair to disparity; None where the synthesiser estimates disparity itself.
        images: without right views. Successive ones of one virtual size are estimated together.
        allow_ood: estimate images unlike what the weights know too, with a ``warning``.

    Raises:
        InputError: what :func:`virtual_sizes` raises, an image unlike what the weights know, or too
            little memory.
    """
    sized_images = [
        (virtual_sizes(synthesiser, image, allow_ood=allow_ood), image) for image in images
    ]
    estimates: list[DepthEstimate] = []
    for sizes, group in groupby(sized_images, key=itemgetter(0)):
        group_images = [image for _, image in group]
        with refused_memory(group_images[0].name):
            estimates += _estimate_one_size(
                synthesiser, matcher, group_images, sizes, allow_ood=allow_ood
            )
    return estimates


def _estimate_one_size(
    synthesiser: Synthesiser,
    matcher: Matcher | None,
    images: Sequence[DepthInput],
    sizes: Sequence[tuple[int, int]],
    *,
    allow_ood: bool,
) -> list[DepthEstimate]:
    """Synthesise the right views of images of the same virtual sizes, match, and triangulate."""
    lefts = [
        torch.stack([resize_image(image.left.float(), *size) for image in images]) for size in sizes
    ]
    views = synthesiser.synthesise(*lefts)
    matches = _match_views(synthesiser, matcher, lefts[0], views)

    estimates: list[DepthEstimate] = []
    for index, image in enumerate(images):
        size = image.left.shape[1:]
        estimate = estimate_from_virtual(
            image,
            resize_match(matches[index], *size),
            resize_image(views.right[index], *size),
            synthesiser.config.virtual_baseline_m,
        )
        if views.image_confidence is not None:
            image_confidence = float(views.image_confidence[index])
            warning = _check_in_distribution(synthesiser, image.name, image_confidence, allow_ood)
            estimate = replace(
                estimate,
                image_confidence=image_confidence,
                warning=join_warnings(warning, estimate.warning),
            )
        estimates.append(estimate)
    return estimates


def virtual_sizes(
    synthesiser: Synthesiser, image: DepthInput, *, allow_ood: bool = False
) -> list[tuple[int, int]]:
    """Compute the sizes (rows, columns) at which the generator sees one image.

    The first is the image's size at the virtual focal length; larger ones follow only where the
    image itself is at least as large.

    Args:
        synthesiser: left view to right view.
        image: the image and its camera.
        allow_ood: take an image that holds two views of one scene for one view.

    Raises:
        InputError: there is no camera, it does not fit the image, the image holds two views, or the
            focal length would make it too large.
    """
    check_image(image.left, f"{image.name}: the image")
    if not allow_ood and (layout := find_two_views(image.left)) is not None:
        raise InputError(
            f"{image.name}: holds two views of one scene, {layout}; 'depthpose data split' "
            "parts them, and a pair has metres by itself (--allow-ood takes it for one image)"
        )
    if image.camera is None:
        raise InputError(
            f"{image.name}: metres from one image need its focal length, and its EXIF has "
            'none. Give a camera: {"width", "height", "K"}, focal_px=, or fov_deg=, the angle '
            "from left to right; a phone's main camera has about 0.75 widths, or 67 degrees."
        )
    height, width = image.left.shape[1:]
    check_image_matches_camera(image.camera, width, height, image.name)
    virtual_focal_px = synthesiser.config.virtual_focal_px
    image_focal_px = float(image.camera.K.diagonal()[:2].min())
    focal_lengths_px = [scale * virtual_focal_px for scale in synthesiser.scales]
    usable_px = [
        focal_px
        for focal_px in focal_lengths_px
        if focal_px == virtual_focal_px or focal_px <= image_focal_px
    ]
    return [size_at_focal_length(image.camera, focal_px) for focal_px in usable_px]


def _match_views(
    synthesiser: Synthesiser, matcher: Matcher | None, left: Views, views: SynthesisedViews
) -> list[Match]:
    """Match images with their synthesised views, or take the generator's own disparity."""
    if synthesiser.config.answer == "own":
        assert views.matches is not None, "a generator that answers itself has them"
        return views.matches
    assert matcher is not None, "FakestereoNet checked it"
    camera = camera_of(synthesiser.config.virtual_focal_px, (left.shape[3], left.shape[2]))
    matches = [
        match_in_usual_range(matcher, *pair, camera) for pair in zip(left, views.right, strict=True)
    ]
    if views.matches is None:
        return matches
    return [
        _take_sky(match, by_generator)
        for match, by_generator in zip(matches, views.matches, strict=True)
    ]


def _take_sky(match: Match, by_generator: Match) -> Match:
    """Take the sky, with the confidence there, from the generator, which knows it."""
    is_sky = by_generator.is_sky
    assert is_sky is not None
    confidence = match.confidence
    if confidence is not None and by_generator.confidence is not None:
        confidence = torch.where(is_sky, by_generator.confidence, confidence)
    return replace(match, is_sky=is_sky, confidence=confidence)


def _check_in_distribution(
    synthesiser: Synthesiser, name: str, image_confidence: float, allow_ood: bool
) -> str:
    """Refuse an image that is out of distribution for the weights, or warn of it.

    Args:
        synthesiser: the synthesiser, whose config has the limit.
        name: name of the image, for the error.
        image_confidence: the generator's confidence in the image as a whole, 0..1.
        allow_ood: warn, and do not refuse.

    Returns:
        A warning, or "" where the image is in distribution.

    Raises:
        InputError: it is out of distribution, and ``allow_ood`` is false.
    """
    config = synthesiser.config
    if not isinstance(config, SelectionConfig) or image_confidence >= config.least_confidence:
        return ""
    measure = "probability of a street" if config.with_street else "mean confidence"
    warning = (
        f"out of distribution for these weights ({measure} {image_confidence:.2f}, below "
        f"{config.least_confidence:.2f}), so its depth is a guess"
    )
    if not allow_ood:
        raise InputError(
            f"{name}: {warning}. Check that it is upright and that the focal length is its "
            "own; --allow-ood (in Python, load(..., allow_ood=True)) answers it all the same."
        )
    return warning
