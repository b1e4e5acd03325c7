"""Materials of synthetic scenes, and how a part of a mesh looks by them."""

from typing import NamedTuple

Number = float | int
"""A length, an angle or a share."""

Color = tuple[Number, Number, Number]
"""Linear RGB, 0 black to 1 white."""


class Material(NamedTuple):
    """Optical properties of a material."""

    variants: int  # number of its different textures
    specular: float = 0.0  # reflectance at normal incidence, 0..1
    translucency: float = 0.0  # share of the light that comes through from behind
    glow: float = 0.0  # emitted light, as a share of its colour


MATERIALS: dict[str, Material] = {
    "road": Material(4), "pavement": Material(3), "grass": Material(3), "dirt": Material(2),
    "curb": Material(1), "brick": Material(3), "plaster": Material(3), "stone": Material(3),
    "concrete": Material(2), "roof": Material(3), "bark": Material(2),
    "leaf": Material(3, translucency=0.35), "wood": Material(2),
    "metal": Material(2, specular=0.05), "paint": Material(1, specular=0.05),
    "side": Material(3, specular=0.05), "glass": Material(1, specular=0.07),
    "pane": Material(3, specular=0.06), "tyre": Material(1), "wheel": Material(2, specular=0.05),
    "plate": Material(2, specular=0.02), "lamp": Material(1, specular=0.05, glow=0.35),
    "sign": Material(6, specular=0.02), "poster": Material(4), "cloth": Material(4),
    "skin": Material(1), "hills": Material(2),
}  # fmt: skip
"""All materials by name. The order is that of their numbers and textures."""

MATERIAL_IDS = {name: number for number, name in enumerate(MATERIALS)}
"""Number of each material in meshes."""

_variant_counts = [material.variants for material in MATERIALS.values()]
FIRST_LAYER = {name: sum(_variant_counts[:number]) for name, number in MATERIAL_IDS.items()}
"""Number of each material's first texture in the stack of all textures."""

LAYER_COUNT = sum(_variant_counts)
"""Number of all textures."""


class Appearance(NamedTuple):
    """How a part of a mesh looks: its material, colour and texture."""

    material: str  # a name of ``MATERIALS``
    tint: Color = (1.0, 1.0, 1.0)  # colour that the texture modulates
    tile_m: Number = 1.0  # side of one tile of the texture
    variant: int = 0  # number of the material's texture; larger numbers begin again

    @property
    def layer(self) -> int:
        """The number of the texture in the stack of all textures."""
        variants = MATERIALS[self.material].variants
        return FIRST_LAYER[self.material] + int(self.variant) % variants
