"""A pose on a page: the object over its picture, numbers, and the cloud with it in 3D."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import Camera, crop_camera, project, resize_camera
from depthpose.core.draw import draw_lines, draw_outline
from depthpose.core.files import Cloud, read_depth_png, read_image
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import cloud_from_depth, is_reading
from depthpose.pose.datasets import Instance
from depthpose.pose.inputs import AnyInput
from depthpose.pose.mesh import drawn_triangles, sample_surface
from depthpose.pose.types import CloudInput, ObjectModel, PoseEstimate, ViewInput
from depthpose.report.page import (
    Drawing,
    Layer,
    Row,
    Scene,
    Section,
    colored_lines,
    frame_axes,
)

Color = tuple[float, float, float]
ESTIMATED: Color = (0.15, 0.35, 1.0)
"""Colour of an estimate: blue."""
TRUTH: Color = (0.1, 0.8, 0.2)
"""Colour of the truth: green."""
VOTED: Color = (1.0, 0.55, 0.1)
"""Colour of voted keypoints: orange."""
ALTERNATIVE: Color = (0.6, 0.3, 0.85)
"""Colour of an alternative: violet."""
_SURFACE_POINTS = 5000
"""Number of points of the posed model in a cloud."""
_SHARP_RAD = math.radians(30)
"""Least angle between the faces at an edge that is drawn."""
_CROSS_ARM = 0.04
"""Half of the cross at a keypoint, in diameters of the object."""
_DRAWN_VOTES = 40
"""Points whose votes are drawn."""
_DASH_PX = 6.0
_GREY = 0.6
"""Grey of the points of an observed cloud."""


def picture_of(instance: Instance) -> Float[Tensor, "3 h w"]:
    """Read the picture of an instance, or its depth in grey where there is none."""
    if instance.rgb is not None:
        return read_image(instance.rgb)
    return grey_depth(read_depth_png(instance.depth, instance.depth_unit_m))


def draw_pose(
    image: Float[Tensor, "3 h w"],
    pose: Rigid | None,
    model: ObjectModel,
    K: Float[Tensor, "3 3"],
    truth: Rigid | None = None,
) -> Float[Tensor, "3 h w"]:
    """Draw the projected box of a posed object and the border of its silhouette, in blue.

    Args:
        image: image of the camera; it is not changed.
        pose: ``camera_from_model``; None: the truth alone is drawn.
        model: the object; one of points alone is drawn by small discs.
        K: intrinsic matrix of the image.
        truth: ``camera_from_model``, whose box is drawn too, green and dashed; None: it is unknown.
    """
    K = K.double()
    box_m = box_edges(model).double()
    if pose is not None:
        ends_px = project(pose.double().apply(box_m), K)
        posed_m = pose.double().apply(drawn_triangles(model).double())
        raster = rasterize(posed_m, K, image.shape[2], image.shape[1], with_barycentric=False)
        image = draw_outline(image, raster.depth_m.isfinite(), ESTIMATED)
        image = draw_lines(image, ends_px, ESTIMATED)
    if truth is not None:
        ends_px = project(truth.double().apply(box_m), K)
        image = draw_lines(image, ends_px, TRUTH, dash_px=_DASH_PX)
    return image


def draw_region(
    image: Float[Tensor, "3 h w"], view: ViewInput, pose: Rigid | None
) -> Float[Tensor, "3 h w"]:
    """Draw the border of the box in which an object was searched, or of its mask, in yellow.

    A mask is drawn only where there is no pose, whose silhouette would cover it.

    Args:
        image: image of the camera; it is not changed.
        view: the view, with its mask or box.
        pose: the pose that was estimated; None: it was refused.
    """
    if pose is None or view.is_region:
        return draw_outline(image, view.mask, _REGION_COLOR)
    return image


def box_edges(model: ObjectModel) -> Float[Tensor, "12 2 3"]:
    """Compute both ends of the edges of the model's box, along its axes [m]."""
    low = model.vertices_m.amin(0)
    high = model.vertices_m.amax(0)
    corners = torch.cartesian_prod(*torch.stack([low, high], -1))
    # The three bits of a corner's number say for each axis whether it is low or high; corners with
    # an edge between them differ in one bit.
    pairs = [(corner, corner | bit) for bit in (1, 2, 4) for corner in range(8) if not corner & bit]
    return corners[torch.tensor(pairs)]


def pose_layers(
    pose: Rigid, model: ObjectModel, *, is_true: bool = False, with_box: bool = False
) -> list[Layer]:
    """Make the layers of a posed object: surface, edges, box and axes.

    Edges are where the surface ends, or bends by more than 30 degrees.

    Args:
        pose: ``camera_from_model``.
        model: the object.
        is_true: the pose is the truth: it is shown by edges and box alone, in green.
        with_box: the box of an estimate is shown at first, and not only when it is switched on.
    """
    pose = pose.double()
    box_m = pose.apply(box_edges(model).double()).float()
    edges_m = _find_sharp_edges(model)
    if edges_m is not None:
        edges_m = pose.apply(edges_m).float()
    if is_true:
        layers = [Layer(name="true box", shape=colored_lines(box_m, TRUTH))]
        if edges_m is not None:
            layers.append(Layer(name="true edges", shape=colored_lines(edges_m, TRUTH)))
        return layers
    layers = [Layer(name="posed model", shape=posed_cloud(torch.empty(0, 3), pose, model))]
    if edges_m is not None:
        layers.append(Layer(name="its edges", shape=colored_lines(edges_m, ESTIMATED)))
    axes = frame_axes(pose.t_m, pose.R, model.diameter_m / 2)
    box = Layer(name="its box", shape=colored_lines(box_m, ESTIMATED), is_shown=with_box)
    return [*layers, box, Layer(name="its axes (x red, y green, z blue)", shape=axes)]


def _find_sharp_edges(model: ObjectModel) -> Float64[Tensor, "n 2 3"] | None:
    """Find the edges where a mesh ends, or bends by more than ``_SHARP_RAD``: both ends [m].

    None of a model without faces.
    """
    if not len(model.faces):
        return None
    # Vertices at one place are one: STL repeats the points of every face.
    places_m, place_of_vertex = torch.unique(model.vertices_m, dim=0, return_inverse=True)
    corners = place_of_vertex[model.faces]
    sides = torch.cat([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    edges, edge_of_side, face_count = torch.unique(
        sides.sort(-1).values, dim=0, return_inverse=True, return_counts=True
    )

    # Two unit normals at an angle have a mean as long as the cosine of half of it.
    a, b, c = model.vertices_m[model.faces].double().unbind(1)
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    normal_sum = normals.new_zeros(len(edges), 3)
    normal_sum.index_add_(0, edge_of_side, normals.repeat(3, 1))
    is_sharp = normal_sum.norm(dim=-1) / face_count < math.cos(_SHARP_RAD / 2)
    is_border = face_count == 1
    return places_m[edges[is_sharp | is_border]].double()


def keypoint_layers(
    voted_m: Float[Tensor, "k 3"], pose: Rigid | None, model: ObjectModel
) -> list[Layer]:
    """Draw crosses at the voted keypoints, and at those of the posed model, in the camera frame."""
    keypoints = [("keypoints, voted", voted_m, VOTED)]
    if pose is not None:
        posed_m = pose.apply(model.keypoints_m.to(pose.R))
        keypoints.append(("keypoints, of the posed model", posed_m, ESTIMATED))
    layers: list[Layer] = []
    for name, centres_m, color in keypoints:
        arms_m = _CROSS_ARM * model.diameter_m * torch.eye(3).to(centres_m)
        starts_m = centres_m[:, None] - arms_m
        ends_m = centres_m[:, None] + arms_m
        lines_m = torch.stack([starts_m, ends_m], 2).flatten(0, 1).float()
        layers.append(Layer(name=name, shape=colored_lines(lines_m, color)))
    return layers


def vote_layer(
    points_m: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n k 3"],
    voted_m: Float[Tensor, "k 3"],
) -> Layer:
    """Draw the votes of some points: lines along their directions to beside the voted keypoints.

    A line ends where it is nearest to the keypoint. ``directions`` need not be of unit length.
    """
    points_m = take_evenly(points_m, _DRAWN_VOTES)
    directions = torch.nn.functional.normalize(take_evenly(directions, _DRAWN_VOTES), dim=-1)
    starts_m = points_m[:, None].expand_as(directions)
    lengths_m = ((voted_m - starts_m) * directions).sum(-1, keepdim=True).clamp(min=0)
    ends_m = starts_m + lengths_m * directions
    lines_m = torch.stack([starts_m, ends_m], -2).flatten(0, 1).float()
    return Layer(name="votes", shape=colored_lines(lines_m, VOTED), is_shown=False)


def posed_cloud(cloud_m: Float[Tensor, "n 3"], pose: Rigid | None, model: ObjectModel) -> Cloud:
    """Join the observed cloud (grey) and the posed surface of the model (blue).

    Without a pose, the cloud alone.
    """
    cloud_color = torch.full((len(cloud_m), 3), _GREY)
    if pose is None:
        return Cloud(points=cloud_m.float(), color=cloud_color)
    surface_m = pose.apply(sample_surface(model, _SURFACE_POINTS)[0].to(pose.R))
    surface_color = torch.tensor(ESTIMATED).expand(len(surface_m), 3)
    return Cloud(
        points=torch.cat([cloud_m.float(), surface_m.float()]),
        color=torch.cat([cloud_color, surface_color]),
    )


def object_points(pose_input: CloudInput | ViewInput, diameter_m: float) -> Float[Tensor, "n 3"]:
    """Take the valid points of a cloud, or of a masked depth image without its flying pixels [m].

    ``diameter_m``: diameter of the object, by which flying pixels are told.
    """
    if isinstance(pose_input, ViewInput):
        return cloud_from_depth(
            pose_input.depth_m, pose_input.mask, pose_input.K, diameter_m
        ).float()
    return pose_input.points_m[is_reading(pose_input.points_m)].float()


def grey_depth(depth_m: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    """Draw depth in grey, near bright and far dark, black without a reading.

    The scale goes from the 1st to the 99th percentile of the readings, so stray ones do not set it.
    """
    readings_m = depth_m[depth_m.isfinite() & (depth_m > 0)].sort().values
    if len(readings_m) == 0:
        return torch.zeros(3, *depth_m.shape)
    last = len(readings_m) - 1
    near_m = float(readings_m[round(0.01 * last)])
    far_m = float(readings_m[round(0.99 * last)])
    nearness = 1 - ((depth_m - near_m) / max(far_m - near_m, 1e-6)).clamp(0, 1)
    grey = torch.where(depth_m > 0, _DARKEST_GREY + (1 - _DARKEST_GREY) * nearness, 0.0)
    return grey.nan_to_num(0.0).float().expand(3, -1, -1)


_DARKEST_GREY = 0.15
"""Grey of the farthest depth; black has no reading."""
_OBJECT_COLOR = (0.55, 0.55, 0.55)
_SURROUNDINGS_COLOR = (0.7, 0.66, 0.6)
_BACKGROUND_COLOR = (0.45, 0.6, 0.75)
_REGION_COLOR = (1.0, 0.85, 0.1)
_MAX_SURROUNDINGS = 20_000
"""Points of all that is not the object, and of the known background."""
_MARGIN = 0.6
"""Margin of a close-up about the object, as a share of the object's extent."""
_CLOSE_UP_PX = 360


def pose_section(
    title: str,
    pose_input: AnyInput,
    estimate: PoseEstimate,
    model: ObjectModel,
    text: str = "",
    *,
    image: Float[Tensor, "3 h w"] | None = None,
    truth: Rigid | None = None,
    rows: Sequence[Row] = (),
) -> Section:
    """Show one estimate: sentence and numbers, the picture, the cloud with the model in 3D.

    Pictures are of the whole view and of the object from near by, with the box in which it was
    searched, and the mask where there is no pose.

    Args:
        title: title of the section.
        pose_input: cloud or view that was posed.
        estimate: its pose, or why there is none.
        model: the object.
        text: before the sentence about the pose.
        image: image of the view's camera, which the pose is drawn over; None: the depth in grey.
        truth: ``camera_from_model``; None: it is unknown.
        rows: rows of a table below.
    """
    drawings: list[Drawing] = []
    if isinstance(pose_input, ViewInput):
        drawings = _pose_drawings(pose_input, estimate, model, image, truth)
    points_m = object_points(pose_input, model.diameter_m)
    return Section(
        title=title,
        text=f"{text} {pose_sentence(estimate)}".strip(),
        facts=pose_facts(estimate, model),
        rows=rows,
        tables=pose_tables(estimate),
        pictures=drawings,
        scenes=[pose_scene(pose_input, points_m, estimate, model, truth)],
    )


def _pose_drawings(
    view: ViewInput,
    estimate: PoseEstimate,
    model: ObjectModel,
    image: Float[Tensor, "3 h w"] | None,
    truth: Rigid | None,
) -> list[Drawing]:
    """Draw a pose over the whole view, and over a close-up of the object."""
    pose = estimate.camera_from_model
    if image is None:
        subject = "depth image, near bright"
        image = grey_depth(view.depth_m)
    else:
        subject = "picture"
    image = draw_region(image, view, pose)

    colors: list[str] = []
    if pose is not None:
        colors.append("the estimated pose blue")
    if pose is None or view.is_region:
        colors.append(f"the {'box' if view.is_region else 'mask'} yellow")
    if truth is not None:
        colors.append("the box of the truth green and dashed")
    legend = ", ".join(colors)

    whole = draw_pose(image, pose, model, view.K, truth)
    drawings = [Drawing(image=whole, caption=f"{subject}; {legend}")]
    if bool(view.mask.any()):
        near, near_K = close_up(image, view.mask, view.K)
        near = draw_pose(near, pose, model, near_K, truth)
        drawings.append(Drawing(image=near, caption=f"the object from near by; {legend}"))
    return drawings


def pose_sentence(estimate: PoseEstimate) -> str:
    """Describe in a sentence where the object is, or why it is refused."""
    if estimate.camera_from_model is None:
        return f"Refused ({estimate.status}): {estimate.reason}."
    x, y, z = estimate.camera_from_model.t_m.tolist()
    sentence = (
        f"The {estimate.object} is at x {x:.4f}, y {y:.4f}, z {z:.4f} m in the camera's frame."
    )
    if estimate.base_from_model is not None:
        x, y, z = estimate.base_from_model.t_m.tolist()
        sentence += f" From the robot's base it is at x {x:.4f}, y {y:.4f}, z {z:.4f} m."
    if estimate.status == "ambiguous":
        sentence += f" It is ambiguous: {estimate.reason}."
    if not estimate.alternatives:
        return sentence
    return f"{sentence} Other poses fit as well: {'; '.join(map(str, estimate.alternatives))}."


def pose_facts(
    estimate: PoseEstimate,
    model: ObjectModel,
    method: str = "",
    agreeing: str = "votes or points that agree",
) -> list[tuple[str, str]]:
    """List the facts of an estimate other than its pose: names and values.

    ``method``: method that estimated it, if not empty; ``agreeing``: name of its ``inlier_share``.
    """
    facts = [("object", f"{estimate.object}, {model.diameter_m:.4f} m long")]
    if method:
        facts.append(("by", method))
    evidence = estimate.evidence
    if evidence is not None:
        facts += [
            ("agreement", f"{evidence.agreement:.1%} of what was compared supports the pose"),
            ("visible", f"{evidence.supported_share:.0%} of the surface that faces the camera"),
            ("noise of the sensor there", f"{1000 * evidence.noise_m:.1f} mm"),
        ]

    # What it is, and how sure that is.
    if estimate.pick_rank is not None:
        facts.append(("pick rank", f"{estimate.pick_rank} of what was found in this image"))
    if estimate.identity is not None:
        identity = estimate.identity
        identity_text = identity.status + (f" ({identity.reason})" if identity.reason else "")
        if identity.size is not None and identity.size_deviation is not None:
            identity_text += (
                f"; size {identity.size:.3f} +- {identity.size_deviation:.3f} of the model's"
            )
        facts.append(("identity", identity_text))
    if estimate.certainty is not None:
        facts.append(("certainty, up to near-symmetry", f"{estimate.certainty:.3f}"))
    if estimate.copy_certainty is not None:
        facts.append(("certainty of this very copy", f"{estimate.copy_certainty:.3f}"))

    facts += [("another pose that fits", str(other)) for other in estimate.alternatives]

    # The fit, and how long it took.
    if estimate.inlier_share is not None:
        facts.append((agreeing, f"{estimate.inlier_share:.0%}"))
    if estimate.residual_m is not None and math.isfinite(estimate.residual_m):
        facts.append(("distance left (RMS)", f"{1000 * estimate.residual_m:.2f} mm"))
    if estimate.free_motions is not None and len(estimate.free_motions):
        free = f"{len(estimate.free_motions)} (a declared symmetry; the covariance leaves them out)"
        facts.append(("free motions", free))
    if estimate.seconds:
        stages = ", ".join(f"{name} {1000 * s:.0f}" for name, s in estimate.seconds.items())
        facts.append(("ms", stages))
    return facts


def pose_tables(estimate: PoseEstimate) -> dict[str, Sequence[Sequence[str]]]:
    """Make the tables of a pose, by title: its matrix, standard deviations and covariance."""
    tables: dict[str, Sequence[Sequence[str]]] = {}
    pose = estimate.camera_from_model
    if pose is not None:
        tables["camera_from_model: R | t [m]"] = _format_matrix(pose)
    if estimate.base_from_model is not None:
        tables["base_from_model: R | t [m]"] = _format_matrix(estimate.base_from_model)
    if pose is not None and estimate.covariance is not None:
        assert estimate.origin_std_mm is not None
        assert estimate.rotation_std_deg is not None
        stds = {
            "place of the model's origin along the camera's axes [mm]": estimate.origin_std_mm,
            "rotation about the model's axes [deg]": estimate.rotation_std_deg,
        }
        tables["standard deviations about this answer alone"] = [
            ["", "x", "y", "z"],
            *([name, *map(_format_std, std.tolist())] for name, std in stds.items()),
        ]
        tables["covariance at the camera's origin, of rotation [rad] and translation [m]"] = [
            [f"{v:.2e}" for v in row] for row in estimate.covariance.tolist()
        ]
    return tables


def _format_std(value: float) -> str:
    """Format a standard deviation; along a free motion, of a declared symmetry, it is infinite."""
    return f"{value:.3f}" if math.isfinite(value) else "free"


def _format_matrix(pose: Rigid) -> list[list[str]]:
    """Format the rows of a transform's 3x4 matrix."""
    rows = torch.cat([pose.R, pose.t_m[:, None]], 1).tolist()
    return [[f"{value:.5f}" for value in row] for row in rows]


def pose_scene(
    pose_input: AnyInput,
    points_m: Float[Tensor, "n 3"],
    estimate: PoseEstimate,
    model: ObjectModel,
    truth: Rigid | None = None,
) -> Scene:
    """Make the 3D view of an estimate: the object's points, the posed model, and the rest.

    Args:
        pose_input: cloud or view that was posed.
        points_m: those of the object in it (:func:`object_points`).
        estimate: its pose, or why there is none.
        model: the object.
        truth: ``camera_from_model``, shown in green; None: it is unknown.
    """
    pose = estimate.camera_from_model
    layers = [_make_point_layer("the object, as seen", points_m, _OBJECT_COLOR)]
    if pose is not None:
        layers += pose_layers(pose, model, with_box=truth is not None)
    for alternative in estimate.alternatives:
        placed = alternative.camera_from_model.double()
        box_m = placed.apply(box_edges(model).double()).float()
        box = colored_lines(box_m, ALTERNATIVE)
        layers.append(Layer(name=f"box if {alternative}", shape=box, is_shown=False))
        axes = frame_axes(placed.t_m, placed.R, model.diameter_m / 2)
        layers.append(Layer(name=f"axes if {alternative}", shape=axes, is_shown=False))
    if truth is not None:
        layers += pose_layers(truth, model, is_true=True)
    if estimate.keypoints_m is not None:
        layers += keypoint_layers(estimate.keypoints_m, pose, model)
    if isinstance(pose_input, ViewInput):
        layers += _make_surroundings(pose_input)
    caption = "The cloud and the posed model" if pose is not None else "The cloud; there is no pose"
    return Scene(caption=caption, layers=layers)


def _make_surroundings(view: ViewInput) -> list[Layer]:
    """Make the layers of all that is not the object, and of the known background; both hidden."""
    around_m = cloud_from_depth(view.depth_m, ~view.mask, view.K).float()
    around_m = take_evenly(around_m, _MAX_SURROUNDINGS)
    layers = [_make_point_layer("all else", around_m, _SURROUNDINGS_COLOR, is_shown=False)]
    if view.background is not None:
        depth_m = view.background.depth_m
        background_m = cloud_from_depth(depth_m, depth_m > 0, view.K).float()
        background_m = take_evenly(background_m, _MAX_SURROUNDINGS)
        layer = _make_point_layer(
            "the known background", background_m, _BACKGROUND_COLOR, is_shown=False
        )
        layers.append(layer)
    return layers


def _make_point_layer(
    name: str, points_m: Float[Tensor, "n 3"], color: Color, *, is_shown: bool = True
) -> Layer:
    """Make a layer of points of one colour."""
    colors = torch.tensor(color).expand(len(points_m), 3)
    return Layer(name=name, shape=Cloud(points=points_m, color=colors), is_shown=is_shown)


def close_up(
    image: Float[Tensor, "3 h w"], mask: Bool[Tensor, "h w"], K: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, "3 _ _"], Float[Tensor, "3 3"]]:
    """Cut out a square about the mask, black beyond the image, and enlarge it.

    Gives the picture and its intrinsic matrix (float64); without a mask, image and K as they are.
    """
    rows, columns = mask.nonzero(as_tuple=True)
    if len(rows) == 0:
        return image, K
    low = torch.stack([columns.amin(), rows.amin()])
    high = torch.stack([columns.amax(), rows.amax()]) + 1
    side = int((1 + _MARGIN) * float((high - low).max()))
    left, top = ((low + high - side) // 2).tolist()

    # The image with a black border, within which the square lies.
    padded = torch.nn.functional.pad(image, (side, side, side, side))
    padded_K = K.double().clone()
    padded_K[:2, 2] += side
    camera = Camera(width=padded.shape[2], height=padded.shape[1], K=padded_K)

    left += side
    top += side
    square = padded[:, top : top + side, left : left + side]
    size = (_CLOSE_UP_PX, _CLOSE_UP_PX)
    enlarged = torch.nn.functional.interpolate(square[None], size=size)[0]
    camera = resize_camera(crop_camera(camera, left, top, side, side), *size)
    return enlarged, camera.K
