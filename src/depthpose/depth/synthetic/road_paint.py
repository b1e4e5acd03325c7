"""What is on the asphalt of a road: markings, wheel tracks, patches, manholes and seams."""

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.depth.synthetic.scene import Markings, SyntheticScene, Weather
from depthpose.depth.synthetic.textures import Numbers, Vectors, look_up_noise, make_textures

ROAD_TILE_M = 3.0
"""Side of a tile of the road's texture, whose coordinates are those on the road [tiles]."""
_PATCH_M = 9.0
"""Length of the stretches of road, of which each may have a patch or a manhole."""


def paint_road(
    scene: SyntheticScene,
    albedo: Vectors,
    place_m: Float[Tensor, "n 2"],
    width_m: Numbers,
    length_m: Numbers,
) -> Vectors:
    """Add markings, wheel tracks, patches and seams to the albedo of the asphalt.

    Args:
        scene: the street.
        albedo: albedo of the asphalt.
        place_m: coordinates (x, s) on the road.
        width_m: width of the pixels' footprints.
        length_m: their length along the road.
    """
    x, s = place_m.unbind(1)
    markings = scene.markings
    weather = scene.weather

    # Wheels darken two tracks in each lane.
    in_lane = ((x - markings.first_lane_x_m) / markings.lane_m) % 1
    left, right = (torch.exp(-(((in_lane - track) / 0.09) ** 2)) for track in (0.25, 0.75))
    factor = 1 - 0.08 * (left + right)
    factor = _paint_patches(factor, markings, weather, x, s)

    # Tar in the seams between lanes, in half of the scenes.
    from_seam = in_lane - 0.02 - 0.015 * torch.sin(s * 0.7)
    seam = torch.exp(-((from_seam / 0.012) ** 2))
    has_seams = weather.shift[1] > 0.5
    worn = albedo * (factor * (1 - 0.35 * seam * has_seams))[:, None]

    # Paint, worn off in places.
    cover = _compute_marked_share(markings, x, s, width_m, length_m)
    wear = torch.sigmoid(3 * (look_up_noise(make_textures().stains, x * 0.13, s * 0.13) + 1.4))
    paint_share = (cover * markings.brightness * (0.3 + 0.7 * wear))[:, None]
    paint_color = worn.new_tensor([0.8, 0.8, 0.77])
    return torch.lerp(worn, paint_color.expand_as(worn), paint_share)


def _paint_patches(
    factor: Numbers, markings: Markings, weather: Weather, x: Numbers, s: Numbers
) -> Numbers:
    """Darken the asphalt where a stretch of road has a patch or a manhole's cover.

    Args:
        factor: of the asphalt's albedo, at each point.
        markings: lanes of the road.
        weather: of the scene, whose random shift makes the patches of scenes differ.
        x: coordinate across the road [m].
        s: coordinate along it [m].

    Returns:
        The factor, smaller in patches and covers.
    """
    # A random number in [0, 1) for each stretch, by a usual hash: digits of a sine of its number.
    # It alone decides what a stretch has, where, how large and how dark.
    stretch = torch.floor(s / _PATCH_M)
    chance = torch.sin(stretch * 12.9898 + 97 * weather.shift[0]) * 43758.5453
    chance = chance - chance.floor()
    along = s - stretch * _PATCH_M
    middle = markings.first_lane_x_m + chance * 2 * markings.lane_m

    # Patches where it is large, covers where it is small.
    is_patch = ((x - middle).abs() < 0.5 + chance) & ((along - 4).abs() < 1 + 2.5 * chance)
    factor = torch.where(is_patch & (chance > 0.6), factor * (0.45 + 0.45 * chance), factor)
    is_cover = ((x - middle) ** 2 + (along - 2) ** 2 < 0.1) & (chance < 0.35)
    return torch.where(is_cover, factor * 0.5, factor)


def _compute_marked_share(
    markings: Markings, x: Numbers, s: Numbers, width_m: Numbers, length_m: Numbers
) -> Numbers:
    """Compute the share of each pixel's footprint that is marked: far lines are narrower than it.

    ``x`` and ``s``: coordinates on the road [m]; the rest as in :func:`paint_road`.
    """
    cover = torch.zeros_like(x)
    for line in markings.lines:
        share = _compute_covered_share(x - line.x_m, line.half_width_m, width_m)
        if line.dash_m < line.period_m:
            from_dash = s % line.period_m - line.period_m / 2
            share = share * _compute_covered_share(from_dash, line.dash_m / 2, length_m)
        cover = torch.maximum(cover, share)
    for bar in markings.bars:
        middle_x = (bar.first_x_m + bar.last_x_m) / 2
        half_x = (bar.last_x_m - bar.first_x_m) / 2
        share = _compute_covered_share(s - bar.s_m, bar.half_length_m, length_m)
        share = share * _compute_covered_share(x - middle_x, half_x, width_m)
        if bar.is_striped:  # stripes of half a metre, one each metre
            share = share * _compute_covered_share(x % 1.0 - 0.5, 0.25, width_m)
        cover = torch.maximum(cover, share)
    return cover


def _compute_covered_share(offset_m: Numbers, half_m: float, footprint_m: Numbers) -> Numbers:
    """Compute the share of a footprint that lies within ``half_m`` of a line, in one dimension.

    ``offset_m``: distance of the footprint's centre from the line. Exact for footprints narrower
    than the line, an approximation for wider ones.
    """
    footprint_m = footprint_m.clamp(min=1e-3)
    inside = ((half_m - offset_m.abs()) / footprint_m + 0.5).clamp(0, 1)
    return inside * (2 * half_m / footprint_m).clamp(max=1)
