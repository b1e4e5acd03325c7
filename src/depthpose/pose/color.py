"""Colour as evidence: which of the poses that depth cannot tell apart shows the right print?

At each pose the colours of the visible surface are compared with the image: brightness, red over
green and blue over green, all as logarithms. Exposure, white balance and a screen's gamma are then
constants and factors, to which a correlation is blind. Shading, the part of the brightness that is
linear in the normal (Lambert), is removed from both by regression.

A correlation ``r`` of ``n`` independent points tells how much of the image a pose explains: its log
likelihood above that of a pose whose print has nothing to do with the image is
``-n / 2 log(1 - r^2)``, that of a linear regression. Neighbouring points are not independent: ``n``
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
_SWEEP_SAMPLES = 1500  # coloured points that are compared in a sweep about an axis
_LEAST_COSINE = 0.3  # least cosine between ray and normal: more slanted print is blurred
_NEAR = 0.05  # diameters: a reading farther from the surface is of another object
_LEAST_VISIBLE = 40  # fewer visible points are not compared
_BLUR = 1.0  # standard deviation of the image's blur, in spacings of the model's coloured points
_BLACK = 0.05  # value, 0 to 1, that noise and stray light give to black
_SATURATED = 0.98  # a channel above this value is clipped, so the colour is false
_DARK = 0.06  # where no channel is above this value, the colour is noise
_PLAIN = 0.03  # a logarithm with a smaller standard deviation shows no print
_MOST_CORRELATION = 0.99  # largest correlation of an image and a model: both are digitised
_FITTED = 2  # unknowns that are fitted to the image: a factor and a constant
_POINTS_AT_ONCE = 1_000_000  # points of all poses that are compared at a time, for the memory


@dataclass(frozen=True, kw_only=True, eq=False)
class ColorAgreement:
    """How the colours of a posed model and an image agree, for a batch of poses."""

    #: of brightness, red against green, blue against green; 0 where model or image are plain.
    correlation: Float64[Tensor, "b 3"]
    independent: Float64[Tensor, "b 3"]  #: effective number of independent points of each
    visible: Int64[Tensor, " b"]  #: coloured points that were compared

    @property
    def score(self) -> Float64[Tensor, " b"]:
        """The mean of the three correlations, -1 to 1."""
        return self.correlation.mean(-1)

    @property
    def log_likelihood(self) -> Float64[Tensor, " b"]:
        """Log likelihood of the image above that of a print that has nothing to do with it.

        Differences are log odds between poses, and between objects at one place. It is 0 where
        colour says nothing: a grey model, too few points, or a print that runs the other way.
        """
        explained = self.correlation.clamp(0, _MOST_CORRELATION).square()
        freedom = (self.independent - _FITTED).clamp(min=0)
        return (-freedom / 2 * torch.log1p(-explained)).sum(-1)


def color_agreement(
    poses: Rigid, model: ObjectModel, view: ViewInput, *, samples: int = _SAMPLES
) -> ColorAgreement:
    """Compare the colours of a posed model with an image, for each of a batch of poses.

    Args:
        poses: ``camera_from_model`` of the depth camera.
        model: the object; without ``colors`` colour says nothing.
        view: depth and colour; without ``color`` colour says nothing. Its mask limits where the
            object is.
        samples: how many coloured points of the model are compared at most.
    """
    if model.colors is None or view.color is None:
        nothing = torch.zeros(len(poses.R), 3, dtype=torch.float64)
        return ColorAgreement(
            correlation=nothing, independent=nothing, visible=nothing[:, 0].long()
        )

    # So many poses at a time as fit in memory.
    surface = _take_samples(model.colors, samples)
    image = _blur_image(view.color, poses, surface)
    parts: list[ColorAgreement] = []
    at_once = max(1, _POINTS_AT_ONCE // len(surface.points_m))
    for first in range(0, len(poses.R), at_once):
        chunk = poses[first : first + at_once].double()
        compared = _compare_features(chunk, surface, view, image, _NEAR * model.diameter_m)
        correlation = _correlate(compared)
        # Colour that explains nothing has no independent points.
        independent = torch.where(
            correlation != 0, _count_independent_points(compared, surface), 0.0
        )
        visible = compared.weight[..., 0].sum(-1).long()
        parts.append(
            ColorAgreement(correlation=correlation, independent=independent, visible=visible)
        )
    return ColorAgreement(
        correlation=torch.cat([part.correlation for part in parts]),
        independent=torch.cat([part.independent for part in parts]),
        visible=torch.cat([part.visible for part in parts]),
    )


def _take_samples(colors: SurfaceColors, samples: int) -> SurfaceColors:
    """Take at most ``samples`` of the coloured points, evenly."""
    return SurfaceColors(
        points_m=take_evenly(colors.points_m, samples),
        normals=take_evenly(colors.normals, samples),
        rgb=take_evenly(colors.rgb, samples),
        spacing_m=colors.spacing_m,  # over which each colour is a mean, not where the next one is
    )


class _BlurredImage(NamedTuple):
    """The part of a colour image about an object, as blurred as the model's colours are."""

    rgb: Float[Tensor, "3 h w"]  #: 0..1
    left: int  #: first column of the part
    top: int  #: and its first row


def _project_to_color(
    points_m: Float64[Tensor, "*b n 3"], color: ColorImage
) -> tuple[Float64[Tensor, "*b n 2"], Float64[Tensor, "*b n"]]:
    """Project points of the depth camera's frame to a colour image: pixels, and depths there."""
    transform = color.color_from_depth
    color_m = points_m if transform is None else transform.double().apply(points_m)
    depth_m = color_m[..., 2]
    pixels = (color_m @ color.K.double().mT)[..., :2] / depth_m.clamp(min=1e-6)[..., None]
    return pixels, depth_m


def _blur_image(color: ColorImage, poses: Rigid, surface: SurfaceColors) -> _BlurredImage:
    """Blur an image, where the posed models lie, by the spacing of the model's colours."""
    # The blur in pixels, where the models lie.
    few_m = take_evenly(surface.points_m, 300).double()
    pixels, depth_m = _project_to_color(poses.double().apply(few_m), color)
    is_front = depth_m > 0
    height, width = color.rgb.shape[1:]
    if not bool(is_front.any()):
        return _BlurredImage(color.rgb, 0, 0)
    sigma = _BLUR * surface.spacing_m * float(color.K[0, 0] / depth_m[is_front].median())
    sigma = min(max(sigma, 1.0), max(height, width) / 8)
    reach = math.ceil(3 * sigma)

    # The part about the poses.
    low = pixels[is_front].amin(0) - 2 * reach
    high = pixels[is_front].amax(0) + 2 * reach
    left = int(low[0].clamp(0, width - 1))
    right = int(high[0].clamp(0, width - 1)) + 1
    top = int(low[1].clamp(0, height - 1))
    bottom = int(high[1].clamp(0, height - 1)) + 1

    # A Gaussian, one axis after the other.
    steps = torch.arange(-reach, reach + 1, dtype=torch.float32)
    kernel = torch.exp(-(steps**2) / (2 * sigma**2))
    kernel /= kernel.sum()
    part = color.rgb[:, None, top:bottom, left:right].float()
    part = F.conv2d(F.pad(part, (reach, reach, 0, 0), "replicate"), kernel[None, None, None])
    part = F.conv2d(F.pad(part, (0, 0, reach, reach), "replicate"), kernel[None, None, :, None])
    return _BlurredImage(part[:, 0], left, top)


class _Compared(NamedTuple):
    """Colour features of a model and of an image at the same points, less mean and shading."""

    weight: Float64[Tensor, "b n 3"]  #: 1 where a feature is compared, else 0
    of_model: Float64[Tensor, "b n 3"]  #: features of the model
    of_image: Float64[Tensor, "b n 3"]  #: features of the image


def _take_logarithms(rgb: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b 3"]:
    """Take the logarithms of brightness, of red over green, and of blue over green."""
    red, green, blue = (rgb + _BLACK).log().unbind(-1)
    brightness = (rgb.mean(-1) + _BLACK).log()
    return torch.stack([brightness, red - green, blue - green], -1)


def _compare_features(
    poses: Rigid, surface: SurfaceColors, view: ViewInput, image: _BlurredImage, near_m: float
) -> _Compared:
    """Compare the colours of posed surfaces and of the image, where both cameras see them.

    Args:
        poses: a batch, ``camera_from_model`` of the depth camera.
        surface: coloured points of the model.
        view: depth, mask and colour image.
        image: the colour image, blurred.
        near_m: largest distance of a point to the depth reading in its direction.
    """
    assert view.color is not None
    points_m = poses.apply(surface.points_m.double())
    normals = surface.normals.double() @ poses.R.mT
    distance_m = points_m.norm(dim=-1)
    cosine = -(normals * points_m).sum(-1) / distance_m.clamp(min=1e-9)

    # Visible to the depth camera: facing it, with a reading there.
    pixels = (points_m @ view.K.double().mT)[..., :2] / points_m[..., 2:].clamp(min=1e-6)
    height, width = view.depth_m.shape
    column, row = pixels.round().long().unbind(-1)
    is_visible = (cosine > _LEAST_COSINE) & (points_m[..., 2] > 0)
    is_visible &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
    place = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    read_m = view.depth_m.flatten()[place].double()
    is_visible &= ((read_m - points_m[..., 2]).abs() < near_m) & view.mask.flatten()[place]

    # The colour camera's image there, between pixels.
    color_pixels, depth_m = _project_to_color(points_m, view.color)
    rows, columns = view.color.rgb.shape[1:]
    u, v = color_pixels.unbind(-1)
    is_visible &= (depth_m > 0) & (u >= 0) & (u <= columns - 1) & (v >= 0) & (v <= rows - 1)
    side = torch.tensor(image.rgb.shape[:0:-1]).double().sub(1).clamp(min=1)
    corner = torch.tensor([image.left, image.top]).double()
    grid = (2 * (color_pixels - corner) / side - 1).float()  # -1 to 1 within the part
    rgb = F.grid_sample(image.rgb[None], grid[None], align_corners=True)[0].double()
    rgb = rgb.permute(1, 2, 0)

    # Colour is false where a channel is clipped, and noise where all are dark.
    has_color = (rgb.amax(-1) < _SATURATED) & (rgb.amax(-1) > _DARK)
    with_color = is_visible & has_color
    weight = torch.stack([is_visible, with_color, with_color], -1).double()
    of_model = _take_logarithms(surface.rgb.double()).expand(len(points_m), -1, -1)
    return _Compared(
        weight=weight,
        of_model=_remove_shading(of_model, normals, weight),
        of_image=_remove_shading(_take_logarithms(rgb), normals, weight),
    )


_RIDGE = 1e-4  # added to the normals' second moments: a plane has no second direction


def _remove_shading(
    features: Float64[Tensor, "b n 3"],
    normals: Float64[Tensor, "b n 3"],
    weight: Float64[Tensor, "b n 3"],
) -> Float64[Tensor, "b n 3"]:
    """Subtract from features their means, and from brightness its shading (Lambert)."""
    total = weight.sum(1, keepdim=True).clamp(min=1)
    features = (features - (weight * features).sum(1, keepdim=True) / total) * weight

    # Regression of brightness on the normals.
    brightness = features[..., :1]
    used = weight[..., :1]
    centred = (normals - (used * normals).sum(1, keepdim=True) / total[..., :1]) * used
    moments = centred.mT @ centred + _RIDGE * total[..., :1] * torch.eye(3, dtype=torch.float64)
    shading = centred @ torch.linalg.solve(moments, centred.mT @ brightness)
    return torch.cat([brightness - shading, features[..., 1:]], -1)


def _correlate(compared: _Compared) -> Float64[Tensor, "b 3"]:
    """Correlate model and image; 0 where few points are visible, or either has no print."""
    total = compared.weight.sum(1)
    of_model = compared.of_model.square().sum(1)
    of_image = compared.of_image.square().sum(1)
    both = (compared.of_model * compared.of_image).sum(1)
    least = _PLAIN**2 * total
    is_printed = (of_model > least) & (of_image > least) & (total >= _LEAST_VISIBLE)
    return torch.where(is_printed, both / (of_model * of_image).clamp(min=1e-12).sqrt(), 0.0)


_PAIRED = 250  # visible points whose pairs give the autocorrelations
_BINS = 16  # bins of their distances, the nearer the finer
_POSES_AT_ONCE = 16  # poses whose pairs are counted at a time, for the memory


def _count_independent_points(
    compared: _Compared, surface: SurfaceColors
) -> Float64[Tensor, "b 3"]:
    """Count the independent points of each correlation: their effective number.

    The variance of the correlation of two unrelated fields is the mean product of their
    autocorrelations over all pairs of points (Dutilleul 1993), and the number its inverse. Products
    below 0, which come from chance, are left out, so that the number is rather too small.
    """
    generator = torch.Generator().manual_seed(0)
    key = torch.rand(compared.weight.shape[1], generator=generator, dtype=torch.float64)
    count = min(_PAIRED, compared.weight.shape[1])
    reach_m = float((surface.points_m.amax(0) - surface.points_m.amin(0)).norm())
    numbers: list[Tensor] = []
    for first in range(0, len(compared.weight), _POSES_AT_ONCE):
        # Visible points of each pose, chosen at random, and the bin of the distance of each pair.
        chunk = slice(first, first + _POSES_AT_ONCE)
        chosen = (compared.weight[chunk, :, 0] * (1 + key)).topk(count, dim=1).indices
        points_m = surface.points_m.double()[chosen]
        distance = torch.cdist(points_m, points_m) / reach_m
        bins = (distance.sqrt() * _BINS).long().clamp(max=_BINS - 1)
        bins += _BINS * torch.arange(len(chosen))[:, None, None]

        # Autocorrelations of the model and of the image, by distance.
        index = chosen[..., None].expand(-1, -1, 3)
        weight, *fields = (values[chunk].gather(1, index) for values in compared)
        pairs = _sum_by_bin(torch.einsum("bif,bjf->fbij", weight, weight), bins)
        autocorrelations: list[Tensor] = []
        for values in fields:
            products = _sum_by_bin(torch.einsum("bif,bjf->fbij", values, values), bins)
            variance = values.square().sum(1).mT / weight.sum(1).mT.clamp(min=1)
            mean = products / pairs.clamp(min=1)
            autocorrelations.append(mean / variance.clamp(min=1e-12)[..., None])

        # The mean of their product over all pairs; that of a place with itself is 1.
        product = (autocorrelations[0] * autocorrelations[1]).clamp(min=0)
        sums = pairs * product
        visible = weight.square().sum(1).mT
        sums[..., 0] -= visible * product[..., 0]
        variance = (sums.sum(-1) + visible) / visible.square().clamp(min=1)
        numbers.append((1 / variance.clamp(min=1 / count)).mT)
    return torch.cat(numbers)


def _sum_by_bin(
    values: Float64[Tensor, "f b m m"], bins: Int64[Tensor, "b m m"]
) -> Float64[Tensor, "f b bins"]:
    """Sum values of pairs of points by the bin of their distance."""
    flat = values.flatten(1)
    sums = flat.new_zeros(len(flat), len(bins) * _BINS)
    return sums.index_add_(1, bins.flatten(), flat).unflatten(1, (len(bins), _BINS))


_STEP_DEG = 5.0  # step of a sweep about an axis
_FINE_STEPS = 5  # fine steps in each step of a sweep
_MOST_PEAKS = 3  # largest number of poses that a sweep about one axis returns


def copies_about_axis(
    pose: Rigid, axis: Axis, model: ObjectModel, view: ViewInput, *, step_deg: float = _STEP_DEG
) -> Rigid:
    """Rotate a pose about an axis of the model to where its print agrees with the image.

    A sweep of the full circle finds the largest agreements; each is refined by finer steps and by
    the parabola through the best three of them.

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

    # The largest agreements of a sweep.
    steps = max(3, math.ceil(360 / step_deg))
    step_rad = 2 * math.pi / steps
    sweep_rad = torch.arange(steps, dtype=torch.float64) * step_rad
    rough = _score_sweep(_rotate_about(pose, axis, sweep_rad), model, view, _SWEEP_SAMPLES)
    is_peak = (rough >= rough.roll(1)) & (rough > rough.roll(-1)) & (rough > 0)
    peaks = is_peak.nonzero()[:, 0]
    peaks = peaks[rough[peaks].argsort(descending=True)][:_MOST_PEAKS]
    if len(peaks) == 0:
        return pose.double()[None]

    # Finer steps about each, and a parabola through the best three.
    fine_rad = step_rad / _FINE_STEPS
    offsets_rad = torch.arange(-_FINE_STEPS, _FINE_STEPS + 1, dtype=torch.float64) * fine_rad
    angles_rad = sweep_rad[peaks, None] + offsets_rad
    fine = _score_sweep(_rotate_about(pose, axis, angles_rad.flatten()), model, view, _SAMPLES)
    fine = fine.reshape(angles_rad.shape)
    best = fine.argmax(1).clamp(1, 2 * _FINE_STEPS - 1)
    three = fine.gather(1, best[:, None] + torch.tensor([-1, 0, 1]))
    middle_rad = angles_rad.gather(1, best[:, None])[:, 0]
    best_rad = middle_rad + _find_parabola_peak(three) * step_rad / _FINE_STEPS
    order = three[:, 1].argsort(descending=True)
    return _rotate_about(pose, axis, best_rad[order])


def _rotate_about(pose: Rigid, axis: Axis, angles_rad: Float64[Tensor, " a"]) -> Rigid:
    """Rotate the model at a pose about one of its axes by each angle."""
    turns = turn_about(axis.direction.double(), axis.point_m.double(), angles_rad)
    return pose.double()[None] @ turns


def _score_sweep(
    poses: Rigid, model: ObjectModel, view: ViewInput, samples: int
) -> Float64[Tensor, " b"]:
    """Score poses by how much of the colours they explain, fast enough for sweeps of many poses.

    As :attr:`ColorAgreement.log_likelihood`, but with every visible point counted as independent.
    """
    assert model.colors is not None
    assert view.color is not None
    surface = _take_samples(model.colors, samples)
    image = _blur_image(view.color, poses, surface)
    scores: list[Tensor] = []
    at_once = max(1, _POINTS_AT_ONCE // len(surface.points_m))
    for first in range(0, len(poses.R), at_once):
        chunk = poses[first : first + at_once]
        compared = _compare_features(chunk, surface, view, image, _NEAR * model.diameter_m)
        explained = _correlate(compared).clamp(0, _MOST_CORRELATION).square()
        scores.append((-compared.weight.sum(1) * torch.log1p(-explained)).sum(-1))
    return torch.cat(scores)


_SAME_RAD = math.radians(3)  # angle up to which two proposed copies are the same
_MOST_COPIES = 8  # largest number of copies that are proposed beside a pose
_SAME_TURN_RAD = math.radians(10)  # angle up to which two rotations that are tried are the same
_MANY_TURNS = 6  # rotations about one line that make a shape nearly a body of revolution
_PARALLEL_COSINE = math.cos(math.radians(8))  # least cosine of two directions that are the same
_SETTLE_STEP_RAD = math.radians(2)  # step of the small sweep about a pose
_SETTLE_STEPS = 10  # steps of it to each side


def color_copies(
    pose: Rigid,
    model: ObjectModel,
    view: ViewInput,
    *,
    turns: Rigid | None = None,
    most: int = _MOST_COPIES,
) -> Rigid:
    """Propose poses that depth cannot tell from a given one, but colour may: its copies.

    They are symmetric copies that were found in the shape, near-symmetric ones, and half turns
    about the principal axes. Each is rotated about axes of revolution, or nearly so, to where its
    print agrees. Declared symmetries make no copies: they count as one answer. Refine a copy by
    depth, and settle it (:func:`settle_spin`), before its evidence is compared.

    Args:
        pose: ``camera_from_model``, one.
        model: the object.
        view: depth and colour.
        turns: motions of the model to try in place of those found in its shape.
        most: largest number of poses beside ``pose``.

    Returns:
        A batch of poses, ``pose`` itself the first, then the others, those that agree best before.
    """
    pose = pose.double()
    if model.colors is None or view.color is None:
        return pose[None]

    # The motions that may be, and axes to sweep about.
    of_shape, axes = _find_ambiguous_motions(model)
    motions = of_shape if turns is None else [turns.double()[k] for k in range(len(turns.R))]

    # Of motions that differ by a rotation about an axis one is tried: it is swept about the axis.
    distinct = [Rigid(torch.eye(3).double(), torch.zeros(3).double())]
    for motion in motions:
        is_swept = any(
            _differ_by_rotation_about(axis, motion, other) for axis in axes for other in distinct
        )
        apart_rad = [float(geodesic_rad(motion.R, other.R)) for other in distinct]
        if not is_swept and min(apart_rad) > _SAME_TURN_RAD:
            distinct.append(motion)

    # Each of them, rotated about the axes to where its print agrees.
    proposed: list[Rigid] = []
    for motion in distinct:
        copy = pose @ motion
        swept = [copies_about_axis(copy, axis, model, view) for axis in axes]
        proposed += swept or [copy[None]]

    # The best that are distinct.
    copies = Rigid.cat(proposed)
    order = _score_sweep(copies, model, view, _SAMPLES).argsort(descending=True, stable=True)
    best = [pose[None]]
    for k in order.tolist():
        better = Rigid.cat(best)
        apart_rad = geodesic_rad(copies.R[k].expand_as(better.R), better.R)
        if float(apart_rad.min()) > _SAME_RAD and len(best) <= most:
            best.append(copies[k][None])
    return Rigid.cat(best)


def settle_spin(pose: Rigid, model: ObjectModel, view: ViewInput) -> Rigid:
    """Rotate a pose a little about axes that depth does not fix, to where its print agrees best.

    Refinement by depth lets a pose drift about an axis of revolution.

    Args:
        pose: ``camera_from_model``, one; within 20 degrees of where it belongs.
        model: the object.
        view: depth and colour.

    Returns:
        The rotated pose; the same one where colour says nothing or the shape has no such axis.
    """
    pose = pose.double()
    if model.colors is None or view.color is None:
        return pose
    steps = torch.arange(-_SETTLE_STEPS, _SETTLE_STEPS + 1).double()
    offsets_rad = steps * _SETTLE_STEP_RAD
    _, axes = _find_ambiguous_motions(model)
    for axis in axes:
        scores = _score_sweep(_rotate_about(pose, axis, offsets_rad), model, view, _SWEEP_SAMPLES)
        best = int(scores.argmax().clamp(1, len(offsets_rad) - 2))
        if float(scores[best]) > 0:
            peak = _find_parabola_peak(scores[best - 1 : best + 2])
            pose = _rotate_about(pose, axis, offsets_rad[best, None] + peak * _SETTLE_STEP_RAD)[0]
    return pose


def _find_parabola_peak(values: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b"]:
    """Find the peak of the parabola through three values, -1 to 1 from the middle one."""
    before, middle, after = values.unbind(-1)
    bend = (before - 2 * middle + after).clamp(max=-1e-9)
    return ((before - after) / (2 * bend)).clamp(-1, 1)


@lru_cache(maxsize=64)
def _find_ambiguous_motions(model: ObjectModel) -> tuple[list[Rigid], list[Axis]]:
    """Find the motions of a model after which depth looks alike or nearly, and its free axes.

    Declared symmetries are not among them.
    """
    assert model.colors is not None
    # Those of the shape: near-symmetries, and symmetries that were found.
    turns = [near.model_from_model.double() for near in near_symmetries(model)]
    axes: list[Axis] = []
    if model.symmetries.is_found:
        discrete = model.symmetries.discrete
        if discrete is not None:
            turns += [discrete.double()[k] for k in range(len(discrete.R))]
        axes += model.symmetries.continuous
    axes += _find_axes_of_many_turns(turns, axes)

    # A box whose halves differ a little looks alike after half turns about its middle.
    points_m = model.colors.points_m.double()
    centred_m = points_m - points_m.mean(0)
    principal = torch.linalg.eigh(centred_m.T.cov()).eigenvectors.T
    along_m = points_m @ principal.T
    middle_m = (along_m.amin(0) + along_m.amax(0)) / 2 @ principal
    half = torch.tensor(math.pi, dtype=torch.float64)
    turns += [turn_about(direction, middle_m, half) for direction in principal]
    return turns, axes


def _find_axes_of_many_turns(turns: Sequence[Rigid], others: Sequence[Axis]) -> list[Axis]:
    """Find the lines about which many of the turns are, without those parallel to other axes."""
    # The direction of each axis is the one that the rotation leaves as it is.
    eye = torch.eye(3).double()
    directions = [torch.linalg.svd(turn.R - eye).Vh[-1] for turn in turns]
    axes: list[Axis] = []
    for direction in directions:
        earlier = [*others, *axes]
        has_axis = any(_are_parallel(direction, axis.direction.double()) for axis in earlier)
        alike = [k for k, other in enumerate(directions) if _are_parallel(other, direction)]
        if has_axis or len(alike) < _MANY_TURNS:
            continue

        # A point that each turn leaves where it is.
        points = [torch.linalg.pinv(eye - turns[k].R, rtol=1e-3) @ turns[k].t_m for k in alike]
        point_m = torch.stack(points).median(0).values
        axes.append(Axis(direction=direction, point_m=point_m))
    return axes


def _are_parallel(first: Float64[Tensor, "3"], second: Float64[Tensor, "3"]) -> bool:
    """Whether two unit vectors are of the same line, within 8 degrees."""
    return abs(float(first @ second)) > _PARALLEL_COSINE


def _differ_by_rotation_about(axis: Axis, first: Rigid, second: Rigid) -> bool:
    """Whether two motions differ by a rotation about an axis: both carry it to one direction."""
    direction = axis.direction.double()
    return float((first.R @ direction) @ (second.R @ direction)) > _PARALLEL_COSINE
