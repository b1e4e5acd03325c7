"""Methods by their names on the command line, with what decides their results."""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

from tqdm import tqdm

from depthpose.core.checkpoint import file_sha256, find_weights, read_checkpoint
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.core.run import own_device
from depthpose.depth.baselines import NearestImageBaseline, RowDepthBaseline
from depthpose.depth.config import Answer, BaselineName, MatcherConfig, SGBMConfig, Speed
from depthpose.depth.datasets import Dataset
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.predictions import Estimator
from depthpose.depth.stereo import MATCHERS, SGBMMatcher, with_usable_precision


class Method(NamedTuple):
    """An estimator, what to call it, and the JSON values that decide its results.

    ``with_right`` says whether it is given the real right view.
    """

    name: str
    net: Estimator
    settings: dict[str, Any]
    with_right: bool = True


def weights_method(
    weights: str,
    config: MatcherConfig,
    *,
    with_right: bool | None = None,
    matcher: str | None = None,
    allow_ood: bool = True,
    answer: Answer | None = None,
) -> Method:
    """Build the network of a weights file, given by its path or by name.

    Args:
        weights: the file; what it holds decides what is built.
        config: how the matcher runs.
        with_right: give it the real right view; by default only to a matcher, which needs it.
        matcher: for the synthesised view: None (the weights' own), sgbm (OpenCV's), or that of
            other weights, by name or file.
        allow_ood: answer out-of-distribution images too, as a measurement must.
        answer: where depth of one image comes from, in place of what the weights say.

    Raises:
        InputError: a matcher alone is asked to do without the right view, or weights without a
            matcher for it.
    """
    config = with_usable_precision(config)  # what is computed in is what is recorded
    path = find_weights(weights)
    kind = read_checkpoint(path).kind
    is_matcher = kind in MATCHERS
    is_shown = is_matcher if with_right is None else with_right
    if is_matcher and not is_shown:
        raise InputError(
            f"{path}: matches pairs, but depth from one image is asked for. Give weights that "
            "synthesise the right view."
        )
    facts = {"matcher": kind, "weights": path.stem, "weights_sha256": file_sha256(path)}
    if not is_matcher:
        facts["input"] = "both views" if is_shown else "left view"
    if matcher is not None:
        return _matched_by(path, matcher, config, facts, is_shown, allow_ood)
    config = replace(config, device=own_device(config.device))
    net = FakestereoNet.load(path, config=config, answer=answer, allow_ood=allow_ood)
    if is_shown and net.matcher is None:
        raise InputError(
            f"{path}: answers depth of one image, and holds no matcher, which a pair needs. Give "
            "weights with one, or sgbm."
        )
    name = f"{path.stem}-both" if is_shown and not is_matcher else path.stem
    if answer is not None:
        name += f"-{answer}"
    settings = {**facts, **_of_one_image(net, is_shown=is_shown), **config_to_dict(config)}
    return Method(name, net, settings, is_shown)


def _of_one_image(net: FakestereoNet, *, is_shown: bool) -> dict[str, Any]:
    """Say where depth of one image comes from, and in which sizes the image is looked at."""
    if is_shown or net.synthesiser is None:
        return {}
    return {"answer": net.synthesiser.config.answer, "scales": list(net.synthesiser.scales)}


def _matched_by(
    path: Path,
    matcher: str,
    config: MatcherConfig,
    facts: dict[str, str],
    is_shown: bool,
    allow_ood: bool,
) -> Method:
    """Build the network of a generator whose view is matched by OpenCV, or by other weights."""
    config = replace(config, device=own_device(config.device))
    settings = config_to_dict(config)
    if matcher == "sgbm":
        name, sgbm = "sgbm", SGBMConfig(with_filled_holes=True)
        other, settings = SGBMMatcher(sgbm), {**settings, **config_to_dict(sgbm)}
    else:
        other = find_weights(matcher)
        name = other.stem
        facts["matcher_sha256"] = file_sha256(other)
    facts["matcher"] += f" with {name}"
    net = FakestereoNet.load(
        path, matcher=other, config=config, answer="matched", allow_ood=allow_ood
    )
    settings = {**facts, **_of_one_image(net, is_shown=is_shown), **settings}
    return Method(f"{path.stem}-{name}", net, settings, is_shown)


def named_method(word: str, config: MatcherConfig) -> Method:
    """Build the method of a name: weights by file or name, perhaps with ``both:`` and the like.

    ``own:NAME``, ``matched:NAME`` and ``joined:NAME`` say what depth of one image comes from,
    ``quick:NAME`` and ``fine:NAME`` how much time the match of a real pair may take.
    """
    how, _, name = word.rpartition(":")
    if how in get_args(Answer):
        return weights_method(name, config, with_right=False, answer=cast("Answer", how))
    if how == "both":
        return weights_method(name, config, with_right=True)
    if how in get_args(Speed):
        method = weights_method(name, replace(config, speed=how), with_right=True)
        return method._replace(name=f"{method.name}-{how}")
    if how == "sgbm":
        return weights_method(name, config, with_right=False, matcher="sgbm")
    return weights_method(word, config)


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
