"""The work behind ``depthpose depth predict|match --engine ray``."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from depthpose.cli.engine import EngineOptions, Inputs, Weights, run
from depthpose.cli.matching import refuse_unrectified_pair, write_match
from depthpose.cli.methods import Method, sgbm_method, weights_method
from depthpose.cli.predicting import Lens, Look, Predictor, read_lens
from depthpose.core.camera import StereoRig, read_rig
from depthpose.core.engine import Files, Function, Job, Sample
from depthpose.core.errors import InputError
from depthpose.core.files import VIDEO_SUFFIXES, image_size, read_image
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.depth.config import Answer, MatcherConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.predictions import ENDINGS
from depthpose.depth.types import StereoInput

IMAGES = Files(roles=("image",), suffixes=LISTED_SUFFIXES)
PAIRS = Files(roles=("left", "right"), suffixes=LISTED_SUFFIXES)


@dataclass(frozen=True, kw_only=True)
class NetRecipe:
    """What a worker builds its networks of; without weights it is OpenCV's matcher."""

    weights: Weights | None
    config: MatcherConfig
    with_right: bool
    with_sgbm: bool
    with_unlike: bool = True
    answer: Answer | None = None

    def build(self) -> Method:
        """Build the networks on the device of the config."""
        if self.weights is None:
            return sgbm_method(with_filled_holes=False)
        with self.weights.unpacked() as path:
            return weights_method(
                path,
                self.config,
                with_right=self.with_right,
                matcher="sgbm" if self.with_sgbm else "psmnet",
                with_unlike=self.with_unlike,
                answer=self.answer,
            )

    def settings(self) -> dict[str, Any]:
        """Say what decides the results; this machine need not have the workers' device."""
        method = replace(self, config=replace(self.config, device="cpu")).build()
        own = {"device": self.config.device} if "device" in method.settings else {}
        return method.settings | own


@dataclass(frozen=True, kw_only=True)
class PredictWork:
    """Single images to the files of their depth."""

    recipe: NetRecipe
    lens: Lens
    look: Look
    files: Files = IMAGES
    endings: Sequence[str] = ENDINGS

    @property
    def batch(self) -> int:
        """Images that go through the networks together."""
        return self.look.batch

    def start(self) -> Function:
        """Build the networks."""
        net = self.recipe.build().net
        assert isinstance(net, FakestereoNet)
        return partial(_predict, net, self.lens, self.look)


@dataclass(frozen=True, kw_only=True)
class MatchWork:
    """Stereo pairs to the files of their depth."""

    recipe: NetRecipe
    rig: StereoRig
    with_cloud: bool
    files: Files = PAIRS
    endings: Sequence[str] = ENDINGS
    batch: int = 1

    def start(self) -> Function:
        """Build the matcher."""
        return partial(_match, self.recipe.build(), self.rig, self.with_cloud)


def predict(
    words: Sequence[str],
    given: tuple[Path | None, float | None],
    recipe: NetRecipe,
    look: Look,
    out: str,
    options: EngineOptions,
) -> int:
    """Predict by an engine; ``given`` is the camera's file, or its focal length [px]."""
    video = next((word for word in words if word.lower().endswith(tuple(VIDEO_SUFFIXES))), None)
    if video is not None:
        raise InputError(f"{video}: --engine ray takes no videos; leave --engine away for them")
    inputs = Inputs.find(words, IMAGES)
    with inputs.first() as (image,):
        lens = read_lens(*given, image)
    settings = {
        **recipe.settings(), "camera": lens.facts(), "color_range_m": list(look.range_m)
    }  # fmt: skip
    work = PredictWork(recipe=recipe, lens=lens, look=look)
    return run(_job(work, inputs, out, settings, options), options, "depth maps")


def match(
    words: Sequence[str],
    camera: Path,
    recipe: NetRecipe,
    out: str,
    options: EngineOptions,
    *,
    with_cloud: bool,
    with_check: bool,
) -> int:
    """Match by an engine; ``words`` are the left and right sides, manifests or tar shards."""
    inputs = Inputs.find(words, PAIRS)
    with inputs.first() as (left, right):
        rig = read_rig(camera, image_size(left))
        if with_check:
            refuse_unrectified_pair(_read_pair("the first pair", left, right, rig))
    facts = {"K": rig.K.tolist(), "baseline_m": rig.baseline_m}
    work = MatchWork(recipe=recipe, rig=rig, with_cloud=with_cloud)
    settings = {**recipe.settings(), "camera": facts}
    return run(_job(work, inputs, out, settings, options), options, "pairs")


def _job(
    work: PredictWork | MatchWork,
    inputs: Inputs,
    out: str,
    settings: dict[str, Any],
    options: EngineOptions,
) -> Job:
    return Job(
        work=work,
        items=inputs.items,
        tars=inputs.tars,
        out=out,
        settings=settings,
        form=options.shards,
        block=options.block,
    )


def _predict(
    net: FakestereoNet, lens: Lens, look: Look, samples: Sequence[Sample], out: Path
) -> list[str]:
    predictor = Predictor(lens=lens, net=net, out=out, look=look)
    predictor.predict_images({sample.name: sample.files[0] for sample in samples})
    return [str(predictor.failures.get(sample.name, "")) for sample in samples]


def _match(
    method: Method, rig: StereoRig, with_cloud: bool, samples: Sequence[Sample], out: Path
) -> list[str]:
    reasons: list[str] = []
    for sample in samples:
        try:
            left, right = sample.files
            pair = _read_pair(sample.name, left, right, rig)
            write_match(out, pair, method.net.estimate_pair(pair), with_cloud=with_cloud)
            reasons.append("")
        except InputError as error:
            reasons.append(str(error))
    return reasons


def _read_pair(name: str, left: Path, right: Path, rig: StereoRig) -> StereoInput:
    return StereoInput(name=name, left=read_image(left), right=read_image(right), camera=rig)
