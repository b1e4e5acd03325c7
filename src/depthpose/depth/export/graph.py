"""The depth networks as one ONNX graph, with all that the estimator does around them.

Sizes stay free: the graph computes them from the images that it is given. Networks come from
``torch.export``; what is around them (the virtual rig, padding, and the way back) is written
in operators, because sizes there depend on a focal length, which no exporter follows.
"""

from typing import NamedTuple, cast

import numpy as np
import torch
from torch import nn

from depthpose.core.errors import InputError
from depthpose.core.export import Graph, Value, network_model
from depthpose.depth.config import Answer, GeneratorConfig, SelectionConfig
from depthpose.depth.estimator.rig import SKY_M
from depthpose.depth.export.network import DrawnValues, drawn, dynamic_shape_network
from depthpose.depth.export.steps import (
    columns,
    focal_size,
    focal_yx,
    joined,
    pads,
    ratio,
    resized_image,
    resized_map,
    rows,
    size_of,
)
from depthpose.depth.stereo import StereoNetwork
from depthpose.depth.stereo.enlargement import LEAST_PX
from depthpose.depth.stereo.network_matcher import IMAGENET_MEAN, IMAGENET_STD, NetworkConfig
from depthpose.depth.weights import DepthWeights

_IMAGES = ("batch", 3, "height", "width")
_MAPS = ("batch", "height", "width")


class _Maps(NamedTuple):
    """Disparity [px], confidence, and 1 in the sky where it is known."""

    disparity_px: Value
    confidence: Value
    sky: Value | None = None


def image_graph(weights: DepthWeights) -> Graph:
    """Write one image to depth: what ``FakestereoNet.estimate`` does without a right view.

    Inputs ``image`` (batch, 3, height, width; RGB in [0, 1]) and ``K`` (3, 3; float64, of all
    images). Outputs ``depth_m``, ``disparity_px`` (of the imitated rig, in the image's pixels),
    ``confidence`` (each batch, height, width) and ``right``, the drawn view; of networks that know
    the sky ``is_sky`` too (batch, height, width; bool), of weights that know streets
    ``image_confidence`` (batch), how probable one is.

    Raises:
        InputError: a network is missing, or the generator is stochastic (dropout at test time).
    """
    generator = weights.generator
    if generator is None or (weights.matcher is None and generator.config.answer != "own"):
        raise InputError(
            f"depth from one image needs a generator and a matcher, and these weights lack the "
            f"{'generator' if generator is None else 'matcher'}; 'depthpose weights pack' makes "
            "one file of both."
        )
    rig = generator.config
    graph = Graph()
    image = graph.input("image", np.float32, _IMAGES)
    K = graph.input("K", np.float64, (3, 3))
    full = size_of(image)
    small = focal_size(full, focal_yx(K), rig.virtual_focal_px)
    left = resized_image(image, small)
    seen = drawn(left, generator)
    found = _answered(left, seen, weights.matcher, rig)
    disparity_px = resized_map(found.disparity_px, full) * ratio(full, small)
    confidence = resized_map(found.confidence, full)
    focal_m_px = _focal_m_px(K, rig)
    depth_m = _depth(disparity_px, focal_m_px)
    if found.sky is not None:
        is_sky = resized_map(found.sky, full).op("Greater", np.float32(0.5))
        depth_m = is_sky.op("Where", np.float32(np.nan), depth_m)
        disparity_px = is_sky.op("Where", focal_m_px / np.float32(SKY_M), disparity_px)
        graph.output("is_sky", is_sky, np.bool_, _MAPS)
    _output_maps(graph, depth_m, disparity_px, confidence)
    graph.output("right", resized_image(seen.right, full), np.float32, _IMAGES)
    if seen.street is not None:
        graph.output("image_confidence", seen.street, np.float32, ("batch",))
    return graph


def pair_graph(weights: DepthWeights) -> Graph:
    """Write a rectified pair to disparity: what ``FakestereoNet.estimate`` does with ``right=``.

    Inputs ``left`` and ``right`` (batch, 3, height, width; RGB in [0, 1]), and ``K`` (3, 3;
    float64) where the weights were trained at one focal length. Outputs ``disparity_px`` and
    ``confidence`` (batch, height, width), and of a network that knows the sky ``is_sky`` (the same;
    bool), where disparity is 0.01 px. Elsewhere depth is ``fx * baseline / disparity``.

    Raises:
        InputError: there is no matcher in the weights.
    """
    if weights.matcher is None:
        raise InputError("these weights hold no matcher, only a generator; give a matcher's.")
    network = dynamic_shape_network(weights.matcher)
    config = cast("NetworkConfig", weights.matcher.config)
    graph = Graph()
    left = graph.input("left", np.float32, _IMAGES)
    right = graph.input("right", np.float32, _IMAGES)
    focal_px = None
    if config.work_focal_px is not None:
        focal_px = focal_yx(graph.input("K", np.float64, (3, 3)))
    found = _matched(left, right, focal_px, network, config)
    disparity_px = found.disparity_px
    if found.sky is not None:
        is_sky = found.sky.op("Greater", np.float32(0.5))
        disparity_px = is_sky.op("Where", np.float32(LEAST_PX), disparity_px)
        graph.output("is_sky", is_sky, np.bool_, _MAPS)
    _output_maps(graph, None, disparity_px, found.confidence)
    return graph


def _answered(
    left: Value,
    seen: DrawnValues,
    matcher: StereoNetwork | None,
    rig: GeneratorConfig | SelectionConfig,
) -> _Maps:
    """Take the generator's own disparity, the matcher's, or both."""
    answer: Answer = rig.answer
    if answer == "own":
        return _own(seen)
    assert matcher is not None, "checked before"
    focal_px = np.array([rig.virtual_focal_px] * 2)
    config = cast("NetworkConfig", matcher.config)
    matched = _matched(left, seen.right, focal_px, dynamic_shape_network(matcher), config)
    if answer == "matched":
        return matched if seen.is_sky is None else matched._replace(sky=_own(seen).sky)
    return _both(_own(seen), matched)


def _own(seen: DrawnValues) -> _Maps:
    assert seen.disparity_px is not None and seen.confidence is not None  # noqa: PT018
    sky = None if seen.is_sky is None else seen.is_sky.cast(np.float32)
    return _Maps(seen.disparity_px, seen.confidence, sky)


def _both(one: _Maps, other: _Maps) -> _Maps:
    """What ``join_matches`` does: the mean of the logarithms, weighed by confidence."""
    is_known = other.disparity_px.op("Greater", np.float32(0))
    weight = is_known.op("Where", other.confidence, np.float32(0))
    if other.sky is not None:
        weight = weight * (other.sky * np.float32(-1) + np.float32(1))
    share = weight / (weight + one.confidence).op("Max", np.float32(1e-6))
    logs = [maps.disparity_px.op("Max", np.float32(1e-3)).op("Log") for maps in (one, other)]
    log_px = _between(logs[0], logs[1], share)
    return _Maps(log_px.op("Exp"), _between(one.confidence, weight, share), one.sky)


def _between(start: Value, end: Value, share: Value) -> Value:
    return start + (end - start) * share


def _matched(
    left: Value,
    right: Value,
    focal_px: Value | np.ndarray | None,
    network: nn.Module,
    config: NetworkConfig,
) -> _Maps:
    """Match at the focal length that the weights want, and come back to the images' size."""
    size = work = size_of(left)
    if config.work_focal_px is not None:
        work = focal_size(size, focal_px, config.work_focal_px)
    least, step = config.min_side_px, config.step_px
    lacking = ((work + (step - 1)) / step * step).op("Max", least) - work
    above, beside = rows(lacking), columns(lacking)
    widths = pads(left, before=joined(above, 0), after=joined(0, beside))
    mean, deviation = (
        np.array(v, np.float32)[:, None, None] for v in (IMAGENET_MEAN, IMAGENET_STD)
    )
    padded = [
        ((resized_image(view, work) - mean) / deviation).op("Pad", widths) for view in (left, right)
    ]
    example = [torch.rand(2, 3, least + step, least + 2 * step) for _ in range(2)]
    found = left.graph.call(network_model(network, example, step), *padded)
    whole = 1 << 62
    found = [m.slice(joined(above, 0), joined(whole, columns(work)), [1, 2]) for m in found]
    disparity_px, confidence, *sky = (resized_map(m, size) for m in found)
    is_sky = [values.op("Greater", np.float32(0.5)).cast(np.float32) for values in sky]
    return _Maps(disparity_px * ratio(size, work), confidence, *is_sky)


def _focal_m_px(K: Value, rig: GeneratorConfig | SelectionConfig) -> Value:
    """Give focal length times the imitated baseline: depth is that over disparity."""
    fx = K.op("Reshape", [-1]).op("Gather", 0).cast(np.float32)
    return fx * np.float32(rig.virtual_baseline_m)


def _depth(disparity_px: Value, focal_m_px: Value) -> Value:
    depth_m = focal_m_px / disparity_px
    return disparity_px.op("Greater", np.float32(0)).op("Where", depth_m, np.float32(np.nan))


def _output_maps(graph: Graph, *maps: Value | None) -> None:
    for name, values in zip(("depth_m", "disparity_px", "confidence"), maps, strict=True):
        if values is not None:
            graph.output(name, values, np.float32, _MAPS)
