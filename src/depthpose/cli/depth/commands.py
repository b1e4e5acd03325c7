"""``depthpose depth ...``."""

import re
from dataclasses import replace
from pathlib import Path

import tyro

from depthpose.cli.arguments import NewPath, NewPlace, Source
from depthpose.cli.depth import options
from depthpose.cli.engine import EngineOptions
from depthpose.core.errors import InputError


def predict_depth(
    images: tyro.conf.Positional[tuple[Source, ...]],
    out: NewPlace,
    lens: options.LensOptions = options.LensOptions(),
    output: options.PredictOutput = options.PredictOutput(),
    networks: options.ImageNetworkOptions = options.ImageNetworkOptions(),
    matching: options.MatcherOptions = options.MatcherOptions(),
    scale: options.ScaleOptions = options.ScaleOptions(),
    engine: EngineOptions = EngineOptions(),
) -> int:
    """Estimate depth in metres from single images, by a synthesised right view.

    For each NAME.png: NAME.depth_m.npy (metres, NaN where invalid and in the sky), NAME.depth.png
    (16 bit, metres x 256), NAME.disparity_px.npy, NAME.confidence.npy (0..1), NAME.right.png (the
    synthesised view), NAME.sky.png (255 in the sky, where the weights know it), NAME.color.png, and
    NAME.cloud.ply with --cloud; of a video those of each frame, and NAME.color.mp4. report.html
    shows some. A rerun skips what is finished; other settings need another --out.

        depthpose depth predict street.png --camera cam.json --out out
        depthpose depth predict drive.mp4 --fov 90 --camera-height 1.4 --out out

    Args:
        images: images, folders of them, quoted patterns such as 'left/*.png', or videos.
        out: folder for the results.
    """
    from depthpose.cli.depth.inputs import IMAGES, InputReader, list_images_and_videos, read_lens
    from depthpose.cli.depth.methods import DepthNetworkSpec
    from depthpose.cli.depth.predict import (
        DepthWorker,
        find_inputs_for_ray,
        predict_depth_of_files,
        predict_depth_on_ray,
    )

    if not images:
        raise InputError("name images, folders of them, patterns or videos to predict from")
    spec = DepthNetworkSpec(
        weights=networks.weights,
        config=matching.config,
        with_right=False,
        matcher=networks.matcher,
        allow_ood=networks.allow_ood,
        answer=networks.answer,
        use="images",
    )

    # By workers of a cluster, to which the weights travel.
    if engine.engine == "ray":
        packed = spec.with_packed_weights()
        inputs = find_inputs_for_ray(images, IMAGES)
        with inputs.open_first() as first_image:
            camera = read_lens(lens, first_image)
        reader = InputReader(camera=camera, scale=scale)
        worker = DepthWorker(spec=packed, reader=reader, output=output)
        return predict_depth_on_ray(inputs, worker, out, engine)

    # In this process.
    paths = list_images_and_videos(images, Path(out))
    camera = read_lens(lens, paths)
    reader = InputReader(camera=camera, scale=scale)
    method = spec.build()
    has_matcher_options = matching.precision != "fp32" or matching.max_memory is not None
    if method.settings.get("answer") == "own" and has_matcher_options:
        raise InputError(
            "--precision and --max-memory are for a matcher with weights, and none runs here; "
            "leave them out"
        )
    sources = [(path,) for path in paths]
    return predict_depth_of_files(sources, method, reader, output, Path(out))


def match_pairs(
    left: tyro.conf.Positional[Source],
    right: tyro.conf.Positional[Source | None] = None,
    *,
    camera: Path,
    out: NewPlace,
    pairs: options.DepthMatchOptions = options.DepthMatchOptions(),
    matching: options.PairMatcherOptions = options.PairMatcherOptions(),
    engine: EngineOptions = EngineOptions(),
) -> int:
    """Match real stereo pairs to metric depth.

    For each left image NAME.png it writes the files of 'depth predict' except the right view: depth
    in metres, disparity, confidence, sky, colours, and the cloud with --cloud. report.html shows
    some.
    A rerun skips what is finished; other settings need another --out.

        depthpose depth match left.png right.png --camera cam.json --out out
        depthpose depth match left.png right.png --camera cam.json --matcher sgbm --out sgbm

    Args:
        left: left image, a folder of them, or a quoted pattern such as 'left/*.png'; with --engine
            ray also a manifest with columns left and right, or tar shards of both, without RIGHT.
        right: right image, folder or pattern; paired by their names, or the numbers in them.
        camera: JSON file: {"width", "height", "K": 3x3, "baseline_m"}, or a file of ROS, OpenCV,
            KITTI and others; for ROS and OpenCV also a folder with both cameras' files.
        out: folder for the results.
    """
    from depthpose.cli.depth.inputs import PAIRS, InputReader, list_pairs
    from depthpose.cli.depth.methods import make_pair_spec
    from depthpose.cli.depth.predict import (
        DepthWorker,
        find_inputs_for_ray,
        predict_depth_of_files,
        predict_depth_on_ray,
    )
    from depthpose.core.camera import read_rig
    from depthpose.core.files import image_size
    from depthpose.core.files.images import refuse_among_inputs

    output = options.PredictOutput(cloud=pairs.cloud, min_confidence=pairs.min_confidence)
    config = replace(
        matching.config,
        with_left_right_check=matching.left_right_check,
        max_disparity_px=matching.max_disparity,
    )
    spec = make_pair_spec(pairs.matcher, pairs.weights, config, with_check=pairs.check)

    # By workers of a cluster. The weights are packed into the spec, which is sent to them.
    if engine.engine == "ray":
        packed_spec = spec.with_packed_weights()
        sources = [left] if right is None else [left, right]
        inputs = find_inputs_for_ray(sources, PAIRS)
        with inputs.open_first() as first_pair:
            rig = read_rig(camera, image_size(first_pair[0]))
        reader = InputReader(camera=rig, files=PAIRS)
        worker = DepthWorker(spec=packed_spec, reader=reader, output=output)
        return predict_depth_on_ray(inputs, worker, out, engine)

    # In this process.
    if right is None:
        raise InputError(f"{left}: there is no right image beside it; give it second")
    image_pairs = list_pairs(left, right)
    images = [path for pair in image_pairs for path in pair]
    refuse_among_inputs(Path(out), (left, right), images)
    rig = read_rig(camera, image_size(image_pairs[0][0]))
    reader = InputReader(camera=rig, files=PAIRS)
    return predict_depth_of_files(image_pairs, spec.build(), reader, output, Path(out))


def evaluate_depth(
    data: Path,
    out: NewPath,
    split: str | None = None,
    methods: options.DepthMethodOptions = options.DepthMethodOptions(),
    comparison: options.ProtocolOptions = options.ProtocolOptions(),
    matching: options.MatcherOptions = options.MatcherOptions(),
) -> int:
    """Measure depth on a dataset by a named protocol, and write rows, a table and a page.

    Predictions are made once, as files in OUT/predictions/METHOD, and measured from there. Several
    methods share the table; --predictions measures the files of any other. Under torchrun or
    accelerate launch the processes share the frames, and the first one measures.

    Protocols: eigen-raw (one LiDAR scan, depth = LiDAR x, Garg crop: the published one),
    eigen-raw-camera (depth = camera z), eigen-improved (annotated maps, no crop),
    eigen-improved-garg (with the crop), kitti-2015 (disparity: EPE and D1).

    Args:
        data: KITTI raw, object, 2012/2015, Middlebury, or a plain folder of pairs.
        out: folder for rows.json, rows.csv, table.md, report.html and the predictions.
        split: eigen-test, -val, -train, -train-val, -benchmark, or a file of frames.
    """
    from depthpose.cli.depth.evaluate import (
        choose_methods,
        measure_and_report,
        measure_shards,
        open_frames,
        predict_depth_of_dataset,
    )
    from depthpose.core.engine import PLAN
    from depthpose.core.files import stores
    from depthpose.core.run_folder import claim_folder
    from depthpose.depth.protocols import find_protocol
    from depthpose.report.page import list_table_files

    rule = find_protocol(comparison.protocol)
    dataset = open_frames(data, split)
    chosen = choose_methods(methods, matching.config, dataset)

    # The folder is that of these frames and this protocol; methods may be added later.
    is_url = re.match(r"\w+:/", str(data)) is not None
    settings = {
        "command": "depth evaluate",
        "data": str(data if is_url else data.resolve()),
        "split": None if split is None else str(split),
        "protocol": comparison.protocol,
        "cap": list(comparison.cap),
    }
    files = [*list_table_files("rows", "frames", "confidence"), "report.html", "predictions"]
    claim_folder(out, settings, files)

    # Predict what is missing, then measure it with the predictions that are given.
    folders = [
        predict_depth_of_dataset(dataset, method, rule, out / "predictions") for method in chosen
    ]
    protocol = comparison.protocol
    caps_m = comparison.cap
    predictions = methods.predictions
    if predictions is not None and stores.exists(stores.join(predictions, PLAN)):
        of_shards = measure_shards(dataset, predictions, protocol, caps_m)
        return measure_and_report(dataset, folders, protocol, caps_m, out, [of_shards])
    if predictions is not None:
        folders.append(Path(predictions))
    return measure_and_report(dataset, folders, protocol, caps_m, out)
