"""Seamless textures of the materials, painted from noise once in a process.

A texture modulates a surface's colour, so its mean is about 1. Coordinates run from 0 to 1 over a
tile: ``_X`` to the right, ``_Y`` upwards on a wall.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float16, Int
from torch import Tensor

from depthpose.depth.synthetic.materials import FIRST_LAYER, LAYER_COUNT, MATERIALS, Number
from depthpose.depth.synthetic.randomness import Stream, make_rng

SIDE_PX = 256
"""Side of a texture at full size."""
LEVEL_COUNT = 9
"""Number of levels of detail of a texture, with sides from 256 pixels down to 1."""

Numbers = Float[Tensor, " n"]
Vectors = Float[Tensor, "n 3"]
Indices = Int[Tensor, " n"]

GreyTexture = Float[np.ndarray, "256 256"]
ColorTexture = Float[np.ndarray, "256 256 3"]

_Y, _X = np.mgrid[:SIDE_PX, :SIDE_PX].astype(np.float32) / SIDE_PX
"""Coordinates of the pixels of a texture [tiles]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Textures:
    """All textures at all levels of detail."""

    texels: Float16[Tensor, "n 3"]  # texels of all textures, level by level
    starts: Int[Tensor, " levels"]  # number of the first texel of each level
    clouds: Float[Tensor, "256 256"]  # a field of noise for clouds
    stains: Float[Tensor, "256 256"]  # a field of noise for unevenness over metres


@cache
def make_textures() -> Textures:
    """Make all textures, once in a process; it takes a second."""
    rng = make_rng(Stream.TEXTURES)
    noise = _Noise(rng)
    stack = np.ones((LAYER_COUNT, SIDE_PX, SIDE_PX, 3), np.float32)
    for name, material in MATERIALS.items():
        for variant in range(material.variants):
            painted = _PAINTERS[name](noise, variant)
            is_grey = painted.ndim == 2
            stack[FIRST_LAYER[name] + variant] = painted[..., None] if is_grey else painted

    # Each level of detail has half the side of the one before: means of 2 x 2 texels.
    level = np.clip(stack, 0.02, 3)
    levels = []
    for _ in range(LEVEL_COUNT):
        levels.append(level.reshape(-1, 3))
        half = level.shape[1] // 2
        if half:
            level = level.reshape(LAYER_COUNT, half, 2, half, 2, 3).mean((2, 4))
    starts = np.cumsum([0, *(len(texels) for texels in levels[:-1])])

    return Textures(
        texels=torch.from_numpy(np.concatenate(levels).astype(np.float16)),
        starts=torch.from_numpy(starts),
        clouds=torch.from_numpy(noise.draw(2.6, (1, 100))),
        stains=torch.from_numpy(noise.draw(2.0, (1, 64))),
    )


def sample_texture(
    textures: Textures,
    layer: Indices,
    uv: Float[Tensor, "n 2"],
    level: Numbers,
) -> Vectors:
    """Sample textures bilinearly, in the nearest level of detail.

    Args:
        textures: all textures.
        layer: number of the texture of each sample.
        uv: coordinates [tiles].
        level: level of detail, rounded to the nearest: 0 is the full size, 1 half of it.
    """
    # The four texels about each place; sides are powers of two, so a mask repeats the texture.
    whole_level = level.round().clamp(0, LEVEL_COUNT - 1).long()
    side = SIDE_PX >> whole_level
    place = uv * side[:, None] - 0.5
    low = place.floor()
    share = place - low
    column, row = low.long().unbind(1)
    mask = side - 1
    start = textures.starts.to(layer.device)[whole_level] + layer * side * side
    left = column & mask
    right = (column + 1) & mask
    upper_row = start + (row & mask) * side
    lower_row = start + ((row + 1) & mask) * side

    # Their mean, weighted by nearness.
    texels = textures.texels
    upper_left, upper_right, lower_left, lower_right = (
        texels.index_select(0, index).float()
        for index in (upper_row + left, upper_row + right, lower_row + left, lower_row + right)
    )
    across = share[:, :1]
    down = share[:, 1:]
    upper = torch.lerp(upper_left, upper_right, across)
    lower = torch.lerp(lower_left, lower_right, across)
    return torch.lerp(upper, lower, down)


def look_up_noise(noise: Float[Tensor, "256 256"], u: Numbers, v: Numbers) -> Numbers:
    """Look up a repeating field of noise at coordinates u and v [tiles]."""
    column = (u * SIDE_PX).long() % SIDE_PX
    row = (v * SIDE_PX).long() % SIDE_PX
    return noise.flatten().index_select(0, row * SIDE_PX + column)


_RISE_JOINTS = 0.6  # distance over which a joint blends into a brick, in widths of the joint


class _Bond(NamedTuple):
    """A bond of bricks, slabs, tiles or boards."""

    brick_blend: Float[np.ndarray, "256 256"]  # 1 on bricks, 0 in joints, between at their edges
    shade: ColorTexture  # a random factor of the colour for each brick
    height_in_row: Float[np.ndarray, "256 256"]  # 0 at the lower edge of the brick's row, to 1


@dataclass(frozen=True)
class _Noise:
    """Draws seamless fields of noise with a mean of 0 and a deviation of 1."""

    rng: np.random.Generator

    def draw(
        self,
        falloff: Number,
        band: tuple[Number, Number],
        stretch_yx: tuple[Number, Number] = (1, 1),
    ) -> GreyTexture:
        """Draw noise whose power at a frequency f is f^-falloff.

        Args:
            falloff: exponent of the power spectrum; larger ones give broader patches.
            band: lowest and highest frequency, in periods per tile.
            stretch_yx: factors by which frequencies along y and x are higher.
        """
        frequency_y = np.fft.fftfreq(SIDE_PX)[:, None] * SIDE_PX / stretch_yx[0]
        frequency_x = np.fft.rfftfreq(SIDE_PX)[None] * SIDE_PX / stretch_yx[1]
        frequency = np.hypot(frequency_x, frequency_y)
        is_in_band = (frequency >= band[0]) & (frequency <= band[1])

        # A ring of the spectrum holds f amplitude^2, which is f^-falloff for this amplitude.
        amplitude = 1 / np.maximum(frequency, 1) ** (falloff / 2 + 0.5)
        amplitude = np.where(is_in_band, amplitude, 0)
        phase = np.exp(2j * np.pi * self.rng.random(amplitude.shape))
        field = np.fft.irfft2(amplitude * phase, s=(SIDE_PX, SIDE_PX))
        return (field / field.std()).astype(np.float32)

    def draw_rough(self) -> GreyTexture:
        """Draw coarse and fine noise together."""
        return self.draw(1.6, (1, 128))

    def draw_fine(self) -> GreyTexture:
        """Draw grains."""
        return self.draw(0.3, (24, 128))

    def draw_broad(self) -> GreyTexture:
        """Draw patches."""
        return self.draw(2.4, (1, 20))

    def draw_bond(self, rows: int, columns: int, joint_rows: Number, spread: Number) -> _Bond:
        """Draw bricks in rows, every second row staggered by half a brick.

        Args:
            rows: number of rows.
            columns: number of bricks in a row.
            joint_rows: width of the joints, in heights of a row.
            spread: standard deviation of the bricks' shades.
        """
        row = np.floor(_Y * rows).astype(int)
        across = _X * columns + 0.5 * (row % 2)
        column = np.floor(across).astype(int) % columns
        in_row = (_Y * rows) % 1
        in_column = across % 1

        # Distance to the nearest edge of the brick, in heights of a row.
        to_side = np.minimum(in_column, 1 - in_column) * rows / columns
        edge = np.minimum(to_side, np.minimum(in_row, 1 - in_row))
        # From the joint to the brick the blend rises linearly.
        rise_rows = _RISE_JOINTS * joint_rows
        brick_blend = np.clip((edge - joint_rows / 2) / rise_rows, 0, 1)

        # A grey shade of each brick, and a smaller deviation of each channel.
        shade = 1 + spread * self.rng.normal(size=(rows, columns, 1))
        shade = shade + 0.3 * spread * self.rng.normal(size=(rows, columns, 3))
        return _Bond(brick_blend, shade[row, column].astype(np.float32), in_row)


def _paint_road(noise: _Noise, variant: int) -> GreyTexture:
    """Paint asphalt with cracks in some places."""
    # Cracks are where smooth noise crosses 0, in places that are more or less frequent by variant.
    cracks = np.clip(1 - np.abs(noise.draw(1.8, (2, 60))) / 0.035, 0, 1)
    cracks = cracks * np.clip(noise.draw_broad() - (0.4 * variant) % 1, 0, 1)
    rough = noise.draw_rough()
    fine = noise.draw_fine()
    broad = noise.draw_broad()
    return 1 + (0.24 + 0.05 * variant) * fine + 0.14 * rough + 0.06 * broad - 0.6 * cracks


def _paint_grass(noise: _Noise, variant: int) -> ColorTexture:
    """Paint grass, drier in some places."""
    fine = noise.draw_fine()
    rough = noise.draw_rough()
    broad = noise.draw_broad()
    dryness = 0.14 + 0.1 * variant
    red = 1 + 0.34 * fine + 0.26 * rough + dryness * broad
    green = 1 + 0.32 * fine + 0.24 * rough + 0.4 * dryness * broad
    blue = 1 + 0.3 * fine + 0.22 * rough
    return np.stack([red, green, blue], 2)


def _paint_dirt(noise: _Noise, _: int) -> GreyTexture:
    """Paint grains and patches."""
    grey = np.ones((SIDE_PX, SIDE_PX), np.float32)
    grey = grey + 0.2 * noise.draw_rough()
    grey = grey + 0.18 * noise.draw_fine()
    return grey + 0.12 * noise.draw_broad()


def _paint_pavement(noise: _Noise, variant: int) -> ColorTexture:
    """Paint slabs of several sizes."""
    rows, columns = ((4, 4), (12, 6), (8, 8))[variant]
    slabs = noise.draw_bond(rows, columns, 0.05, 0.07)
    grey = np.ones((SIDE_PX, SIDE_PX), np.float32)
    grey = grey + 0.08 * noise.draw_rough()
    grey = grey + 0.14 * noise.draw_fine()
    return slabs.shade * (grey * (0.55 + 0.45 * slabs.brick_blend))[..., None]


def _paint_stone(noise: _Noise, variant: int) -> ColorTexture:
    """Paint a wall of blocks of several sizes."""
    rows, columns = ((8, 5), (6, 3), (12, 6))[variant]
    blocks = noise.draw_bond(rows, columns, 0.06, 0.14)
    grey = np.ones((SIDE_PX, SIDE_PX), np.float32)
    grey = grey + 0.09 * noise.draw_fine()
    grey = grey + 0.12 * noise.draw_rough()
    return blocks.shade * (grey * (0.55 + 0.45 * blocks.brick_blend))[..., None]


def _paint_brick(noise: _Noise, variant: int) -> ColorTexture:
    """Paint bricks with lighter joints."""
    bricks = noise.draw_bond(24, (8, 6, 10)[variant], 0.1, 0.16)
    wall = bricks.shade * (1 + 0.1 * noise.draw_fine() + 0.08 * noise.draw_rough())[..., None]
    joint = (1.3 + 0.08 * noise.draw_fine())[..., None] * np.array([0.9, 1.3, 1.5])
    wall = np.where(bricks.brick_blend[..., None] > 0.5, wall, joint)
    return wall * (1 + 0.1 * noise.draw_broad())[..., None]


def _paint_plaster(noise: _Noise, variant: int) -> GreyTexture:
    """Paint plaster with streaks of dirt that run down."""
    streaks = np.clip(noise.draw(2.2, (1, 60), (0.25, 1)) - 0.6, 0, 2)
    fine = noise.draw_fine()
    rough = noise.draw_rough()
    broad = noise.draw_broad()
    clean = 1 + 0.05 * fine + 0.06 * rough + 0.07 * broad
    return clean - (0.06 + 0.06 * variant) * streaks


def _paint_concrete(noise: _Noise, _: int) -> GreyTexture:
    """Paint faint grains and patches."""
    grey = np.ones((SIDE_PX, SIDE_PX), np.float32)
    grey = grey + 0.07 * noise.draw_fine()
    grey = grey + 0.09 * noise.draw_rough()
    return grey + 0.08 * noise.draw_broad()


def _paint_roof(noise: _Noise, variant: int) -> ColorTexture:
    """Paint roof tiles, each in the shadow of the one above it."""
    tiles = noise.draw_bond((14, 20, 10)[variant], 12, 0.04, 0.13)
    grains = 1 + 0.09 * noise.draw_fine() + 0.1 * noise.draw_broad()
    return tiles.shade * ((0.55 + 0.65 * tiles.height_in_row) * grains)[..., None]


def _paint_bark(noise: _Noise, _: int) -> GreyTexture:
    """Paint bark, whose furrows run along the trunk."""
    return 1 + 0.38 * noise.draw(1.2, (4, 128), (0.18, 1)) + 0.12 * noise.draw_fine()


def _paint_leaf(noise: _Noise, _: int) -> ColorTexture:
    """Paint light and dark clumps: a ball covered with them looks like foliage."""
    fine = noise.draw_fine()
    rough = noise.draw_rough()
    clumps = np.clip(1 + 0.55 * noise.draw(0.8, (6, 60)) + 0.2 * fine, 0.1, 2.5)
    return np.stack([clumps + 0.15 * rough, clumps + 0.1 * rough, clumps], 2)


def _paint_wood(noise: _Noise, variant: int) -> ColorTexture:
    """Paint six boards side by side, with grain; those of variant 0 have no gaps between them."""
    boards = noise.draw_bond(1, 6, 0.03 * variant + 1e-3, 0.08)
    grain = 0.2 * noise.draw(1.4, (2, 128), (0.15, 1)) + 0.05 * noise.draw_fine()
    return boards.shade * ((1 + grain) * (0.5 + 0.5 * boards.brick_blend))[..., None]


def _paint_metal(noise: _Noise, variant: int) -> GreyTexture:
    """Paint faint grains and patches of weathering."""
    return 1 + 0.06 * noise.draw_fine() + (0.08 + 0.1 * variant) * noise.draw_broad()


def _paint_lacquer(noise: _Noise, _: int) -> GreyTexture:
    """Paint lacquer, which is almost even."""
    grey = np.ones((SIDE_PX, SIDE_PX), np.float32)
    grey = grey + 0.03 * noise.draw_broad()
    return grey + 0.012 * noise.draw_fine()


def _paint_side(noise: _Noise, variant: int) -> GreyTexture:
    """Paint a car's flank, rear (0) to front along x, sill (0) to roof along y.

    It is lighter above, has gaps and handles of two or three doors, and dirt at the sill.
    """
    grey = 1 + 0.04 * noise.draw_broad() + 0.1 * np.clip((_Y - 0.2) * 2, -0.5, 0.6)
    is_door = (_Y > 0.16) & (_Y < 0.62)
    gaps = ((0.3, 0.5, 0.7), (0.34, 0.68), (0.28, 0.49, 0.72))[variant]
    for gap in gaps:
        grey -= 0.8 * np.clip(1 - np.abs(_X - gap) / 0.006, 0, 1) * is_door
        is_handle = (np.abs(_X - gap - 0.04) < 0.018) & (np.abs(_Y - 0.52) < 0.01)
        grey[is_handle] = 0.35

    # A strip along the doors, which variant 0 lacks, and the dark sill.
    if variant > 0:
        grey[np.abs(_Y - 0.34) < 0.012] *= 0.55
    grey[_Y < 0.15] *= 0.3
    dirt = np.clip((0.32 - _Y) * 3, 0, 1) * (0.5 + 0.3 * noise.draw_rough())
    return grey * (1 - 0.35 * dirt)


def _paint_glass(noise: _Noise, _: int) -> GreyTexture:
    """Paint broad reflections."""
    grey = np.ones((SIDE_PX, SIDE_PX), np.float32)
    return grey + 0.15 * noise.draw_broad()


def _paint_pane(noise: _Noise, variant: int) -> GreyTexture:
    """Paint what is behind a window: curtains (variants 0, 2), blinds (0, 1), a dark room."""
    curtain = np.clip(np.abs(_X - 0.5) * 2 - 0.55, 0, 1) * 2.5 * (1 + 0.3 * np.sin(_X * 90))
    blind_end = (0.2, 0.55, 2)[variant]  # the blind covers what is above; 2: none
    is_blind = blind_end < _Y
    blind = 0.35 * np.sign(np.sin(_Y * np.pi * 40)) * is_blind
    return 0.75 + 0.4 * _Y + 0.15 * noise.draw_broad() + curtain * (variant != 1) + blind


def _paint_tyre(noise: _Noise, _: int) -> GreyTexture:
    """Paint dusty rubber."""
    grey = np.ones((SIDE_PX, SIDE_PX), np.float32)
    grey = grey + 0.2 * noise.draw_fine()
    return grey + 0.15 * noise.draw_rough()


def _paint_wheel(_: _Noise, variant: int) -> GreyTexture:
    """Paint a rim with five or seven spokes and dark gaps between them."""
    y = _Y - 0.5
    x = _X - 0.5
    angle = np.arctan2(y, x)
    radius = np.hypot(x, y)
    is_spoke = np.cos(angle * (5, 7)[variant]) > -0.1
    is_bright = is_spoke | (radius > 0.42) | (radius < 0.12)
    return np.where(is_bright, 1.1, 0.15).astype(np.float32)


def _paint_plate(noise: _Noise, _: int) -> ColorTexture:
    """Paint a number plate: a blue field, and seven dark bars as characters."""
    white = np.ones((SIDE_PX, SIDE_PX, 3), np.float32)
    first_px = 22
    step_px = 31
    for left_px in range(first_px, first_px + 7 * step_px, step_px):
        width_px = int(noise.rng.integers(8, 22))
        white[10:50, left_px : left_px + width_px] = 0.08
    white[:, :14] = (0.1, 0.2, 0.9)
    return white


def _paint_lamp(noise: _Noise, _: int) -> GreyTexture:
    """Paint the ribs of a lens."""
    noise.draw_broad()  # drawn, so that the numbers after it stay those of earlier scenes
    return 1 + 0.15 * np.sign(np.sin(_X * 40 * np.pi))


def _paint_sign(noise: _Noise, variant: int) -> ColorTexture:
    """Paint dark figures on a light ground: bars, arrows, words."""
    rng = noise.rng
    ground = np.ones((SIDE_PX, SIDE_PX, 3), np.float32)
    colors = [(0.1, 0.1, 0.1), (0.05, 0.05, 0.05), (1.0, 0.08, 0.08), (0.1, 0.2, 0.9)]
    color = np.array(colors[variant % 4])
    figure_count = (3, 5, 8, 14, 24, 4)[variant]
    for _ in range(figure_count):
        width = rng.integers(10, 110)
        height = rng.integers(8, 60)
        x = rng.integers(30, 220 - width // 2)
        y = rng.integers(30, 220 - height // 2)
        ground[y : y + height, x : x + width] = color * rng.uniform(0.5, 1.2)
    return ground


def _paint_poster(noise: _Noise, _: int) -> ColorTexture:
    """Paint fifty rectangles of random colours over each other."""
    rng = noise.rng
    picture = np.ones((SIDE_PX, SIDE_PX, 3), np.float32)
    for _ in range(50):
        width = rng.integers(6, 90)
        height = rng.integers(4, 60)
        x, y = rng.integers(0, SIDE_PX, 2)
        picture[y : y + height, x : x + width] = rng.uniform(0.05, 1.4, 3)
    return picture


def _paint_cloth(noise: _Noise, variant: int) -> GreyTexture:
    """Paint cloth with folds; variants 1 and 3 have six stripes."""
    contrast = (0, 0.18, 0, 0.3)[variant]
    stripes = np.sign(np.sin(_X[:1] * 2 * np.pi * 6)) * contrast
    folds = noise.draw(2.0, (2, 30), (0.4, 1))
    return 1 + 0.16 * folds + 0.07 * noise.draw_fine() + stripes


def _paint_skin(noise: _Noise, _: int) -> GreyTexture:
    """Paint faint patches."""
    grey = np.ones((SIDE_PX, SIDE_PX), np.float32)
    return grey + 0.06 * noise.draw_broad()


def _paint_hills(noise: _Noise, _: int) -> GreyTexture:
    """Paint woods far away: coarse grains in patches."""
    return 1 + 0.4 * noise.draw(1.0, (16, 128)) + 0.15 * noise.draw_broad()


_PAINTERS: dict[str, Callable[[_Noise, int], GreyTexture | ColorTexture]] = {
    "road": _paint_road,
    "pavement": _paint_pavement,
    "grass": _paint_grass,
    "dirt": _paint_dirt,
    "curb": _paint_dirt,
    "brick": _paint_brick,
    "plaster": _paint_plaster,
    "stone": _paint_stone,
    "concrete": _paint_concrete,
    "roof": _paint_roof,
    "bark": _paint_bark,
    "leaf": _paint_leaf,
    "wood": _paint_wood,
    "metal": _paint_metal,
    "paint": _paint_lacquer,
    "side": _paint_side,
    "glass": _paint_glass,
    "pane": _paint_pane,
    "tyre": _paint_tyre,
    "wheel": _paint_wheel,
    "plate": _paint_plate,
    "lamp": _paint_lamp,
    "sign": _paint_sign,
    "poster": _paint_poster,
    "cloth": _paint_cloth,
    "skin": _paint_skin,
    "hills": _paint_hills,
}
"""Paints one variant of each material's texture."""
