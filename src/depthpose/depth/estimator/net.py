"""The estimator: one image, or a rectified pair, to depth in metres.

Here networks are loaded and inputs read. The estimates themselves are computed by
:mod:`depthpose.depth.estimator.pair` and :mod:`depthpose.depth.estimator.single_image`.
"""

import warnings
from collections.abc import Iterable, Iterator, Sequence, Sized
from dataclasses import replace
from functools import partial
from itertools import groupby, islice
from pathlib import Path
from typing import cast

import numpy as np
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from depthpose.core.camera import (
    AnyCamera,
    AnyLens,
    camera_of,
    choose_lens,
)
from depthpose.core.checkpoint import find_weights, join_terms, warn_of_terms
from depthpose.core.devices import force_float32, map_in_threads
from depthpose.core.errors import InputError, Notice, result_or_error
from depthpose.core.files import AnyPicture as AnyPicture
from depthpose.core.files import read_exif_focal, rgb_from_picture
from depthpose.depth.config import Answer, MatcherConfig
from depthpose.depth.estimator.pair import depth_from_pair
from depthpose.depth.estimator.single_image import depth_from_images, virtual_sizes
from depthpose.depth.mount import MountFilter, scale_by_distance, scale_by_mount
from depthpose.depth.stereo import (
    Matcher,
    SGBMMatcher,
)
from depthpose.depth.synthesis import Synthesiser, make_synthesiser
from depthpose.depth.types import DepthEstimate, DepthInput
from depthpose.depth.weights import DepthWeights, Use, make_matcher, read_depth_weights


def as_input(
    image: object, name: str, camera: AnyLens | None, *, with_exif: bool = True
) -> DepthInput:
    """Make the input of one image, without a right view.

    Args:
        image: a picture, as :meth:`FakestereoNet.estimate` takes it.
        name: its name in errors.
        camera: its camera, or its focal length [px]; None: not known.
        with_exif: read the focal length from the picture's EXIF where ``camera`` is None, with a
            notice.
    """
    left = rgb_from_picture(image, f"{name}: the image")
    lens = camera
    if camera is None and with_exif and isinstance(image, str | Path | Image.Image):
        exif_focal = read_exif_focal(image)
        if exif_focal is not None:
            lens, source = exif_focal
            message = f"{name}: a focal length of {lens:.0f} px, by its EXIF ({source})"
            warnings.warn(f"{message}; of a cropped picture it is another", Notice, stacklevel=3)
    size = (left.shape[2], left.shape[1])
    return DepthInput(name=name, left=left, right=None, camera=camera_of(lens, size))


def _no_matcher_error(weights: str | Path | None, matcher: str | Path | None) -> InputError:
    """Word the error of an estimator without the matcher that it needs, by what was asked for."""
    return InputError(
        f"weights is {weights and str(weights)!r} and matcher is "
        f"{matcher and str(matcher)!r}: there is no matcher in that. Give "
        "weights='psmnet.safetensors' or matcher='sgbm', which needs none; a generator and "
        "a matcher become one file by 'depthpose weights pack G --matcher S --trained-on "
        "DATA --licence L --out W'."
    )


def require_matcher_config(config: object) -> None:
    """Raise an :class:`InputError` where a config is of something else than a matcher."""
    if config is not None and not isinstance(config, MatcherConfig):
        raise InputError(
            f"config is a {type(config).__name__}, and load takes a MatcherConfig; give "
            "matcher=SGBMMatcher(SGBMConfig(...)) for OpenCV's settings"
        )


def _refuse_unused_settings(config: MatcherConfig, matcher: Matcher) -> None:
    """Refuse settings of a match that a matcher without weights does not know.

    Raises:
        InputError: one is not at its default.
    """
    for name in ("max_disparity_px", "with_left_right_check"):
        if getattr(config, name) != getattr(MatcherConfig, name):
            raise InputError(
                f"config sets {name}, which {type(matcher).__name__} does not take: it is for "
                "matchers of weights. Omit it (SGBMMatcher(SGBMConfig(...)) has settings of its "
                "own)"
            )


DEFAULT = "default"
"""Name of the weights that are loaded where none are named."""


class FakestereoNet:
    """Metric depth from one image, by a synthesised right view, or from a rectified pair.

    Example::

        net = FakestereoNet.load("default")
        net.estimate("street.png", "camera.json").depth_m  # (H, W), metres
        net.estimate("left.png", "rig.json", right="right.png").depth_m

    Args:
        matcher: pair to disparity; None where the synthesiser estimates disparity itself (its
            ``answer`` is ``own``), for single images only.
        synthesiser: left view to right view; None: only real pairs are estimated.
        terms: licence terms of the weights that bind their user; "": none.
        weights: name of the weights, for ``repr``.
        allow_ood: estimate images that are out of distribution for the weights too, with a
            ``warning`` in the estimate; else they are refused.
        with_check: refuse pairs whose images show that they are swapped, not rectified or no pair;
            where that is uncertain, the estimate has a ``warning``.
    """

    def __init__(
        self,
        matcher: Matcher | None,
        synthesiser: Synthesiser | None = None,
        *,
        terms: str = "",
        weights: str = "",
        allow_ood: bool = False,
        with_check: bool = True,
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
        self.with_check = with_check
        self.weights = weights

    def __repr__(self) -> str:
        """Return generator and matcher, weights, and device as one line of text."""
        parts = [part for part in (self.synthesiser, self.matcher) if part is not None]
        facts = [" + ".join(type(part).__name__ for part in parts)]
        if self.weights:
            facts.append(f"weights {self.weights!r}")
        part_devices = (getattr(part, "device", None) for part in parts)
        facts += sorted({str(device) for device in part_devices if device is not None})
        return f"FakestereoNet({', '.join(facts)})"

    @classmethod
    @force_float32()
    def load(
        cls,
        weights: str | Path | None = None,
        *,
        matcher: str | Path | Matcher | None = None,
        config: MatcherConfig | None = None,
        answer: Answer | None = None,
        allow_ood: bool = False,
        with_check: bool = True,
        use: Use | None = None,
    ) -> "FakestereoNet":
        """Build an estimator from weights, by file, folder, name or ``hf://OWNER/NAME``.

        A :class:`LicenceNotice` names terms of the weights that bind the user.

        Args:
            weights: weights of both networks, of the generator alone (pairs then need a
                ``matcher``), or of a matcher alone (real pairs only). None: ``default``, or
                ``matcher`` alone. What names weights: ``core.checkpoint.find_weights``.
            matcher: ``sgbm`` (OpenCV's, with its defaults), weights with a matcher by file or name,
                or any object that is a matcher, such as ``SGBMMatcher(SGBMConfig(...))``. None:
                that of ``weights``.
            config: how networks run.
            answer: where depth of one image comes from, in place of what the weights say
                (:class:`~depthpose.depth.config.SelectionConfig`).
            allow_ood: estimate images unlike what the weights know too, with a ``warning``.
            with_check: refuse pairs that are swapped, not rectified or no pair, by their images.
            use: ``images`` or ``pairs``: build only the networks that these take, which is quicker.
                None: all.

        Raises:
            InputError: no such weights, no matcher in them, an ``answer`` that they cannot give, or
                arguments of which one would not be used.
        """
        require_matcher_config(config)
        # The weights that are named, as generator and matcher.
        if weights is None and matcher is None:
            weights = DEFAULT
        if weights is None and answer is not None:
            raise InputError(
                f"answer is {answer!r}, and a matcher alone estimates no single image; give the "
                "weights of a generator, or omit answer"
            )
        networks_by_name: dict[str, DepthWeights] = {}
        generator = None
        if weights is not None:
            networks = read_depth_weights(find_weights(weights), use=use, answer=answer)
            networks_by_name[str(weights)] = networks
            generator = networks.generator
            if generator is None and matcher is not None:
                raise InputError(
                    f"weights is {str(weights)!r} and matcher is given too, so nothing of these "
                    "weights would run. Omit one of the two."
                )
        # A Path has a method 'match', so it would pass for a matcher: it is recognised first.
        if isinstance(matcher, str | Path) and matcher != "sgbm":
            networks_by_name[str(matcher)] = read_depth_weights(find_weights(matcher), use="pairs")
        terms = join_terms(*(networks.facts for networks in networks_by_name.values()))
        warn_of_terms({"terms": terms})

        # The matcher that runs: OpenCV's, the caller's, or that of the weights that are named last.
        config = config or MatcherConfig()
        if matcher == "sgbm":
            matcher = SGBMMatcher()
        if isinstance(matcher, str | Path | None):
            *_, networks = networks_by_name.values()
            has_own_answer = generator is not None and generator.config.answer == "own"
            if networks.matcher is not None:
                chosen_matcher = make_matcher(networks.matcher, config)
            elif matcher is None and has_own_answer:
                chosen_matcher = None
            else:
                raise _no_matcher_error(weights, matcher)
        else:
            _refuse_unused_settings(config, matcher)
            chosen_matcher = matcher
        synthesiser = None
        if generator is not None:
            synthesiser = make_synthesiser(generator, config.device, config.speed)
        return cls(
            chosen_matcher,
            synthesiser,
            terms=terms,
            weights=" + ".join(networks_by_name),
            allow_ood=allow_ood,
            with_check=with_check,
        )

    from_pretrained = load
    """The same as :meth:`load`."""

    @force_float32()
    def estimate(
        self,
        image: AnyPicture,
        camera: AnyCamera | None = None,
        *,
        focal_px: float | None = None,
        fov_deg: float | None = None,
        right: AnyPicture | None = None,
        known_distance: tuple[float, float, float] | None = None,
        mount: MountFilter | None = None,
        name: str | None = None,
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
                scale of one image, not of a pair.
            mount: of one image, the same for all frames of one camera on one vehicle, taken in
                order: holds its height and smooths its tilt.
            name: name of the input in errors; by default that of the file.

        Raises:
            InputError: a file that cannot be read, sizes that disagree, a camera without what is
                needed, a pair that is none, swapped or not rectified, an image unlike what the
                weights know.
        """
        if not name:
            name = Path(image).stem if isinstance(image, str | Path) else "image"
        lens = choose_lens(camera, focal_px, fov_deg)
        pair = as_input(image, name, lens, with_exif=right is None)
        if right is not None:
            pair = replace(pair, right=rgb_from_picture(right, f"{name}: the right image"))
            if known_distance is not None:
                raise InputError(f"{name}: a pair has metres of its own; omit known_distance")

        estimate = self.estimate_input(pair, mount=mount)
        if known_distance is None:
            return estimate
        return scale_by_distance(estimate, known_distance)

    @force_float32()
    def estimate_input(
        self, depth_input: DepthInput, *, mount: MountFilter | None = None
    ) -> DepthEstimate:
        """Estimate depth of one input whose images are read already, as :meth:`estimate` does.

        Args:
            depth_input: one image, or a pair.
            mount: of one image, as for :meth:`estimate`.

        Raises:
            InputError: as :meth:`estimate`.
        """
        return self._correct_by_mount(self._estimate_alone(depth_input), mount)

    @force_float32()
    def estimate_many(
        self,
        images: Iterable[DepthInput] | Iterable[AnyPicture] | AnyPicture,
        camera: AnyLens | None = None,
        *,
        focal_px: float | None = None,
        fov_deg: float | None = None,
        batch: int = 1,
        threads: int = 1,
        with_progress: bool = False,
    ) -> list[DepthEstimate | InputError]:
        """Estimate depth of many images or pairs; each gives an estimate or its error.

        An input with a right view is matched with it, as :meth:`estimate_input` does.

        Args:
            images: inputs; or pictures, or a batch of them as one array or tensor. An iterator is
                read as its images are needed.
            camera: camera of the pictures, as for :meth:`estimate`; inputs have their own.
            focal_px: the focal length alone [px], in place of ``camera``.
            fov_deg: the horizontal field of view alone [degrees], in place of both.
            batch: how many successive images of one size go through the generator together: more
                are faster on a GPU, slower on a processor. Pairs are matched one by one.
            threads: how many batches run at the same time, in as many times the memory.
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
        is_single = isinstance(images, str | Path | Image.Image | DepthInput)
        if is_single or (isinstance(images, np.ndarray | Tensor) and images.ndim < 4):
            images = [cast("AnyPicture", images)]
        sequence = cast("Iterable[object]", images)
        total = len(sequence) if isinstance(sequence, Sized) else None

        estimates: list[DepthEstimate | InputError] = []
        estimate = partial(self._estimate_pictures, lens=lens)
        batches = _yield_named_batches(sequence, batch)
        with tqdm(total=total, unit=" images", disable=not with_progress) as bar:
            for estimates_of_batch in map_in_threads(estimate, batches, threads):
                estimates += estimates_of_batch
                bar.update(len(estimates_of_batch))
        return estimates

    def _estimate_pictures(
        self, named: Sequence[tuple[str, object]], lens: AnyLens | None
    ) -> list[DepthEstimate | InputError]:
        """Read and estimate a batch of :meth:`estimate_many`: names, with pictures or inputs."""
        inputs = [
            image if isinstance(image, DepthInput) else result_or_error(as_input, image, name, lens)
            for name, image in named
        ]
        readable = [item for item in inputs if not isinstance(item, InputError)]
        estimates = iter(self.estimate_batch(readable))
        return [item if isinstance(item, InputError) else next(estimates) for item in inputs]

    @force_float32()
    def estimate_batch(
        self, inputs: Sequence[DepthInput], *, mount: MountFilter | None = None
    ) -> list[DepthEstimate | InputError]:
        """Estimate inputs in one call of the networks; where that fails, each by itself.

        Args:
            inputs: single images or pairs.
            mount: as for :meth:`estimate`; the images are its frames, in order.

        Returns:
            As :meth:`estimate_many`.
        """
        estimates: list[DepthEstimate | InputError]
        try:
            estimates = [*self._estimate_by_networks(inputs)]
        except InputError:  # of one of them: the others have an estimate
            estimates = [result_or_error(self._estimate_alone, item) for item in inputs]
        correct = partial(self._correct_by_mount, mount=mount)
        return [
            estimate if isinstance(estimate, InputError) else result_or_error(correct, estimate)
            for estimate in estimates
        ]

    def _estimate_alone(self, depth_input: DepthInput) -> DepthEstimate:
        """Estimate one input by the networks."""
        (estimate,) = self._estimate_by_networks([depth_input])
        return estimate

    def _estimate_by_networks(self, inputs: Sequence[DepthInput]) -> list[DepthEstimate]:
        """Estimate inputs in order, without a correction by the mount.

        Raises:
            InputError: an input cannot be estimated.
        """
        estimates: list[DepthEstimate] = []
        for is_pair, group in groupby(inputs, key=lambda item: item.right is not None):
            if is_pair:
                estimates += [self._estimate_pair(pair) for pair in group]
                continue
            images = list(group)
            estimates += depth_from_images(
                self._require_synthesiser(images[0].name),
                self.matcher,
                images,
                allow_ood=self.allow_ood,
            )
        return estimates

    def _estimate_pair(self, pair: DepthInput) -> DepthEstimate:
        """Estimate a pair by the matcher.

        Raises:
            InputError: there is no matcher, or what :meth:`estimate` raises of a pair.
        """
        if self.matcher is None:
            raise InputError(
                f"{pair.name}: there is a right image, and these weights answer one image "
                "alone: a pair needs a matcher. Give matcher='sgbm', or weights of a matcher; "
                "'depthpose weights pack G --matcher S --trained-on DATA --licence L --out W' "
                "makes one file of both."
            )
        return depth_from_pair(self.matcher, pair, with_check=self.with_check)

    def _require_synthesiser(self, name: str) -> Synthesiser:
        """Return the synthesiser, which a single image needs.

        Raises:
            InputError: there is none; ``name`` is that of the image.
        """
        if self.synthesiser is None:
            raise InputError(
                f"{name}: there is no right image, and these weights match pairs only; give "
                "right=, or weights with a generator ('depthpose weights list')."
            )
        return self.synthesiser

    def _correct_by_mount(
        self, estimate: DepthEstimate, mount: MountFilter | None
    ) -> DepthEstimate:
        """Correct the depth of a single image by the mount of its camera; a pair stays as it is.

        Raises:
            InputError: the camera states a mount that the image contradicts, or a pair is one of
                the frames of a mount.
        """
        if estimate.input.right is not None:
            if mount is not None:
                raise InputError(
                    f"{estimate.input.name}: a pair has metres of its own; omit mount, or the "
                    "right image"
                )
            return estimate
        synthesiser = self._require_synthesiser(estimate.input.name)
        return scale_by_mount(estimate, mount, synthesiser.config)

    def virtual_sizes(self, image: DepthInput) -> list[tuple[int, int]]:
        """Compute the sizes (rows, columns) at which the generator sees one image.

        Raises:
            InputError: there is no generator, or what
                ``virtual_sizes`` of ``depth/estimator/single_image.py`` raises.
        """
        synthesiser = self._require_synthesiser(image.name)
        return virtual_sizes(synthesiser, image, allow_ood=self.allow_ood)


def _yield_named_batches(
    images: Iterable[object], batch: int
) -> Iterator[list[tuple[str, object]]]:
    """Yield lists of up to ``batch`` images, each image with a name made of its number."""
    named = ((f"image {number}", image) for number, image in enumerate(images))
    while chunk := list(islice(named, batch)):
        yield chunk
