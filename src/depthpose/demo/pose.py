"""Poses in the demo: synthetic parts on a table, posed from a depth image and masks."""

from pathlib import Path
from typing import Any

from depthpose.core.camera import Camera, back_project, write_camera
from depthpose.core.files import Cloud, write_cloud, write_depth_png, write_image
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.datasets import open_bop, write_bop_models, write_bop_scene
from depthpose.pose.datasets.write import write_mask
from depthpose.pose.estimator import GeoPoseNet
from depthpose.pose.evaluate import evaluate
from depthpose.pose.predictions import CLOUD, Prediction, place_of, write_predictions
from depthpose.pose.synthetic import make_frames
from depthpose.report.overlay import draw_pose, grey_depth, pose_layers, posed_cloud
from depthpose.report.scene import Layer, Scene
from depthpose.report.tables import Picture, Section

_FRAMES_SEED = 9
"""No weights were trained on frames of this seed."""

_FRAME = 1
"""The first that shows every part whole."""

_SAMPLE = "flange"
"""Whose depth image, mask and camera lie in a folder of their own, for a first command."""

_UNIT_M = 0.0001
_COLUMNS = ("object", "visible_fraction", "status", "metric", "error_mm", "of_diameter",
            "rotation_deg", "translation_mm", "ms_network", "ms_total", "reason")  # fmt: skip
_TEXT = (
    "Five synthetic parts on a table, with the noise and the shadows of a structured-light sensor. "
    "The network was trained on synthetic views of these parts alone; the masks are given. Blue: "
    "the estimated pose, as box and silhouette; green and dashed: the box of the truth. An "
    "estimate is right below a tenth of the diameter (ADD, or ADD-S where a part is symmetric); "
    "an uncertain one is refused with a reason. error_mm is that error, of_diameter its share of "
    "the diameter, visible_fraction the share of a part's pixels that nothing hides; ms_network "
    "and ms_total are the milliseconds of the network and of the whole estimate."
)


def show_poses(out: Path, weights: str | Path) -> tuple[list[dict[str, Any]], list[Section]]:
    """Pose the parts of a synthetic frame; give a row for each, and the sections of the page."""
    net = GeoPoseNet.load(weights)
    models = {model.number: model for model in net.weights.models}
    count = len(models)
    config = ObjectsConfig(
        seed=_FRAMES_SEED, distance_m=(0.6, 0.9), frame_objects=(count, count), frame_clutter=(2, 2)
    )
    frame = next(make_frames(tuple(models.values()), config, 1, first=_FRAME))
    assert frame.rgb is not None
    write_bop_models(out / "parts", net.weights.models)
    write_bop_scene(out / "parts", "test", 0, [frame])
    dataset = open_bop(out / "parts", cloud=net.weights.cloud)
    views = [dataset.view(instance).input for instance in dataset.instances]
    sample = next(view for view in views if view.object == _SAMPLE)
    height, width = sample.mask.shape
    camera = Camera(width=width, height=height, K=sample.K.double(), depth_unit_m=_UNIT_M)
    write_camera(out / "part/camera.json", camera)
    write_depth_png(out / "part/depth.png", sample.depth_m, _UNIT_M)
    write_mask(out / "part/mask.png", sample.mask)
    net.estimate_many(views)  # prepares the models: times below are those of further estimates
    estimates = net.estimate_many(views)
    predictions = [
        Prediction(estimate=estimate, place=place_of(instance))
        for estimate, instance in zip(estimates, dataset.instances, strict=True)
    ]
    folder = out / "geo-posenet"
    write_predictions(folder, predictions)
    rows = [_row(row.columns()) for row in evaluate(dataset, predictions).per_instance]
    points_m = back_project(frame.depth_m, frame.K).reshape(-1, 3)
    is_seen = points_m.isfinite().all(-1) & (points_m[:, 2] > 0)
    color = frame.rgb.permute(1, 2, 0).reshape(-1, 3)[is_seen]
    table = Cloud(points=points_m[is_seen].float(), color=color)
    picture, layers = frame.rgb, [Layer(name="table, as the sensor sees it", shape=table)]
    for view, estimate, instance in zip(views, estimates, dataset.instances, strict=True):
        model, K = models[instance.object_id], instance.K.double()
        if (pose := estimate.camera_from_model) is not None:
            picture = draw_pose(picture, pose, model, K)
            cloud = posed_cloud(dataset.sample(instance).input.points_m, pose, model)
            write_cloud(folder / f"{view.object}.{CLOUD}", cloud)
            layers += pose_layers(pose, model)
        picture = draw_pose(picture, instance.camera_from_model, model, K, is_true=True)
        layers += pose_layers(instance.camera_from_model, model, is_true=True)
    write_image(folder / "poses.png", picture)
    write_image(folder / "depth.grey.png", grey_depth(frame.depth_m))
    pictures = [
        Picture(path=folder / "depth.grey.png", caption="depth image, near bright"),
        Picture(path=folder / "poses.png", caption="poses, estimated and true"),
    ]
    scenes = [Scene(caption="The sensor's cloud with the posed parts in it", layers=layers)]
    title = "Parts on a table"
    return rows, [Section(title=title, text=_TEXT, rows=rows, pictures=pictures, scenes=scenes)]


def _row(measured: dict[str, Any]) -> dict[str, Any]:
    """The columns that a newcomer reads, in units that parts have."""
    error_m, moved_m = measured["error_m"], measured["translation_m"]
    row = measured | {
        "error_mm": None if error_m is None else 1000 * error_m,
        "of_diameter": None if error_m is None else error_m / measured["diameter_m"],
        "translation_mm": None if moved_m is None else 1000 * moved_m,
        "ms_network": round(measured["ms_network"]),
        "ms_total": round(measured["ms_total"]),
    }
    return {name: row[name] for name in _COLUMNS}
