"""A pose on a page: the object over its picture, numbers, and the cloud with it in 3D."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import project
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
_SURFACE = 5000
_BEND = math.radians(30)
_CROSS = 0.04  # half of the mark of a keypoint, in diameters of the object
_VOTES = 40  # points whose votes are drawn
_DASH_PX = 6.0


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
        image: of the camera; it is not changed.
        pose: ``camera_from_model``; None: the truth alone is drawn.
        model: the object; one of points alone is drawn by small discs.
        K: intrinsic matrix of the image.
        truth: ``camera_from_model``, whose box is drawn too, green and dashed; None: it is unknown.
    """
    K = K.double()
    if pose is not None:
        ends_px = project(pose.double().apply(box_edges(model).double()), K)
        posed_m = pose.double().apply(drawn_triangles(model).double())
        raster = rasterize(posed_m, K, image.shape[2], image.shape[1], with_barycentric=False)
        image = draw_outline(image, raster.depth_m.isfinite(), ESTIMATED)
        image = draw_lines(image, ends_px, ESTIMATED)
    if truth is not None:
        ends_px = project(truth.double().apply(box_edges(model).double()), K)
        image = draw_lines(image, ends_px, TRUTH, dash_px=_DASH_PX)
    return image


def draw_region(
    image: Float[Tensor, "3 h w"], view: ViewInput, pose: Rigid | None
) -> Float[Tensor, "3 h w"]:
    """Draw the border of where an object was looked for, in yellow: a box; without a pose a mask.

    Args:
        image: of the camera; it is not changed.
        view: with its mask or box.
        pose: that was estimated, if any.
    """
    if pose is None or view.is_region:
        return draw_outline(image, view.mask, _MASKED)
    return image


def box_edges(model: ObjectModel) -> Float[Tensor, "12 2 3"]:
    """Give both ends of the edges of the model's box, along its axes [m]."""
    low = model.vertices_m.amin(0)
    high = model.vertices_m.amax(0)
    corners = torch.cartesian_prod(*torch.stack([low, high], -1))
    pairs = [(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit]
    return corners[torch.tensor(pairs)]


def pose_layers(
    pose: Rigid, model: ObjectModel, *, is_true: bool = False, with_box: bool = False
) -> list[Layer]:
    """Show a posed object in space: surface, edges, box and axes; the truth by edges and box.

    Edges are where the surface ends, or bends by more than 30 degrees. ``with_box``: whether an
    estimate's box is seen at first; that of a truth is.
    """
    pose = pose.double()
    box_m = pose.apply(box_edges(model).double()).float()
    edges_m = _bent_edges(model)
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


def _bent_edges(model: ObjectModel) -> Float64[Tensor, "n 2 3"] | None:
    """Give both ends of the edges where a mesh ends, or bends by more than ``_BEND`` [m].

    None of a model without faces.
    """
    if not len(model.faces):
        return None
    # By place, not by number: STL repeats the points of every face.
    places_m, place = torch.unique(model.vertices_m, dim=0, return_inverse=True)
    ends = place[model.faces]
    sides = torch.cat([ends[:, [0, 1]], ends[:, [1, 2]], ends[:, [2, 0]]]).sort(-1).values
    edges, edge_of, count = torch.unique(sides, dim=0, return_inverse=True, return_counts=True)

    # Two unit normals at an angle have a mean as long as the cosine of half of it.
    a, b, c = model.vertices_m[model.faces].double().unbind(1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    total = normal.new_zeros(len(edges), 3).index_add_(0, edge_of, normal.repeat(3, 1))
    is_bent = total.norm(dim=-1) / count < math.cos(_BEND / 2)
    return places_m[edges[is_bent | (count == 1)]].double()


def keypoint_layers(
    voted_m: Float[Tensor, "k 3"], pose: Rigid | None, model: ObjectModel
) -> list[Layer]:
    """Show the keypoints as voted, and as the model has them if it was posed (camera frame)."""
    marks = [("keypoints, voted", voted_m, VOTED)]
    if pose is not None:
        posed_m = pose.apply(model.keypoints_m.to(pose.R))
        marks.append(("keypoints, of the posed model", posed_m, ESTIMATED))
    layers = []
    for name, at_m, color in marks:
        arms_m = _CROSS * model.diameter_m * torch.eye(3).to(at_m)
        ends_m = torch.stack([at_m[:, None] - arms_m, at_m[:, None] + arms_m], 2).flatten(0, 1)
        layers.append(Layer(name=name, shape=colored_lines(ends_m.float(), color)))
    return layers


def vote_layer(
    points_m: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n k 3"],
    voted_m: Float[Tensor, "k 3"],
) -> Layer:
    """Show votes: from some points, along directions of any length, past the voted keypoints."""
    from_m = take_evenly(points_m, _VOTES)
    toward = take_evenly(directions, _VOTES)
    toward = torch.nn.functional.normalize(toward, dim=-1)
    way_m = ((voted_m - from_m[:, None]) * toward).sum(-1, keepdim=True).clamp(min=0)
    starts_m = from_m[:, None].expand_as(toward)
    ends_m = torch.stack([starts_m, starts_m + way_m * toward], -2).flatten(0, 1)
    return Layer(name="votes", shape=colored_lines(ends_m.float(), VOTED), is_shown=False)


def posed_cloud(cloud_m: Float[Tensor, "n 3"], pose: Rigid | None, model: ObjectModel) -> Cloud:
    """Join the observed cloud (grey) and the posed surface of the model (blue).

    Without a pose, the cloud alone.
    """
    if pose is None:
        return Cloud(points=cloud_m.float(), color=torch.full((len(cloud_m), 3), 0.6))
    surface_m = pose.apply(sample_surface(model, _SURFACE)[0].to(pose.R))
    colors = [torch.full((len(cloud_m), 3), 0.6), torch.tensor(ESTIMATED).expand(len(surface_m), 3)]
    return Cloud(points=torch.cat([cloud_m.float(), surface_m.float()]), color=torch.cat(colors))


def object_points(pose_input: CloudInput | ViewInput, diameter_m: float) -> Float[Tensor, "n 3"]:
    """Give the points of an input that are readings, of a depth image without flying pixels."""
    if isinstance(pose_input, ViewInput):
        return cloud_from_depth(
            pose_input.depth_m, pose_input.mask, pose_input.K, diameter_m
        ).float()
    return pose_input.points_m[is_reading(pose_input.points_m)].float()


def grey_depth(depth_m: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    """Show depth by its grey, near bright and far dark, black where nothing was read.

    From the 1st to the 99th percentile of the readings: a stray one does not set the scale.
    """
    depths_m = depth_m[depth_m.isfinite() & (depth_m > 0)].sort().values
    if len(depths_m) == 0:
        return torch.zeros(3, *depth_m.shape)
    last = len(depths_m) - 1
    low = float(depths_m[round(0.01 * last)])
    high = float(depths_m[round(0.99 * last)])
    share = 1 - ((depth_m - low) / max(high - low, 1e-6)).clamp(0, 1)
    grey = torch.where(depth_m > 0, 0.15 + 0.85 * share, 0.0)
    return grey.nan_to_num(0.0).float().expand(3, -1, -1)


_SEEN = (0.55, 0.55, 0.55)
_AROUND = (0.7, 0.66, 0.6)
_BACKGROUND = (0.45, 0.6, 0.75)
_MASKED = (1.0, 0.85, 0.1)
_AROUND_POINTS = 20_000
_MARGIN = 0.6  # about an object in a close-up, in its own width
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
    looked for, and the mask where there is no pose. ``image`` is what the pose is drawn over, of
    the view's camera; None: its depth in grey. ``text`` comes before the sentence,
    ``rows`` are those of a table.
    """
    drawings: list[Drawing] = []
    if isinstance(pose_input, ViewInput):
        pose = estimate.camera_from_model
        mask = pose_input.mask
        K = pose_input.K
        what = "depth image, near bright" if image is None else "picture"
        image = grey_depth(pose_input.depth_m) if image is None else image
        image = draw_region(image, pose_input, pose)
        colors = [] if pose is None else ["the estimated pose blue"]
        if pose is None or pose_input.is_region:
            colors.append(f"the {'box' if pose_input.is_region else 'mask'} yellow")
        caption = f"{what}; {', '.join(colors)}"
        caption += ", the box of the truth green and dashed" if truth is not None else ""
        whole = draw_pose(image, pose, model, K, truth)
        drawings.append(Drawing(image=whole, caption=caption))
        if bool(mask.any()):
            near, K = close_up(image, mask, K)
            near = draw_pose(near, pose, model, K, truth)
            caption = f"the object from near by; {caption.partition('; ')[2]}"
            drawings.append(Drawing(image=near, caption=caption))
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


def pose_sentence(estimate: PoseEstimate) -> str:
    """Give where the object is, or why it is refused."""
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
    """List the facts of an estimate besides its pose.

    ``method``: what estimated it, if not empty; ``agreeing``: what its ``inlier_share`` is of.
    """
    facts = [("object", f"{estimate.object}, {model.diameter_m:.4f} m long")]
    if method:
        facts.append(("by", method))
    if (evidence := estimate.evidence) is not None:
        facts += [
            ("agreement", f"{evidence.agreement:.1%} of what was compared supports the pose"),
            ("visible", f"{evidence.supported_share:.0%} of the surface that faces the camera"),
            ("noise of the sensor there", f"{1000 * evidence.noise_m:.1f} mm"),
        ]
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
    """Show the pose, and how far it may be off along each axis."""
    tables: dict[str, Sequence[Sequence[str]]] = {}
    pose = estimate.camera_from_model
    if pose is not None:
        tables["camera_from_model: R | t [m]"] = _matrix_rows(pose)
    if estimate.base_from_model is not None:
        tables["base_from_model: R | t [m]"] = _matrix_rows(estimate.base_from_model)
    if pose is not None and estimate.covariance is not None:
        assert estimate.origin_std_mm is not None
        assert estimate.rotation_std_deg is not None
        stds = {
            "place of the model's origin along the camera's axes [mm]": estimate.origin_std_mm,
            "rotation about the model's axes [deg]": estimate.rotation_std_deg,
        }
        tables["standard deviations about this answer alone"] = [
            ["", "x", "y", "z"],
            *(
                [what, *(f"{v:.3f}" if math.isfinite(v) else "free" for v in std.tolist())]
                for what, std in stds.items()
            ),
        ]
        tables["covariance at the camera's origin, of rotation [rad] and translation [m]"] = [
            [f"{v:.2e}" for v in row] for row in estimate.covariance.tolist()
        ]
    return tables


def _matrix_rows(pose: Rigid) -> list[list[str]]:
    rows = torch.cat([pose.R, pose.t_m[:, None]], 1).tolist()
    return [[f"{value:.5f}" for value in row] for row in rows]


def pose_scene(
    pose_input: AnyInput,
    points_m: Float[Tensor, "n 3"],
    estimate: PoseEstimate,
    model: ObjectModel,
    truth: Rigid | None = None,
) -> Scene:
    """Show what was seen, the posed model, its keypoints, and the truth where it is known."""
    pose = estimate.camera_from_model
    layers = list[Layer]()
    if pose is not None:
        layers += pose_layers(pose, model, with_box=truth is not None)
    for other in estimate.alternatives:  # by axes and box, not shown at first
        placed = other.camera_from_model.double()
        box_m = placed.apply(box_edges(model).double()).float()
        box = colored_lines(box_m, ALTERNATIVE)
        layers.append(Layer(name=f"box if {other}", shape=box, is_shown=False))
        axes = frame_axes(placed.t_m, placed.R, model.diameter_m / 2)
        layers.append(Layer(name=f"axes if {other}", shape=axes, is_shown=False))
    if truth is not None:
        layers += pose_layers(truth, model, is_true=True)
    if estimate.keypoints_m is not None:
        layers += keypoint_layers(estimate.keypoints_m, pose, model)
    color = torch.tensor(_SEEN).expand(len(points_m), 3)
    observed = Layer(name="the object, as seen", shape=Cloud(points=points_m, color=color))
    layers.insert(0, observed)
    if isinstance(pose_input, ViewInput):
        around_m = cloud_from_depth(pose_input.depth_m, ~pose_input.mask, pose_input.K).float()
        around_m = take_evenly(around_m, _AROUND_POINTS)
        around = Cloud(points=around_m, color=torch.tensor(_AROUND).expand(len(around_m), 3))
        layers.append(Layer(name="all else", shape=around, is_shown=False))
    if isinstance(pose_input, ViewInput) and (known := pose_input.background) is not None:
        bin_m = cloud_from_depth(known.depth_m, known.depth_m > 0, pose_input.K).float()
        bin_m = take_evenly(bin_m, _AROUND_POINTS)
        drawn = Cloud(points=bin_m, color=torch.tensor(_BACKGROUND).expand(len(bin_m), 3))
        layers.append(Layer(name="the known background", shape=drawn, is_shown=False))
    caption = "The cloud and the posed model" if pose is not None else "The cloud; there is no pose"
    return Scene(caption=caption, layers=layers)


def close_up(
    image: Float[Tensor, "3 h w"], mask: Bool[Tensor, "h w"], K: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, "3 _ _"], Float[Tensor, "3 3"]]:
    """Cut out a square about the mask and enlarge it to a panel, with its camera."""
    rows, columns = mask.nonzero(as_tuple=True)
    if len(rows) == 0:
        return image, K
    low = torch.stack([columns.amin(), rows.amin()])
    high = torch.stack([columns.amax(), rows.amax()]) + 1
    side = int((1 + _MARGIN) * float((high - low).max()))
    left, top = ((low + high - side) // 2).tolist()
    # Beyond the picture there is black.
    padded = torch.nn.functional.pad(image, (side, side, side, side))
    part = padded[:, top + side : top + 2 * side, left + side : left + 2 * side]
    size = (_CLOSE_UP_PX, _CLOSE_UP_PX)
    grown = torch.nn.functional.interpolate(part[None], size=size)[0]
    scale = _CLOSE_UP_PX / side
    moved = K.double().clone()
    moved[:2, 2] -= torch.tensor([left - 0.5, top - 0.5], dtype=torch.float64)
    moved[:2] *= scale
    moved[:2, 2] -= 0.5
    return grown, moved
