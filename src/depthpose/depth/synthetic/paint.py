"""What lies on the asphalt: lines, zebra crossings, wheel tracks, patches and covers."""

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.depth.synthetic.scene import Markings, StreetScene
from depthpose.depth.synthetic.textures import SIDE_PX, textures

_PATCH_M = 9.0


def paint_road(
    scene: StreetScene,
    albedo: Float[Tensor, "n 3"],
    place_m: Float[Tensor, "n 2"],
    foot: tuple[Float[Tensor, " n"], Float[Tensor, " n"]],
) -> Float[Tensor, "n 3"]:
    """Give the colour of the asphalt with what is painted on it.

    Lines are narrower than a pixel far away, so they cover it by the share of its footprint.

    Args:
        scene: whose road it is.
        albedo: colour of the bare asphalt.
        place_m: x across and s along the road.
        foot: width of a pixel's footprint [m], and the cosine of the angle it is seen at.
    """
    x, s = place_m.unbind(1)
    width_m, length_m = foot[0], foot[0] / foot[1].clamp(min=0.02)
    cover = _cover(scene.markings, x, s, (width_m, length_m))
    wear = torch.sigmoid(3 * (_field(x * 0.13, s * 0.13) + 1.4))
    paint = (cover * scene.markings.brightness * (0.3 + 0.7 * wear))[:, None]
    worn = albedo * _wear(scene, x, s)[:, None]
    return torch.lerp(worn, worn.new_tensor([0.8, 0.8, 0.77]).expand_as(worn), paint)


def _cover(
    markings: Markings, x: Tensor, s: Tensor, foot: tuple[Tensor, Tensor]
) -> Float[Tensor, " n"]:
    """How much of each pixel is painted."""
    width_m, length_m = foot
    cover = torch.zeros_like(x)
    for at, half, period, dash in markings.lines.tolist():
        line = _inside(x - at, half, width_m)
        if dash < period:
            line = line * _inside(s % period - period / 2, dash / 2, length_m)
        cover = torch.maximum(cover, line)
    for at, half, first, last, is_striped in markings.bars.tolist():
        bar = _inside(s - at, half, length_m)
        bar = bar * _inside(x - (first + last) / 2, (last - first) / 2, width_m)
        if is_striped:
            bar = bar * _inside(x % 1.0 - 0.5, 0.25, width_m)
        cover = torch.maximum(cover, bar)
    return cover


def _inside(off: Tensor, half: float, foot: Tensor) -> Tensor:
    """Share of a footprint that lies within ``half`` of a line."""
    foot = foot.clamp(min=1e-3)
    return ((half - off.abs()) / foot + 0.5).clamp(0, 1) * (2 * half / foot).clamp(max=1)


def _wear(scene: StreetScene, x: Tensor, s: Tensor) -> Float[Tensor, " n"]:
    """Darker where wheels roll, where it was mended, and on covers."""
    first, lane_m = scene.markings.wheel_tracks
    within = ((x - first) / lane_m) % 1
    tracks = torch.exp(-(((within - 0.25) / 0.09) ** 2)) + torch.exp(
        -(((within - 0.75) / 0.09) ** 2)
    )
    factor = 1 - 0.08 * tracks
    cell = torch.floor(s / _PATCH_M)
    chance = torch.sin(cell * 12.9898 + 97 * scene.weather.shift[0]) * 43758.5453
    chance = chance - chance.floor()
    along = s - cell * _PATCH_M
    middle = first + chance * 2 * lane_m
    is_patch = ((x - middle).abs() < 0.5 + chance) & ((along - 4).abs() < 1 + 2.5 * chance)
    factor = torch.where(is_patch & (chance > 0.6), factor * (0.45 + 0.45 * chance), factor)
    is_cover = ((x - middle) ** 2 + (along - 2) ** 2 < 0.1) & (chance < 0.35)
    factor = torch.where(is_cover, factor * 0.5, factor)
    # Tar in the seams between lanes.
    seam = torch.exp(-(((within - 0.02 - 0.015 * torch.sin(s * 0.7)) / 0.012) ** 2))
    return factor * (1 - 0.35 * seam * (scene.weather.shift[1] > 0.5))


def _field(u: Tensor, v: Tensor) -> Tensor:
    column, row = (u * SIDE_PX).long() % SIDE_PX, (v * SIDE_PX).long() % SIDE_PX
    return textures().stains.flatten().index_select(0, row * SIDE_PX + column)
