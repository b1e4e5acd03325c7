"""The tab Pose: a depth image or cloud of a known object to its pose, or why there is none."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

from depthpose.core import files
from depthpose.core.camera import Camera, write_camera
from depthpose.core.errors import InputError, refuse_unknown
from depthpose.core.units import METRES, Unit
from depthpose.pose import mesh
from depthpose.pose.background import add_background
from depthpose.pose.config import EstimateConfig, ObjectsConfig
from depthpose.pose.datasets import Detection, mask_view, parse_box
from depthpose.pose.datasets.dataset import write_mask
from depthpose.pose.inliers import view_inliers
from depthpose.pose.inputs import cloud_input, view_input
from depthpose.pose.network_pose import GeoPoseNet, VotingDirections
from depthpose.pose.predictions import CLOUD, PICTURE, Prediction, write_predictions
from depthpose.pose.registration import Registration
from depthpose.pose.synthetic import make_frames
from depthpose.pose.types import CloudInput, ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.verify.decide import with_status
from depthpose.report import pose as report
from depthpose.report.page import Layer, Scene
from depthpose.report.pose import select_object_points
from depthpose.web.answer import (
    EXAMPLE_SEED,
    Answer,
    Form,
    ShownPicture,
    encode_example,
    refuse_large,
)

CAD_FILE = "cad"
"""Value of the field ``object`` that means the CAD file."""
_MAX_SHAPE_DIFFERENCE = 0.02
"""Largest difference [diameters] of size and surface of a CAD file and the weights' own object."""
_SURFACE_POINTS = 500
"""Number of points of a CAD file whose distance to that object is measured."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Target:
    """The object of a form, and its estimator."""

    model: ObjectModel
    net: GeoPoseNet | Registration
    method: str  #: the estimator, in words for the page


@dataclass(frozen=True, kw_only=True, eq=False)
class _ShownPose:
    """An estimate that the page shows, and its input."""

    input: CloudInput | ViewInput  #: of a searched image, with the mask of the pixels it explains
    estimate: PoseEstimate


def answer_pose(form: Form, net: GeoPoseNet) -> Answer:
    """Estimate poses for a form: what the page shows, with files to download.

    Raises:
        InputError: a field or file is missing, wrong or too large.
    """
    target = _find_target(form, net)
    pose_input = _read_input(form, target.model)
    shown_poses, votes = _estimate(form, target, pose_input)
    min_certainty = form.read_number("min_certainty")
    if min_certainty is not None:
        limit = EstimateConfig(min_certainty=min_certainty).min_certainty  # refuses what is none
        shown_poses = [
            replace(shown, estimate=with_status(shown.estimate, limit)) for shown in shown_poses
        ]

    # The files for download.
    folder = form.folder / "results"
    folder.mkdir()
    pictures = _write_results(folder, pose_input.name, shown_poses, target.model)

    # What the page shows: the best of them, and a row and a layer for each.
    best = shown_poses[0]
    agreeing = "votes that agree" if isinstance(target.net, GeoPoseNet) else "points near the model"
    tables = report.make_pose_tables(best.estimate)
    if len(shown_poses) > 1:
        head = ["", "status", "x [m]", "y [m]", "z [m]", "certainty", "visible", "pick rank"]
        rows = [[shown.input.name, *_format_row(shown.estimate)] for shown in shown_poses]
        tables = {"found in this image": [head, *rows]} | tables
    return Answer(
        is_ok=best.estimate.is_posed,
        sentence=report.describe_pose(best.estimate),
        facts=report.list_pose_facts(best.estimate, target.model, target.method, agreeing),
        tables=tables,
        pictures=pictures,
        scene=_make_scene(shown_poses, votes, target.model),
        terms=net.terms if target.net is net else "",
        files={path.name: path.read_bytes() for path in sorted(folder.iterdir())},
    )


def _estimate(
    form: Form, target: _Target, pose_input: CloudInput | ViewInput
) -> tuple[list[_ShownPose], VotingDirections | None]:
    """Estimate what a form asks for.

    Boxes are searched, one pose in each; a depth image without a mask is searched as a whole.

    Returns:
        The estimates, the surest first; and of a single one by a network its votes, else None.
    """
    views = _make_box_views(form, pose_input)
    if views:
        estimates = target.net.estimate_many(views)
        shown_poses = [
            _ShownPose(input=view, estimate=estimate)
            for view, estimate in zip(views, estimates, strict=True)
        ]
        return sorted(shown_poses, key=lambda shown: -(shown.estimate.certainty or 0.0)), None
    if "depth" in form.files and "mask" not in form.files:
        assert isinstance(pose_input, ViewInput)
        return _search(target, pose_input), None
    if isinstance(target.net, GeoPoseNet):
        estimate, votes = target.net.estimate_with_votes(pose_input)
        return [_ShownPose(input=pose_input, estimate=estimate)], votes
    (estimate,) = target.net.estimate_many([pose_input])
    if estimate.status == "unreadable":
        raise InputError(estimate.reason)
    return [_ShownPose(input=pose_input, estimate=estimate)], None


def _search(target: _Target, view: ViewInput) -> list[_ShownPose]:
    """Search a whole depth image for the object: an estimate for each copy that is found."""
    surface = target.net.surface_of(target.model.name)
    shown_poses: list[_ShownPose] = []
    for estimate in target.net.find(view, objects=target.model.name):
        shown_view = replace(view, name=estimate.name)
        if estimate.camera_from_model is not None:
            mask = view_inliers(view, estimate.camera_from_model, surface)
            shown_view = replace(shown_view, mask=mask)
        shown_poses.append(_ShownPose(input=shown_view, estimate=estimate))
    return shown_poses


def _make_scene(
    shown_poses: Sequence[_ShownPose], votes: VotingDirections | None, model: ObjectModel
) -> Scene:
    """Make the 3D view: the best pose with its votes, and a layer for each of the others."""
    best = shown_poses[0]
    points_m = select_object_points(best.input, model.diameter_m)
    scene = report.make_pose_scene(best.input, points_m, best.estimate, model)
    layers = list(scene.layers)
    keypoints_m = best.estimate.keypoints_m
    if keypoints_m is not None and votes is not None:
        layers.append(report.make_vote_layer(votes.points_m, votes.directions, keypoints_m))
    for shown in shown_poses[1:]:
        points_m = select_object_points(shown.input, model.diameter_m)
        cloud = report.join_posed_cloud(points_m, shown.estimate.camera_from_model, model)
        layers.append(Layer(name=shown.input.name, shape=cloud))
    return replace(scene, layers=layers)


def _make_box_views(form: Form, pose_input: CloudInput | ViewInput) -> list[ViewInput]:
    """Make a view for each box in the form, [] without one: NAME, or NAME_1, NAME_2 of several.

    Raises:
        InputError: a box is no box, or there is a mask or cloud beside it.
    """
    words = form.fields.get("box", "").split()
    if words and ("mask" in form.files or not isinstance(pose_input, ViewInput)):
        raise InputError(
            "a box says where the object is in a depth image; take it out where a mask or a cloud "
            "does"
        )
    views: list[ViewInput] = []
    for number, word in enumerate(words, 1):
        assert isinstance(pose_input, ViewInput)
        name = pose_input.name + (f"_{number}" if len(words) > 1 else "")
        view = mask_view(pose_input, Detection(box=parse_box(word)))
        views.append(replace(view, name=name))
    return views


def _format_row(estimate: PoseEstimate) -> list[str]:
    """Format the row of an estimate in the table of an image; empty where it has no value."""
    pose = estimate.camera_from_model
    position = [""] * 3 if pose is None else [f"{v:.4f}" for v in pose.t_m.tolist()]
    shares = (estimate.certainty, estimate.visible_share)
    numbers = ["" if share is None else f"{share:.3f}" for share in shares]
    rank = "" if estimate.pick_rank is None else str(estimate.pick_rank)
    return [estimate.status, *position, *numbers, rank]


def _write_results(
    folder: Path, name: str, shown_poses: list[_ShownPose], model: ObjectModel
) -> list[ShownPicture]:
    """Write ``poses.json``, a cloud with each posed model, and a picture of all of them.

    Returns:
        The picture, if the input is a depth image; else [].
    """
    predictions = [Prediction(estimate=shown_pose.estimate) for shown_pose in shown_poses]
    write_predictions(folder, predictions)
    for shown_pose in shown_poses:
        points_m = select_object_points(shown_pose.input, model.diameter_m)
        cloud = report.join_posed_cloud(points_m, shown_pose.estimate.camera_from_model, model)
        files.write_cloud(folder / f"{shown_pose.input.name}.{CLOUD}", cloud)

    pose_input = shown_poses[0].input
    if not isinstance(pose_input, ViewInput):
        return []
    picture = report.draw_grey_depth(pose_input.depth_m)
    caption = "depth image, near bright"
    pose_count = 0
    for shown_pose in shown_poses:
        pose = shown_pose.estimate.camera_from_model
        if isinstance(shown_pose.input, ViewInput) and shown_pose.input.is_region:
            picture = report.draw_region(picture, shown_pose.input, pose)
        picture = report.draw_pose(picture, pose, model, pose_input.K)
        pose_count += pose is not None

    if pose_count:
        caption += f", with the posed model{'s' * (pose_count > 1)}"
    if pose_input.is_region:
        caption += ", boxes yellow"
    files.write_image(folder / f"{name}.{PICTURE}", picture)
    return [ShownPicture(file=f"{name}.{PICTURE}", caption=caption)]


def _find_target(form: Form, net: GeoPoseNet) -> _Target:
    """Find the object and its estimator: an object of the weights, or a CAD file.

    A CAD file of an object that the weights know is posed by the network, another one registered.
    """
    name = form.fields.get("object", "")
    models = net.weights.models
    if name != CAD_FILE:
        if "cad" in form.files:
            raise InputError(
                f"object {name!r} and the CAD file {form.files['cad'].name} are both given; choose "
                "'the CAD file above' as the object, or take the file out"
            )
        model = next((model for model in models if model.name == name), None)
        if model is None:
            raise InputError(f"object {name!r}: the weights know {', '.join(net.objects)}")
        return _Target(model=model, net=net, method="network, by the weights' own model")
    cad = form.require_file("cad")
    unit = mesh.FIXED_UNITS.get(cad.suffix.lower()) or form.fields.get("cad_unit", "")
    refuse_unknown("cad_unit", unit, METRES)
    cad_model = mesh.read_model(cad, cast(Unit, unit))
    for model in models:
        if _is_same_shape(cad_model, model):
            method = f"network; the CAD file is the weights' {model.name!r}"
            return _Target(model=model, net=net, method=method)
    cad_model = mesh.with_found_symmetries(cad_model)
    registration = Registration([cad_model], net.config)
    return _Target(model=cad_model, net=registration, method="the CAD file alone, without training")


def _is_same_shape(cad_model: ObjectModel, model: ObjectModel) -> bool:
    """Whether a CAD file is an object of the weights, in the same frame: size and surface agree."""
    if abs(cad_model.diameter_m / model.diameter_m - 1) > _MAX_SHAPE_DIFFERENCE:
        return False
    # Points of the whole CAD surface must lie on the model: the file has no part that the model
    # lacks. Of the model the keypoints suffice: they lie far apart, so one is off a CAD file that
    # lies in another frame or lacks one of the model's ends.
    cad_points_m = mesh.sample_surface(cad_model, _SURFACE_POINTS)[0]
    to_cad_m = mesh.gap_to_surface_m(model.keypoints_m, cad_model)
    from_cad_m = mesh.gap_to_surface_m(cad_points_m, model)
    return max(to_cad_m, from_cad_m) < _MAX_SHAPE_DIFFERENCE * model.diameter_m


def _read_input(form: Form, model: ObjectModel) -> CloudInput | ViewInput:
    """Read the cloud of a form, or its depth image with mask and camera.

    Raises:
        InputError: one of them is missing, wrong or too large, or both are there.
    """
    if "cloud" in form.files:
        if not form.files.keys().isdisjoint(("depth", "mask", "empty_frame")):
            raise InputError("a cloud and a depth image are both given; choose one of the two")
        path = form.require_file("cloud")
        unit = form.fields.get("cloud_unit", "")
        refuse_unknown("cloud_unit", unit, METRES)
        return cloud_input(path, cast(Unit, unit), model.name, path.stem)
    depth = form.require_file("depth")
    mask = form.require_file("mask") if "mask" in form.files else None
    if mask is not None:
        refuse_large(mask.name, *files.image_size(mask))

    size = _read_size(depth)
    keys: dict[str, Any] = {}
    if "camera" not in form.files:
        focal_px = form.read_number("focal_px")
        if focal_px is None:
            raise InputError(
                "focal length: without it a depth image has no size; fill in that of the depth "
                "sensor (its driver has it), or choose a camera file"
            )
        keys = form.make_pinhole_keys(size, focal_px)
        keys["depth_unit_m"] = form.read_number("depth_unit_m")
    camera = form.make_camera(keys, size)
    if camera.depth_unit_m is None:
        # Files of ROS, OpenCV and KITTI do not have it.
        camera = replace(camera, depth_unit_m=form.read_number("depth_unit_m"))
    view = view_input(depth, mask, camera, model.name, depth.stem)
    if "empty_frame" not in form.files:
        return view
    empty_frame = form.require_file("empty_frame")
    _read_size(empty_frame)
    return add_background(view, empty_frame, camera)


def _read_size(depth: Path) -> tuple[int, int]:
    """Read width and height of a depth image.

    Raises:
        InputError: it cannot be read, or is too large.
    """
    if depth.suffix.lower() in files.MAP_SUFFIXES:
        height, width = files.read_stored_depth(depth).shape
        size = (width, height)
    else:
        size = files.image_size(depth)
    refuse_large(depth.name, *size)
    return size


_EXAMPLE_UNIT_M = 0.0001
"""Unit of the depth image of the example."""


def make_pose_example(net: GeoPoseNet) -> dict[str, Any]:
    """Render the example of the tab, as JSON: the weights' first object on a table.

    It has a depth image, a mask and a camera.
    """
    model = net.weights.models[0]
    near_m = 4 * model.diameter_m
    config = ObjectsConfig(
        seed=EXAMPLE_SEED,
        distance_m=(near_m, 1.5 * near_m),
        frame_objects=(1, 1),
        frame_clutter=(0, 0),
    )
    frame = next(make_frames((model,), config, 1))
    height, width = frame.depth_m.shape
    camera = Camera(width=width, height=height, K=frame.K.double(), depth_unit_m=_EXAMPLE_UNIT_M)
    with TemporaryDirectory(prefix="depthpose-") as name:
        folder = Path(name)
        files.write_depth_png(folder / "depth.png", frame.depth_m, _EXAMPLE_UNIT_M)
        write_mask(folder / "mask.png", frame.objects[0].visible)
        write_camera(folder / "camera.json", camera)
        return encode_example(folder, {"object": model.name})
