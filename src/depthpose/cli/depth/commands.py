"""``depthpose depth ...``."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from depthpose.cli.engine import EngineOptions, Weights
from depthpose.core.errors import InputError
from depthpose.depth.config import Answer, BaselineName, MatcherConfig, Speed

Precision = Literal["fp32", "bf16"]
Engine = Annotated[EngineOptions, tyro.conf.OmitArgPrefixes]


def predict(
    images: tyro.conf.Positional[list[str]],
    out: str,
    camera: Path | None = None,
    focal_px: float | None = None,
    weights: str = "default",
    matcher: str | None = None,
    answer: Answer | None = None,
    color_range: tuple[float, float] = (3.0, 80.0),
    device: str = "cpu",
    precision: Precision = "fp32",
    max_memory: str | None = None,
    batch: int = 1,
    cloud: bool = False,
    with_unlike: bool = False,
    view: str | None = None,
    engine: Engine = EngineOptions(),  # noqa: B008  frozen
) -> int:
    """Depth in metres from single images, by a synthesised right view.

    For each NAME.png: NAME.depth_m.npy (metres, NaN where invalid and in the sky), NAME.depth.png
    (16 bit, metres x 256), NAME.disparity_px.npy, NAME.confidence.npy (0..1), NAME.right.png (the
    drawn view), NAME.sky.png (255 in the sky, where the weights know it), NAME.color.png, and
    NAME.cloud.ply with --cloud. A video gives the files of each frame and
    NAME.color.mp4. report.html shows some of them, with the cloud in 3D. A rerun skips what is
    finished; other settings need another --out. No file is written over that is not the run's own.

        depthpose depth predict street.png --camera cam.json --out out
        depthpose depth predict drive.mp4 --focal-px 1100 --out out

    Args:
        images: images, folders of them, quoted patterns such as 'left/*.png', or videos.
        out: folder for the results.
        camera: JSON file: {"width", "height", "K": 3x3}, or that of KITTI, Middlebury, TUM RGB-D,
            BOP, ROS or OpenCV. A baseline in it is ignored: one image has none.
        focal_px: the focal length in pixels, in place of a camera whose centre is the image's.
        weights: weights with a generator, by name or file ('depthpose weights list').
        matcher: what matches the drawn view: sgbm (OpenCV's), or other weights with a matcher, by
            name or file. Left out, or psmnet: that of the weights.
        answer: own: the generator's own disparity; matched: the matcher on left and drawn right
            view; joined: both. Left out: what the weights say; another matcher matches.
        color_range: metres of the brightest and the darkest colour, the same for all pictures.
        device: cpu, cuda, cuda:1, ...
        precision: of the matcher, fp32, or bf16: faster, at some hundredths of a pixel.
        max_memory: bound on the memory of the matcher, such as 1GB; exact.
        batch: images of one size that go through the networks together: for a GPU; a processor is
            busy with one.
        cloud: write a coloured point cloud, NAME.cloud.ply.
        with_unlike: answer images that are unlike what the weights know too, with a warning
            (NAME.warning.txt), in place of refusing them.
        view: live shows each result in Rerun's viewer (an extra) as it comes; FILE.rrd records it.
        engine: where the work is done.
    """
    from depthpose.cli.depth import methods, predicting
    from depthpose.depth.stereo import is_own_matcher

    config = MatcherConfig(
        device=device, precision=precision, max_memory_bytes=methods.parse_bytes(max_memory)
    )
    if not 0 < color_range[0] < color_range[1]:
        raise InputError(f"--color-range {color_range}: give near and far metres, near first.")
    if batch < 1:
        raise InputError(f"--batch {batch}: one image at least goes through the networks; take 1.")
    is_own = is_own_matcher(matcher)
    if not is_own and answer is not None:
        raise InputError(
            f"--answer {answer} and --matcher {matcher}: another matcher matches the drawn view; "
            "leave one away."
        )
    if matcher == "sgbm" and config != MatcherConfig():
        raise InputError(
            "--device, --precision and --max-memory are for matchers with weights; sgbm takes none."
        )
    look = predicting.Look(range_m=color_range, with_cloud=cloud, batch=batch)
    if engine.is_ray:
        from depthpose.cli.depth import engine as engine_depth

        if not is_own and matcher != "sgbm":
            raise InputError(
                f"--matcher {matcher}: --engine ray takes sgbm or the weights' own; make one file "
                "of both by 'depthpose weights pack G --matcher S --out W'"
            )
        recipe = engine_depth.NetRecipe(
            weights=Weights.read(weights),
            config=config,
            with_right=False,
            with_sgbm=matcher == "sgbm",
            with_unlike=with_unlike,
            answer=answer,
        )
        return engine_depth.predict(images, (camera, focal_px), recipe, look, out, engine)
    sources = predicting.find_sources(images, Path(out))
    lens = predicting.read_lens(camera, focal_px, sources[0])
    method = methods.weights_method(
        weights,
        config,
        with_right=False,
        matcher=matcher,
        with_unlike=with_unlike,
        answer=answer,
    )
    return predicting.predict_all(sources, lens, method, Path(out), look, view)


def match(
    left: tyro.conf.Positional[str],
    right: tyro.conf.Positional[str | None] = None,
    *,
    camera: Path,
    out: str,
    weights: str | None = None,
    matcher: str | None = None,
    device: str = "cpu",
    speed: Speed = "fine",
    precision: Precision = "fp32",
    max_memory: str | None = None,
    tile: tuple[int, int] | None = None,
    left_right_check: bool = False,
    cloud: bool = False,
    check: bool = True,
    engine: Engine = EngineOptions(),  # noqa: B008  frozen
) -> int:
    """Match real stereo pairs to metric depth.

    For each NAME.png on the left: NAME.depth_m.npy (metres, NaN where invalid), NAME.depth.png
    (16 bit, metres x 256), NAME.disparity_px.npy, NAME.confidence.npy (0..1), NAME.color.png, and
    NAME.cloud.ply with --cloud. report.html shows some of them, with the cloud in 3D. A rerun skips
    what is finished; other settings need another --out. No file is written over that is not the
    run's own.

        depthpose depth match left.png right.png --camera cam.json --out out
        depthpose depth match left.png right.png --camera cam.json --matcher sgbm --out sgbm

    Args:
        left: left image, a folder of them, or a quoted pattern such as 'left/*.png'; with --engine
            ray also a manifest with columns left and right, or tar shards of both, without RIGHT.
        right: right image, folder or pattern; images are paired in sorted order.
        camera: JSON file: {"width", "height", "K": 3x3, "baseline_m"}, or that of KITTI,
            Middlebury, ROS or OpenCV; of the latter two a folder may hold both files of the pair.
        out: folder for the results.
        weights: weights with a matcher, by name or file; 'default' unless sgbm matches.
        matcher: what matches the two views: sgbm (OpenCV's, which needs no weights), or weights
            with a matcher, by name or file. Left out, or psmnet: that of the weights.
        device: cpu, cuda, cuda:1, ...
        speed: quick: at the focal length that the weights were trained at; fine: at up to 280,000
            pixels, for KITTI in 3 to 4 times the time.
        precision: fp32, or bf16: faster, at some hundredths of a pixel.
        max_memory: bound on the memory of activations, such as 1GB or 800MB; exact.
        tile: match tiles of so many rows and columns: less memory and approximate. The first
            pair is matched whole as well, and the change of its disparity is printed.
        left_right_check: match the mirrored pair too, which makes the confidence better.
        cloud: write a coloured point cloud, NAME.cloud.ply.
        check: check the first pair for swapped or unrectified images before any work.
        engine: where the work is done.
    """
    from depthpose.cli.depth import matching, methods
    from depthpose.core.run import refuse_among_inputs

    weights = _weights_that_match(weights, matcher)
    config = MatcherConfig(
        device=device,
        speed=speed,
        precision=precision,
        max_memory_bytes=methods.parse_bytes(max_memory),
        tile_px=tile,
        with_left_right_check=left_right_check,
    )
    if weights is None and config != MatcherConfig():
        raise InputError(
            "--device, --speed, --precision, --max-memory, --tile and --left-right-check are for "
            "matchers with weights; sgbm takes none of them."
        )
    if engine.is_ray:
        return _match_on_ray(left, right, camera, weights, config, out, engine, cloud, check)
    if right is None:
        raise InputError(
            f"{left}: there is no right image beside it; give it as the second argument"
        )
    pairs = matching.Pairs.find(left, right, camera)
    refuse_among_inputs(Path(out), (left, right), (*pairs.left, *pairs.right))
    if check:
        matching.refuse_unusable_first(pairs)
    if weights is None:
        method = methods.sgbm_method(with_filled_holes=False)
    else:
        method = methods.weights_method(weights, config, with_right=True)
    if tile is not None:
        matching.say_tile_change(pairs, method)
    return matching.match_all(pairs, method, Path(out), with_cloud=cloud)


def _weights_that_match(weights: str | None, matcher: str | None) -> str | None:
    """Name the weights whose matcher matches; None where sgbm does."""
    from depthpose.depth.stereo import is_own_matcher

    if is_own_matcher(matcher):
        return "default" if weights is None else weights
    if weights is not None:
        raise InputError(
            f"--weights {weights} and --matcher {matcher}: one of the two matches the pair; leave "
            "the other away"
        )
    return None if matcher == "sgbm" else matcher


def _match_on_ray(
    left: str,
    right: str | None,
    camera: Path,
    weights: str | None,
    config: MatcherConfig,
    out: str,
    on: EngineOptions,
    cloud: bool,
    check: bool,
) -> int:
    from depthpose.cli.depth import engine as engine_depth

    recipe = engine_depth.NetRecipe(
        weights=None if weights is None else Weights.read(weights),
        config=config,
        with_right=True,
        with_sgbm=False,
    )
    words = [left] if right is None else [left, right]
    return engine_depth.match(words, camera, recipe, out, on, with_cloud=cloud, with_check=check)


def evaluate(
    data: Path,
    out: Path,
    weights: tuple[str, ...] = (),
    matcher: Literal["sgbm"] | None = None,
    predictions: str | None = None,
    baseline: Annotated[tuple[BaselineName, ...], tyro.conf.arg(aliases=("--floor",))] = (),
    train: tuple[Path, ...] = (),
    train_without: tuple[str, ...] = (),
    protocol: str = "eigen-raw",
    cap: tuple[float, ...] = (80.0, 50.0),
    split: str | None = None,
    holes: Literal["fill", "leave"] = "fill",
    device: str = "cpu",
    speed: Speed = "fine",
    precision: Precision = "fp32",
    max_memory: str | None = None,
    engine: Engine = EngineOptions(),  # noqa: B008  frozen
) -> int:
    """Measure depth on a dataset by a named protocol, and write rows, a table and a page.

    Predictions are made once, as files in OUT/predictions/METHOD, and measured from there; a second
    run measures without predicting anew. --predictions measures the files of any other method.
    Several methods may be named at once: their rows share the table. Under torchrun or accelerate
    launch the processes share the frames, and the first one measures.

    Protocols: eigen-raw (one LiDAR scan, depth = LiDAR x, Garg crop: the published one),
    eigen-raw-camera (depth = camera z), eigen-improved (annotated maps, no crop),
    eigen-improved-garg (with the crop), kitti-2015 (disparity: EPE and D1).

    Args:
        data: KITTI raw, object, 2012/2015, Middlebury, or a plain folder of pairs.
        out: folder for rows.json, rows.csv, table.md, report.html and the predictions.
        weights: files or names. Weights with a generator see the left view alone; 'both:NAME' shows
            their matcher the real right view too, 'sgbm:NAME' lets OpenCV match the drawn one, and
            'own:NAME', 'matched:NAME', 'joined:NAME' take the depth of one image from the
            generator, from the matcher on the drawn view, or from both.
        matcher: sgbm measures OpenCV's StereoSGBM on both views, and no weights.
        predictions: measure these files: NAME.disparity_px.npy or NAME.depth_m.npy; or the shards
            that 'depth predict|match --engine ray' left, path or URL.
        baseline: what every method must beat: rows (the best constant depth of each image row) or
            nearest (the depth of the training image that looks most alike), or both.
        train: folders with the frames that a baseline is fitted to.
        train_without: names of frames to keep out of them.
        protocol: how prediction and truth are compared.
        cap: metres beyond which truth does not count; a row each.
        split: eigen-test, eigen-val, eigen-train, eigen-train-val, eigen-benchmark, or a file of
            frames.
        holes: sgbm's pixels without an answer: fill, as KITTI's devkit does, or leave them out
            (then the column 'coverage' says what share was measured).
        device: cpu, cuda, cuda:1, ...
        speed: of matching real pairs, quick or fine; 'quick:NAME' and 'fine:NAME' set it for one.
        precision: fp32 or bf16.
        max_memory: bound on the memory of activations, such as 1GB.
        engine: where --predictions that are shards are measured; the numbers are the same.
    """
    from depthpose.cli.depth import evaluating, methods
    from depthpose.core.engine import is_job
    from depthpose.core.run import claim_folder
    from depthpose.depth.evaluate import find_protocol
    from depthpose.report.tables import table_files

    if not weights and matcher is None and predictions is None and not baseline:
        raise InputError(
            "measure --weights FILE, --matcher sgbm, --predictions DIR or --baseline rows, or "
            "several."
        )
    rule = find_protocol(protocol)
    dataset = evaluating.open_frames(data, split)
    chosen: list[methods.Method] = []
    if matcher == "sgbm":
        chosen.append(methods.sgbm_method(with_filled_holes=holes == "fill"))
    memory = methods.parse_bytes(max_memory)
    config = MatcherConfig(device=device, speed=speed, precision=precision, max_memory_bytes=memory)
    chosen += [methods.named_method(word, config) for word in weights]
    if baseline:
        training = evaluating.open_training(train, train_without)
        chosen += [methods.baseline_method(name, training) for name in dict.fromkeys(baseline)]
    home = out / "predictions"
    files = [*table_files("rows", "frames", "confidence"), "report.html", "predictions"]
    claim_folder(out, {"command": "depth evaluate"}, files)
    folders = [evaluating.predict_all(dataset, method, rule, home) for method in chosen]
    if predictions is not None and is_job(predictions):
        from depthpose.cli.depth.engine import ShardTruth, measure_shards

        truth = ShardTruth(data=str(data.resolve()), split=split, protocol=protocol, caps_m=cap)
        ready = measure_shards(dataset, predictions, truth, out, engine)
        return evaluating.measure(dataset, folders, protocol, cap, out, [ready])
    if engine.is_ray:
        raise InputError("--engine ray measures shards; give them by --predictions")
    folders += [] if predictions is None else [Path(predictions)]
    return evaluating.measure(dataset, folders, protocol, cap, out)
