"""The page of ``depthpose demo``: synthetic parts posed, a street and a real pair matched."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from depthpose.core.camera import Camera, StereoRig, back_project, write_camera
from depthpose.core.draw import draw_depth
from depthpose.core.files import PointCloud, write_cloud, write_depth_png, write_image
from depthpose.core.rigid import Rigid
from depthpose.core.run import claim_folder, describe_environment
from depthpose.depth.config import COLOR_RANGE_M, SGBMConfig, StreetsConfig
from depthpose.depth.disparity import depth_from_disparity
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.metrics import measure
from depthpose.depth.predictions import CLOUD_M, write_estimate
from depthpose.depth.protocols import clamped_depth_from_disparity
from depthpose.depth.synthetic import Streets
from depthpose.depth.types import DepthError, StereoInput, StereoSample, StereoTruth
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.datasets import Instance, open_bop, write_bop_models, write_bop_scene
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
"""Of streets that no weights were trained on."""
_STREET = 1
_CAP_M = 80.0
"""Truth beyond it is not compared."""
_FROM_ONE = "one image"
_FROM_PAIR = "both images"
Nets = Mapping[str, tuple[str, FakestereoNet]]
"""By the method's name: the images that it is given, and its estimator."""

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


def show_depth(out: Path, weights: str | Path) -> tuple[list[dict[str, Any]], list[Section]]:
    """Estimate depth of both scenes; give a row for each method, and the parts of the page."""
    street = Streets(StreetsConfig(seed=_STREETS_SEED))[_STREET]
    street = replace(street, input=replace(street.input, name="street"))
    scenes = [
        (read_motorcycle(), _MOTORCYCLE_TEXT, (1.5, 8.0)),
        (street, _STREET_TEXT, COLOR_RANGE_M),
    ]
    network = FakestereoNet.load(weights)
    rows: list[dict[str, Any]] = []
    sections: list[Section] = []
    for sample, text, range_m in scenes:
        if sample is not None:
            scene_rows, scene_sections = _show_scene(
                out, sample, _make_nets(network, sample), text, range_m
            )
            rows += scene_rows
            sections += scene_sections
    return rows, sections


def _make_nets(network: FakestereoNet, sample: StereoSample) -> Nets:
    """Choose the methods for a scene.

    Depth from one image is only for the street: the generator was trained on streets alone.
    """
    nets: dict[str, tuple[str, FakestereoNet]] = {}
    if network.matcher is not None:
        nets["stereo network"] = (_FROM_PAIR, network)

    # The disparity of the nearest surfaces of both scenes is a tenth of the width, to which the
    # difference of the principal points adds. OpenCV leaves as many columns unmatched as it
    # considers disparities, a multiple of 16.
    rig = sample.input.camera
    assert isinstance(rig, StereoRig)
    nearest_px = sample.input.left.shape[2] / 10 + max(rig.cx_right_minus_left_px, 0.0)
    num_disparities = 16 * math.ceil(nearest_px / 16)
    config = SGBMConfig(num_disparities=num_disparities, with_filled_holes=True)
    sgbm = FakestereoNet.load(matcher="sgbm", config=config)
    nets["SGBM, holes filled"] = (_FROM_PAIR, sgbm)

    if sample.input.name == "street":
        nets["selecting generator"] = (_FROM_ONE, network)
    return nets


def _show_scene(
    out: Path, sample: StereoSample, nets: Nets, text: str, range_m: tuple[float, float]
) -> tuple[list[dict[str, Any]], list[Section]]:
    """Estimate the depth of a scene by each method, and write the pair as files of a command.

    Args:
        out: folder of the demo.
        sample: pair and truth.
        nets: the methods; the first is shown above the others.
        text: of the scene.
        range_m: depth of the brightest and of the darkest colour.

    Returns:
        A row for each method, and the sections of the page.
    """
    # The pair, as files.
    pair = sample.input
    truth = sample.truth
    folder = out / pair.name
    assert pair.right is not None
    assert isinstance(pair.camera, StereoRig)
    assert truth.depth_m is not None
    assert truth.disparity_px is not None
    write_image(folder / "left.png", pair.left)
    write_image(folder / "right.png", pair.right)
    write_camera(folder / "camera.json", pair.camera)
    write_image(folder / "depth.color.png", draw_depth(truth.depth_m, *range_m))

    # The depth of each method.
    rows: list[dict[str, Any]] = []
    sections: list[Section] = []
    homes = {method: out / method.lower().replace(",", "").replace(" ", "-") for method in nets}
    for method, (views, net) in nets.items():
        net_input = pair if views == _FROM_PAIR else replace(pair, right=None)
        estimate = net.estimate_input(net_input, with_check=False)
        write_estimate(homes[method], net_input, estimate, range_m, CLOUD_M)

        # The numbers, over pixels that have a truth within the cap and an answer.
        predicted_m = clamped_depth_from_disparity(estimate.disparity_px, pair.camera, _CAP_M)
        is_measured = truth.depth_m < _CAP_M
        mask = is_measured & torch.isfinite(estimate.disparity_px)
        row: dict[str, Any] = {"scene": pair.name, "method": method, "input": views}
        row["coverage"] = float(mask.sum() / is_measured.sum())
        row |= measure("disparity", estimate.disparity_px[mask], truth.disparity_px[mask])
        row |= measure("depth", predicted_m[mask], truth.depth_m[mask])
        rows.append(row)

        # Its part of the page.
        error_px = (estimate.disparity_px - truth.disparity_px).abs()
        error = DepthError(error=error_px, is_disparity=True)
        title = f"{pair.name}: {method}, {views}"
        section = make_depth_section(
            title, net_input, estimate, range_m=range_m, error=error, with_image=False
        )
        sections.append(section)

    # Above them the pair, the first method's depth and the truth.
    first_method = next(iter(nets))
    estimated_picture = homes[first_method] / f"{pair.name}.color.png"
    true_picture = folder / "depth.color.png"
    color_bar = make_depth_color_bar(*range_m)
    pictures = [
        PictureFile(path=folder / "left.png", caption="left image"),
        PictureFile(path=folder / "right.png", caption="right image"),
        PictureFile(
            path=estimated_picture, caption=f"depth from both: {first_method}", color_bar=color_bar
        ),
        PictureFile(path=true_picture, caption="true depth; grey: none", color_bar=color_bar),
    ]
    opening = Section(title=f"The {pair.name}", text=text, rows=rows, pictures=pictures)
    return rows, [opening, *sections]


def read_motorcycle() -> StereoSample | None:
    """Read the pair with its true disparity, or None where scikit-image is not installed."""
    # Images a quarter of the original size; calibration by scikit-image's documentation.
    try:
        from skimage.data import stereo_motorcycle
    except ImportError:
        return None

    # The camera.
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
    truth = StereoTruth(disparity_px=disparity_px, depth_m=depth_from_disparity(disparity_px, rig))
    left_view = torch.from_numpy(np.array(left)).permute(2, 0, 1).float() / 255
    right_view = torch.from_numpy(np.array(right)).permute(2, 0, 1).float() / 255
    pair = StereoInput(name="motorcycle", left=left_view, right=right_view, camera=rig)
    return StereoSample(input=pair, truth=truth)


_FRAMES_SEED = 9
"""Of frames that no weights were trained on."""
_FRAME = 1
"""The first that shows every part whole."""
_SAMPLE = "flange"
"""The part whose depth image, mask and camera get a folder of their own, for a first command."""
_UNIT_M = 0.0001
"""Of that depth image."""
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
    """Pose the parts of a synthetic frame; give a row for each, and the section of the page.

    The frame is written as a data set, one of its parts as files of a first command.
    """
    # A frame that shows each part once.
    net = GeoPoseNet.load(weights)
    models = {model.number: model for model in net.weights.models}
    count = len(models)
    config = ObjectsConfig(
        seed=_FRAMES_SEED, distance_m=(0.6, 0.9), frame_objects=(count, count), frame_clutter=(2, 2)
    )
    frame = next(make_frames(tuple(models.values()), config, 1, first=_FRAME))
    assert frame.rgb is not None

    # As a data set, and one part as files.
    write_bop_models(out / "parts", net.weights.models)
    write_bop_scene(out / "parts", "test", 0, [frame])
    dataset = open_bop(out / "parts")
    views = [dataset.view(instance).input for instance in dataset.instances]
    _write_sample(next(view for view in views if view.object == _SAMPLE), out / "part")

    # The poses of all parts, and their errors. The first call prepares the models, so that the
    # times are those of further estimates.
    net.estimate_many(views)
    estimates = net.estimate_many(views)
    predictions = [
        Prediction(estimate=estimate, place=place_of(instance))
        for estimate, instance in zip(estimates, dataset.instances, strict=True)
    ]
    folder = out / "geo-posenet"
    write_predictions(folder, predictions)

    # What the page says of each part; the error is that of the nearest copy.
    nearest = [
        replace(prediction, estimate=_choose_nearest_copy(prediction.estimate, instance, models))
        for prediction, instance in zip(predictions, dataset.instances, strict=True)
    ]
    copies = {estimate.object: len(_list_named_copies(estimate)) for estimate in estimates}
    measured = [row.columns() for row in evaluate(dataset, nearest).per_instance]
    rows = [_select_columns({**row, "copies": copies[row["object"]]}) for row in measured]

    # The sensor's cloud.
    points_m = back_project(frame.depth_m, frame.K).reshape(-1, 3)
    has_reading = points_m.isfinite().all(-1) & (points_m[:, 2] > 0)
    color = frame.rgb.permute(1, 2, 0).reshape(-1, 3)[has_reading]
    table = PointCloud(points=points_m[has_reading].float(), color=color)

    # The poses over it, and over the picture.
    picture = frame.rgb
    layers = [Layer(name="table, as the sensor sees it", shape=table)]
    for view, estimate, instance in zip(views, estimates, dataset.instances, strict=True):
        model = models[instance.object_id]
        K = instance.K.double()
        pose = estimate.camera_from_model
        if pose is not None:
            picture = draw_pose(picture, pose, model, K)
            cloud = join_posed_cloud(select_object_points(view, model.diameter_m), pose, model)
            write_cloud(folder / f"{view.object}.{CLOUD}", cloud)
            layers += make_pose_layers(pose, model)
        picture = draw_pose(picture, None, model, K, truth=instance.camera_from_model)
        layers += make_truth_layers(instance.camera_from_model, model)

    # The section of the page.
    write_image(folder / "poses.png", picture)
    write_image(folder / "depth.grey.png", draw_grey_depth(frame.depth_m))
    pictures = [
        PictureFile(path=folder / "depth.grey.png", caption="depth image, near bright"),
        PictureFile(path=folder / "poses.png", caption="poses, estimated and true"),
    ]
    scenes = [Scene(caption="The sensor's cloud with the posed parts in it", layers=layers)]
    title = "Parts on a table"
    return rows, [Section(title=title, text=_TEXT, rows=rows, pictures=pictures, scenes=scenes)]


def _write_sample(view: ViewInput, folder: Path) -> None:
    """Write depth image, mask and camera of a view as files that ``pose predict`` takes."""
    height, width = view.mask.shape
    camera = Camera(width=width, height=height, K=view.K.double(), depth_unit_m=_UNIT_M)
    write_camera(folder / "camera.json", camera)
    write_depth_png(folder / "depth.png", view.depth_m, _UNIT_M)
    write_mask(folder / "mask.png", view.mask)


def _list_named_copies(estimate: PoseEstimate) -> list[Rigid]:
    """List the near-symmetric copies that an estimate names beside its pose."""
    return [other.camera_from_model for other in estimate.alternatives if other.is_copy]


def _choose_nearest_copy(
    estimate: PoseEstimate, instance: Instance, models: Mapping[int, ObjectModel]
) -> PoseEstimate:
    """Choose the nearest to the truth of an estimate's pose and that pose's copies."""
    if estimate.camera_from_model is None:
        return estimate
    points_m = models[instance.object_id].vertices_m
    poses = [estimate.camera_from_model, *_list_named_copies(estimate)]
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

    page: Path  #: its file
    depths: list[dict[str, Any]]  #: one for each scene and method
    poses: list[dict[str, Any]]  #: one for each part


def make_demo(
    out: Path,
    weights: str | Path = "default",
    parts: str | Path = "parts",
    on_message: Callable[[str], None] | None = None,
) -> DemoResult:
    """Pose synthetic parts on a table; estimate depth of a real pair and a synthetic street.

    Args:
        out: folder for the page, tables, pictures and poses.
        weights: of the depth networks.
        parts: weights of a pose network for the parts.
        on_message: called with what is done next.
    """
    # Both parts of the demo.
    files = [*_RESULT_FOLDERS, *pages.list_table_files("depths", "poses"), _PAGE]
    claim_folder(out, {"command": "demo"}, files)
    on_message = on_message or (lambda _: None)
    on_message("synthetic parts on a table are posed from a depth image ...")
    poses, pose_sections = show_poses(out, parts)
    on_message("depth of a real pair and of a synthetic street ...")
    depths, depth_sections = show_depth(out, weights)

    # Their tables and the page.
    pages.write_table(out, depths, name="depths")
    pages.write_table(out, poses, name="poses")
    page = out / _PAGE
    title = "depthpose: a depth sensor to poses, images to metric depth"
    pages.write_page(page, title, [*pose_sections, *depth_sections], describe_environment())
    return DemoResult(page, depths, poses)
