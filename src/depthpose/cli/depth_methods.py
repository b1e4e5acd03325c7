"""Methods by their names on the command line, with what decides their results."""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast, get_args

from tqdm import tqdm

from depthpose.cli.engine import Weights
from depthpose.core.checkpoint import file_sha256, find_weights, read_checkpoint
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.core.run import own_device
from depthpose.depth.baselines import NearestImageBaseline, RowDepthBaseline
from depthpose.depth.config import Answer, BaselineName, MatcherConfig, SGBMConfig, Speed
from depthpose.depth.datasets import Dataset
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.predictions import Estimator
from depthpose.depth.stereo import SGBMMatcher, with_usable_precision
from depthpose.depth.weights import MATCHERS, Use


class Method(NamedTuple):
    """An estimator, what to call it, and the JSON values that decide its results.

    ``with_right`` says whether it is given the real right view.
    """

    name: str
    net: Estimator
    settings: dict[str, Any]
    with_right: bool = True


@dataclass(frozen=True, kw_only=True)
class MethodSource:
    """What a method is built from, in this process or by the workers of an engine.

    Attributes:
        weights: by name or file, or packed to travel; what they hold decides what is built. None:
            OpenCV's matcher.
        config: how the networks run.
        with_right: give them the real right view; by default only a matcher, which needs it.
        matcher: for the synthesised view: None (the weights' own), sgbm (OpenCV's), or that of
            other weights, by name or file.
        allow_ood: answer out-of-distribution images too, as a measurement must.
        answer: where depth of one image comes from, in place of what the weights say.
        use: build what these take alone; None: all networks.
    """

    weights: str | Weights | None
    config: MatcherConfig
    with_right: bool | None = None
    matcher: str | None = None
    allow_ood: bool = True
    answer: Answer | None = None
    use: Use | None = None

    def build(self) -> Method:
        """Build the networks on the device of the config."""
        if self.weights is None:
            return sgbm_method(with_filled_holes=False)
        if isinstance(self.weights, Weights):
            with self.weights.unpacked() as file:
                return replace(self, weights=file).build()
        config = with_usable_precision(self.config)  # what is computed in is what is recorded
        config = replace(config, device=own_device(config.device))
        path = find_weights(self.weights)
        kind = read_checkpoint(path).kind
        is_matcher = kind in MATCHERS
        with_right = is_matcher if self.with_right is None else self.with_right
        if is_matcher and not with_right:
            raise InputError(
                f"{path}: matches pairs, but depth from one image is asked for. Give weights that "
                "synthesise the right view."
            )
        facts: dict[str, Any] = {"matcher": kind, "weights": path.stem}
        facts["weights_sha256"] = file_sha256(path)
        if not is_matcher:
            facts["input"] = "both views" if with_right else "left view"
        own, matcher, answer = config_to_dict(config), None, self.answer
        if self.matcher is None:
            name = path.stem + ("-both" if with_right and not is_matcher else "")
            name += "" if answer is None else f"-{answer}"
        else:  # OpenCV, or other weights, match the view of the generator
            other, answer = self.matcher, "matched"
            if self.matcher == "sgbm":
                sgbm = SGBMConfig(with_filled_holes=True)
                matcher, own = SGBMMatcher(sgbm), {**own, **config_to_dict(sgbm)}
            else:
                matcher = find_weights(self.matcher)
                other, facts["matcher_sha256"] = matcher.stem, file_sha256(matcher)
            name, facts["matcher"] = f"{path.stem}-{other}", f"{kind} with {other}"
        net = FakestereoNet.load(
            path, matcher=matcher, config=config, answer=answer, allow_ood=self.allow_ood,
            use=self.use,
        )  # fmt: skip
        if with_right and net.matcher is None:
            raise InputError(
                f"{path}: answers depth of one image, and holds no matcher, which a pair needs. "
                "Give weights with one, or sgbm."
            )
        if not with_right and net.synthesiser is not None:
            facts["answer"] = net.synthesiser.config.answer
            facts["scales"] = list(net.synthesiser.scales)
        return Method(name, net, {**facts, **own}, with_right)

    def packed(self) -> "MethodSource":
        """Give the same with the weights in memory."""
        if self.matcher not in (None, "sgbm"):
            raise InputError(
                f"--matcher {self.matcher}: --engine ray takes sgbm or the weights' own; make one "
                "file of both by 'depthpose weights pack G --matcher S --trained-on DATA --licence "
                "L --out W'"
            )
        if not isinstance(self.weights, str):
            return self
        return replace(self, weights=Weights.read(self.weights))

    def settings(self) -> dict[str, Any]:
        """Say what decides the results; this machine need not have the workers' device."""
        settings = replace(self, config=replace(self.config, device="cpu")).build().settings
        return settings | ({"device": self.config.device} if "device" in settings else {})


def named_method(word: str, config: MatcherConfig) -> Method:
    """Build the method of a name: weights by file or name, perhaps with ``both:`` and the like."""
    how, _, name = word.rpartition(":")
    source = MethodSource(weights=name, config=config, with_right=how not in get_args(Answer))
    if how in get_args(Answer):  # what depth of one image comes from
        return replace(source, answer=cast("Answer", how)).build()
    if how == "both":
        return source.build()
    if how in get_args(Speed):  # how much time the match of a real pair may take
        method = replace(source, config=replace(config, speed=how)).build()
        return method._replace(name=f"{method.name}-{how}")
    if how == "sgbm":
        return replace(source, with_right=False, matcher="sgbm").build()
    return MethodSource(weights=word, config=config).build()


def sgbm_method(*, with_filled_holes: bool) -> Method:
    """OpenCV's StereoSGBM with the settings of our tables."""
    config = SGBMConfig(with_filled_holes=with_filled_holes)
    net = FakestereoNet.load(matcher="sgbm", config=config)
    name = "sgbm-filled" if with_filled_holes else "sgbm"
    return Method(name, net, {"matcher": "sgbm", **config_to_dict(config)})


def baseline_method(name: BaselineName, training: Dataset) -> Method:
    """Fit a baseline to the truth of training frames."""
    kinds = {"rows": RowDepthBaseline, "nearest": NearestImageBaseline}
    names = "\n".join(frame.name for frame in training.frames)
    settings = {
        "matcher": f"baseline: {name}",
        "input": "left view" if name == "nearest" else "no image",
        "train": training.name,
        "train_frames": len(training),
        "train_sha256": hashlib.sha256(names.encode()).hexdigest(),
    }

    def show(frames: Sequence[int]) -> Iterable[int]:
        return tqdm(frames, f"fit {name}", unit=" frames", disable=None)

    return Method(f"baseline-{name}", kinds[name].fit(training, show), settings, with_right=False)
