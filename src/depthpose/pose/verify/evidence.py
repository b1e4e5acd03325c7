"""A posed model compared with a depth image: the evidence for and against the pose.

The model is drawn as the camera would see it. Where it is drawn, the residual is the reading less
the drawn depth, averaged over a few neighbours and counted in standard deviations of the sensor and
the object (:mod:`depthpose.pose.sensor`). A connected patch of residuals beyond three deviations
contradicts the pose, however small its share of the whole: behind the drawn surface the camera saw
through it (a free-space violation), before it the object bulges where the model does not, and the
object's own readings beside the drawn silhouette are not explained at all. Where no mask says which
readings are the object's, a surface that goes on across the silhouette, straight or bent away as
round a corner of one body, contradicts the pose too: it lies on something larger.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from scipy import ndimage
from scipy.spatial import KDTree
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.camera.pinhole import Window, crop_intrinsics
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import grow_mask
from depthpose.pose.geometry.rendering import Rendering, render_surface
from depthpose.pose.geometry.surface import Surface
from depthpose.pose.sensor import (
    AVERAGED_PER_WHITE,
    CORRELATION_PX,
    CORRELATION_RAD,
    EDGE_PX,
    FINEST_RAD,
    FLAT_M,
    SHARED_PER_WHITE,
    DepthNoise,
    measure_noise,
)
from depthpose.pose.types import Evidence, ViewInput

THRESHOLD = 3.0  #: deviations beyond which a residual contradicts a pose
_CUT_OFF = 2 * THRESHOLD  # deviations at which the residual of one reading is clipped
AVERAGED_PX = 5  #: residuals are averaged over a square of this side
_LEAST_FILLED = 0.3  # share of the averaged square that must have residuals
_CORRELATED_READINGS = 3  # averaged readings that count as one: neighbours share their error
_LEAST_PATCH = 0.25  # smallest patch that counts, in independent patches: others are accidents
_ACROSS = (-1.0, -0.5, 0.5, 1.0)
"""Where readings are compared across a silhouette, on the line from it to a pixel beside it: 0 is
the silhouette, 1 the pixel, and what is negative lies within."""
_NEAREST_WITHIN = 1
"""Number of the place whose reading must support the pose: the one before it may lie beyond the far
edge of a thin object."""
_MEETING = 2.0
"""Deviations of the noise: sides of a silhouette that are farther apart do not meet there, and an
edge that bends more toward the camera is concave."""
_LEAST_INNER = 0.25  # share of the silhouette that must remain without its borders
_OBJECT_PX = 8000  # pixels of an object that are compared; the window of a larger one is thinned
_NEIGHBOURS = 4  # the one whose distance is the spacing of a cloud's points
_SPACED_POINTS = 200  # points of a cloud by which this spacing is measured
_POINT_PX = 1.5  # side of a pixel of a drawn cloud, in spacings of its points
_JUMP_DIAMETERS = 0.02
_JUMP_M = 0.01
"""Drawn neighbours that differ in depth by more than both are the two sides of an edge."""
_FAR_M = np.float32(1e6)
_MARGIN_DIAMETERS = 0.6
_MARGIN_PX = 4
"""Margin of the window about the points of an object: both together."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Observation:
    """What a camera observed about an object, in a window of its image, thinned if it is large."""

    cloud_m: Float64[Tensor, "n 3"]  #: points on the object, in the camera frame
    view: ViewInput | None  #: the depth image that they are of; None of a cloud alone
    depth_m: np.ndarray  #: (h, w), NaN where there is no reading
    is_masked: bool  #: whether a mask says which pixels are of the object
    is_object: np.ndarray  #: (h, w) these pixels, without their border; none without a mask
    leaves_image: bool  #: whether the mask reaches the border of the image
    is_background: np.ndarray  #: (h, w) pixels whose readings lie on a known background
    K: Float64[Tensor, "3 3"]  #: intrinsic matrix of the window
    noise: DepthNoise  #: of readings on the object
    step: int = 1  #: every ``step``-th row and column of the image is used
    #: side of a square of readings that is one observation, in pixels of the window.
    patch_px: float = CORRELATION_PX

    @property
    def focal_px(self) -> float:
        """Focal length of the image itself, before it was thinned."""
        return self.step * float(self.K[0, 0])

    def in_units_of(self, length_m: float) -> "Observation":
        """Measure all depths and deviations in another unit of length, as if it were a metre.

        A model of its own size then looks as one ``length_m`` times as large does here. ``view``
        stays in metres.
        """
        noise = DepthNoise(
            white_std_m=self.noise.white_std_m / length_m,
            shared_std_m=self.noise.shared_std_m / length_m,
            lateral_std_m=self.noise.lateral_std_m / length_m,
            object_std_m=self.noise.object_std_m / length_m,
        )
        depth_m = (self.depth_m / length_m).astype(self.depth_m.dtype)
        return replace(self, depth_m=depth_m, cloud_m=self.cloud_m / length_m, noise=noise)

    @property
    def colored_view(self) -> ViewInput | None:
        """The view, where it has a colour image."""
        return None if self.view is None or self.view.color is None else self.view


def observe(
    cloud_m: Float[Tensor, "n 3"],
    view: ViewInput | None,
    surface: Surface,
    *,
    is_masked: bool,
) -> Observation:
    """Crop a depth image to the window about an object, and measure its noise there.

    Args:
        cloud_m: points that lie on the object, in the camera frame.
        view: their depth image; None: the points are drawn as one, by a camera in whose image they
            are about a pixel apart.
        surface: of the object.
        is_masked: whether the points are exactly those of the object, so that points which a pose
            does not explain contradict it.
    """
    cloud_m = cloud_m.double()
    K = _camera_of_cloud(cloud_m) if view is None else view.K.double()
    pixel = (cloud_m @ K.T)[:, :2].div(cloud_m[:, 2:]).round().long()

    # The window of the points, with a margin, within the image.
    distance_m = float(cloud_m[:, 2].median())
    margin_px = (
        int(_MARGIN_DIAMETERS * surface.diameter_m / distance_m * float(K[0, 0])) + _MARGIN_PX
    )
    low = pixel.amin(0) - margin_px
    high = pixel.amax(0) + margin_px + 1
    if view is not None:
        low = low.clamp(min=0)
        high = torch.minimum(high, torch.tensor(view.depth_m.shape).flip(0))
    width, height = (high - low).tolist()
    left, top = low.tolist()

    # The object's pixels. Of a large cloud some points were left out: small gaps are closed.
    is_inside = ((pixel >= low) & (pixel < high)).all(-1)
    column, row = (pixel - low)[is_inside].unbind(-1)
    place = row * width + column
    is_object = torch.zeros(height * width, dtype=torch.bool)
    is_object[place] = True
    is_object = grow_mask(grow_mask(is_object.view(height, width), 1), -1)

    # The readings: of the image, or the nearest point in each pixel.
    if view is None:
        depth_m = torch.full((height * width,), torch.inf, dtype=torch.float64)
        depth_m.scatter_reduce_(0, place, cloud_m[is_inside, 2], "amin")
        depth_m = depth_m.view(height, width)
    else:
        depth_m = view.depth_m[top : top + height, left : left + width].double()
    depth_m = torch.where(depth_m.isfinite() & (depth_m > 0), depth_m, torch.nan)
    leaves_image = False
    if view is not None:
        mask = view.mask
        borders = (mask[0], mask[-1], mask[:, 0], mask[:, -1])
        leaves_image = any(bool(border.any()) for border in borders)
    is_background = torch.zeros_like(is_object)
    if view is not None and view.background is not None:
        is_background = view.background.is_seen[top : top + height, left : left + width]
    inner = grow_mask(is_object, -EDGE_PX)
    inner = inner if bool(inner.any()) else is_object  # thin objects are all border
    shared_per_white = SHARED_PER_WHITE if view is None else view.shared_per_white
    noise = measure_noise(
        depth_m.numpy(), inner.numpy(), surface.deviation_m, float(K[0, 0]), shared_per_white
    )

    # Thinned, if the object is large.
    step = max(1, math.floor(math.sqrt(float(is_object.sum()) / _OBJECT_PX)))
    window_K = crop_intrinsics(K, left, top)
    window_K[:2] /= step
    # The pixels of a drawn cloud are not those of its sensor, whose correlation is then an angle.
    correlation_px = CORRELATION_PX if view is not None else CORRELATION_RAD * float(K[0, 0])
    return Observation(
        cloud_m=cloud_m,
        view=view,
        depth_m=np.ascontiguousarray(depth_m.float().numpy()[::step, ::step]),
        is_masked=is_masked,
        leaves_image=leaves_image,
        is_object=np.ascontiguousarray(inner.numpy()[::step, ::step]) & is_masked,
        is_background=np.ascontiguousarray(is_background.numpy()[::step, ::step]),
        K=window_K,
        noise=noise,
        step=step,
        patch_px=max(1.0, correlation_px / step),
    )


def _camera_of_cloud(cloud_m: Float64[Tensor, "n 3"]) -> Float64[Tensor, "3 3"]:
    """Make the intrinsic matrix of a camera to which neighbouring points are about a pixel apart.

    Their spacing is the distance to the fourth neighbour, which in a grid is that of the first.
    Where a cloud holds one surface behind another, the first neighbour may be of the other one.
    """
    rays = (cloud_m[:, :2] / cloud_m[:, 2:]).unique(dim=0)  # some clouds hold points twice
    count = min(_NEIGHBOURS + 1, len(rays))  # the nearest is the ray itself
    distance, _ = KDTree(rays.numpy()).query(
        take_evenly(rays, _SPACED_POINTS).numpy(), count, workers=1
    )
    spacing = max(float(np.median(distance[:, -1])), FINEST_RAD)
    focal_px = 1 / (_POINT_PX * spacing)
    return torch.diag(torch.tensor([focal_px, focal_px, 1.0], dtype=torch.float64))


def compare(observation: Observation, pose: Rigid, surface: Surface) -> Evidence:
    """Compare a posed surface with an observation.

    Args:
        observation: of :func:`observe`.
        pose: ``camera_from_model``.
        surface: of the model.
    """
    rendering = render_surface(surface, pose, observation.K, *observation.depth_m.shape)
    is_drawn = np.isfinite(rendering.depth_m)
    inner = _without_edges(rendering.depth_m, is_drawn, surface.diameter_m, observation.step)
    deviations, is_compared = _residual_deviations(observation, rendering, inner)
    is_supported = is_compared & (np.abs(deviations) <= THRESHOLD)

    # Patches that contradict the pose.
    patch_area_px2 = observation.patch_px**2
    seen_through = _patch_area(deviations > THRESHOLD, patch_area_px2)
    bulging = 0.0
    beside = 0.0
    silhouette = 0.0
    continued = 0.0
    if observation.is_masked:  # the mask says which readings are the object's
        is_bulging = (deviations < -THRESHOLD) & observation.is_object[rendering.window]
        is_beside = _is_beside_silhouette(observation, is_drawn, rendering.window)
        bulging = _patch_area(is_bulging, patch_area_px2)
        beside = _patch_area(is_beside, patch_area_px2)
    else:  # the surface may go on where the object ends
        across = _readings_across(observation, is_drawn, is_supported, rendering.window)
        # Where the surface goes on, patches are as long as others, and half as wide.
        silhouette = float(across.is_read.sum()) / (patch_area_px2 / 2)
        continued = _patch_area(_is_continued(across, observation), patch_area_px2 / 2)

    is_explained = _lies_on_rendering(observation, rendering)
    visible = float(inner.sum()) / patch_area_px2
    supported = float(is_supported.sum()) / patch_area_px2
    squares = deviations[is_supported] ** 2
    return Evidence(
        visible=visible,
        supported=supported,
        explained=float(is_explained.sum()) / patch_area_px2,
        # What neither supports the pose nor contradicts it has no reading, or is hidden.
        unobserved=max(0.0, visible - supported - seen_through - bulging),
        seen_through=seen_through,
        bulging=bulging,
        beside=beside,
        silhouette=silhouette,
        continued=continued,
        rms=float(np.sqrt(squares.mean())) if len(squares) else THRESHOLD,
        noise_m=observation.noise.white_std_m,
    )


def _residual_deviations(
    observation: Observation, rendering: Rendering, inner: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Average residuals over neighbours, in standard deviations of their mean.

    A pixel without a reading of its own has the mean of its neighbours: clouds are sparse.

    Args:
        observation: the readings.
        rendering: of the posed surface.
        inner: its pixels without those near edges, which alone are compared.

    Returns:
        Reading less drawn depth in deviations, 0 where nothing is compared; and the pixels that
        are compared.
    """
    noise = observation.noise
    depth_m = observation.depth_m[rendering.window]
    has_residual = np.isfinite(depth_m) & inner
    residual_m = np.where(has_residual, depth_m - rendering.depth_m, 0).astype(np.float32)
    # Clipped, so that a reading of the background at an edge does not decide for its neighbours.
    limit_m = _CUT_OFF * noise.deviation_m(rendering.cosine, 1).astype(np.float32)
    residual_m = np.clip(residual_m, -limit_m, limit_m)

    side = _averaged_side(observation.step)
    filled_share = ndimage.uniform_filter(has_residual.astype(np.float32), side)
    mean_m = ndimage.uniform_filter(residual_m, side)
    is_compared = inner & (filled_share > _LEAST_FILLED)
    mean_m = mean_m[is_compared] / filled_share[is_compared]
    independent = side**2 // _CORRELATED_READINGS
    deviations = np.zeros_like(residual_m)
    deviations[is_compared] = mean_m / noise.deviation_m(rendering.cosine[is_compared], independent)
    return deviations, is_compared


def _lies_on_rendering(observation: Observation, rendering: Rendering) -> Bool[np.ndarray, "h w"]:
    """Mark the pixels whose own reading lies on the rendered surface, those near its edges too."""
    residual_m = np.abs(observation.depth_m[rendering.window] - rendering.depth_m)
    return residual_m <= THRESHOLD * observation.noise.deviation_m(rendering.cosine, 1)


def _is_beside_silhouette(
    observation: Observation, is_drawn: np.ndarray, window: Window
) -> Bool[np.ndarray, "h w"]:
    """Mark the object's readings that lie beside the silhouette, farther than an edge may move."""
    border = max(1, round((EDGE_PX + 1) / observation.step))
    is_silhouette = np.zeros(observation.depth_m.shape, bool)
    is_silhouette[window] = is_drawn
    is_near = ndimage.binary_dilation(is_silhouette, iterations=border)
    return observation.is_object & np.isfinite(observation.depth_m) & np.logical_not(is_near)


class _Across(NamedTuple):
    """Readings on lines across a silhouette, each through a pixel beside it."""

    inverse: np.ndarray  #: (4, n) 1 / depth [1/m] at the places of ``_ACROSS``, NaN without reading
    spacing_px: np.ndarray  #: (n,) distance of the two places within, and of the two outside
    pixel: np.ndarray  #: (2, n) row and column beside the silhouette, in the observation

    @property
    def is_read(self) -> Bool[np.ndarray, " n"]:
        """Lines whose four places have readings."""
        return np.asarray(np.isfinite(self.inverse).all(0))


def _readings_across(
    observation: Observation,
    is_drawn: np.ndarray,
    is_supported: np.ndarray,
    window: Window,
) -> _Across:
    """Average readings at four places on lines across the silhouette, two on each side.

    Readings on a known background are of no object, and left out.

    Args:
        observation: its readings, (h, w).
        is_drawn: pixels of the silhouette, in the window of the rendering.
        is_supported: of these the ones whose readings support the pose.
        window: rows and columns of the rendering in the observation.
    """
    if not is_drawn.any():  # no silhouette
        return _Across(np.empty((4, 0)), np.empty(0), np.empty((2, 0), int))

    # The silhouette, in a window with a margin.
    border = math.ceil(EDGE_PX / observation.step + observation.patch_px / 2)
    reach = border + max(1, round(observation.patch_px / 2))
    height, width = observation.depth_m.shape
    rows = slice(max(0, window[0].start - reach), min(height, window[0].stop + reach))
    columns = slice(max(0, window[1].start - reach), min(width, window[1].stop + reach))
    inset = (
        slice(window[0].start - rows.start, window[0].stop - rows.start),
        slice(window[1].start - columns.start, window[1].stop - columns.start),
    )
    shape = rows.stop - rows.start, columns.stop - columns.start
    is_silhouette = np.zeros(shape, bool)
    is_silhouette[inset] = is_drawn
    is_support = np.zeros(shape, bool)
    is_support[inset] = is_supported

    # The pixels beside the silhouette, and the pixel of the silhouette nearest to each.
    distance, nearest = cast(
        "tuple[np.ndarray, np.ndarray]",
        ndimage.distance_transform_edt(~is_silhouette, return_indices=True),
    )
    beside = np.stack(np.nonzero((distance > border) & (distance <= reach)))
    edge = nearest[:, beside[0], beside[1]]
    outward = beside - edge

    # Means of readings on the line across the silhouette through each pixel.
    is_background = observation.is_background[rows, columns]
    depth_m = np.where(is_background, np.nan, observation.depth_m[rows, columns])
    mean_inverse = 1 / _mean_depth(depth_m, _averaged_side(observation.step))
    inverse = []
    for k, times in enumerate(_ACROSS):
        pixel = edge + np.rint(times * outward).astype(int)
        row, column = np.clip(pixel, 0, np.array(shape)[:, None] - 1)
        inverse.append(mean_inverse[row, column])
        if k == _NEAREST_WITHIN:
            inverse[-1] = np.where(is_support[row, column], inverse[-1], np.nan)
    return _Across(
        inverse=np.stack(inverse),
        spacing_px=0.5 * distance[tuple(beside)],
        pixel=beside + np.array([[rows.start], [columns.start]]),
    )


def _is_continued(across: _Across, observation: Observation) -> Bool[np.ndarray, "h w"]:
    """Mark pixels beside the silhouette in which the surface within it goes on.

    At its silhouette an object ends: by a step in depth, or by a concave edge where it touches
    something. It does not end where the readings go on straight, as those of a larger box on whose
    side a box is posed, or where they bend away, as round a corner of one body. In 1 / depth those
    of one plane lie on a straight line.
    """
    is_continued = np.zeros(observation.depth_m.shape, bool)
    is_continued[tuple(across.pixel)] = _is_joined_across(
        across.inverse,
        spacing_px=across.spacing_px,
        edge_px=EDGE_PX / observation.step,
        noise_m=math.hypot(AVERAGED_PER_WHITE * observation.noise.white_std_m, FLAT_M),
    )
    return ndimage.binary_closing(is_continued)


def _is_joined_across(
    inverse: Float[np.ndarray, "4 n"],
    *,
    spacing_px: Float[np.ndarray, " n"],
    edge_px: float,
    noise_m: float,
) -> Bool[np.ndarray, " n"]:
    """Whether a surface goes on across a silhouette: straight, or bent away.

    Args:
        inverse: 1 / depth [1/m] at the places of ``_ACROSS``, from within to outside; NaN where
            there is none.
        spacing_px: distance of the two places within, and of the two outside.
        edge_px: distance by which a sensor moves edges.
        noise_m: standard deviation of the depths.
    """
    far_within, within, outside, far_outside = inverse
    noise = noise_m * far_within**2

    # Extended to the silhouette, do the two sides meet? The gap has the variance of ten means.
    within_edge = 2 * within - far_within
    outside_edge = 2 * outside - far_outside
    gap = np.abs(within_edge - outside_edge)
    bend = (far_outside - outside) - (within - far_within)
    # Where they bend, a moved edge leaves a gap at the silhouette.
    edge_gap = edge_px * np.abs(bend) / spacing_px
    is_joined = gap <= _MEETING * math.sqrt(10) * noise + edge_gap

    # Concave, the surface comes nearer outside. The bend has the variance of four means.
    is_concave = bend > _MEETING * 2 * noise
    return is_joined & ~is_concave


def _averaged_side(step: int) -> int:
    """Compute the side of the squares over which readings are averaged [px of the window]; odd."""
    return max(3, 2 * round((AVERAGED_PX / step - 1) / 2) + 1)


def _mean_depth(depth_m: np.ndarray, side: int) -> np.ndarray:
    """Average readings over a square about each pixel that has one; NaN for other pixels."""
    is_read = np.isfinite(depth_m)
    filled = ndimage.uniform_filter(is_read.astype(np.float32), side)
    mean_m = ndimage.uniform_filter(np.where(is_read, depth_m, 0).astype(np.float32), side)
    return np.where(is_read, mean_m / np.maximum(filled, 1e-6), np.nan)


def _without_edges(
    drawn_m: np.ndarray, is_drawn: np.ndarray, diameter_m: float, step: int
) -> np.ndarray:
    """Mark the drawn pixels that are not near an edge, which a sensor moves by some pixels.

    The border left out is narrowed where less than a quarter of the rendering would remain.
    """
    jump_m = max(_JUMP_M, _JUMP_DIAMETERS * diameter_m)
    nearest_m = ndimage.minimum_filter(np.where(is_drawn, drawn_m, _FAR_M), 3)
    farthest_m = ndimage.maximum_filter(np.where(is_drawn, drawn_m, -_FAR_M), 3)
    is_edge = farthest_m - nearest_m > jump_m
    surface = is_drawn & ~is_edge
    for border in range(math.ceil(EDGE_PX / step), 0, -1):
        inner = ndimage.binary_erosion(surface, iterations=border)
        if inner.sum() >= _LEAST_INNER * is_drawn.sum():
            return inner
    return surface


def _patch_area(mask: Bool[np.ndarray, "h w"], patch_area_px2: float) -> float:
    """Add up the areas of connected patches in a mask, in independent patches.

    Patches too small to be more than accidents are left out.
    """
    if not mask.any():
        return 0.0
    labels = np.zeros(mask.shape, np.int32)
    ndimage.label(mask, output=labels)
    areas_px = np.bincount(labels.ravel())[1:]
    areas_px = areas_px[areas_px >= _LEAST_PATCH * patch_area_px2]
    # A patch that remains is wider than a sensor moves an edge: it is one observation at least.
    return float(np.maximum(areas_px / patch_area_px2, 1.0).sum())
