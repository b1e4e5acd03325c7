"""One image, or a rectified pair, to one depth estimate in metres; and what may be given."""

import math
import warnings
from collections.abc import Iterable, Sequence, Sized
from dataclasses import replace
from functools import partial
from itertools import groupby, islice
from operator import itemgetter
from pathlib import Path
from typing import cast

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from depthpose.core.camera import (
    AnyCamera,
    AnyLens,
    StereoRig,
    camera_of,
    check_image_matches_camera,
    check_rectified,
    choose_lens,
    find_two_views,
)
from depthpose.core.checkpoint import find_weights, join_terms, warn_of_terms
from depthpose.core.devices import each_in_threads, force_float32, refused_memory
from depthpose.core.errors import InputError, Notice
from depthpose.core.files import Picture as Picture
from depthpose.core.files import as_tensor, read_exif_focal
from depthpose.core.files.images import check_image
from depthpose.depth import disparity
from depthpose.depth.config import Answer, MatcherConfig, SelectionConfig, SGBMConfig
from depthpose.depth.ground import MountFilter, scale_by_distance, scale_by_mount
from depthpose.depth.stereo import (
    CameraMatcher,
    Matcher,
    NetworkMatcher,
    SGBMMatcher,
    choose_search_range,
    doubt_hidden,
    doubt_outside,
    measure_disparity_range,
    move_views,
    moved_back,
)
from depthpose.depth.synthesis import (
    SelectionGenerator,
    SynthesisedViews,
    Synthesiser,
    make_synthesiser,
)
from depthpose.depth.types import DepthEstimate, Match, StereoInput, Views
from depthpose.depth.weights import Use, make_matcher, read_depth_weights


def as_input(
    image: object, name: str, camera: AnyLens | None, *, with_exif: bool = True
) -> StereoInput:
    """Take a picture and what is known of its camera; without that, ask the picture's EXIF."""
    left = as_tensor(image)
    exif_focal = None
    if camera is None and with_exif and isinstance(image, str | Path | Image.Image):
        exif_focal = read_exif_focal(image)
    if exif_focal is not None:
        camera, source = exif_focal
        message = f"{name}: a focal length of {camera:.0f} px, by its EXIF ({source})"
        warnings.warn(f"{message}; of a cropped picture it is another", Notice, stacklevel=3)
    camera = camera_of(camera, (left.shape[2], left.shape[1]))
    return StereoInput(name=name, left=left, right=None, camera=camera)


def refuse_unrectified(pair: StereoInput, *, with_check: bool = True) -> str:
    """Raise where two images are no pair, are swapped, or their rows do not correspond.

    Args:
        pair: the images, and their rig where it is known.
        with_check: look at what they show; else only whether they can be matched at all.

    Returns:
        A warning where this cannot be told, else nothing.

    Raises:
        InputError: with what was measured and what to do; there is no right view, its size is
            another, the camera has no baseline, or an image does not lie in [0, 1].
    """
    if pair.right is None:
        raise InputError(f"{pair.name}: there is no right image; give right=.")
    check_image(pair.left, f"{pair.name}: the left image")
    check_image(pair.right, f"{pair.name}: the right image")
    if pair.right.shape != pair.left.shape:
        left = pair.left.shape[1:]
        right = pair.right.shape[1:]
        raise InputError(
            f"{pair.name}: the left image is {left[1]}x{left[0]} and the right one "
            f"{right[1]}x{right[0]}; a rectified pair has one size. Rectify the pair again."
        )
    if pair.camera is not None:
        height, width = pair.left.shape[1:]
        check_image_matches_camera(pair.camera, width, height, pair.name)
        if not isinstance(pair.camera, StereoRig):
            raise InputError(
                f"{pair.name}: the camera has no baseline, so disparity cannot become metres. Add "
                '"baseline_m" (the distance between the two cameras in metres) to its file.'
            )
    if not with_check:
        return ""
    cx_difference_px = 0.0 if pair.camera is None else pair.camera.cx_right_minus_left_px
    report = check_rectified(pair.left, pair.right, cx_difference_px)
    if report.is_wrong:
        raise InputError(
            f"{pair.name}: {report.message} (--no-check, in Python with_check=False, matches them "
            "all the same.)"
        )
    return report.message if report.is_rectified is None else ""


def _match_in_range(
    matcher: NetworkMatcher, pair: StereoInput, cx_difference_px: float
) -> tuple[Match, str]:
    """Measure which disparities a pair has, and search where they lie.

    ``cx_difference_px``: cx of the right camera less that of the left one [px]. Gives the match,
    and a doubt about what lies beyond the search, or "".
    """
    assert pair.right is not None
    left = pair.left
    measured = measure_disparity_range(matcher, left, pair.right, -cx_difference_px)
    search = choose_search_range(matcher, measured, left.shape[1:], pair.camera)
    (match,) = matcher.match_many([(left, pair.right)], pair.camera, search)
    if not matcher.config.with_left_right_check:
        match = doubt_hidden(match, measured)
    return doubt_outside(match, measured, search)


def _match_moved_views(matcher: Matcher, pair: StereoInput, cx_difference_px: float) -> Match:
    """Move the views so that a disparity of 0 is infinitely far away, match, and move back.

    ``cx_difference_px``: cx of the right camera less that of the left one [px].
    """
    assert pair.right is not None
    first_px = -math.ceil(cx_difference_px)
    left, right = move_views(pair.left, pair.right, first_px)
    rig = pair.camera
    if isinstance(rig, StereoRig) and first_px != 0:
        K = rig.K.clone()
        K[0, 2] += left.shape[2] - pair.left.shape[2]
        moved_px = cx_difference_px + first_px
        rig = replace(rig, width=left.shape[2], K=K, cx_right_minus_left_px=moved_px)
    if isinstance(matcher, CameraMatcher):
        (match,) = matcher.match_many([(left, right)], rig)
    else:
        match = matcher.match(left, right)
    return moved_back(match, first_px)


DEFAULT = "default"
"""Name of the weights that are taken where none are named."""


class FakestereoNet:
    """Metric depth from one image, by a synthesised right view, or from a rectified pair.

    Example::

        net = FakestereoNet.load("default")
        net.estimate("street.png", "camera.json").depth_m  # (H, W), metres
        net.estimate("left.png", "rig.json", right="right.png").depth_m

    Args:
        matcher: pair to disparity; None where the synthesiser answers depth itself (its
            ``answer`` is own), for one image alone.
        synthesiser: left view to right view; None matches real pairs only.
        terms: of the weights, where they bind whoever uses them.
        weights: what they are called.
        allow_ood: answer images that are unlike what the weights know too, with a
            ``warning`` in the estimate, in place of refusing them.
    """

    def __init__(
        self,
        matcher: Matcher | None,
        synthesiser: Synthesiser | None = None,
        *,
        terms: str = "",
        weights: str = "",
        allow_ood: bool = False,
    ) -> None:
        if matcher is None and (synthesiser is None or synthesiser.config.answer != "own"):
            raise InputError(
                "matcher is None, and without one only a synthesiser whose answer is 'own' gives "
                "depth. Give a matcher: SGBMMatcher(), or that of weights."
            )
        if matcher is not None and not callable(getattr(matcher, "match", None)):
            raise InputError(
                f"matcher is a {type(matcher).__name__}, which has no method 'match'; make a "
                "matcher of a function by CallableMatcher(function)"
            )
        self.matcher = matcher
        self.synthesiser = synthesiser
        self.terms = terms
        self.allow_ood = allow_ood
        self.weights = weights

    def __repr__(self) -> str:
        """Give one line: generator and matcher, weights, device."""
        parts = [part for part in (self.synthesiser, self.matcher) if part is not None]
        parts_shown = [" + ".join(type(part).__name__ for part in parts)]
        parts_shown += [f"weights {self.weights!r}"] if self.weights else []
        part_devices = (getattr(part, "device", None) for part in parts)
        devices = {str(device) for device in part_devices if device is not None}
        return f"FakestereoNet({', '.join(parts_shown + sorted(devices))})"

    @classmethod
    @force_float32()
    def load(
        cls,
        weights: str | Path | None = None,
        *,
        matcher: str | Path | Matcher | None = None,
        config: MatcherConfig | SGBMConfig | None = None,
        answer: Answer | None = None,
        allow_ood: bool = False,
        use: Use | None = None,
    ) -> "FakestereoNet":
        """Build an estimator from weights, by file, folder, name or ``hf://OWNER/NAME``.

        Weights whose terms bind the user say so (:class:`LicenceNotice`).

        Args:
            weights: weights of both networks, of the generator alone (pairs then need a
                ``matcher``), or of a matcher alone (real pairs only). None: ``default``, or
                ``matcher`` alone. What names weights: ``core.checkpoint.find_weights``.
            matcher: ``sgbm`` (OpenCV's), weights with a matcher by file or name, or any matcher of
                your own. None: that of ``weights``.
            config: how the matcher runs.
            answer: where depth of one image comes from, in place of what the weights say
                (:class:`~depthpose.depth.config.SelectionConfig`).
            allow_ood: answer images unlike what the weights know too, with a ``warning``.
            use: ``images`` or ``pairs``: build what these take alone, which is quicker. None: all.

        Raises:
            InputError: no such weights, no matcher in them, or an ``answer`` that they cannot give.
        """
        if weights is None and matcher is None:
            weights = DEFAULT
        main = None
        if weights is not None:
            main = read_depth_weights(find_weights(weights), use=use, answer=answer)
        # Paths first: a Path has a method 'match' too, and would pass for a matcher.
        beside = None
        if isinstance(matcher, str | Path) and matcher != "sgbm":
            beside = read_depth_weights(find_weights(matcher), use="pairs")
        terms = join_terms(*(read.facts for read in (main, beside) if read is not None))
        warn_of_terms({"terms": terms})

        generator = None if main is None else main.generator
        if answer is not None and isinstance(generator, SelectionGenerator):
            generator.config = replace(generator.config, answer=answer)
        elif answer is not None and (generator is None or answer != generator.config.answer):
            raise InputError(
                f"answer is {answer!r}, which takes the weights of a generator that selects; omit "
                "it: these have no generator, or a U-Net, which estimates no disparity."
            )
        # A matcher: OpenCV's, the caller's own, that of the weights, or none.
        run = config if isinstance(config, MatcherConfig) else MatcherConfig()
        holder = beside or main
        if isinstance(config, SGBMConfig) and matcher != "sgbm":
            raise InputError(
                f"config is of SGBM, but matcher is {matcher!r}; give matcher='sgbm' or a "
                "MatcherConfig"
            )
        if matcher == "sgbm":
            if main is not None and generator is None:
                raise InputError(
                    f"weights is {str(weights)!r} and matcher is 'sgbm', which takes no weights of "
                    "a matcher. Omit one of the two."
                )
            chosen = SGBMMatcher(config if isinstance(config, SGBMConfig) else SGBMConfig())
        elif matcher is not None and not isinstance(matcher, str | Path):
            chosen = matcher
        elif holder is not None and holder.matcher is not None:
            chosen = make_matcher(holder.matcher, run)
        elif matcher is None and generator is not None and generator.config.answer == "own":
            chosen = None
        else:
            raise InputError(
                f"weights is {weights and str(weights)!r} and matcher is "
                f"{matcher and str(matcher)!r}: there is no matcher in that. Give "
                "weights='psmnet.safetensors' or matcher='sgbm', which needs none; a generator and "
                "a matcher become one file by 'depthpose weights pack G --matcher S --trained-on "
                "DATA --licence L --out W'."
            )

        synthesiser = None
        if generator is not None:
            synthesiser = make_synthesiser(generator, run.device, run.speed)
        files = ((weights, main), (matcher, beside))
        names = " + ".join(str(name) for name, read in files if read is not None)
        return cls(chosen, synthesiser, terms=terms, weights=names, allow_ood=allow_ood)

    from_pretrained = load
    """The same as :meth:`load`."""

    @force_float32()
    def estimate(
        self,
        image: Picture,
        camera: AnyCamera | None = None,
        *,
        focal_px: float | None = None,
        fov_deg: float | None = None,
        right: Picture | None = None,
        known_distance: tuple[float, float, float] | None = None,
        mount: MountFilter | None = None,
        name: str | None = None,
        with_check: bool = True,
    ) -> DepthEstimate:
        """Estimate depth of ``image``, alone or as the left one of a rectified pair.

        Args:
            image: the image, the left one of a pair: a file, a picture of Pillow's, an array or a
                tensor, RGB, RGBA or grey, 8-bit numbers or floats in [0, 1] (of OpenCV's BGR,
                ``image[..., ::-1]``).
            camera: camera or rig, its file of any format that is read, a dict of what such a file
                holds, or the 3x3 matrix K. One image needs its focal length, for the image is
                brought to the rig that the generator imitates; of a rig, its disparity is that of
                the baseline. Its ``mount_height_m`` and ``tilt_deg`` set the scale of one image.
                A pair without camera gives disparity only; one image without is asked for its EXIF.
            focal_px: the focal length alone [px], in place of a camera.
            fov_deg: the horizontal field of view alone [degrees], in place of both.
            right: right image, the same size and rows.
            known_distance: column, row [px] and camera z [m] of a measured point, which sets the
                scale of one image.
            mount: the same for all frames of one camera on one vehicle, taken in order: holds its
                height and smooths its tilt.
            name: what to call the input in errors; the file's name by default.
            with_check: look first whether both images show one scene, rectified and in the right
                order; where that cannot be told, the estimate has a ``warning``.

        Raises:
            InputError: a file that cannot be read, sizes that disagree, a camera without what is
                needed, a pair that is none, swapped or not rectified, an image unlike what the
                weights know.
        """
        chosen = name or (Path(image).stem if isinstance(image, str | Path) else "image")
        lens = choose_lens(camera, focal_px, fov_deg)
        pair = as_input(image, chosen, lens, with_exif=right is None)
        if right is not None:
            pair = replace(pair, right=as_tensor(right, "the right image"))
            if known_distance is not None:
                raise InputError(f"{chosen}: a pair has metres of its own; omit known_distance")
        depth = self.estimate_pair(pair, with_check=with_check, mount=mount)
        return depth if known_distance is None else scale_by_distance(depth, chosen, known_distance)

    @torch.no_grad()
    @force_float32()
    def estimate_pair(
        self, pair: StereoInput, *, with_check: bool = True, mount: MountFilter | None = None
    ) -> DepthEstimate:
        """Estimate depth of one input whose images are read already, as :meth:`estimate` does.

        Networks that find the range measure the disparities of the pair first, and search where
        they lie; the estimate's ``warning`` names what lies beyond. For other matchers views of a
        rig with principal points apart are moved by their difference: what is farthest then has a
        disparity of 0 px, where matchers search. The estimate has the disparities of the views as
        given.
        """
        if pair.right is None:
            return self._estimate_alone([pair], self.virtual_sizes(pair), mount)[0]
        if self.matcher is None:
            raise InputError(
                f"{pair.name}: there is a right image, and these weights answer one image alone: "
                "a pair needs a matcher. Give matcher='sgbm', or weights of a matcher; 'depthpose "
                "weights pack G --matcher S --trained-on DATA --licence L --out W' makes one file "
                "of both."
            )
        warning = refuse_unrectified(pair, with_check=with_check)
        width = pair.left.shape[2]
        cx_difference_px = 0.0
        if isinstance(pair.camera, StereoRig):
            cx_difference_px = pair.camera.cx_right_minus_left_px
        if abs(math.ceil(cx_difference_px)) >= width:
            raise InputError(
                f"cx_right_minus_left_px is {cx_difference_px:g}, and the images are {width} px "
                "wide: the two views share nothing that is far away. Take both principal points "
                "from one calibration of images of this size."
            )
        with refused_memory(pair.name):
            if isinstance(self.matcher, NetworkMatcher) and self.matcher.finds_range:
                match, doubt = _match_in_range(self.matcher, pair, cx_difference_px)
                warning = "; ".join(text for text in (warning, doubt) if text)
            else:
                match = _match_moved_views(self.matcher, pair, cx_difference_px)
            return disparity.estimate_from_pair(pair, match, warning)

    @force_float32()
    def estimate_many(
        self,
        images: Iterable[StereoInput] | Iterable[Picture] | Picture,
        camera: AnyLens | None = None,
        *,
        focal_px: float | None = None,
        fov_deg: float | None = None,
        with_check: bool = True,
        batch: int = 1,
        threads: int = 1,
        with_progress: bool = False,
    ) -> list[DepthEstimate | InputError]:
        """Estimate depth of images, alone or as pairs: of each a result, or its error.

        An input with a right view is matched with it, as :meth:`estimate_pair` does.

        Args:
            images: inputs; or pictures, or a batch of them as one array or tensor; a generator's
                are taken as they are needed.
            camera: of the pictures, as for :meth:`estimate`; inputs have their own.
            focal_px: the same as its focal length alone [px].
            fov_deg: the same as its horizontal field of view [degrees].
            with_check: of pairs, as for :meth:`estimate`.
            batch: so many neighbours of one size go through the networks together: faster on a
                GPU, slower on a processor.
            threads: so many batches are worked at at a time, in as many times the memory.
            with_progress: show a bar on the terminal.

        Returns:
            An estimate for each image, or the :class:`~depthpose.core.errors.InputError` that
            :meth:`estimate` raises for it.

        Raises:
            InputError: a camera, ``batch`` or ``threads`` that fits no image.
        """
        if batch < 1:
            raise InputError(f"batch is {batch}; take 1 or more images")
        lens = choose_lens(camera, focal_px, fov_deg)
        is_one = isinstance(images, str | Path | Image.Image | StereoInput)
        if is_one or (isinstance(images, np.ndarray | Tensor) and images.ndim < 4):
            images = [cast("Picture", images)]
        several = cast("Iterable[object]", images)
        named = iter((f"image {k}", image) for k, image in enumerate(several))
        batches = iter(lambda: list(islice(named, batch)), [])
        estimates: list[DepthEstimate | InputError] = []
        total = len(several) if isinstance(several, Sized) else None
        with tqdm(total=total, unit=" images", disable=not with_progress) as bar:
            work = partial(self.estimate_together, lens=lens, with_check=with_check)
            for estimates_of_batch in each_in_threads(work, batches, threads):
                estimates += estimates_of_batch
                bar.update(len(estimates_of_batch))
        return estimates

    @force_float32()
    def estimate_together(
        self,
        named: Sequence[tuple[str, object]],
        lens: AnyLens | None = None,
        *,
        with_check: bool = True,
        mount: MountFilter | None = None,
    ) -> list[DepthEstimate | InputError]:
        """Estimate one batch; where an image of it is unusable, each alone.

        Args:
            named: names and inputs, or pictures.
            lens: camera of the pictures, as for :meth:`estimate_many`.
            with_check: of pairs, as for :meth:`estimate`.
            mount: as for :meth:`estimate`; the images are its frames, in order.

        Returns:
            As :meth:`estimate_many`.
        """
        estimates: list[DepthEstimate | InputError] = []
        before = None if mount is None else mount.last
        try:
            inputs = [
                image if isinstance(image, StereoInput) else as_input(image, name, lens)
                for name, image in named
            ]
            sized = [
                (
                    depth_input,
                    None if depth_input.right is not None else self.virtual_sizes(depth_input),
                )
                for depth_input in inputs
            ]
            for sizes, group in groupby(sized, itemgetter(1)):
                same_sizes = [depth_input for depth_input, _ in group]
                if sizes is None:
                    estimates += map(partial(self.estimate_pair, with_check=with_check), same_sizes)
                else:
                    estimates += self._estimate_alone(same_sizes, sizes, mount)
        except InputError as error:
            if len(named) == 1:
                return [error]
            if mount is not None:
                mount.last = before
            alone = (
                self.estimate_together([depth_input], lens, with_check=with_check, mount=mount)
                for depth_input in named
            )
            return [estimate for (estimate,) in alone]
        return estimates

    def virtual_sizes(self, image: StereoInput) -> list[tuple[int, int]]:
        """Rows and columns at which one image is looked at.

        The first is its size at the virtual focal length; larger ones follow where the image has
        the pixels.

        Raises:
            InputError: there is no generator or no camera, or the focal length would make the image
                too large.
        """
        if self.synthesiser is None:
            raise InputError(
                f"{image.name}: there is no right image, and these weights match pairs only; give "
                "right=, or weights with a generator ('depthpose weights list')."
            )
        check_image(image.left, f"{image.name}: the image")
        if not self.allow_ood and (layout := find_two_views(image.left)) is not None:
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
        rig_px = self.synthesiser.config.virtual_focal_px
        image_focal_px = float(image.camera.K.diagonal()[:2].min())
        usable_scales = [
            s for s in self.synthesiser.scales if s == 1 or s * rig_px <= image_focal_px
        ]
        return [
            disparity.size_at_focal_length(image.camera, scale * rig_px) for scale in usable_scales
        ]

    def _estimate_alone(
        self,
        images: list[StereoInput],
        sizes: list[tuple[int, int]],
        mount: MountFilter | None = None,
    ) -> list[DepthEstimate]:
        """Estimate single images of one virtual size together; with ``mount``, frames in order."""
        estimates = self.estimate_without_mount(images, sizes)
        assert self.synthesiser is not None, "estimate_without_mount needs it"
        rig = self.synthesiser.config
        rig = rig if isinstance(rig, SelectionConfig) else SelectionConfig()
        return [
            scale_by_mount(estimate, image, mount, rig)
            for estimate, image in zip(estimates, images, strict=True)
        ]

    @torch.no_grad()
    def estimate_without_mount(
        self, images: list[StereoInput], sizes: list[tuple[int, int]]
    ) -> list[DepthEstimate]:
        """Estimate depth by the networks alone, before the camera's mount corrects it.

        Images are brought to the virtual rig, their right views drawn and matched.

        Args:
            images: single images, all of the same virtual sizes.
            sizes: these sizes, by :meth:`virtual_sizes`.

        Raises:
            InputError: an image unlike what the weights know.
        """
        assert self.synthesiser is not None, "virtual_sizes checked it"
        rig = self.synthesiser.config
        with refused_memory(images[0].name):
            left, *larger = (
                torch.stack([disparity.resize_image(image.left.float(), *size) for image in images])
                for size in sizes
            )
            views = self.synthesiser.draw(left, *larger)
            matches = self._match_virtual(left, views)
            estimates: list[DepthEstimate] = []
            for n, (image, match) in enumerate(zip(images, matches, strict=True)):
                if views.is_sky is not None:
                    match = replace(match, is_sky=views.is_sky[n])  # noqa: PLW2901
                estimate = disparity.estimate_from_virtual(image, rig, match, views.right[n])
                if views.confidence is not None:
                    street = views.street_probability
                    score = views.confidence[n].mean() if street is None else street[n]
                    warning = self._ood_warning(image.name, float(score))
                    estimate = replace(estimate, image_confidence=float(score), warning=warning)
                estimates.append(estimate)
        return estimates

    def _match_virtual(self, left: Views, views: SynthesisedViews) -> list[Match]:
        """Match images with their synthesised views, or take the synthesiser's own disparity."""
        assert self.synthesiser is not None
        rig = self.synthesiser.config
        if rig.answer != "matched":
            assert views.disparity_px is not None, "it has an answer of its own"
            assert views.confidence is not None
            return [
                Match(disparity_px=disparity_px, confidence=confidence)
                for disparity_px, confidence in zip(
                    views.disparity_px, views.confidence, strict=True
                )
            ]
        assert self.matcher is not None, "__init__ checked it"
        camera = camera_of(rig.virtual_focal_px, (left.shape[3], left.shape[2]))
        pairs = list(zip(left, views.right, strict=True))
        if isinstance(self.matcher, CameraMatcher):
            return self.matcher.match_many(pairs, camera)
        return [self.matcher.match(*pair) for pair in pairs]

    def _ood_warning(self, name: str, image_confidence: float) -> str:
        """Warn of an image that is unlike what the weights know, or refuse it; "" of a usual one.

        Raises:
            InputError: it is unlike that, and such images are not to be answered.
        """
        assert self.synthesiser is not None
        rig = self.synthesiser.config
        if not isinstance(rig, SelectionConfig) or image_confidence >= rig.least_confidence:
            return ""
        what = "probability of a street" if rig.with_street else "mean confidence"
        warning = (
            f"out of distribution for these weights ({what} {image_confidence:.2f}, below "
            f"{rig.least_confidence:.2f}), so its depth is a guess"
        )
        if not self.allow_ood:
            raise InputError(
                f"{name}: {warning}. Check that it is upright and that the focal length is its "
                "own; --allow-ood (in Python, load(..., allow_ood=True)) answers it all the same."
            )
        return warning
