"""The section of a report page that shows an estimated pose: pictures, facts, tables, a 3D view."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import Camera, crop_camera, project, resize_camera
from depthpose.core.draw import Rgb, draw_lines, draw_outline
from depthpose.core.files import PointCloud, read_depth_png, read_image
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
    make_frame_axes,
    make_lines,
)

ESTIMATED: Rgb = (0.15, 0.35, 1.0)
"""Colour of an estimate: blue."""
TRUTH: Rgb = (0.1, 0.8, 0.2)
"""Colour of the truth: green."""
VOTED: Rgb = (1.0, 0.55, 0.1)
"""Colour of voted keypoints: orange."""
ALTERNATIVE: Rgb = (0.6, 0.3, 0.85)
"""Colour of an alternative: violet."""
_SURFACE_POINTS = 5000
"""Number of points by which the surface of a posed model is shown."""
_SHARP_RAD = math.radians(30)
"""Least angle between the faces at an edge that is drawn."""
_CROSS_ARM = 0.04
"""Half the width of the cross at a keypoint, in diameters of the object."""
_DRAWN_VOTES = 40
"""Number of points whose votes are drawn."""
_DASH_PX = 6.0
"""Length of the dashes of the true box."""
_GREY = 0.6
"""Grey of the points of an observed cloud."""


def read_instance_image(instance: Instance) -> Float[Tensor, "3 h w"]:
    """Read the colour image of an instance, or draw its depth in grey where it has none."""
    if instance.rgb is not None:
        return read_image(instance.rgb)
    return draw_grey_depth(read_depth_png(instance.depth, instance.depth_unit_m))


def draw_pose(
    image: Float[Tensor, "3 h w"],
    pose: Rigid | None,
    model: ObjectModel,
    K: Float[Tensor, "3 3"],
    truth: Rigid | None = None,
) -> Float[Tensor, "3 h w"]:
    """Draw the projected box of a posed object and the outline of its silhouette, in blue.

    Args:
        image: image of the camera; it is not changed.
        pose: ``camera_from_model``; None: the truth alone is drawn.
        model: the object; points without faces are drawn as small discs.
        K: intrinsic matrix of the image.
        truth: ``camera_from_model``, whose box is drawn too, green and dashed; None: it is unknown.
    """
    K = K.double()
    box_m = list_box_edges(model).double()
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
    """Draw the outline of the region in which an object was searched, or of its mask, in yellow.

    A mask is drawn only without a pose, whose silhouette would cover it.

    Args:
        image: image of the camera; it is not changed.
        view: the view, with its mask or box.
        pose: the pose that was estimated; None: it was refused.
    """
    if pose is None or view.is_region:
        return draw_outline(image, view.mask, _REGION_COLOR)
    return image


def list_box_edges(model: ObjectModel) -> Float[Tensor, "12 2 3"]:
    """List the 12 edges of a model's axis-aligned bounding box: both ends of each [m]."""
    low = model.vertices_m.amin(0)
    high = model.vertices_m.amax(0)
    corners = torch.cartesian_prod(*torch.stack([low, high], -1))
    # The three bits of a corner's number say for each axis whether it is low or high; corners with
    # an edge between them differ in one bit.
    pairs = [(corner, corner | bit) for bit in (1, 2, 4) for corner in range(8) if not corner & bit]
    return corners[torch.tensor(pairs)]


def make_pose_layers(pose: Rigid, model: ObjectModel, *, with_box: bool = False) -> list[Layer]:
    """Make the layers of an estimated pose: the model's surface, sharp edges, box and axes.

    Args:
        pose: ``camera_from_model``.
        model: the object.
        with_box: show the box when the page opens; else it is hidden until it is switched on.
    """
    pose = pose.double()
    layers = [Layer(name="posed model", shape=join_posed_cloud(torch.empty(0, 3), pose, model))]
    if len(model.faces):
        edges_m = pose.apply(_find_sharp_edges(model)).float()
        layers.append(Layer(name="its edges", shape=make_lines(edges_m, ESTIMATED)))
    box_m = pose.apply(list_box_edges(model).double()).float()
    box = make_lines(box_m, ESTIMATED)
    layers.append(Layer(name="its box", shape=box, is_shown=with_box))
    axes = make_frame_axes(pose.t_m, pose.R, model.diameter_m / 2)
    layers.append(Layer(name="its axes (x red, y green, z blue)", shape=axes))
    return layers


def make_truth_layers(pose: Rigid, model: ObjectModel) -> list[Layer]:
    """Make the layers of the true pose, ``camera_from_model``: box and sharp edges in green."""
    pose = pose.double()
    box_m = pose.apply(list_box_edges(model).double()).float()
    layers = [Layer(name="true box", shape=make_lines(box_m, TRUTH))]
    if len(model.faces):
        edges_m = pose.apply(_find_sharp_edges(model)).float()
        layers.append(Layer(name="true edges", shape=make_lines(edges_m, TRUTH)))
    return layers


def _find_sharp_edges(model: ObjectModel) -> Float64[Tensor, "n 2 3"]:
    """Find the edges where a mesh ends, or bends by more than ``_SHARP_RAD``: both ends [m]."""
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


def make_keypoint_layers(
    voted_m: Float[Tensor, "k 3"], pose: Rigid | None, model: ObjectModel
) -> list[Layer]:
    """Make layers of crosses at the voted keypoints and, if there is a pose, at the model's own.

    Args:
        voted_m: the voted keypoints, in the camera's frame [m].
        pose: ``camera_from_model``; None: it was refused.
        model: the object.
    """
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
        layers.append(Layer(name=name, shape=make_lines(lines_m, color)))
    return layers


def make_vote_layer(
    points_m: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n k 3"],
    voted_m: Float[Tensor, "k 3"],
) -> Layer:
    """Make a layer of the votes of some points, hidden at first.

    A vote is a line from the point along its direction, up to where it is nearest to the keypoint.

    Args:
        points_m: points of the object, in the camera's frame [m].
        directions: from each point to each keypoint, of any length.
        voted_m: the voted keypoints [m].
    """
    points_m = take_evenly(points_m, _DRAWN_VOTES)
    directions = torch.nn.functional.normalize(take_evenly(directions, _DRAWN_VOTES), dim=-1)
    starts_m = points_m[:, None].expand_as(directions)
    lengths_m = ((voted_m - starts_m) * directions).sum(-1, keepdim=True).clamp(min=0)
    ends_m = starts_m + lengths_m * directions
    lines_m = torch.stack([starts_m, ends_m], -2).flatten(0, 1).float()
    return Layer(name="votes", shape=make_lines(lines_m, VOTED), is_shown=False)


def join_posed_cloud(
    cloud_m: Float[Tensor, "n 3"], pose: Rigid | None, model: ObjectModel
) -> PointCloud:
    """Join the observed cloud [m] in grey and points of the model's posed surface in blue.

    Without a pose, the result is the cloud alone.
    """
    cloud_color = torch.full((len(cloud_m), 3), _GREY)
    if pose is None:
        return PointCloud(points=cloud_m.float(), color=cloud_color)
    surface_m = pose.apply(sample_surface(model, _SURFACE_POINTS)[0].to(pose.R))
    surface_color = torch.tensor(ESTIMATED).expand(len(surface_m), 3)
    return PointCloud(
        points=torch.cat([cloud_m.float(), surface_m.float()]),
        color=torch.cat([cloud_color, surface_color]),
    )


def select_object_points(
    pose_input: CloudInput | ViewInput, diameter_m: float
) -> Float[Tensor, "n 3"]:
    """Select the points of the object [m]: of a masked depth image without flying pixels.

    Args:
        pose_input: a cloud, of which all valid points are taken, or a view.
        diameter_m: diameter of the object, by which flying pixels are recognised.
    """
    if isinstance(pose_input, ViewInput):
        return cloud_from_depth(
            pose_input.depth_m, pose_input.mask, pose_input.K, diameter_m
        ).float()
    return pose_input.points_m[is_reading(pose_input.points_m)].float()


def draw_grey_depth(depth_m: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    """Draw depth in grey: near bright, far dark, and black without a reading.

    The grey scale spans the 1st to the 99th percentile of the readings: outliers do not set it.
    """
    readings_m = depth_m[depth_m.isfinite() & (depth_m > 0)].sort().values
    if len(readings_m) == 0:
        return torch.zeros(3, *depth_m.shape)
    last = len(readings_m) - 1
    near_m = float(readings_m[round(0.01 * last)])
    far_m = float(readings_m[round(0.99 * last)])
    extent_m = max(far_m - near_m, 1e-6)  # not 0, as of a plane
    nearness = 1 - ((depth_m - near_m) / extent_m).clamp(0, 1)
    grey = torch.where(depth_m > 0, _DARKEST_GREY + (1 - _DARKEST_GREY) * nearness, 0.0)
    return grey.nan_to_num(0.0).float().expand(3, -1, -1)


_DARKEST_GREY = 0.15
"""Grey of the farthest depth; black has no reading."""
_OBJECT_COLOR: Rgb = (0.55, 0.55, 0.55)
_SURROUNDINGS_COLOR: Rgb = (0.7, 0.66, 0.6)
_BACKGROUND_COLOR: Rgb = (0.45, 0.6, 0.75)
_REGION_COLOR: Rgb = (1.0, 0.85, 0.1)
_MAX_SURROUNDINGS = 20_000
"""Most points of the surroundings of the object, and of the known background."""
_MARGIN = 0.6
"""By how much a close-up is larger than the object, as a share of the object's larger side."""
_CLOSE_UP_PX = 360
"""Side of a close-up [px]."""


def make_pose_section(
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
    """Make the section of an estimate: a sentence, facts, tables, pictures and a 3D view.

    Pictures, of a view alone, show the whole view and a close-up of the object.

    Args:
        title: title of the section.
        pose_input: cloud or view of which the pose was estimated.
        estimate: the pose, or why it was refused.
        model: the object.
        text: text before the sentence about the pose.
        image: image of the view's camera, over which the pose is drawn; None: the depth in grey.
        truth: ``camera_from_model``; None: it is unknown.
        rows: rows of a table below.
    """
    drawings: list[Drawing] = []
    if isinstance(pose_input, ViewInput):
        drawings = _draw_view(pose_input, estimate, model, image, truth)
    points_m = select_object_points(pose_input, model.diameter_m)
    return Section(
        title=title,
        text=f"{text} {describe_pose(estimate)}".strip(),
        facts=list_pose_facts(estimate, model),
        rows=rows,
        tables=make_pose_tables(estimate),
        pictures=drawings,
        scenes=[make_pose_scene(pose_input, points_m, estimate, model, truth)],
    )


def _draw_view(
    view: ViewInput,
    estimate: PoseEstimate,
    model: ObjectModel,
    image: Float[Tensor, "3 h w"] | None,
    truth: Rigid | None,
) -> list[Drawing]:
    """Draw a pose over the whole view, and over a close-up of the object if its mask has pixels.

    Arguments are those of :func:`make_pose_section`.
    """
    pose = estimate.camera_from_model
    if image is None:
        subject = "depth image, near bright"
        image = draw_grey_depth(view.depth_m)
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
        near, near_K = cut_close_up(image, view.mask, view.K)
        near = draw_pose(near, pose, model, near_K, truth)
        drawings.append(Drawing(image=near, caption=f"the object from near by; {legend}"))
    return drawings


def describe_pose(estimate: PoseEstimate) -> str:
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


def list_pose_facts(
    estimate: PoseEstimate,
    model: ObjectModel,
    method: str = "",
    agreeing: str = "votes or points that agree",
) -> list[tuple[str, str]]:
    """List facts about an estimate other than its pose, each a name and a value, for people.

    Args:
        estimate: the estimate.
        model: the object.
        method: name of the method; "" leaves it out.
        agreeing: name of the fact ``inlier_share``, which differs with the method.
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


def make_pose_tables(estimate: PoseEstimate) -> dict[str, Sequence[Sequence[str]]]:
    """Make the tables of an estimate, by their captions: matrix, standard deviations, covariance.

    A refused estimate has none.
    """
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
    """Format a standard deviation; an infinite one, along a declared symmetry, is ``free``."""
    return f"{value:.3f}" if math.isfinite(value) else "free"


def _format_matrix(pose: Rigid) -> list[list[str]]:
    """Format the rows of a transform's 3x4 matrix."""
    rows = torch.cat([pose.R, pose.t_m[:, None]], 1).tolist()
    return [[f"{value:.5f}" for value in row] for row in rows]


def make_pose_scene(
    pose_input: AnyInput,
    points_m: Float[Tensor, "n 3"],
    estimate: PoseEstimate,
    model: ObjectModel,
    truth: Rigid | None = None,
) -> Scene:
    """Make the 3D view of an estimate, in the camera's frame.

    It shows the object's points, the posed model, alternatives, the truth, keypoints and the
    surroundings, as far as there are any.

    Args:
        pose_input: cloud or view of which the pose was estimated.
        points_m: points of the object in it (:func:`select_object_points`).
        estimate: the pose, or why it was refused.
        model: the object.
        truth: ``camera_from_model``; None: it is unknown.
    """
    pose = estimate.camera_from_model
    layers = [_make_point_layer("the object, as seen", points_m, _OBJECT_COLOR)]
    if pose is not None:
        layers += make_pose_layers(pose, model, with_box=truth is not None)
    for alternative in estimate.alternatives:
        other_pose = alternative.camera_from_model.double()
        box_m = other_pose.apply(list_box_edges(model).double()).float()
        box = make_lines(box_m, ALTERNATIVE)
        layers.append(Layer(name=f"box if {alternative}", shape=box, is_shown=False))
        axes = make_frame_axes(other_pose.t_m, other_pose.R, model.diameter_m / 2)
        layers.append(Layer(name=f"axes if {alternative}", shape=axes, is_shown=False))
    if truth is not None:
        layers += make_truth_layers(truth, model)
    if estimate.keypoints_m is not None:
        layers += make_keypoint_layers(estimate.keypoints_m, pose, model)
    if isinstance(pose_input, ViewInput):
        layers += _make_surroundings(pose_input)
    caption = "The cloud and the posed model" if pose is not None else "The cloud; there is no pose"
    return Scene(caption=caption, layers=layers)


def _make_surroundings(view: ViewInput) -> list[Layer]:
    """Make the layers of all points beside the object, and of the known background; both hidden."""
    other_m = cloud_from_depth(view.depth_m, ~view.mask, view.K).float()
    other_m = take_evenly(other_m, _MAX_SURROUNDINGS)
    layers = [_make_point_layer("all else", other_m, _SURROUNDINGS_COLOR, is_shown=False)]
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
    name: str, points_m: Float[Tensor, "n 3"], color: Rgb, *, is_shown: bool = True
) -> Layer:
    """Make a layer of points of one colour."""
    colors = torch.tensor(color).expand(len(points_m), 3)
    return Layer(name=name, shape=PointCloud(points=points_m, color=colors), is_shown=is_shown)


def cut_close_up(
    image: Float[Tensor, "3 h w"], mask: Bool[Tensor, "h w"], K: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, "3 _ _"], Float[Tensor, "3 3"]]:
    """Cut a square about the mask out of an image, and resize it; it is black beyond the image.

    Returns:
        The square, of ``_CLOSE_UP_PX`` pixels a side, and its intrinsic matrix (float64); image and
        K as they are where the mask is empty.
    """
    rows, columns = mask.nonzero(as_tuple=True)
    if len(rows) == 0:
        return image, K
    # The square about the centre of the mask's box, in columns and rows.
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
