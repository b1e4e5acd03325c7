"""The page of ``depthpose demo``: synthetic parts posed, a street and a real pair matched."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import Camera, StereoRig, back_project, write_camera
from depthpose.core.draw import draw_depth
from depthpose.core.environment import describe_environment
from depthpose.core.errors import InputError
from depthpose.core.files import PointCloud, write_cloud, write_depth_png, write_image
from depthpose.core.rigid import Rigid
from depthpose.core.run_folder import claim_folder
from depthpose.depth.config import COLOR_RANGE_M, SGBMConfig, StreetsConfig
from depthpose.depth.disparity import depth_from_disparity
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.metrics import measure
from depthpose.depth.predictions import CLOUD_M, OutputOptions, write_estimate
from depthpose.depth.protocols import clamped_depth_from_disparity
from depthpose.depth.stereo import SGBMMatcher
from depthpose.depth.synthetic import Streets
from depthpose.depth.types import DepthEstimate, DepthInput, DepthSample, DepthTruth, ErrorMaps
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.datasets import (
    BopDataset,
    BopFrame,
    Instance,
    open_bop,
    write_bop_models,
    write_bop_scene,
)
from depthpose.pose.datasets.dataset import write_mask
from depthpose.pose.evaluate import evaluate
from depthpose.pose.metrics import add_m
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.predictions import CLOUD, Prediction, place_of, write_predictions
from depthpose.pose.synthetic import make_frames
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.report import page as pages
from depthpose.report.depth import make_depth_section
from depthpose.report.page import Layer, PictureFile, Scene, Section, make_depth_color_bar
from depthpose.report.pose import (
    draw_grey_depth,
    draw_pose,
    join_posed_cloud,
    make_pose_layers,
    make_truth_layers,
    select_object_points,
)

_STREETS_SEED = 9
"""Seed of streets that no weights were trained on."""
_STREET = 1
"""Number of the street that is shown."""
_CAP_M = 80.0
"""Truth beyond it is not compared."""
_FROM_ONE = "one image"
_FROM_PAIR = "both images"
_MAX_DISPARITY_SHARE = 0.1
"""Disparity of the nearest surfaces of both scenes, as a share of the width."""
_SGBM_STEP_PX = 16
"""OpenCV's matcher searches a multiple of so many disparities."""

_STREET_TEXT = (
    "A synthetic street of a seed that no training used; its depth is known exactly. Distances "
    "from 3 m (bright) to 80 m (dark); the sky is grey. Measured over all pixels nearer than 80 m, "
    "occluded ones too. Depth from one image is an estimate from what streets usually look like: "
    "good for road, cars and house fronts at a usual camera's height, too near far away."
)
_MOTORCYCLE_TEXT = (
    "A real pair: Motorcycle of the Middlebury 2014 benchmark (Scharstein et al., GCPR 2014), as "
    "scikit-image ships it. Distances from 1.5 m to 8 m. The shipped matcher was trained on "
    "synthetic scenes alone."
)
_MOTORCYCLE_RANGE_M = (1.5, 8.0)


class _DepthScene(NamedTuple):
    """A pair with its truth, what the page says of it, and the depths of its colours."""

    sample: DepthSample
    text: str
    range_m: tuple[float, float]  #: depth of the brightest and of the darkest colour


class _DepthMethod(NamedTuple):
    """An estimator of depth, its name, and the images that it is given."""

    name: str
    views: str  #: ``_FROM_ONE`` or ``_FROM_PAIR``
    net: FakestereoNet


def show_depth(out: Path, weights: str | Path) -> tuple[list[dict[str, Any]], list[Section]]:
    """Estimate depth of both scenes, and write them as files.

    Args:
        out: folder of the demo.
        weights: weights of the depth networks, by name or file.

    Returns:
        A row for each scene and method, and the sections of the page.
    """
    street = Streets(StreetsConfig(seed=_STREETS_SEED))[_STREET]
    street = replace(street, input=replace(street.input, name="street"))
    scenes = [_DepthScene(street, _STREET_TEXT, COLOR_RANGE_M)]
    motorcycle = read_motorcycle()
    if motorcycle is not None:
        scenes.insert(0, _DepthScene(motorcycle, _MOTORCYCLE_TEXT, _MOTORCYCLE_RANGE_M))

    network = FakestereoNet.load(weights, with_check=False)
    rows: list[dict[str, Any]] = []
    sections: list[Section] = []
    for scene in scenes:
        methods = _choose_methods(network, scene.sample)
        scene_rows, scene_sections = _show_scene(out, scene, methods)
        rows += scene_rows
        sections += scene_sections
    return rows, sections


def _choose_methods(network: FakestereoNet, sample: DepthSample) -> list[_DepthMethod]:
    """Choose the methods for a scene: the networks, and OpenCV's matcher.

    Depth from one image is only for the street: the generator was trained on streets alone.
    """
    methods: list[_DepthMethod] = []
    if network.matcher is not None:
        methods.append(_DepthMethod("stereo network", _FROM_PAIR, network))

    # The difference of the principal points adds to disparities. OpenCV leaves as many columns
    # unmatched as it considers disparities, so it considers no more than there are.
    rig = sample.input.camera
    assert isinstance(rig, StereoRig)
    width = sample.input.left.shape[2]
    nearest_px = width * _MAX_DISPARITY_SHARE + max(rig.cx_right_minus_left_px, 0.0)
    num_disparities = _SGBM_STEP_PX * math.ceil(nearest_px / _SGBM_STEP_PX)
    config = SGBMConfig(num_disparities=num_disparities, with_filled_holes=True)
    sgbm = FakestereoNet(SGBMMatcher(config), with_check=False)
    methods.append(_DepthMethod("SGBM, holes filled", _FROM_PAIR, sgbm))

    if sample.input.name == "street":
        methods.append(_DepthMethod("selecting generator", _FROM_ONE, network))
    return methods


def _show_scene(
    out: Path, scene: _DepthScene, methods: Sequence[_DepthMethod]
) -> tuple[list[dict[str, Any]], list[Section]]:
    """Estimate the depth of a scene by each method, write it as files, and make its sections.

    The pair is written too, as files that ``depth match`` takes.

    Args:
        out: folder of the demo.
        scene: pair and truth.
        methods: the methods; the first, of both images, is shown beside the truth.

    Returns:
        A row for each method, and the sections of the page.
    """
    pair = scene.sample.input
    truth = scene.sample.truth
    range_m = scene.range_m
    assert pair.right is not None
    assert isinstance(pair.camera, StereoRig)
    assert truth.depth_m is not None
    assert truth.disparity_px is not None

    # The pair, as files.
    folder = out / pair.name
    write_image(folder / "left.png", pair.left)
    write_image(folder / "right.png", pair.right)
    write_camera(folder / "camera.json", pair.camera)
    write_image(folder / "depth.color.png", draw_depth(truth.depth_m, *range_m))

    # The depth of each method.
    rows: list[dict[str, Any]] = []
    sections: list[Section] = []
    for method in methods:
        net_input = pair if method.views == _FROM_PAIR else replace(pair, right=None)
        estimate = method.net.estimate_input(net_input)
        options = OutputOptions(range_m=range_m, cloud_m=CLOUD_M)
        write_estimate(_name_folder(out, method), estimate, options)
        origin = {"scene": pair.name, "method": method.name, "input": method.views}
        rows.append(origin | _measure_depth(estimate, scene.sample))

        # Its part of the page.
        error_px = (estimate.disparity_px - truth.disparity_px).abs()
        error = ErrorMaps(error=error_px, is_disparity=True)
        title = f"{pair.name}: {method.name}, {method.views}"
        section = make_depth_section(
            title, estimate, range_m=range_m, error=error, with_image=False
        )
        sections.append(section)

    # Above them the pair, the first method's depth and the truth.
    first_method = methods[0]
    estimated_picture = _name_folder(out, first_method) / f"{pair.name}.color.png"
    true_picture = folder / "depth.color.png"
    color_bar = make_depth_color_bar(*range_m)
    pictures = [
        PictureFile(path=folder / "left.png", caption="left image"),
        PictureFile(path=folder / "right.png", caption="right image"),
        PictureFile(
            path=estimated_picture,
            caption=f"depth from both: {first_method.name}",
            color_bar=color_bar,
        ),
        PictureFile(path=true_picture, caption="true depth; grey: none", color_bar=color_bar),
    ]
    opening = Section(title=f"The {pair.name}", text=scene.text, rows=rows, pictures=pictures)
    return rows, [opening, *sections]


def _name_folder(out: Path, method: _DepthMethod) -> Path:
    """Name the folder of a method's files, below that of the demo."""
    return out / method.name.lower().replace(",", "").replace(" ", "-")


def _measure_depth(estimate: DepthEstimate, sample: DepthSample) -> dict[str, float]:
    """Measure disparity and depth, over pixels with an estimate and a truth nearer than the cap.

    Returns the metrics by name; ``coverage`` is the share of the pixels with such a truth that have
    an estimate.
    """
    truth = sample.truth
    rig = sample.input.camera
    assert isinstance(rig, StereoRig)
    assert truth.depth_m is not None
    assert truth.disparity_px is not None
    predicted_m = clamped_depth_from_disparity(estimate.disparity_px, rig, _CAP_M)
    has_truth = truth.depth_m < _CAP_M
    mask = has_truth & torch.isfinite(estimate.disparity_px)
    row = {"coverage": float(mask.sum() / has_truth.sum())}
    row |= measure("disparity", estimate.disparity_px[mask], truth.disparity_px[mask])
    row |= measure("depth", predicted_m[mask], truth.depth_m[mask])
    return row


def read_motorcycle() -> DepthSample | None:
    """Read the pair Motorcycle with its true disparity, as scikit-image ships it.

    None where scikit-image is not installed.
    """
    try:
        from skimage.data import stereo_motorcycle
    except ImportError:
        return None

    # The camera, of images of a quarter of the original size, by scikit-image's documentation.
    left, right, disparity = stereo_motorcycle()
    K = torch.tensor([[994.978, 0, 311.193], [0, 994.978, 254.877], [0, 0, 1]], dtype=torch.float64)
    rig = StereoRig(
        width=left.shape[1],
        height=left.shape[0],
        K=K,
        baseline_m=0.193001,
        cx_right_minus_left_px=31.086,
    )

    # Truth and views.
    disparity_px = torch.from_numpy(np.array(disparity, np.float32))
    disparity_px[~torch.isfinite(disparity_px)] = torch.nan
    truth = DepthTruth(disparity_px=disparity_px, depth_m=depth_from_disparity(disparity_px, rig))
    left_view = torch.from_numpy(np.array(left)).permute(2, 0, 1).float() / 255
    right_view = torch.from_numpy(np.array(right)).permute(2, 0, 1).float() / 255
    pair = DepthInput(name="motorcycle", left=left_view, right=right_view, camera=rig)
    return DepthSample(input=pair, truth=truth)


_FRAMES_SEED = 9
"""Seed of frames that no weights were trained on."""
_FRAME = 1
"""Number of the first frame that shows every part whole."""
_SAMPLE = "flange"
"""The part whose depth image, mask and camera get a folder of their own, for a first command."""
_UNIT_M = 0.0001
"""Unit of that depth image."""
_COLUMNS = ("object", "visible_fraction", "status", "copies", "metric", "error_mm", "of_diameter",
            "rotation_deg", "translation_mm", "ms_network", "ms_total", "reason")  # fmt: skip
_TEXT = (
    "Five synthetic parts on a table, with the noise and the shadows of a structured-light sensor. "
    "The network was trained on synthetic views of these parts alone; the masks are given. Blue: "
    "the estimated pose, as box and silhouette; green and dashed: the box of the truth. An "
    "estimate is right below a tenth of the diameter; an uncertain one is refused with a reason. "
    "Where near-symmetric copies fit as well, as of a mug whose handle is hidden, they are named, "
    "and the error is that of the nearest."
)


def show_poses(out: Path, weights: str | Path) -> tuple[list[dict[str, Any]], list[Section]]:
    """Pose the parts of a synthetic frame, which is written as a dataset.

    One of its parts is written as files of a first command.

    Args:
        out: folder of the demo.
        weights: weights of a pose network of the parts, by name or file.

    Returns:
        A row for each part, and the section of the page.
    """
    # A frame that shows each part once, and two other things, from 0.6 to 0.9 m away.
    net = GeoPoseNet.load(weights)
    if _SAMPLE not in net.objects:
        raise InputError(
            f"--pose-weights {weights}: the demo shows {_SAMPLE!r} among other parts, and these "
            f"weights know {', '.join(net.objects)}; take parts"
        )
    models = {model.number: model for model in net.weights.models}
    count = len(models)
    config = ObjectsConfig(
        seed=_FRAMES_SEED, distance_m=(0.6, 0.9), frame_objects=(count, count), frame_clutter=(2, 2)
    )
    frame = next(make_frames(tuple(models.values()), config, 1, first=_FRAME))

    # As a dataset, and one part as files.
    write_bop_models(out / "parts", net.weights.models)
    write_bop_scene(out / "parts", "test", 0, [frame])
    dataset = open_bop(out / "parts")
    views = [dataset.view(instance).input for instance in dataset.instances]
    _write_sample(next(view for view in views if view.object == _SAMPLE), out / "part")

    # The poses of all parts. The first call prepares the models, so that the times are those of
    # further estimates.
    net.estimate_many(views)
    estimates = net.estimate_many(views)
    predictions = [
        Prediction(estimate=estimate, place=place_of(instance))
        for estimate, instance in zip(estimates, dataset.instances, strict=True)
    ]
    folder = out / "geo-posenet"
    write_predictions(folder, predictions)

    for view, estimate, instance in zip(views, estimates, dataset.instances, strict=True):
        pose = estimate.camera_from_model
        if pose is not None:
            model = models[instance.object_id]
            cloud = join_posed_cloud(select_object_points(view, model.diameter_m), pose, model)
            write_cloud(folder / f"{view.object}.{CLOUD}", cloud)

    # The section of the page: numbers, pictures and a scene.
    rows = _measure_poses(predictions, dataset, models)
    write_image(folder / "depth.grey.png", draw_grey_depth(frame.depth_m))
    picture, scene = _draw_poses(frame, dataset.instances, estimates, models)
    write_image(folder / "poses.png", picture)
    pictures = [
        PictureFile(path=folder / "depth.grey.png", caption="depth image, near bright"),
        PictureFile(path=folder / "poses.png", caption="poses, estimated and true"),
    ]
    title = "Parts on a table"
    return rows, [Section(title=title, text=_TEXT, rows=rows, pictures=pictures, scenes=[scene])]


def _draw_poses(
    frame: BopFrame,
    instances: Sequence[Instance],
    estimates: Sequence[PoseEstimate],
    models: Mapping[int, ObjectModel],
) -> tuple[Float[Tensor, "3 h w"], Scene]:
    """Draw estimated and true poses over the picture of a frame, and in the sensor's cloud.

    Args:
        frame: picture and depth.
        instances: the parts with their true poses.
        estimates: the estimate of each part.
        models: models of the parts, by their numbers.
    """
    assert frame.rgb is not None
    picture = frame.rgb
    sensor_cloud = _make_sensor_cloud(frame.depth_m, frame.rgb, frame.K)
    layers = [Layer(name="table, as the sensor sees it", shape=sensor_cloud)]
    for estimate, instance in zip(estimates, instances, strict=True):
        model = models[instance.object_id]
        K = instance.K.double()
        pose = estimate.camera_from_model
        if pose is not None:
            picture = draw_pose(picture, pose, model, K)
            layers += make_pose_layers(pose, model)
        picture = draw_pose(picture, None, model, K, truth=instance.camera_from_model)
        layers += make_truth_layers(instance.camera_from_model, model)
    return picture, Scene(caption="The sensor's cloud with the posed parts in it", layers=layers)


def _measure_poses(
    predictions: Sequence[Prediction], dataset: BopDataset, models: Mapping[int, ObjectModel]
) -> list[dict[str, Any]]:
    """Measure the pose of each part, or of the copy that is nearest to the truth, for the page."""
    nearest = [
        replace(prediction, estimate=_choose_nearest_copy(prediction.estimate, instance, models))
        for prediction, instance in zip(predictions, dataset.instances, strict=True)
    ]
    copy_counts = {
        prediction.estimate.object: len(_list_copies(prediction.estimate))
        for prediction in predictions
    }
    rows: list[dict[str, Any]] = []
    for instance_row in evaluate(dataset, nearest).per_instance:
        columns = instance_row.columns()
        columns["copies"] = copy_counts[columns["object"]]
        rows.append(_select_columns(columns))
    return rows


def _make_sensor_cloud(
    depth_m: Float[Tensor, "h w"], rgb: Float[Tensor, "3 h w"], K: Float[Tensor, "3 3"]
) -> PointCloud:
    """Make the coloured cloud of a depth image."""
    points_m = back_project(depth_m, K).reshape(-1, 3)
    has_reading = points_m.isfinite().all(-1) & (points_m[:, 2] > 0)
    color = rgb.permute(1, 2, 0).reshape(-1, 3)[has_reading]
    return PointCloud(points=points_m[has_reading].float(), color=color)


def _write_sample(view: ViewInput, folder: Path) -> None:
    """Write depth image, mask and camera of a view as files that ``pose predict`` takes."""
    height, width = view.mask.shape
    camera = Camera(width=width, height=height, K=view.K.double(), depth_unit_m=_UNIT_M)
    write_camera(folder / "camera.json", camera)
    write_depth_png(folder / "depth.png", view.depth_m, _UNIT_M)
    write_mask(folder / "mask.png", view.mask)


def _list_copies(estimate: PoseEstimate) -> list[Rigid]:
    """List the near-symmetric copies that an estimate names beside its pose."""
    return [other.camera_from_model for other in estimate.alternatives if other.is_copy]


def _choose_nearest_copy(
    estimate: PoseEstimate, instance: Instance, models: Mapping[int, ObjectModel]
) -> PoseEstimate:
    """Return an estimate with the pose nearest to the truth: its own, or that of one of its copies.

    ``models``: by their numbers.
    """
    if estimate.camera_from_model is None:
        return estimate
    points_m = models[instance.object_id].vertices_m
    poses = [estimate.camera_from_model, *_list_copies(estimate)]
    nearest = min(poses, key=lambda pose: float(add_m(pose, instance.camera_from_model, points_m)))
    return replace(estimate, camera_from_model=nearest)


def _select_columns(measured: dict[str, Any]) -> dict[str, Any]:
    """Select the columns of an instance that the page shows, lengths in millimetres."""
    error_m = measured["error_m"]
    translation_m = measured["translation_m"]
    row = measured | {
        "error_mm": None if error_m is None else 1000 * error_m,
        "of_diameter": None if error_m is None else error_m / measured["diameter_m"],
        "translation_mm": None if translation_m is None else 1000 * translation_m,
        "ms_network": round(measured["ms_network"]),
        "ms_total": round(measured["ms_total"]),
    }
    return {name: row[name] for name in _COLUMNS}


_PAGE = "report.html"
_RESULT_FOLDERS = (
    "street", "motorcycle", "selecting-generator", "stereo-network", "sgbm-holes-filled",
    "part", "parts", "geo-posenet",
)  # fmt: skip


@dataclass(frozen=True)
class DemoResult:
    """The page of a demo, and the rows on it."""

    page: Path  #: file of the page
    depths: list[dict[str, Any]]  #: a row for each scene and method
    poses: list[dict[str, Any]]  #: a row for each part


def make_demo(
    out: Path,
    weights: str | Path = "default",
    parts: str | Path = "parts",
    on_message: Callable[[str], None] | None = None,
) -> DemoResult:
    """Pose synthetic parts, estimate depth of a real pair and a street, and write a page.

    Args:
        out: folder for the page, tables, pictures and poses.
        weights: weights of the depth networks, by name or file.
        parts: weights of a pose network for the parts, by name or file.
        on_message: called with what is done next.
    """
    # Poses, then depth.
    files = [*_RESULT_FOLDERS, *pages.list_table_files("depths", "poses"), _PAGE]
    claim_folder(out, {"command": "demo"}, files)
    on_message = on_message or (lambda _: None)
    on_message("synthetic parts on a table are posed from a depth image ...")
    poses, pose_sections = show_poses(out, parts)
    on_message("depth of a real pair and of a synthetic street ...")
    depths, depth_sections = show_depth(out, weights)

    # The tables and the page.
    pages.write_table(out, depths, name="depths")
    pages.write_table(out, poses, name="poses")
    page = out / _PAGE
    title = "depthpose: a depth sensor to poses, images to metric depth"
    pages.write_page(page, title, [*pose_sections, *depth_sections], describe_environment())
    return DemoResult(page, depths, poses)
