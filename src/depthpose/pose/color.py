"""Colour as evidence: which of the poses that depth cannot tell apart shows the right print?

At each pose the coloured surface that the camera sees is compared with the image: brightness, and
red and blue each against green, all as logarithms. Exposure, white balance and a screen's gamma are
then constants and factors, which a correlation does not see. What light adds to brightness by the
direction of a surface (Lambert) is taken off both by regression on the normal.

A correlation ``r`` of ``n`` independent places says how much of the image a pose explains: its log
likelihood above that of a pose whose print has nothing to do with the image is
``-n / 2 log(1 - r^2)``, that of a linear regression. Neighbouring places are not independent: ``n``
is the effective number of a correlation between two fields that each correlate with themselves
(Clifford, Richardson and Hemon 1989; Dutilleul 1993), so a smooth shade counts for little and fine
print for much.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.mesh import near_symmetries, turn_about
from depthpose.pose.types import Axis, ColorImage, ObjectModel, SurfaceColors, ViewInput

_SAMPLES = 4000  # coloured points of a model that are compared, about a third of them visible
_SWEPT = 1500  # in a sweep about an axis
_FACING = 0.3  # least cosine between ray and normal: more slanted print is blurred along the slant
_NEAR = 0.05  # of the diameter: a reading farther before the surface is of something else
_LEAST_VISIBLE = 40  # points; fewer say nothing
_BLUR = 1.0  # standard deviation of the image's blur, in distances of the model's coloured points
_BLACK = 0.05  # of the range: what noise and stray light make of black
_SATURATED = 0.98  # a channel of more is clipped, so the colour is false
_DARK = 0.06  # where no channel has more, the colour is noise
_PLAIN = 0.03  # standard deviation of a logarithm: of less contrast is no print
_POINTS_AT_ONCE = 1_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class ColorAgreement:
    """How the colours of a posed model and an image agree, for a batch of poses."""

    #: of brightness, red against green, blue against green; 0 where model or image are plain.
    correlation: Float64[Tensor, "b 3"]
    places: Float64[Tensor, "b 3"]  #: independent ones that each correlation is of
    visible: Int64[Tensor, " b"]  #: coloured points that were compared

    @property
    def score(self) -> Float64[Tensor, " b"]:
        """Mean of the three correlations, -1 to 1."""
        return self.correlation.mean(-1)

    @property
    def log_likelihood(self) -> Float64[Tensor, " b"]:
        """Log likelihood of the image above that of a print that has nothing to do with it.

        Differences are log odds between poses, and between objects at one place. It is 0 where
        colour says nothing: a grey model, too few places, or a print that runs the other way.
        """
        explained = self.correlation.clamp(0, _MOST).square()
        freedom = (self.places - _FITTED).clamp(min=0)
        return (-freedom / 2 * torch.log1p(-explained)).sum(-1)


_MOST = 0.99  # correlation that an image and a model can have: both are digitised
_FITTED = 2  # a factor and a constant are fitted to the image


def color_agreement(
    poses: Rigid, model: ObjectModel, view: ViewInput, *, samples: int = _SAMPLES
) -> ColorAgreement:
    """Compare the colours of a posed model with an image, for each of a batch of poses.

    Args:
        poses: ``camera_from_model`` of the depth camera.
        model: the object; without ``colors`` colour says nothing.
        view: depth and colour; without ``color`` colour says nothing. Its mask limits where the
            object is.
        samples: how many coloured points of the model are looked at.
    """
    if model.colors is None or view.color is None:
        nothing = torch.zeros(len(poses.R), 3, dtype=torch.float64)
        return ColorAgreement(correlation=nothing, places=nothing, visible=nothing[:, 0].long())
    surface = _thinned(model.colors, samples)
    image = _blurred(view.color, poses, surface)
    parts: list[ColorAgreement] = []
    at_once = max(1, _POINTS_AT_ONCE // len(surface.points_m))
    for first in range(0, len(poses.R), at_once):
        of_chunk = poses[first : first + at_once].double()
        seen = _look(of_chunk, surface, view, image, _NEAR * model.diameter_m)
        correlation = _correlation(seen)
        places = torch.where(correlation != 0, _independent_places(seen, surface), 0.0)
        visible = seen.weight[..., 0].sum(-1).long()
        parts.append(ColorAgreement(correlation=correlation, places=places, visible=visible))
    return ColorAgreement(
        correlation=torch.cat([part.correlation for part in parts]),
        places=torch.cat([part.places for part in parts]),
        visible=torch.cat([part.visible for part in parts]),
    )


def _thinned(colors: SurfaceColors, samples: int) -> SurfaceColors:
    """Give at most so many of the coloured points, evenly taken."""
    return SurfaceColors(
        points_m=take_evenly(colors.points_m, samples),
        normals=take_evenly(colors.normals, samples),
        rgb=take_evenly(colors.rgb, samples),
        spacing_m=colors.spacing_m,  # over which each colour is a mean, not where the next one is
    )


class _BlurredImage(NamedTuple):
    """The part of a colour image about an object, as blurred as the model's colours are."""

    rgb: Float[Tensor, "3 h w"]
    left: int
    top: int


def _in_color_camera(
    points_m: Float64[Tensor, "*b n 3"], color: ColorImage
) -> tuple[Float64[Tensor, "*b n 2"], Float64[Tensor, "*b n"]]:
    """Give pixels of a colour image, and depths, of points in the depth camera's frame."""
    beside = color.color_from_depth
    moved_m = points_m if beside is None else beside.double().apply(points_m)
    depth_m = moved_m[..., 2]
    pixels = (moved_m @ color.K.double().mT)[..., :2] / depth_m.clamp(min=1e-6)[..., None]
    return pixels, depth_m


def _blurred(color: ColorImage, poses: Rigid, surface: SurfaceColors) -> _BlurredImage:
    """Blur an image over the distance of the model's colours, where the poses lie."""
    some_m = take_evenly(surface.points_m, 300).double()
    pixels, depth_m = _in_color_camera(poses.double().apply(some_m), color)
    is_front = depth_m > 0
    height, width = color.rgb.shape[1:]
    if not bool(is_front.any()):
        return _BlurredImage(color.rgb, 0, 0)
    sigma = _BLUR * surface.spacing_m * float(color.K[0, 0] / depth_m[is_front].median())
    sigma = min(max(sigma, 1.0), max(height, width) / 8)
    reach = math.ceil(3 * sigma)
    low = pixels[is_front].amin(0) - 2 * reach
    high = pixels[is_front].amax(0) + 2 * reach
    left = int(low[0].clamp(0, width - 1))
    right = int(high[0].clamp(0, width - 1)) + 1
    top = int(low[1].clamp(0, height - 1))
    bottom = int(high[1].clamp(0, height - 1)) + 1
    steps = torch.arange(-reach, reach + 1, dtype=torch.float32)
    kernel = torch.exp(-(steps**2) / (2 * sigma**2))
    kernel /= kernel.sum()
    part = color.rgb[:, None, top:bottom, left:right].float()
    part = F.conv2d(F.pad(part, (reach, reach, 0, 0), "replicate"), kernel[None, None, None])
    part = F.conv2d(F.pad(part, (0, 0, reach, reach), "replicate"), kernel[None, None, :, None])
    return _BlurredImage(part[:, 0], left, top)


class _Seen(NamedTuple):
    """Features of a model and of an image at the same places, each less its mean and shading."""

    weight: Float64[Tensor, "b n 3"]  # 1 where a feature is compared, else 0
    of_model: Float64[Tensor, "b n 3"]
    of_image: Float64[Tensor, "b n 3"]


def _features(rgb: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b 3"]:
    """Give logarithms of brightness, of red over green, and of blue over green."""
    red, green, blue = (rgb + _BLACK).log().unbind(-1)
    return torch.stack([(rgb.mean(-1) + _BLACK).log(), red - green, blue - green], -1)


def _look(
    poses: Rigid, surface: SurfaceColors, view: ViewInput, image: _BlurredImage, near_m: float
) -> _Seen:
    """Find what the cameras see of the posed surface, and what colours are there."""
    assert view.color is not None
    points_m = poses.apply(surface.points_m.double())
    normals = surface.normals.double() @ poses.R.mT
    distance_m = points_m.norm(dim=-1)
    facing = -(normals * points_m).sum(-1) / distance_m.clamp(min=1e-9)

    # The depth camera sees the surface, and nothing before it.
    pixels = (points_m @ view.K.double().mT)[..., :2] / points_m[..., 2:].clamp(min=1e-6)
    height, width = view.depth_m.shape
    column, row = pixels.round().long().unbind(-1)
    is_seen = (facing > _FACING) & (points_m[..., 2] > 0)
    is_seen &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
    place = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    read_m = view.depth_m.flatten()[place].double()
    is_seen &= ((read_m - points_m[..., 2]).abs() < near_m) & view.mask.flatten()[place]

    # The colour camera's image there.
    at, depth_m = _in_color_camera(points_m, view.color)
    rows, columns = view.color.rgb.shape[1:]
    u, v = at.unbind(-1)
    is_seen &= (depth_m > 0) & (u >= 0) & (u <= columns - 1) & (v >= 0) & (v <= rows - 1)
    side = torch.tensor(image.rgb.shape[:0:-1]).double().sub(1).clamp(min=1)
    corner = torch.tensor([image.left, image.top]).double()
    grid = (2 * (at - corner) / side - 1).float()
    rgb = F.grid_sample(image.rgb[None], grid[None], align_corners=True)[0].double()
    rgb = rgb.permute(1, 2, 0)

    # Colour is false where a channel is clipped, and noise where all are dark.
    has_color = (rgb.amax(-1) < _SATURATED) & (rgb.amax(-1) > _DARK)
    weight = torch.stack([is_seen, is_seen & has_color, is_seen & has_color], -1).double()
    of_model = _features(surface.rgb.double()).expand(len(points_m), -1, -1)
    return _Seen(
        weight=weight,
        of_model=_without_light(of_model, normals, weight),
        of_image=_without_light(_features(rgb), normals, weight),
    )


_RIDGE = 1e-4  # of the normals' second moments: a plane has no second direction


def _without_light(
    features: Float64[Tensor, "b n 3"],
    normals: Float64[Tensor, "b n 3"],
    weight: Float64[Tensor, "b n 3"],
) -> Float64[Tensor, "b n 3"]:
    """Take means off features, and off brightness what is linear in the normal (Lambert)."""
    total = weight.sum(1, keepdim=True).clamp(min=1)
    features = (features - (weight * features).sum(1, keepdim=True) / total) * weight
    lit = features[..., :1]
    used = weight[..., :1]
    sides = (normals - (used * normals).sum(1, keepdim=True) / total[..., :1]) * used
    moments = sides.mT @ sides + _RIDGE * total[..., :1] * torch.eye(3, dtype=torch.float64)
    shade = sides @ torch.linalg.solve(moments, sides.mT @ lit)
    return torch.cat([lit - shade, features[..., 1:]], -1)


def _correlation(seen: _Seen) -> Float64[Tensor, "b 3"]:
    """Correlate what is seen; 0 where too little is, or either has no print."""
    total = seen.weight.sum(1)
    of_model = seen.of_model.square().sum(1)
    of_image = seen.of_image.square().sum(1)
    both = (seen.of_model * seen.of_image).sum(1)
    least = _PLAIN**2 * total
    is_printed = (of_model > least) & (of_image > least) & (total >= _LEAST_VISIBLE)
    return torch.where(is_printed, both / (of_model * of_image).clamp(min=1e-12).sqrt(), 0.0)


_PAIRED = 250  # visible points whose pairs give the correlation of neighbours
_BINS = 16  # of distances, the finer the nearer
_POSES_AT_ONCE = 16


def _independent_places(seen: _Seen, surface: SurfaceColors) -> Float64[Tensor, "b 3"]:
    """Effective number of places of a correlation of two fields with neighbours alike.

    The variance of the correlation of two unrelated fields is the mean product of their
    autocorrelations over all pairs of places (Dutilleul 1993). Products below 0, as those of
    chance, are left out, so that the number is rather too small.
    """
    generator = torch.Generator().manual_seed(0)
    key = torch.rand(seen.weight.shape[1], generator=generator, dtype=torch.float64)
    count = min(_PAIRED, seen.weight.shape[1])
    reach_m = float((surface.points_m.amax(0) - surface.points_m.amin(0)).norm())
    places: list[Tensor] = []
    for first in range(0, len(seen.weight), _POSES_AT_ONCE):
        here = slice(first, first + _POSES_AT_ONCE)
        chosen = (seen.weight[here, :, 0] * (1 + key)).topk(count, dim=1).indices
        points_m = surface.points_m.double()[chosen]
        apart = torch.cdist(points_m, points_m) / reach_m
        number = (apart.sqrt() * _BINS).long().clamp(max=_BINS - 1)
        number += _BINS * torch.arange(len(chosen))[:, None, None]
        each = chosen[..., None].expand(-1, -1, 3)
        weight, *fields = (values[here].gather(1, each) for values in seen)
        pairs = torch.einsum("bif,bjf->fbij", weight, weight)
        alike: list[Tensor] = []
        for values in fields:
            products = torch.einsum("bif,bjf->fbij", values, values)
            binned = _binned(products, number) / _binned(pairs, number).clamp(min=1)
            variance = values.square().sum(1).mT / weight.sum(1).mT.clamp(min=1)
            alike.append(binned / variance.clamp(min=1e-12)[..., None])
        product = (alike[0] * alike[1]).clamp(min=0)
        off_diagonal = _binned(pairs, number) * product
        # A place with itself is alike, whatever its bin says.
        itself = weight.square().sum(1).mT
        off_diagonal[..., 0] -= itself * product[..., 0]
        total = itself.square()
        variance = (off_diagonal.sum(-1) + itself) / total.clamp(min=1)
        places.append((1 / variance.clamp(min=1 / count)).mT)
    return torch.cat(places)


def _binned(
    values: Float64[Tensor, "f b m m"], number: Int64[Tensor, "b m m"]
) -> Float64[Tensor, "f b bins"]:
    """Sum values of pairs by the bin of their distance."""
    flat = values.flatten(1)
    sums = flat.new_zeros(len(flat), len(number) * _BINS)
    return sums.index_add_(1, number.flatten(), flat).unflatten(1, (len(number), _BINS))


_STEP_DEG = 5.0
_FINE = 5  # finer steps in each of a sweep
_MOST_SPINS = 3  # of one axis that are kept


def copies_about_axis(
    pose: Rigid, axis: Axis, model: ObjectModel, view: ViewInput, *, step_deg: float = _STEP_DEG
) -> Rigid:
    """Turn a pose about an axis of the model to where its print agrees with the image.

    A sweep of the full turn finds where the agreement is largest; there, finer steps and the
    parabola through the best three follow.

    Args:
        pose: ``camera_from_model``, one.
        axis: of revolution, of the model's shape, or nearly so.
        model: the object, with colours.
        view: depth and colour.
        step_deg: of the sweep; print narrower than it along the circumference is stepped over.

    Returns:
        Poses at the largest agreements, at most three, the best first; ``pose`` alone where colour
        says nothing.
    """
    if model.colors is None or view.color is None:
        return pose.double()[None]
    steps = max(3, math.ceil(360 / step_deg))
    step_rad = 2 * math.pi / steps
    sweep_rad = torch.arange(steps, dtype=torch.float64) * step_rad
    rough = _explained(_turned(pose, axis, sweep_rad), model, view, _SWEPT)
    is_peak = (rough >= rough.roll(1)) & (rough > rough.roll(-1)) & (rough > 0)
    peaks = is_peak.nonzero()[:, 0]
    peaks = peaks[rough[peaks].argsort(descending=True)][:_MOST_SPINS]
    if len(peaks) == 0:
        return pose.double()[None]
    offsets = torch.arange(-_FINE, _FINE + 1, dtype=torch.float64) * (step_rad / _FINE)
    angles_rad = sweep_rad[peaks, None] + offsets
    fine = _explained(_turned(pose, axis, angles_rad.flatten()), model, view, _SAMPLES)
    fine = fine.reshape(angles_rad.shape)
    best = fine.argmax(1).clamp(1, 2 * _FINE - 1)
    beside = fine.gather(1, best[:, None] + torch.tensor([-1, 0, 1]))
    found_rad = angles_rad.gather(1, best[:, None])[:, 0] + _peak(beside) * step_rad / _FINE
    order = beside[:, 1].argsort(descending=True)
    return _turned(pose, axis, found_rad[order])


def _turned(pose: Rigid, axis: Axis, angles_rad: Float64[Tensor, " a"]) -> Rigid:
    return pose.double()[None] @ turn_about(
        axis.direction.double(), axis.point_m.double(), angles_rad
    )


def _explained(
    poses: Rigid, model: ObjectModel, view: ViewInput, samples: int
) -> Float64[Tensor, " b"]:
    """Give what colours explain, a place alike for all poses: for sweeps of many of them."""
    assert model.colors is not None
    assert view.color is not None
    surface = _thinned(model.colors, samples)
    image = _blurred(view.color, poses, surface)
    shares: list[Tensor] = []
    at_once = max(1, _POINTS_AT_ONCE // len(surface.points_m))
    for first in range(0, len(poses.R), at_once):
        of_chunk = poses[first : first + at_once]
        seen = _look(of_chunk, surface, view, image, _NEAR * model.diameter_m)
        explained = _correlation(seen).clamp(0, _MOST).square()
        shares.append((-seen.weight.sum(1) * torch.log1p(-explained)).sum(-1))
    return torch.cat(shares)


_SAME_RAD = math.radians(3)
_MOST_COPIES = 8
_ONE_TURN_RAD = math.radians(10)
_MANY_TURNS = 6  # about one line: the shape nearly is a body of revolution
_ALONG = math.cos(math.radians(8))  # cosine from which two directions are one


def color_copies(
    pose: Rigid,
    model: ObjectModel,
    view: ViewInput,
    *,
    turns: Rigid | None = None,
    most: int = _MOST_COPIES,
) -> Rigid:
    """Propose what a pose may be exchanged for by colour: copies that look alike to depth.

    They are symmetric copies that were found in the shape, near-symmetric ones, half turns about
    the principal axes, and of each the turns about axes of revolution, or nearly so, by which its
    print agrees. Declared symmetries are none: their copies are one answer. A copy is to be refined
    by depth, and settled (:func:`settle_spin`), before its evidence is compared.

    Args:
        pose: ``camera_from_model``, one.
        model: the object.
        view: depth and colour.
        turns: motions of the model to try in place of those that its shape shows.
        most: so many are given beside ``pose``.

    Returns:
        A batch of poses, ``pose`` itself the first, then the others, what agrees best before.
    """
    pose = pose.double()
    if model.colors is None or view.color is None:
        return pose[None]
    shown, axes = _look_alikes(model)
    tried = shown if turns is None else [turns.double()[k] for k in range(len(turns.R))]

    # Of copies that a turn about an axis carries into each other one is swept.
    eye = Rigid(torch.eye(3).double(), torch.zeros(3).double())
    distinct = [eye]
    for turn in tried:
        is_swept = any(_is_spun(turn, other, axis) for axis in axes for other in distinct)
        apart_rad = [float(geodesic_rad(turn.R, other.R)) for other in distinct]
        if not is_swept and min(apart_rad) > _ONE_TURN_RAD:
            distinct.append(turn)
    proposed: list[Rigid] = []
    for base in (pose @ turn for turn in distinct):
        spun = [copies_about_axis(base, axis, model, view) for axis in axes]
        proposed += spun or [base[None]]
    every = Rigid.cat(proposed)
    order = _explained(every, model, view, _SAMPLES).argsort(descending=True, stable=True)
    best = [pose[None]]
    for k in order.tolist():
        before = Rigid.cat(best)
        apart_rad = geodesic_rad(every.R[k].expand_as(before.R), before.R)
        if float(apart_rad.min()) > _SAME_RAD and len(best) <= most:
            best.append(every[k][None])
    return Rigid.cat(best)


def settle_spin(pose: Rigid, model: ObjectModel, view: ViewInput) -> Rigid:
    """Turn a pose a little about axes that depth does not fix, to where its print agrees best.

    Refinement by depth drifts about an axis of revolution; print says where it stands.

    Args:
        pose: ``camera_from_model``, one; within 20 degrees of where it belongs.
        model: the object.
        view: depth and colour.

    Returns:
        The pose, turned; as it was where colour says nothing or the shape has no such axis.
    """
    pose = pose.double()
    if model.colors is None or view.color is None:
        return pose
    offsets_rad = torch.arange(-10, 11).double() * math.radians(2)
    for axis in _look_alikes(model)[1]:
        explained = _explained(_turned(pose, axis, offsets_rad), model, view, _SWEPT)
        best = int(explained.argmax().clamp(1, len(offsets_rad) - 2))
        if float(explained[best]) > 0:
            peak = _peak(explained[best - 1 : best + 2])
            pose = _turned(pose, axis, offsets_rad[best, None] + peak * math.radians(2))[0]
    return pose


def _peak(values: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b"]:
    """Place of the largest value of a parabola through three, from the middle one, -1..1."""
    before, at, after = values.unbind(-1)
    bend = (before - 2 * at + after).clamp(max=-1e-9)
    return ((before - after) / (2 * bend)).clamp(-1, 1)


@lru_cache(maxsize=64)
def _look_alikes(model: ObjectModel) -> tuple[list[Rigid], list[Axis]]:
    """Give the turns after which a shape looks alike or nearly, and axes of any turn."""
    assert model.colors is not None
    symmetries = model.symmetries if model.symmetries.is_found else None
    turns = [near.model_from_model.double() for near in near_symmetries(model)]
    if symmetries is not None and symmetries.discrete is not None:
        turns += [symmetries.discrete.double()[k] for k in range(len(symmetries.discrete.R))]
    axes = [] if symmetries is None else list(symmetries.continuous)
    axes += _axes_of_many(turns, axes)
    # A box whose halves differ a little looks alike after half turns about its middle.
    points_m = model.colors.points_m.double()
    principal = torch.linalg.eigh((points_m - points_m.mean(0)).T.cov()).eigenvectors.T
    along_m = points_m @ principal.T
    middle_m = (along_m.amin(0) + along_m.amax(0)) / 2 @ principal
    half = torch.tensor(math.pi, dtype=torch.float64)
    turns += [turn_about(direction, middle_m, half) for direction in principal]
    return turns, axes


def _axes_of_many(turns: Sequence[Rigid], known: Sequence[Axis]) -> list[Axis]:
    """Find lines about which a shape looks alike after many turns, beside those that are known."""
    eye = torch.eye(3).double()
    # The direction that a rotation leaves alone, and a point that it does.
    directions = [torch.linalg.svd(turn.R - eye).Vh[-1] for turn in turns]
    axes: list[Axis] = []
    for direction in directions:
        others = [*known, *axes]
        is_known = any(abs(float(direction @ axis.direction.double())) > _ALONG for axis in others)
        alike = [k for k, d in enumerate(directions) if abs(float(d @ direction)) > _ALONG]
        if is_known or len(alike) < _MANY_TURNS:
            continue
        points = [torch.linalg.pinv(eye - turns[k].R, rtol=1e-3) @ turns[k].t_m for k in alike]
        point_m = torch.stack(points).median(0).values
        axes.append(Axis(direction=direction, point_m=point_m))
    return axes


def _is_spun(turn: Rigid, other: Rigid, axis: Axis) -> bool:
    """Whether two turns differ by a turn about an axis of the model: both move it alike."""
    direction = axis.direction.double()
    return float((turn.R @ direction) @ (other.R @ direction)) > _ALONG
