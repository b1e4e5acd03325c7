"""A pose on a page: the picture with the posed model, numbers, and the cloud with it in 3D."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import back_project
from depthpose.core.draw import draw_outline
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import object_points
from depthpose.pose.estimator.prepare import AnyInput
from depthpose.pose.types import Identity, ObjectModel, PoseEstimate, ViewInput
from depthpose.report.overlay import (
    alternative_layers,
    draw_pose,
    grey_depth,
    keypoint_layers,
    pose_layers,
)
from depthpose.report.scene import Layer, Scene, colored_points
from depthpose.report.tables import Drawing, Row, Section

_SEEN = (0.55, 0.55, 0.55)
_AROUND = (0.7, 0.66, 0.6)
_MASKED = (1.0, 0.85, 0.1)
_AROUND_POINTS = 20_000
_MARGIN = 0.6
"""About an object in a close-up, in its own width."""
_CLOSE_UP_PX = 360


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseShown:
    """An estimate or a refusal as a page shows it.

    Attributes:
        given: what was seen.
        estimate: its result.
        model: the object.
        image: what the pose is drawn over, of the view's camera; None: its depth in grey.
        truth: ``camera_from_model``, where it is known.
    """

    given: AnyInput
    estimate: PoseEstimate
    model: ObjectModel
    image: Float[Tensor, "3 h w"] | None = None
    truth: Rigid | None = None


def pose_section(title: str, shown: PoseShown, text: str = "", rows: Sequence[Row] = ()) -> Section:
    """Show one estimate: sentence and numbers, the picture, the cloud with the model in 3D."""
    found, model = shown.estimate, shown.model
    points_m = object_points(shown.given, model.diameter_m)
    scene = pose_scene(shown.given, points_m, found, model, shown.truth)
    return Section(
        title=title,
        text=f"{text} {pose_sentence(found)}".strip(),
        facts=pose_facts(found, model),
        rows=rows,
        tables=pose_tables(found),
        pictures=_drawings(shown),
        scenes=[scene],
    )


def pose_sentence(found: PoseEstimate) -> str:
    """Give where the object is, or why it is refused."""
    if found.camera_from_model is None:
        return f"Refused ({found.status}): {found.reason}."
    x, y, z = found.camera_from_model.t_m.tolist()
    said = f"The {found.object} is at x {x:.4f}, y {y:.4f}, z {z:.4f} m in the camera's frame."
    if found.status == "ambiguous":
        said += f" It is ambiguous: {found.reason}."
    if not found.alternatives:
        return said
    return f"{said} Other poses fit as well: {'; '.join(alternative_lines(found))}."


def alternative_lines(found: PoseEstimate) -> list[str]:
    """Say of each alternative how it differs from the pose, and how likely it is."""
    return [f"{one.difference}, {one.probability:.0%}" for one in found.alternatives]


def identity_words(identity: Identity) -> str:
    """Say whether it is the object, and the size that fits best."""
    said = identity.status + (f" ({identity.reason})" if identity.reason else "")
    if identity.size is not None and identity.size_deviation is not None:
        said += f"; size {identity.size:.3f} +- {identity.size_deviation:.3f} of the model's"
    return said


def pose_facts(
    found: PoseEstimate,
    model: ObjectModel,
    how: str = "",
    agreeing: str = "votes or points that agree",
) -> list[tuple[str, str]]:
    """Say what is known of an estimate besides its pose.

    Args:
        found: the estimate.
        model: the object.
        how: by what it was found; empty: not said.
        agreeing: what the estimate's ``inlier_share`` is of.
    """
    facts = [("object", f"{found.object}, {model.diameter_m:.4f} m long")]
    if how:
        facts.append(("by", how))
    if found.fit is not None:
        facts += [
            ("fits", f"{found.fit.agrees:.1%} of the posed surface that was seen agrees"),
            ("seen", f"{found.fit.seen:.0%} of the surface that faces the camera"),
            ("the sensor's noise there", f"{1000 * found.fit.noise_m:.1f} mm"),
        ]
    if found.identity is not None:
        facts.append(("identity", identity_words(found.identity)))
    if found.certainty is not None:
        facts.append(("certainty of this pose", f"{found.certainty:.3f}"))
    facts += [("another pose that fits", line) for line in alternative_lines(found)]
    if found.inlier_share is not None:
        facts.append((agreeing, f"{found.inlier_share:.0%}"))
    if found.residual_m is not None and math.isfinite(found.residual_m):
        facts.append(("distance left (RMS)", f"{1000 * found.residual_m:.2f} mm"))
    if found.free_motions is not None and len(found.free_motions):
        free = f"{len(found.free_motions)} (a declared symmetry; the covariance leaves them out)"
        facts.append(("free motions", free))
    if found.seconds:
        stages = ", ".join(f"{name} {1000 * s:.0f}" for name, s in found.seconds.items())
        facts.append(("ms", stages))
    return facts


def pose_tables(found: PoseEstimate) -> dict[str, Sequence[Sequence[str]]]:
    """Show the pose, and how far it may be off along each axis."""
    tables: dict[str, Sequence[Sequence[str]]] = {}
    pose = found.camera_from_model
    if pose is not None:
        rows = torch.cat([pose.R, pose.t_m[:, None]], 1).tolist()
        tables["camera_from_model: R | t [m]"] = [[f"{v:.5f}" for v in row] for row in rows]
    if pose is not None and found.covariance is not None:
        assert found.origin_std_mm is not None
        assert found.rotation_std_deg is not None
        stds = {
            "place of the model's origin along the camera's axes [mm]": found.origin_std_mm,
            "rotation about the model's axes [deg]": found.rotation_std_deg,
        }
        tables["standard deviations about this answer alone"] = [
            ["", "x", "y", "z"],
            *(
                [what, *(f"{v:.3f}" if math.isfinite(v) else "free" for v in std.tolist())]
                for what, std in stds.items()
            ),
        ]
        tables["covariance at the camera's origin, of rotation [rad] and translation [m]"] = [
            [f"{v:.2e}" for v in row] for row in found.covariance.tolist()
        ]
    return tables


def pose_scene(
    given: AnyInput,
    points_m: Float[Tensor, "n 3"],
    found: PoseEstimate,
    model: ObjectModel,
    truth: Rigid | None = None,
) -> Scene:
    """Show what was seen, the posed model, its keypoints, and the truth where it is known."""
    layers = [Layer(name="the object, as seen", shape=colored_points(points_m, _SEEN))]
    pose = found.camera_from_model
    if pose is not None:
        layers += pose_layers(pose, model, with_box=truth is not None)
        layers += alternative_layers(found, model)
    if truth is not None:
        layers += pose_layers(truth, model, is_true=True)
    if found.keypoints_m is not None:
        layers += keypoint_layers(found.keypoints_m, pose, model)
    if isinstance(given, ViewInput):
        around_m = back_project(given.depth_m, given.K)[~given.mask]
        around_m = around_m[around_m.isfinite().all(-1)].float()
        around = colored_points(take_evenly(around_m, _AROUND_POINTS), _AROUND)
        layers.append(Layer(name="all else", shape=around, is_shown=False))
    caption = "The cloud and the posed model" if pose is not None else "The cloud; there is no pose"
    return Scene(caption=caption, layers=layers)


def draw_boxes(
    image: Float[Tensor, "3 h w"],
    poses: tuple[Rigid | None, Rigid | None],
    model: ObjectModel,
    K: Float[Tensor, "3 3"],
) -> Float[Tensor, "3 h w"]:
    """Draw the box of the truth, green and dashed, and of the estimate, blue and solid.

    Args:
        image: it is not changed.
        poses: truth and estimate, each where there is one.
        model: the object.
        K: intrinsic matrix of the image.
    """
    truth, found = poses
    if found is not None:
        image = draw_pose(image, found, model, K.double())
    if truth is not None:
        image = draw_pose(image, truth, model, K.double(), is_true=True)
    return image


def close_up(
    image: Float[Tensor, "3 h w"], mask: Bool[Tensor, "h w"], K: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, "3 _ _"], Float[Tensor, "3 3"]]:
    """Cut out a square about what the mask shows and enlarge it to a panel, with its camera."""
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


def _drawings(shown: PoseShown) -> list[Drawing]:
    """Draw the whole picture and the object from near by; the mask where there is no pose."""
    view = shown.given
    if not isinstance(view, ViewInput):
        return []
    image = grey_depth(view.depth_m) if shown.image is None else shown.image
    poses = (shown.truth, shown.estimate.camera_from_model)
    what = "depth image, near bright" if shown.image is None else "picture"
    if poses[1] is None:
        image = draw_outline(image, view.mask, _MASKED)
    said = "the estimated pose blue" if poses[1] is not None else "the border of the mask yellow"
    said += ", the box of the truth green and dashed" if poses[0] is not None else ""
    whole = draw_boxes(image, poses, shown.model, view.K)
    drawings = [Drawing(image=whole, caption=f"{what}; {said}")]
    if bool(view.mask.any()):
        near, K = close_up(image, view.mask, view.K)
        near = draw_boxes(near, poses, shown.model, K)
        drawings.append(Drawing(image=near, caption=f"the object from near by; {said}"))
    return drawings
