"""What surfaces are made of: names, variants, and the few numbers that shading needs."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

Number = float | int
"""A length, an angle or a share, written as one likes."""

Values = Sequence | np.ndarray | float | int
"""What NumPy makes an array of."""

Color = tuple[Number, Number, Number]
"""Linear RGB, 0 black to 1 white."""


class Material(NamedTuple):
    """How a material takes light.

    Attributes:
        variants: how many different textures there are of it.
        specular: mirror reflection seen straight on, 0..1.
        translucency: share of the light that comes through from behind.
        glow: light of its own, as a share of its colour.
    """

    variants: int
    specular: float = 0.0
    translucency: float = 0.0
    glow: float = 0.0


MATERIALS: dict[str, Material] = {
    "road": Material(4),
    "pavement": Material(3),
    "grass": Material(3),
    "dirt": Material(2),
    "curb": Material(1),
    "brick": Material(3),
    "plaster": Material(3),
    "stone": Material(3),
    "concrete": Material(2),
    "roof": Material(3),
    "bark": Material(2),
    "leaf": Material(3, translucency=0.35),
    "wood": Material(2),
    "metal": Material(2, specular=0.05),
    "paint": Material(1, specular=0.05),
    "side": Material(3, specular=0.05),
    "glass": Material(1, specular=0.07),
    "pane": Material(3, specular=0.06),
    "tyre": Material(1),
    "wheel": Material(2, specular=0.05),
    "plate": Material(2, specular=0.02),
    "lamp": Material(1, specular=0.05, glow=0.35),
    "sign": Material(6, specular=0.02),
    "poster": Material(4),
    "cloth": Material(4),
    "skin": Material(1),
    "hills": Material(2),
}
NUMBER = {name: number for number, name in enumerate(MATERIALS)}
"""Numbers by which meshes name materials."""

_counts = [material.variants for material in MATERIALS.values()]
FIRST_LAYER = {name: sum(_counts[:number]) for name, number in NUMBER.items()}
"""Where the textures of each material begin in the stack of all textures."""

LAYERS = sum(_counts)
"""Textures in all."""


class Surface(NamedTuple):
    """What a part of a mesh is covered with.

    Attributes:
        material: a name of ``MATERIALS``.
        tint: colour that the texture modulates.
        tile_m: length that one tile of the texture covers.
        variant: which of the material's textures; any whole number.
    """

    material: str
    tint: Color = (1.0, 1.0, 1.0)
    tile_m: Number = 1.0
    variant: int = 0

    @property
    def layer(self) -> int:
        """Number of the texture in the stack of all textures."""
        variants = MATERIALS[self.material].variants
        return FIRST_LAYER[self.material] + int(self.variant) % variants
