"""One image and one pair by torch, ONNX Runtime and OpenVINO: seconds, and difference of results.

    python bench/engines.py [--weights default] [--frames 4] [--runs 8] [--what network image pair]

Needs the extras ``export`` and ``openvino``. One thread and one process; runs of the engines
alternate, so that a busy machine slows all alike: processor time, least of the runs, and ratio to
torch's. Results are compared on synthetic streets that were not trained on. int8: convolutions
alone, in QDQ form, with ranges from other synthetic streets by onnxruntime.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.checkpoint import find_weights
from depthpose.core.export.graph import import_export
from depthpose.core.run import environment
from depthpose.depth.config import MatcherConfig, StreetsConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.export.graph import image_graph, pair_graph
from depthpose.depth.synthesis import SelectionGenerator, openvino_generator
from depthpose.depth.synthesis.openvino import import_openvino
from depthpose.depth.synthetic import Streets
from depthpose.depth.types import StereoInput, StereoSample
from depthpose.depth.weights import read_depth_weights
from depthpose.report.tables import markdown_table, write_table

SEED, CALIBRATION_SEED, CALIBRATION_FRAMES = 771, 772, 8
Feed = dict[str, np.ndarray]
Run = Callable[[StereoInput], np.ndarray]
"""Gives disparity [px of the image] of one input."""


def feed_of(given: StereoInput) -> Feed:
    """Give the inputs of a graph; those that it does not take are left out later."""
    assert given.camera is not None
    feed = {"image": given.left, "left": given.left}
    feed |= {} if given.right is None else {"right": given.right}
    return {name: view[None].numpy() for name, view in feed.items()} | {"K": given.camera.K.numpy()}


def export_graph(folder: Path, weights: str, what: str) -> Path:
    """Write the graph, unless it exists."""
    path = folder / f"{Path(weights).name}-{what}.onnx"
    if not path.exists():
        found = read_depth_weights(find_weights(weights))
        graph = (image_graph if what == "image" else pair_graph)(found)
        import_export().save(graph.model({}), str(path))
    return path


class Calibration:
    """Inputs from which onnxruntime takes the ranges of activations."""

    def __init__(self, frames: list[StereoSample], names: list[str]) -> None:
        self._feeds = iter([{n: feed_of(f.input)[n] for n in names} for f in frames])

    def get_next(self) -> Feed | None:
        """Give the next inputs, or None after the last."""
        return next(self._feeds, None)

    def __iter__(self) -> Iterator[Feed]:
        return self._feeds

    def __next__(self) -> Feed:
        return next(self._feeds)


def quantised(path: Path) -> Path:
    """Write the int8 graph, unless it exists."""
    target = path.with_suffix(".int8.onnx")
    if not target.exists():
        quantization = import_module("onnxruntime.quantization")
        names = [given.name for given in import_export().load(path).graph.input]
        streets = Streets(StreetsConfig(seed=CALIBRATION_SEED, scale=0.5))
        frames = [streets[k] for k in range(CALIBRATION_FRAMES)]
        quantization.quantize_static(
            str(path),
            str(target),
            Calibration(frames, names),
            quant_format=quantization.QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            per_channel=True,
        )
    return target


def torch_run(weights: str, *, precision: str = "fp32", **options: Any) -> Run:  # noqa: ANN401
    """Make the estimator itself."""
    # As exported graphs are.
    config = MatcherConfig(precision=precision, speed="quick")  # pyright: ignore[reportArgumentType]
    net = FakestereoNet.load(weights, config=config, allow_ood=True, **options)
    return lambda given: net.estimate_pair(given).disparity_px.numpy()


def onnxruntime_run(path: Path) -> Run:
    """Make a session of onnxruntime."""
    ort = import_module("onnxruntime")
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    names = [given.name for given in session.get_inputs()]
    outputs = [given.name for given in session.get_outputs()]
    at = outputs.index("disparity_px")

    def run(given: StereoInput) -> np.ndarray:
        feed = feed_of(given)
        return session.run(outputs, {name: feed[name] for name in names})[at][0]

    return run


def openvino_run(path: Path, precision: str) -> Run:
    """Compile a graph by OpenVINO, at the size of each input, as its users do."""
    core = import_openvino().Core()
    wanted = {"INFERENCE_PRECISION_HINT": precision, "INFERENCE_NUM_THREADS": 1}
    model = core.read_model(path)
    names = [given.get_any_name() for given in model.inputs]
    compiled: dict[tuple[int, ...], Any] = {}

    def run(given: StereoInput) -> np.ndarray:
        feed = {name: values for name, values in feed_of(given).items() if name in names}
        shape = tuple(given.left.shape)
        if shape not in compiled:
            fixed = model.clone()
            fixed.reshape({name: list(values.shape) for name, values in feed.items()})
            compiled[shape] = core.compile_model(fixed, "CPU", wanted).create_infer_request()
        return compiled[shape].infer(feed)["disparity_px"][0].copy()

    return run


def runs_of(folder: Path, weights: str, what: str) -> dict[str, Run]:
    """Make every engine."""
    path = export_graph(folder, weights, what)
    int8 = quantised(path)
    runs = {"torch": torch_run(weights)}
    if what == "image":
        runs["torch, engine='openvino'"] = torch_run(weights, engine="openvino")
        runs["the same, bf16"] = torch_run(weights, precision="bf16", engine="openvino")
    else:
        runs["torch, bf16"] = torch_run(weights, precision="bf16")
    return runs | {
        "onnxruntime, fp32": onnxruntime_run(path),
        "onnxruntime, int8": onnxruntime_run(int8),
        "OpenVINO, fp32": openvino_run(path, "f32"),
        "OpenVINO, bf16": openvino_run(path, "bf16"),
        "OpenVINO, int8": openvino_run(int8, "f32"),
    }


def seconds_of(runs: Mapping[str, Run], given: StereoInput, count: int) -> dict[str, list[float]]:
    """Run the engines alternately; the first round is a warm-up."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(count + 1):
        for name, run in runs.items():
            begin = time.process_time()
            run(given)
            if turn:
                times[name].append(time.process_time() - begin)
    return times


def differences_of(
    runs: Mapping[str, Run], frames: list[StereoSample], what: str, baseline_m: float | None
) -> dict[str, tuple[float, float]]:
    """Give the mean relative difference of depth from torch's, and AbsRel to 80 m, by engine."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in runs}
    for frame in frames:
        given, rig = input_of(frame, what), frame.input.camera
        assert frame.truth.depth_m is not None
        assert isinstance(rig, StereoRig)
        truth_m = frame.truth.depth_m.numpy()
        is_known = np.isfinite(truth_m) & (truth_m < 80)
        answers = {name: 1 / run(given)[is_known] for name, run in runs.items()}
        factor = float(rig.K[0, 0]) * (baseline_m or rig.baseline_m)
        for name, inverse in answers.items():
            apart = np.abs(inverse / answers["torch"] - 1).mean()
            error = np.abs(np.clip(inverse * factor, 1e-3, 80) / truth_m[is_known] - 1).mean()
            found[name].append((float(apart), float(error)))
    return {name: tuple(np.mean(rows, 0)) for name, rows in found.items()}


def input_of(frame: StereoSample, what: str) -> StereoInput:
    """Give a frame as a pair, or as one image, whose disparity is then of the virtual rig."""
    given = frame.input
    if what == "pair":
        return given
    assert given.camera is not None
    camera = Camera(width=given.camera.width, height=given.camera.height, K=given.camera.K)
    return replace(given, right=None, camera=camera)


def measure(folder: Path, asked: argparse.Namespace, what: str) -> list[dict[str, object]]:
    """Give a row for each engine."""
    runs = runs_of(folder, asked.weights, what)
    streets = Streets(StreetsConfig(seed=SEED))
    frames = [streets[k] for k in range(asked.frames)]
    rig = read_depth_weights(find_weights(asked.weights)).generator
    baseline_m = rig.config.virtual_baseline_m if rig is not None and what == "image" else None
    apart = differences_of(runs, frames, what, baseline_m)
    times = seconds_of(runs, input_of(frames[0], what), asked.runs)
    base = np.array(times["torch"])
    return [
        {
            "what": what,
            "engine": name,
            "processor_s": min(spent),
            "of_torch": min(spent) / min(base),
            "of_torch_median": float(np.median(np.array(spent) / base)),
            "depth_from_torch": apart[name][0],
            "abs_rel": apart[name][1],
        }
        for name, spent in times.items()
    ]


def measure_network(asked: argparse.Namespace) -> list[dict[str, object]]:
    """Give a row for each engine of the generator alone, at its rig's size of a street."""
    generator = read_depth_weights(find_weights(asked.weights)).generator
    assert isinstance(generator, SelectionGenerator)
    image = torch.rand(1, 3, 192, 640, generator=torch.Generator().manual_seed(0))
    networks = {
        "torch": generator.eval(),
        "OpenVINO, fp32": openvino_generator(generator, "cpu"),
        "OpenVINO, bf16": openvino_generator(generator, "cpu", "bf16"),
    }
    times: dict[str, list[float]] = {name: [] for name in networks}
    with torch.inference_mode():
        expected = networks["torch"](image)[0]
        off = {name: float((n(image)[0] - expected).abs().max()) for name, n in networks.items()}
        for _ in range(asked.runs):
            for name, network in networks.items():
                begin = time.process_time()
                network(image)
                times[name].append(time.process_time() - begin)
    base = np.array(times["torch"])
    return [
        {
            "what": "network",
            "engine": name,
            "processor_s": min(spent),
            "of_torch": min(spent) / min(base),
            "of_torch_median": float(np.median(np.array(spent) / base)),
            "logits_from_torch": off[name],
        }
        for name, spent in times.items()
    ]


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--weights", default="default")
    parser.add_argument("--frames", type=int, default=4, help="streets to compare results on")
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--what", nargs="+", default=["network", "image", "pair"])
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    asked = parser.parse_args()
    torch.set_num_threads(1)
    folder = asked.out / "engines"
    folder.mkdir(parents=True, exist_ok=True)
    for what in asked.what:
        rows = measure_network(asked) if what == "network" else measure(folder, asked, what)
        write_table(asked.out, rows, name=f"engines_{what}")
        print(markdown_table(rows), flush=True)
    print(environment())


if __name__ == "__main__":
    main()
