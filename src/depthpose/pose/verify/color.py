"""Colour as evidence: which of the poses that depth cannot tell apart shows the right print?

The print is the pattern of colours on the surface. At each pose the colours of the visible surface
are compared with the image: brightness, red over green and blue over green, all as logarithms.
Exposure, white balance and a screen's gamma are then constants and factors, to which a correlation
is blind. Shading, the part of the brightness that is linear in the normal (Lambert), is removed
from both by regression.

A correlation ``r`` of ``n`` independent points tells how much of the image a pose explains: its log
likelihood above that of a pose whose print has nothing to do with the image is
``-n / 2 log(1 - r^2)``, that of a linear regression. Neighbouring points are not independent: ``n``
is the effective number of a correlation between two fields that each correlate with themselves
(Clifford, Richardson and Hemon 1989; Dutilleul 1993), so a smooth shade counts for little and fine
print for much.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid
from depthpose.pose.types import ColorImage, ObjectModel, SurfaceColors, ViewInput

MOST_SAMPLES = 4000  #: coloured points of a model that are compared; about a third are visible
_LEAST_COSINE = 0.3  # least cosine between ray and normal: more slanted print is blurred
_NEAR_DIAMETERS = 0.05  # a reading farther from the surface is of another object
_LEAST_VISIBLE = 40  # fewer visible points are not compared
_BLUR = 1.0  # standard deviation of the image's blur, in spacings of the model's coloured points
_PROJECTED = 300  # points of a model by which the part of the image about it is found
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

    #: of brightness, red over green, blue over green; 0 where model or image show no print.
    correlation: Float64[Tensor, "b 3"]
    independent_count: Float64[Tensor, "b 3"]  #: effective number of independent points of each
    visible_count: Int64[Tensor, " b"]  #: coloured points that were compared

    @property
    def log_likelihood(self) -> Float64[Tensor, " b"]:
        """Log likelihood of the image above that of a print that has nothing to do with it.

        Differences are log odds between poses, and between objects at one place. It is 0 where
        colour says nothing: a grey model, too few points, or a negative correlation.
        """
        explained = self.correlation.clamp(0, _MOST_CORRELATION).square()
        freedom = (self.independent_count - _FITTED).clamp(min=0)
        return (-freedom / 2 * torch.log1p(-explained)).sum(-1)


def measure_color_agreement(poses: Rigid, model: ObjectModel, view: ViewInput) -> ColorAgreement:
    """Correlate the colours of a posed model with an image, for each of a batch of poses.

    Args:
        poses: ``camera_from_model`` of the depth camera.
        model: the object; without ``colors`` colour says nothing.
        view: depth and colour; without ``color`` colour says nothing. Its mask limits where the
            object is.
    """
    if model.colors is None or view.color is None:
        zeros = torch.zeros(len(poses.R), 3, dtype=torch.float64)
        return ColorAgreement(
            correlation=zeros, independent_count=zeros, visible_count=zeros[:, 0].long()
        )
    surface = _take_samples(model.colors, MOST_SAMPLES)
    correlations: list[Tensor] = []
    independent_counts: list[Tensor] = []
    visible_counts: list[Tensor] = []
    for features in _sample_in_chunks(poses, surface, view, model.diameter_m):
        correlation = _correlate(features)
        independent_count = _count_independent_points(features, surface)
        correlations.append(correlation)
        # Colour that explains nothing has no independent points.
        independent_counts.append(torch.where(correlation != 0, independent_count, 0.0))
        visible_counts.append(features.weight[..., 0].sum(-1).long())
    return ColorAgreement(
        correlation=torch.cat(correlations),
        independent_count=torch.cat(independent_counts),
        visible_count=torch.cat(visible_counts),
    )


def score_by_color(
    poses: Rigid, model: ObjectModel, view: ViewInput, most_samples: int = MOST_SAMPLES
) -> Float64[Tensor, " b"]:
    """Score poses by how much of the colours they explain, fast enough for sweeps of many poses.

    Twice :attr:`ColorAgreement.log_likelihood`, but with every visible point counted as
    independent.

    Args:
        poses: a batch, ``camera_from_model`` of the depth camera.
        model: the object, with colours.
        view: depth and colour.
        most_samples: largest number of coloured points that are compared.
    """
    assert model.colors is not None
    surface = _take_samples(model.colors, most_samples)
    scores: list[Tensor] = []
    for features in _sample_in_chunks(poses, surface, view, model.diameter_m):
        explained = _correlate(features).clamp(0, _MOST_CORRELATION).square()
        visible_count = features.weight.sum(1)
        scores.append((-visible_count * torch.log1p(-explained)).sum(-1))
    return torch.cat(scores)


def _take_samples(colors: SurfaceColors, most: int) -> SurfaceColors:
    """Take ``most`` of the coloured points at most, evenly."""
    return SurfaceColors(
        points_m=take_evenly(colors.points_m, most),
        normals=take_evenly(colors.normals, most),
        rgb=take_evenly(colors.rgb, most),
        spacing_m=colors.spacing_m,  # over which each colour is a mean, not where the next one is
    )


class _BlurredImage(NamedTuple):
    """The part of a colour image about an object, as blurred as the model's colours are."""

    rgb: Float[Tensor, "3 h w"]  #: 0..1
    left: int  #: first column of the part
    top: int  #: first row of the part


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
    """Blur the part of an image about the posed models by the spacing of the model's colours."""
    few_m = take_evenly(surface.points_m, _PROJECTED).double()
    pixels, depth_m = _project_to_color(poses.double().apply(few_m), color)
    is_front = depth_m > 0
    height, width = color.rgb.shape[1:]
    if not bool(is_front.any()):
        return _BlurredImage(color.rgb, 0, 0)

    # The spacing in pixels, at the depth of the models: from a pixel to an eighth of the image.
    px_per_m = float(color.K[0, 0] / depth_m[is_front].median())
    sigma_px = _BLUR * surface.spacing_m * px_per_m
    sigma_px = min(max(sigma_px, 1.0), max(height, width) / 8)
    reach = math.ceil(3 * sigma_px)

    # The part about the models, with a margin of twice the reach of the blur.
    low = pixels[is_front].amin(0) - 2 * reach
    high = pixels[is_front].amax(0) + 2 * reach
    left = int(low[0].clamp(0, width - 1))
    right = int(high[0].clamp(0, width - 1)) + 1
    top = int(low[1].clamp(0, height - 1))
    bottom = int(high[1].clamp(0, height - 1)) + 1

    # A Gaussian, one axis after the other.
    steps = torch.arange(-reach, reach + 1, dtype=torch.float32)
    kernel = torch.exp(-(steps**2) / (2 * sigma_px**2))
    kernel /= kernel.sum()
    part = color.rgb[:, None, top:bottom, left:right].float()
    part = F.conv2d(F.pad(part, (reach, reach, 0, 0), "replicate"), kernel[None, None, None])
    part = F.conv2d(F.pad(part, (0, 0, reach, reach), "replicate"), kernel[None, None, :, None])
    return _BlurredImage(part[:, 0], left, top)


class _ColorFeatures(NamedTuple):
    """Colour features of a model and of an image at the same points, less mean and shading."""

    weight: Float64[Tensor, "b n 3"]  #: 1 where a feature is compared, else 0
    of_model: Float64[Tensor, "b n 3"]  #: of brightness, red over green, blue over green
    of_image: Float64[Tensor, "b n 3"]  #: the same of the image


def _take_logarithms(rgb: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b 3"]:
    """Take the logarithms of brightness, of red over green, and of blue over green."""
    red, green, blue = (rgb + _BLACK).log().unbind(-1)
    brightness = (rgb.mean(-1) + _BLACK).log()
    return torch.stack([brightness, red - green, blue - green], -1)


def _sample_in_chunks(
    poses: Rigid, surface: SurfaceColors, view: ViewInput, diameter_m: float
) -> Iterator[_ColorFeatures]:
    """Yield the colour features of as many poses at a time as fit in memory.

    Args:
        poses: a batch, ``camera_from_model`` of the depth camera.
        surface: coloured points of the model.
        view: depth, mask and colour image.
        diameter_m: of the model.
    """
    assert view.color is not None
    image = _blur_image(view.color, poses, surface)
    at_once = max(1, _POINTS_AT_ONCE // len(surface.points_m))
    for first in range(0, len(poses.R), at_once):
        chunk = poses[first : first + at_once].double()
        yield _sample_features(chunk, surface, view, image, _NEAR_DIAMETERS * diameter_m)


def _sample_features(
    poses: Rigid, surface: SurfaceColors, view: ViewInput, image: _BlurredImage, near_m: float
) -> _ColorFeatures:
    """Sample the colours of posed surfaces and of the image where both cameras see the surface.

    Args:
        poses: a batch, ``camera_from_model`` of the depth camera.
        surface: coloured points of the model.
        view: depth, mask and colour image.
        image: the colour image, blurred.
        near_m: largest distance of a visible point to the depth reading in its direction.
    """
    assert view.color is not None
    points_m = poses.apply(surface.points_m.double())
    normals = surface.normals.double() @ poses.R.mT
    rgb, is_within = _sample_image(points_m, view.color, image)
    is_visible = _mark_visible(points_m, normals, view, near_m) & is_within

    # Colour is false where a channel is clipped, and noise where all are dark.
    brightest = rgb.amax(-1)
    has_hue = is_visible & (brightest < _SATURATED) & (brightest > _DARK)
    weight = torch.stack([is_visible, has_hue, has_hue], -1).double()
    of_model = _take_logarithms(surface.rgb.double()).expand(len(points_m), -1, -1)
    return _ColorFeatures(
        weight=weight,
        of_model=_remove_shading(of_model, normals, weight),
        of_image=_remove_shading(_take_logarithms(rgb), normals, weight),
    )


def _mark_visible(
    points_m: Float64[Tensor, "b n 3"],
    normals: Float64[Tensor, "b n 3"],
    view: ViewInput,
    near_m: float,
) -> Bool[Tensor, "b n"]:
    """Mark the surface points that the depth camera sees: they face it, with a reading near them.

    Args:
        points_m: points of the surface, in the frame of the depth camera.
        normals: outward normals of these points.
        view: depth and mask.
        near_m: largest distance along the optical axis between a point and its reading.
    """
    distance_m = points_m.norm(dim=-1)
    cosine = -(normals * points_m).sum(-1) / distance_m.clamp(min=1e-9)
    is_visible = (cosine > _LEAST_COSINE) & (points_m[..., 2] > 0)

    pixels = (points_m @ view.K.double().mT)[..., :2] / points_m[..., 2:].clamp(min=1e-6)
    height, width = view.depth_m.shape
    column, row = pixels.round().long().unbind(-1)
    is_visible &= (column >= 0) & (column < width) & (row >= 0) & (row < height)

    place = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    read_m = view.depth_m.flatten()[place].double()
    is_near = (read_m - points_m[..., 2]).abs() < near_m
    return is_visible & is_near & view.mask.flatten()[place]


def _sample_image(
    points_m: Float64[Tensor, "b n 3"], color: ColorImage, image: _BlurredImage
) -> tuple[Float64[Tensor, "b n 3"], Bool[Tensor, "b n"]]:
    """Sample a blurred colour image at points of the depth camera's frame, between pixels.

    Returns:
        The colours, 0..1; and whether a point is projected into the image.
    """
    pixels, depth_m = _project_to_color(points_m, color)
    u, v = pixels.unbind(-1)
    rows, columns = color.rgb.shape[1:]
    is_within = (depth_m > 0) & (u >= 0) & (u <= columns - 1) & (v >= 0) & (v <= rows - 1)

    height, width = image.rgb.shape[1:]
    last_pixel = torch.tensor([width - 1, height - 1]).double().clamp(min=1)
    corner = torch.tensor([image.left, image.top]).double()
    grid = (2 * (pixels - corner) / last_pixel - 1).float()  # -1 to 1 within the part
    rgb = F.grid_sample(image.rgb[None], grid[None], align_corners=True)[0].double()
    return rgb.permute(1, 2, 0), is_within


_RIDGE = 1e-4  # added to the normals' second moments: a plane has no second direction


def _remove_shading(
    features: Float64[Tensor, "b n 3"],
    normals: Float64[Tensor, "b n 3"],
    weight: Float64[Tensor, "b n 3"],
) -> Float64[Tensor, "b n 3"]:
    """Subtract from features their means, and from brightness its shading (Lambert).

    Args:
        features: brightness, red over green, blue over green.
        normals: of the points.
        weight: 1 where a feature is compared, else 0; there the result is 0 too.
    """
    count = weight.sum(1, keepdim=True).clamp(min=1)
    mean = (weight * features).sum(1, keepdim=True) / count
    features = (features - mean) * weight

    # Regression of brightness on the normals about their mean N: N (N^T N + ridge)^-1 N^T b.
    brightness = features[..., :1]
    is_compared = weight[..., :1]
    visible_count = count[..., :1]
    mean_normal = (is_compared * normals).sum(1, keepdim=True) / visible_count
    centred = (normals - mean_normal) * is_compared
    ridge = _RIDGE * visible_count * torch.eye(3, dtype=torch.float64)
    moments = centred.mT @ centred + ridge
    shading = centred @ torch.linalg.solve(moments, centred.mT @ brightness)
    return torch.cat([brightness - shading, features[..., 1:]], -1)


def _correlate(features: _ColorFeatures) -> Float64[Tensor, "b 3"]:
    """Correlate model and image; 0 where few points are visible, or either has no print."""
    count = features.weight.sum(1)
    model_square = features.of_model.square().sum(1)
    image_square = features.of_image.square().sum(1)
    product = (features.of_model * features.of_image).sum(1)
    correlation = product / (model_square * image_square).clamp(min=1e-12).sqrt()
    least = _PLAIN**2 * count
    has_print = (model_square > least) & (image_square > least) & (count >= _LEAST_VISIBLE)
    return torch.where(has_print, correlation, 0.0)


_PAIRED = 250  # visible points whose pairs give the autocorrelations
_BINS = 16  # bins of their distances, the nearer the finer
_POSES_AT_ONCE = 16  # poses whose pairs are counted at a time, for the memory


def _count_independent_points(
    features: _ColorFeatures, surface: SurfaceColors
) -> Float64[Tensor, "b 3"]:
    """Count the independent points of each correlation: their effective number.

    The variance of the correlation of two unrelated fields is the mean product of their
    autocorrelations over all pairs of points (Dutilleul 1993), and the number its inverse.
    """
    point_count = features.weight.shape[1]
    generator = torch.Generator().manual_seed(0)  # any seed: which points is of no account
    key = torch.rand(point_count, generator=generator, dtype=torch.float64)
    points_m = surface.points_m.double()
    reach_m = float((surface.points_m.amax(0) - surface.points_m.amin(0)).norm())
    counts: list[Tensor] = []
    for first in range(0, len(features.weight), _POSES_AT_ONCE):
        weight, of_model, of_image = (part[first : first + _POSES_AT_ONCE] for part in features)

        # Some points of each pose, chosen at random, visible ones before others.
        priority = weight[..., 0] * (1 + key)
        chosen = priority.topk(min(_PAIRED, point_count), dim=1).indices
        index = chosen[..., None].expand(-1, -1, 3)
        sample = _ColorFeatures(
            weight.gather(1, index), of_model.gather(1, index), of_image.gather(1, index)
        )

        # The bin of the distance of each pair; each pose has bins of its own.
        chosen_m = points_m[chosen]
        distance = torch.cdist(chosen_m, chosen_m) / reach_m
        bins = (distance.sqrt() * _BINS).long().clamp(max=_BINS - 1)
        bins += _BINS * torch.arange(len(chosen))[:, None, None]
        counts.append(_count_by_autocorrelation(sample, bins))
    return torch.cat(counts)


def _count_by_autocorrelation(
    sample: _ColorFeatures, bins: Int64[Tensor, "b m m"]
) -> Float64[Tensor, "b 3"]:
    """Compute the effective number of independent points from the pairs of some points.

    Products of autocorrelations below 0, which come from chance, count as 0, so that the number is
    rather too small.

    Args:
        sample: features at some points of each pose.
        bins: bin of the distance of each pair of these points.
    """
    weight = sample.weight
    pair_count = _sum_by_bin(torch.einsum("bif,bjf->fbij", weight, weight), bins)
    model_autocorrelation = _autocorrelate(sample.of_model, weight, pair_count, bins)
    image_autocorrelation = _autocorrelate(sample.of_image, weight, pair_count, bins)

    # Summed over all pairs. Those of a point with itself are in the first bin, and have a product
    # of 1 in place of that of the bin.
    product = (model_autocorrelation * image_autocorrelation).clamp(min=0)
    sums = pair_count * product
    visible_count = weight.square().sum(1).mT
    sums[..., 0] -= visible_count * product[..., 0]
    variance = (sums.sum(-1) + visible_count) / visible_count.square().clamp(min=1)
    return (1 / variance.clamp(min=1 / weight.shape[1])).mT


def _autocorrelate(
    values: Float64[Tensor, "b m f"],
    weight: Float64[Tensor, "b m f"],
    pair_count: Float64[Tensor, "f b bins"],
    bins: Int64[Tensor, "b m m"],
) -> Float64[Tensor, "f b bins"]:
    """Compute the autocorrelation of a field of mean 0 in each bin of distances.

    Args:
        values: of the field at points, 0 where they are not compared.
        weight: 1 where a point is compared, else 0.
        pair_count: pairs of compared points in each bin.
        bins: bin of the distance of each pair of points.
    """
    products = _sum_by_bin(torch.einsum("bif,bjf->fbij", values, values), bins)
    variance = values.square().sum(1).mT / weight.sum(1).mT.clamp(min=1)
    mean_product = products / pair_count.clamp(min=1)
    return mean_product / variance.clamp(min=1e-12)[..., None]


def _sum_by_bin(
    values: Float64[Tensor, "f b m m"], bins: Int64[Tensor, "b m m"]
) -> Float64[Tensor, "f b bins"]:
    """Sum values of pairs of points by the bin of their distance."""
    flat = values.flatten(1)
    sums = flat.new_zeros(len(flat), len(bins) * _BINS)
    return sums.index_add_(1, bins.flatten(), flat).unflatten(1, (len(bins), _BINS))
