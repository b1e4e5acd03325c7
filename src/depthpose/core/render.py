"""A z-buffer in plain tensor operations: the visible triangle of each pixel, and its depth.

Visibility is exact at the pixel centres: triangles are never clipped or snapped to a grid. The
edge functions are those of homogeneous pixels (Olano and Greer, Triangle Scan Conversion Using 2D
Homogeneous Coordinates, 1997), so a triangle may reach behind the camera. Everything runs on the
device of the triangles, in bounded memory, and the result is the same to the bit every time. It is
made for synthetic images, whose textures need exact coordinates on the triangles; where many poses
are compared with an image, the compiled loop of ``pose/geometry/rendering.py`` is faster.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from depthpose.core.camera.pinhole import check_intrinsics
from depthpose.core.errors import InputError

_EMPTY = (1 << 63) - 1  # the largest key: that of a pixel without a triangle
_NUMBER_BITS = 32  # lower bits of a key: the number of the triangle; its depth lies above them
# Rows of triangles, and pixels of rows, that are computed at a time: some 200 MB at most.
_MAX_ROWS = 1 << 20
_MAX_PIXELS = 1 << 18


@dataclass(frozen=True, kw_only=True, eq=False)
class Raster:
    """Depth and visible triangle of each pixel."""

    depth_m: Float[Tensor, "h w"]  #: along the viewing axis [m]; NaN where nothing is visible
    primitive: Int64[Tensor, "h w"]  #: index of the visible triangle; -1 where there is none
    barycentric: Float[Tensor, "h w 3"] | None  #: of each pixel in its triangle; None: left out


def rasterize(
    triangles: Float[Tensor, "n 3 3"],
    K: Float64[Tensor, "3 3"],
    width: int,
    height: int,
    near_m: float = 0.01,
    *,
    with_barycentric: bool = True,
) -> Raster:
    """Render triangles, visible from both sides, with a pinhole camera.

    Where two are equally far, the one with the lower index is visible.

    Args:
        triangles: corners in the camera's frame (x right, y down, z forward) [m].
        K: intrinsic matrix; fx and fy may differ, skew is allowed.
        width: columns of the picture [px].
        height: rows [px].
        near_m: least depth at which something is visible [m].
        with_barycentric: compute barycentric coordinates too.

    Raises:
        InputError: a size is not positive, ``K`` is no intrinsic matrix, ``near_m`` not positive,
            or a corner is not finite.
    """
    check_intrinsics(K)
    _refuse_unusable(triangles, width, height)
    if not near_m > 0:
        raise InputError(f"near_m is {near_m}, but a camera sees what is in front; take 0.01")
    corners = triangles.double() @ K.to(triangles.device).mT
    is_front = corners[..., 2] >= near_m
    all_front = is_front.all(1)[:, None, None]
    pixels = corners[..., :2] / torch.where(all_front, corners[..., 2:], 1)
    # A triangle that crosses the camera's plane may appear anywhere: its box is the whole picture.
    whole_picture = pixels.new_tensor([[-1.0, -1.0], [0, 0], [float(width), float(height)]])
    pixels = torch.where(all_front, pixels, whole_picture)
    raster = _draw(corners, pixels, is_front, None, width, height, near_m, with_barycentric)
    return replace(raster, depth_m=raster.depth_m.to(triangles.dtype))


def rasterize_orthographic(
    triangles_px: Float[Tensor, "n 3 3"],
    width: int,
    height: int,
    *,
    with_barycentric: bool = True,
) -> Raster:
    """Render triangles with parallel rays, as for shadow maps and height maps.

    Args:
        triangles_px: corners (u [px], v [px], depth [m]); the smallest depth is visible, and it
            may be negative.
        width: columns of the picture [px].
        height: rows [px].
        with_barycentric: compute barycentric coordinates too.

    Raises:
        InputError: a size is not positive, or a corner is not finite.
    """
    _refuse_unusable(triangles_px, width, height)
    triangles = triangles_px.double()
    pixels = triangles[..., :2]
    corners = torch.cat([pixels, torch.ones_like(triangles[..., 2:])], -1)
    # Depth from the nearest corner: the buffer sorts by the bits of a float, which are in the order
    # of the numbers only where these are not negative.
    nearest_m = triangles[..., 2].amin() if len(triangles) else triangles.new_zeros(())
    depth_m = triangles[..., 2] - nearest_m
    raster = _draw(corners, pixels, None, depth_m, width, height, 0.0, with_barycentric)
    return replace(raster, depth_m=(raster.depth_m + nearest_m).to(triangles_px.dtype))


def edge_functions(
    corners: Float64[Tensor, "n 3 3"],
) -> tuple[Float64[Tensor, "n 3 3"], Float64[Tensor, " n"]]:
    """Compute the edge functions of triangles, linear in the pixel (u, v), and their volumes.

    ``edges[i] @ (u, v, 1) / volume[i]`` are the three barycentric coordinates of triangle i at that
    pixel, divided by the depth there: they sum to 1 / depth, and are positive inside the triangle.

    Args:
        corners: homogeneous pixels ``K @ (x, y, z)`` of each triangle.

    Returns:
        Edges, and the signed volumes of the parallelepipeds that the corners span; a volume is 0
        where the plane of the triangle contains the camera.
    """
    # The edge opposite to a corner is the cross product of the other two. Products are rounded
    # before they are subtracted, so that the edge two triangles share has, up to the sign, the same
    # three numbers in both: no gap opens between them.
    ax, ay, az = corners.roll(-1, 1).unbind(-1)
    bx, by, bz = corners.roll(-2, 1).unbind(-1)
    products = [(ay * bz, az * by), (az * bx, ax * bz), (ax * by, ay * bx)]
    edges = torch.stack([minuend - subtrahend for minuend, subtrahend in products], -1)
    volumes = (corners[:, 0] * edges[:, 0]).sum(-1)
    return edges, volumes


def barycentric_shares(
    edges: Float64[Tensor, "n 3 3"],
    volume: Float64[Tensor, " n"],
    primitive: Int64[Tensor, "h w"],
) -> Float[Tensor, "h w 3"]:
    """Compute the barycentric coordinates of each pixel centre in its visible triangle.

    Args:
        edges: edge functions of all triangles, by :func:`edge_functions`.
        volume: volumes of all triangles, by the same function.
        primitive: number of the visible triangle of each pixel; -1 where there is none.

    Returns:
        Shares of the three corners, which sum to 1; 0 where no triangle is visible.
    """
    height, width = primitive.shape
    shares = torch.zeros(height * width, 3, device=edges.device)
    covered = (primitive.reshape(-1) >= 0).nonzero()[:, 0]
    triangle = primitive.reshape(-1)[covered]

    # The edge functions at the pixel centres, divided by their sum.
    u = (covered % width).double()[:, None]
    v = (covered // width).double()[:, None]
    u_slope, v_slope, constant = edges.index_select(0, triangle).unbind(-1)
    weight = torch.addcmul(constant, u_slope, u).addcmul_(v_slope, v).div_(volume[triangle, None])
    weight = weight.clamp_(min=0)  # a pixel on an edge may lie outside by a rounding
    weight_sum = _reduce_columns(torch.add, weight)
    shares[covered] = (weight / weight_sum[:, None]).float()
    return shares.reshape(height, width, 3)


def _refuse_unusable(triangles: Tensor, width: int, height: int) -> None:
    """Refuse a picture without pixels, and corners that are not finite."""
    for name, size in (("width", width), ("height", height)):
        if size < 1:
            raise InputError(f"{name} is {size}, but a picture has a pixel at least; correct it")
    if not bool(triangles.isfinite().all()):
        raise InputError("a corner of the triangles is not finite; leave such triangles out")


@dataclass(frozen=True, kw_only=True, eq=False)
class _Triangles:
    """The triangles whose bounding box contains a pixel centre."""

    number: Int64[Tensor, " n"]  # index among all triangles
    edges: Float64[Tensor, "n 3 3"]  # edge functions, not negative inside
    plane: Float64[Tensor, "n 3"]  # linear in (u, v): 1 / depth, or of parallel rays the depth
    first_column: Int64[Tensor, " n"]  # the box, as far as it lies in the picture
    last_column: Int64[Tensor, " n"]
    first_row: Int64[Tensor, " n"]
    last_row: Int64[Tensor, " n"]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Spans:
    """Spans: the adjacent pixels of one row that lie inside one triangle."""

    number: Int64[Tensor, " n"]  # index of the triangle among all
    row: Int64[Tensor, " n"]
    first_column: Int64[Tensor, " n"]
    last_column: Int64[Tensor, " n"]
    plane_slope: Float64[Tensor, " n"]  # along the row the plane is slope * u + offset
    plane_offset: Float64[Tensor, " n"]


def _draw(
    corners: Float64[Tensor, "n 3 3"],
    pixels: Float64[Tensor, "n 3 2"],
    is_front: Bool[Tensor, "n 3"] | None,
    parallel_depth_m: Float64[Tensor, "n 3"] | None,
    width: int,
    height: int,
    near_m: float,
    with_barycentric: bool,
) -> Raster:
    """Draw triangles into a z-buffer: the rows of each triangle, and the pixels of each row.

    Args:
        corners: homogeneous pixels of the triangles.
        pixels: three points a triangle, whose bounding box holds what it may cover [px].
        is_front: whether a corner is in front of the camera; None: all are.
        parallel_depth_m: depth of the corners along parallel rays, 0 or more; None: a pinhole.
        width: columns of the picture [px].
        height: rows [px].
        near_m: least depth at which something is visible [m].
        with_barycentric: compute barycentric coordinates too.
    """
    triangles = _select_triangles(corners, pixels, is_front, parallel_depth_m, width, height)
    is_parallel = parallel_depth_m is not None

    # A key has the bits of the depth above the number of the triangle, so that the smallest key of
    # a pixel is that of the visible triangle.
    buffer = torch.full((width * height,), _EMPTY, dtype=torch.int64, device=corners.device)
    for chunk in _split_by_sum(triangles.last_row - triangles.first_row + 1, _MAX_ROWS):
        spans = _find_spans(triangles, chunk)
        for part in _split_by_sum(spans.last_column - spans.first_column + 1, _MAX_PIXELS):
            _draw_spans(buffer, spans, part, width, near_m, is_parallel=is_parallel)

    # Depth and number out of the keys.
    is_drawn = buffer != _EMPTY
    primitive = torch.where(is_drawn, buffer & ((1 << _NUMBER_BITS) - 1), -1).reshape(height, width)
    depth_m = (buffer >> _NUMBER_BITS).int().view(torch.float32).double()
    depth_m = torch.where(is_drawn, depth_m, torch.nan).reshape(height, width)
    shares = barycentric_shares(*edge_functions(corners), primitive) if with_barycentric else None
    return Raster(depth_m=depth_m, primitive=primitive, barycentric=shares)


def _select_triangles(
    corners: Float64[Tensor, "n 3 3"],
    pixels: Float64[Tensor, "n 3 2"],
    is_front: Bool[Tensor, "n 3"] | None,
    parallel_depth_m: Float64[Tensor, "n 3"] | None,
    width: int,
    height: int,
) -> _Triangles:
    """Select the triangles that may cover a pixel; arguments are those of :func:`_draw`."""
    first = pixels.amin(1).ceil().clamp(min=0)
    last = torch.minimum(pixels.amax(1).floor(), pixels.new_tensor([width - 1, height - 1]))
    has_pixels = (first <= last).all(1)
    if is_front is not None:
        has_pixels = has_pixels & is_front.any(1)
    number = has_pixels.nonzero()[:, 0]
    first_column, first_row = first[number].long().unbind(-1)
    last_column, last_row = last[number].long().unbind(-1)

    # The three edge functions, each divided by the volume, sum to 1 / depth. Weighted by the depths
    # of the corners along parallel rays, they sum to the depth.
    signed_edges, volume = edge_functions(corners.index_select(0, number))
    scale = torch.where(volume != 0, 1 / volume, 0)[:, None]
    if parallel_depth_m is None:
        plane = signed_edges.sum(1) * scale
    else:
        corner_depth_m = parallel_depth_m.index_select(0, number)[..., None]
        plane = (signed_edges * scale[..., None] * corner_depth_m).sum(1)
    return _Triangles(
        number=number,
        edges=signed_edges * volume.sign()[:, None, None],
        plane=plane,
        first_column=first_column,
        last_column=last_column,
        first_row=first_row,
        last_row=last_row,
    )


def _find_spans(triangles: _Triangles, chunk: slice) -> _Spans:
    """Find the spans of some triangles: in each row the columns inside all three edges."""
    triangle, row = _expand_ranges(triangles.first_row[chunk], triangles.last_row[chunk])
    triangle = triangle + chunk.start
    v = row.double()
    u_slope, v_slope, constant = triangles.edges.index_select(0, triangle).unbind(-1)
    offset = torch.addcmul(constant, v_slope, v[:, None])
    first, last = _find_columns_inside(
        u_slope, offset, triangles.first_column[triangle], triangles.last_column[triangle]
    )
    not_empty = (first <= last).nonzero()[:, 0]
    triangle, row, first, last, v = (
        values.index_select(0, not_empty) for values in (triangle, row, first, last, v)
    )

    plane_slope, v_slope, constant = triangles.plane.index_select(0, triangle).unbind(-1)
    return _Spans(
        number=triangles.number.index_select(0, triangle),
        row=row,
        first_column=first,
        last_column=last,
        plane_slope=plane_slope,
        plane_offset=v_slope * v + constant,
    )


def _draw_spans(
    buffer: Int64[Tensor, " pixels"],
    spans: _Spans,
    part: slice,
    width: int,
    near_m: float,
    *,
    is_parallel: bool,
) -> None:
    """Draw some spans into the buffer: each of their pixels keeps the smallest key.

    Args:
        buffer: keys of all pixels, row by row; changed in place.
        spans: spans of pixels.
        part: those of them that are drawn.
        width: columns of the picture [px].
        near_m: least depth at which something is visible [m].
        is_parallel: rays are parallel, so that the plane is the depth, and not 1 / depth.
    """
    span, u = _expand_ranges(spans.first_column[part], spans.last_column[part])
    plane_value = torch.addcmul(
        spans.plane_offset[part].index_select(0, span),
        spans.plane_slope[part].index_select(0, span),
        u,
    )
    depth_m = plane_value.clamp(min=0) if is_parallel else 1 / plane_value
    depth_m = depth_m.float()

    # Where 1 / depth is not positive, the ray meets the plane behind the camera.
    is_visible = (depth_m >= near_m) & depth_m.isfinite()
    depth_bits = depth_m.view(torch.int32).long()
    key = (depth_bits << _NUMBER_BITS) | spans.number[part].index_select(0, span)
    key = torch.where(is_visible, key, _EMPTY)
    pixel = (spans.row * width)[part].index_select(0, span) + u
    buffer.scatter_reduce_(0, pixel, key, "amin")


def _find_columns_inside(
    slope: Float64[Tensor, "n 3"],
    offset: Float64[Tensor, "n 3"],
    first: Int64[Tensor, " n"],
    last: Int64[Tensor, " n"],
) -> tuple[Int64[Tensor, " n"], Int64[Tensor, " n"]]:
    """Find the first and the last column of rows inside all three edges of their triangles.

    Args:
        slope: along a row, an edge function is ``slope * u + offset``, not negative inside.
        offset: its value at u = 0.
        first: first column that may be inside.
        last: last column that may be.

    Returns:
        The first and the last column inside; the last is before the first where there is none.
    """
    # An edge that rises with u bounds the row on the left, one that falls on the right.
    crossing = -offset / slope
    left = _reduce_columns(torch.maximum, torch.where(slope > 0, crossing, -torch.inf))
    right = _reduce_columns(torch.minimum, torch.where(slope < 0, crossing, torch.inf))

    # An edge along the row has no crossing: the whole row is inside it, or outside.
    is_level = slope == 0
    is_outside = _reduce_columns(torch.logical_or, is_level & (offset < 0))
    # The edge functions of a triangle without area are 0: it would cover everything.
    has_no_area = _reduce_columns(torch.logical_and, is_level)
    start = torch.maximum(left.ceil(), first.double())
    stop = torch.minimum(right.floor(), last.double())
    stop = torch.where(is_outside | has_no_area, -1, stop)  # before any first column: empty
    return start.long(), stop.clamp(min=-1).long()


def _reduce_columns(join: Callable[[Tensor, Tensor], Tensor], values: Tensor) -> Tensor:
    """Reduce an (n, 3) tensor to (n,) by ``join``, ten times as fast as torch's own reductions."""
    return join(join(values[:, 0], values[:, 1]), values[:, 2])


def _expand_ranges(
    first: Int64[Tensor, " n"], last: Int64[Tensor, " n"]
) -> tuple[Int64[Tensor, " m"], Int64[Tensor, " m"]]:
    """List the integers of all ranges ``first .. last``, one range after the other.

    Returns:
        For each integer the index of its range, and the integers.
    """
    count = last - first + 1
    range_index = torch.repeat_interleave(torch.arange(len(count), device=first.device), count)
    # In a range, the difference of an integer and its position in the list is constant.
    position_of_first = count.cumsum(0) - count
    shift = first - position_of_first
    position = torch.arange(len(range_index), device=first.device)
    return range_index, position + shift.index_select(0, range_index)


def _split_by_sum(counts: Int64[Tensor, " n"], limit: int) -> Iterator[slice]:
    """Yield slices of a list whose counts sum to at most ``limit``, or that hold one item alone."""
    ends = counts.cumsum(0).cpu().numpy()
    start = 0
    sum_before = 0
    while start < len(ends):
        fitting = int(np.searchsorted(ends, sum_before + limit, side="right"))
        stop = max(fitting, start + 1)
        yield slice(start, stop)
        start = stop
        sum_before = int(ends[stop - 1])
