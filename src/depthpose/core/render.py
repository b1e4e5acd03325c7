"""A z-buffer in plain tensor operations: which triangle does each pixel see, and how far is it?

Visibility is exact at the pixel centres: triangles are never clipped or snapped to a grid. The
edge functions live in homogeneous pixels (Olano and Greer, Triangle Scan Conversion Using 2D
Homogeneous Coordinates, 1997), so a triangle may reach behind the camera. Everything runs on the
device of the triangles, in memory that does not grow with the scene, and gives the same bits
every time.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from depthpose.core.camera.pinhole import check_intrinsics
from depthpose.core.errors import InputError

_EMPTY = (1 << 63) - 1
_MAX_ROWS = 1 << 20
_MAX_PIXELS = 1 << 18  # how much is expanded at a time: some 200 MB at most, whatever the scene


@dataclass(frozen=True, kw_only=True, eq=False)
class Raster:
    """What each pixel sees."""

    depth_m: Float[Tensor, "h w"]  #: distance along the viewing axis; NaN where nothing is seen
    primitive: Int64[Tensor, "h w"]  #: number of the triangle; -1 where nothing is seen
    barycentric: Float[Tensor, "h w 3"] | None  #: shares of its corners; None: unasked


def rasterize(
    triangles: Float[Tensor, "n 3 3"],
    K: Float64[Tensor, "3 3"],
    width: int,
    height: int,
    near_m: float = 0.01,
    *,
    with_barycentric: bool = True,
) -> Raster:
    """Draw triangles as a pinhole camera sees them, from both sides.

    Where two are equally far, the one with the lower number is seen.

    Args:
        triangles: corners in the camera's frame (x right, y down, z forward) [m].
        K: intrinsic matrix; fx and fy may differ, skew is allowed.
        width: columns of the picture [px].
        height: rows [px].
        near_m: what is nearer than this is not seen.
        with_barycentric: give barycentric coordinates too.

    Raises:
        InputError: a size is not positive, ``K`` is no intrinsic matrix, ``near_m`` not positive,
            or a corner is not finite.
    """
    check_intrinsics(K)
    _check(triangles, width, height)
    if not near_m > 0:
        raise InputError(f"near_m is {near_m}, but a camera sees what is in front; take 0.01")
    corners = triangles.double() @ K.to(triangles.device).mT
    is_front = corners[..., 2] >= near_m
    all_front = is_front.all(1)[:, None, None]
    pixels = corners[..., :2] / torch.where(all_front, corners[..., 2:], 1)
    # What crosses the plane of the camera may appear anywhere.
    anywhere = pixels.new_tensor([[-1.0, -1.0], [0, 0], [float(width), float(height)]])
    pixels = torch.where(all_front, pixels, anywhere)
    raster = _draw(corners, pixels, is_front, None, width, height, near_m, with_barycentric)
    return replace(raster, depth_m=raster.depth_m.to(triangles.dtype))


def rasterize_orthographic(
    triangles_px: Float[Tensor, "n 3 3"],
    width: int,
    height: int,
    *,
    with_barycentric: bool = True,
) -> Raster:
    """Draw triangles as parallel rays see them: shadow maps and heights of a place from above.

    Args:
        triangles_px: corners (u [px], v [px], depth [m]); the smallest depth is seen, and it may
            be negative.
        width: columns of the picture [px].
        height: rows [px].
        with_barycentric: give barycentric coordinates too.

    Raises:
        InputError: a size is not positive, or a corner is not finite.
    """
    _check(triangles_px, width, height)
    flat = triangles_px.double()
    nearest_m = flat[..., 2].amin() if len(flat) else flat.new_zeros(())
    corners = torch.cat([flat[..., :2], torch.ones_like(flat[..., 2:])], -1)
    # Sorting keys are the bits of a float, which ascend for positive numbers alone.
    above_m = flat[..., 2] - nearest_m
    raster = _draw(corners, flat[..., :2], None, above_m, width, height, 0.0, with_barycentric)
    return replace(raster, depth_m=(raster.depth_m + nearest_m).to(triangles_px.dtype))


def edge_functions(
    corners: Float64[Tensor, "n 3 3"],
) -> tuple[Float64[Tensor, "n 3 3"], Float64[Tensor, " n"]]:
    """Give the edge functions of triangles and their volumes, for any fraction of a pixel.

    ``edges[i] @ (u, v, 1) / volume`` are the barycentric coordinates divided by the depth, so
    their sum is 1 / depth, and all three are positive inside the triangle.

    Args:
        corners: homogeneous pixels ``K @ (x, y, z)`` of each triangle.

    Returns:
        Edges and volumes; the volume is 0 where the plane goes through the camera.
    """
    # The cross product of the two other corners. Products are rounded one by one, so that the edge
    # two triangles share has, up to the sign, the same three numbers in both: nothing shows through
    # between them.
    (ax, ay, az), (bx, by, bz) = (corners.roll(-k, 1).unbind(-1) for k in (1, 2))
    parts = [(ay * bz, az * by), (az * bx, ax * bz), (ax * by, ay * bx)]
    edges = torch.stack([start - other for start, other in parts], -1)
    return edges, (corners[:, 0] * edges[:, 0]).sum(-1)


def barycentric_shares(
    edges: Float64[Tensor, "n 3 3"],
    volume: Float64[Tensor, " n"],
    primitive: Int64[Tensor, "h w"],
) -> Float[Tensor, "h w 3"]:
    """Give the shares of a triangle's corners at each pixel centre; 0 where nothing is seen.

    ``edges`` (:func:`edge_functions`) are those of all triangles, divided by ``volume``;
    ``primitive`` is the triangle that each pixel sees.
    """
    height, width = primitive.shape
    shares = torch.zeros(height * width, 3, device=edges.device)
    covered = (primitive.reshape(-1) >= 0).nonzero()[:, 0]
    triangle = primitive.reshape(-1)[covered]
    u = (covered % width).double()[:, None]
    v = (covered // width).double()[:, None]
    across, down, constant = edges.index_select(0, triangle).unbind(-1)
    weight = torch.addcmul(constant, across, u).addcmul_(down, v).div_(volume[triangle, None])
    weight = weight.clamp_(min=0)  # beyond the edge by a rounding, where a pixel lies on it
    shares[covered] = (weight / _most(torch.add, weight)[:, None]).float()
    return shares.reshape(height, width, 3)


def _check(triangles: Tensor, width: int, height: int) -> None:
    """Refuse an empty picture, and corners that are not finite."""
    for name, size in (("width", width), ("height", height)):
        if size < 1:
            raise InputError(f"{name} is {size}, but a picture has a pixel at least; correct it")
    if not bool(triangles.isfinite().all()):
        raise InputError("a corner of the triangles is not finite; leave such triangles out")


def _draw(
    corners: Float64[Tensor, "n 3 3"],
    pixels: Float64[Tensor, "n 3 2"],
    is_front: Bool[Tensor, "n 3"] | None,
    above_m: Float64[Tensor, "n 3"] | None,
    width: int,
    height: int,
    near_m: float,
    with_barycentric: bool,
) -> Raster:
    """Draw triangles of homogeneous pixels; by parallel rays where ``above_m`` is their depth."""
    # Those whose box covers a pixel centre, each with its first and last column and row.
    first = pixels.amin(1).ceil().clamp(min=0)
    last = torch.minimum(pixels.amax(1).floor(), pixels.new_tensor([width - 1, height - 1]))
    is_seen = (first <= last).all(1) & (True if is_front is None else is_front.any(1))
    number = is_seen.nonzero()[:, 0]
    first = first[number].long()
    last = last[number].long()
    raw, volume = edge_functions(corners.index_select(0, number))
    scale = torch.where(volume != 0, 1 / volume, 0)[:, None]
    edges = raw * volume.sign()[:, None, None]  # not negative inside
    plane = raw.sum(1) * scale  # 1 / depth at (u, v, 1), or, of parallel rays, the depth
    if above_m is not None:
        plane = (raw * scale[..., None] * above_m.index_select(0, number)[..., None]).sum(1)
    buffer = torch.full((width * height,), _EMPTY, dtype=torch.int64, device=corners.device)
    for part in _chunks(last[:, 1] - first[:, 1] + 1, _MAX_ROWS):
        # First the rows of some triangles, then the pixels of each row.
        which, row = _expand(first[part, 1], last[part, 1])
        which = which + part.start
        v = row.double()
        across, down, constant = edges.index_select(0, which).unbind(-1)
        offset = torch.addcmul(constant, down, v[:, None])
        start, stop = _span(across, offset, first[which, 0], last[which, 0])
        not_empty = (start <= stop).nonzero()[:, 0]
        which, row, start, stop, v = (
            values.index_select(0, not_empty) for values in (which, row, start, stop, v)
        )
        slope, down, constant = plane.index_select(0, which).unbind(-1)
        at_row = down * v + constant
        names = number.index_select(0, which)
        for pixel_chunk in _chunks(stop - start + 1, _MAX_PIXELS):
            span, u = _expand(start[pixel_chunk], stop[pixel_chunk])
            at_start = at_row[pixel_chunk].index_select(0, span)
            value = torch.addcmul(at_start, slope[pixel_chunk].index_select(0, span), u)
            depth = (1 / value if above_m is None else value.clamp(min=0)).float()
            key = (depth.view(torch.int32).long() << 32) | names[pixel_chunk].index_select(0, span)
            # Where 1 / depth is not positive, the plane is met behind the camera.
            key = torch.where((depth >= near_m) & depth.isfinite(), key, _EMPTY)
            buffer.scatter_reduce_(
                0, (row * width)[pixel_chunk].index_select(0, span) + u, key, "amin"
            )
    is_drawn = buffer != _EMPTY
    primitive = torch.where(is_drawn, buffer & 0xFFFFFFFF, -1).reshape(height, width)
    depth_m = (buffer >> 32).int().view(torch.float32).double()
    depth_m = torch.where(is_drawn, depth_m, torch.nan).reshape(height, width)
    shares = barycentric_shares(*edge_functions(corners), primitive) if with_barycentric else None
    return Raster(depth_m=depth_m, primitive=primitive, barycentric=shares)


def _span(
    slope: Float64[Tensor, "n 3"],
    offset: Float64[Tensor, "n 3"],
    first: Int64[Tensor, " n"],
    last: Int64[Tensor, " n"],
) -> tuple[Int64[Tensor, " n"], Int64[Tensor, " n"]]:
    """Give the first and last column where all three ``slope * u + offset`` are not negative."""
    cross = -offset / slope
    left = _most(torch.maximum, torch.where(slope > 0, cross, -torch.inf))
    right = _most(torch.minimum, torch.where(slope < 0, cross, torch.inf))
    is_level = slope == 0
    is_outside = _most(torch.logical_or, is_level & (offset < 0))
    # A triangle of no area has only lines of zeros and would cover everything.
    is_flat = _most(torch.logical_and, is_level)
    start = torch.maximum(left.ceil(), first.double())
    stop = torch.minimum(right.floor(), last.double())
    stop = torch.where(is_outside | is_flat, -1, stop)
    return start.long(), stop.clamp(min=-1).long()


def _most(join: Callable[[Tensor, Tensor], Tensor], values: Tensor) -> Tensor:
    """Join the three columns: ten times as fast as a reduction over so short an axis."""
    return join(join(values[:, 0], values[:, 1]), values[:, 2])


def _expand(
    first: Int64[Tensor, " n"], last: Int64[Tensor, " n"]
) -> tuple[Int64[Tensor, " m"], Int64[Tensor, " m"]]:
    """List the whole numbers from ``first`` to ``last`` of each range, and its index."""
    count = last - first + 1
    owner = torch.repeat_interleave(torch.arange(len(count), device=first.device), count)
    begin = first - (count.cumsum(0) - count)
    return owner, torch.arange(len(owner), device=first.device) + begin.index_select(0, owner)


def _chunks(counts: Int64[Tensor, " n"], limit: int) -> Iterator[slice]:
    """Split a list into parts whose counts sum to at most ``limit``, or which are one item."""
    ends = counts.cumsum(0).cpu().numpy()
    start = 0
    done = 0
    while start < len(ends):
        stop = max(int(np.searchsorted(ends, done + limit, side="right")), start + 1)
        yield slice(start, stop)
        start = stop
        done = int(ends[stop - 1])
