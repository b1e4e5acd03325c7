"""What is beside the road: houses, gardens, trees, lamps and signs."""

from itertools import pairwise

import numpy as np

from depthpose.depth.synthetic import furniture, vegetation
from depthpose.depth.synthetic.buildings import Plot, add_house, draw_style
from depthpose.depth.synthetic.materials import Number
from depthpose.depth.synthetic.mesh import MeshBuilder, place
from depthpose.depth.synthetic.road import Road

_FAR_M = 130.0
_DETAIL_M = 45.0
"""Beyond this, what is finer than a pixel is left out."""


def add_roadside(builder: MeshBuilder, rng: np.random.Generator, road: Road) -> None:
    """Fill both sides of the road."""
    for side in (-1, 1):
        if road.place == "city":
            _houses(builder, rng, road, side)
        elif road.place == "suburb":
            _gardens(builder, rng, road, side)
        elif road.place == "avenue":
            _avenue(builder, rng, road, side)
        else:
            _country(builder, rng, road, side)
        _kerb(builder, rng, road, side)
        _woods(builder, rng, road, side)
    _horizon(builder, rng, road)


def _houses(builder: MeshBuilder, rng: np.random.Generator, road: Road, side: int) -> None:
    if road.walk_m > 2 and rng.random() < 0.55:
        _tree_row(builder, rng, road, side, road.edge_m(side) + side * 0.9)
    s, set_back = rng.uniform(-12, -4), rng.uniform(0, 3) * (rng.random() < 0.4)
    tall = rng.uniform(6, 17)
    while s < _FAR_M:
        length = rng.uniform(8, 20)
        if _is_free(road, side, s, length):
            height = tall * rng.uniform(0.75, 1.25)
            back = set_back + rng.uniform(0, 0.6)
            _house(builder, rng, road, side, (s, s + length, back, height))
        elif rng.random() < 0.5:
            _tree(builder, rng, road.plot_m(side) + side * rng.uniform(6, 12), s, None)
        s += length + (rng.uniform(2, 9) if rng.random() < 0.3 else 0.0)


def _gardens(builder: MeshBuilder, rng: np.random.Generator, road: Road, side: int) -> None:
    """Houses behind hedges and fences, with trees and bushes about them."""
    s, back = rng.uniform(-12, -2), rng.uniform(2.5, 7)
    border = int(rng.integers(4))
    while s < _FAR_M:
        length = rng.uniform(8, 15)
        if not _is_free(road, side, s, length):
            s += length
            continue
        if rng.random() < 0.78:
            _house(
                builder,
                rng,
                road,
                side,
                (s, s + length, back * rng.uniform(0.8, 1.3), rng.uniform(3.5, 7.5)),
            )
        border = int(rng.integers(4)) if rng.random() < 0.5 else border
        _border(builder, rng, road, side, (s, s + length + 3, border))
        for _ in range(int(rng.integers(0, 3))):
            x = road.plot_m(side) + side * rng.uniform(1.3, back + 1)
            _tree(builder, rng, x, s + rng.uniform(0, length), rng.uniform(3, 9))
        for _ in range(int(rng.integers(1, 5))):
            x = road.plot_m(side) + side * rng.uniform(0.9, 3)
            _bush(builder, rng, x, s + rng.uniform(0, length), rng.uniform(0.6, 1.9))
        s += length + rng.uniform(1.5, 7)


def _avenue(builder: MeshBuilder, rng: np.random.Generator, road: Road, side: int) -> None:
    """A wide road: rows of trees, hedges or rails, and set-back houses or nothing behind."""
    has_row, has_border, has_houses = rng.random(3) < (0.7, 0.5, 0.35)
    rail = int(rng.integers(4))
    if has_row:
        x = road.edge_m(side) + side * rng.uniform(1.2, max(1.5, road.verge_m))
        _tree_row(builder, rng, road, side, x)
    if has_border:
        _border(builder, rng, road, side, (-8, 100, rail))
    s = rng.uniform(-10, 5)
    while s < _FAR_M:
        length = rng.uniform(10, 26)
        if has_houses and rng.random() < 0.7 and _is_free(road, side, s, length):
            _house(
                builder, rng, road, side, (s, s + length, rng.uniform(5, 22), rng.uniform(5, 16))
            )
        else:
            _copse(builder, rng, road, side, (s, length, rng.uniform(4, 14)))
        s += length + rng.uniform(0, 10)


def _tree_row(
    builder: MeshBuilder, rng: np.random.Generator, road: Road, side: int, x: Number
) -> None:
    step, height = rng.uniform(6, 14), rng.uniform(5, 13)
    for s in np.arange(rng.uniform(-8, 6), _FAR_M, step):
        if not road.is_side_street(s, side, 2) and rng.random() < 0.85:
            place_m = (x + rng.normal(0, 0.3), s + rng.normal(0, 0.8))
            _tree(builder, rng, *place_m, height * rng.uniform(0.8, 1.2))


def _country(builder: MeshBuilder, rng: np.random.Generator, road: Road, side: int) -> None:
    """Open fields with some trees, or a forest's edge."""
    is_forest = road.place == "forest"
    is_open = not is_forest and rng.random() < 0.55
    edge, height = rng.uniform(1.0, 4.5), rng.uniform(9, 15)
    s = rng.uniform(-10, -4)
    while s < _FAR_M + 30:
        if is_forest:
            for depth in (0.0, 4.5) if s < 60 else (0.0,):
                x = road.plot_m(side) + side * (edge + depth + rng.uniform(0, 2.5))
                _tree(builder, rng, x, s + rng.uniform(-2, 2), height * rng.uniform(0.75, 1.25))
            if rng.random() < 0.8:
                x = road.plot_m(side) + side * (edge + rng.uniform(-0.4, 1.5))
                _bush(builder, rng, x, s + rng.uniform(0, 3), rng.uniform(0.8, 2.6))
            s += rng.uniform(2.6, 5) + max(0.0, s) * 0.04
        else:
            chance = 0.25 if is_open else 0.9
            if rng.random() < chance:
                _copse(builder, rng, road, side, (s, 12.0, 25.0 if is_open else 7.0))
            s += rng.uniform(8, 18)
    if not is_forest and rng.random() < 0.45:
        _border(builder, rng, road, side, (-8, 90, int(rng.integers(4))))


def _woods(builder: MeshBuilder, rng: np.random.Generator, road: Road, side: int) -> None:
    """The front of a wood: right behind a forest's first trees, far behind elsewhere."""
    is_forest = road.place == "forest"
    chance = {"forest": 0.9, "city": 0.1, "suburb": 0.35}.get(road.place, 0.55)
    if rng.random() > chance:
        return
    near, height = (rng.uniform(8, 13), 13.0) if is_forest else (rng.uniform(14, 55), 9.0)
    start = rng.uniform(-10, 0) if is_forest else rng.uniform(-10, 60)
    x = road.plot_m(side) + side * near
    stop, other = start + rng.uniform(60, 200), x + side * rng.uniform(-2, 15)
    height *= rng.uniform(0.7, 1.3)
    vegetation.add_wood_edge(builder, rng, (x, start, other, stop), height)


def _copse(
    builder: MeshBuilder,
    rng: np.random.Generator,
    road: Road,
    side: int,
    where: tuple[Number, Number, Number],
) -> None:
    s, length, depth = where
    for _ in range(int(rng.integers(1, 7))):
        x = road.plot_m(side) + side * (1.5 + depth * rng.uniform(0, 1))
        if not road.is_side_street(s + length / 2, side, length / 2):
            _tree(builder, rng, x, s + rng.uniform(0, length), rng.uniform(4, 13))
    for _ in range(int(rng.integers(0, 4))):
        x = road.plot_m(side) + side * (0.8 + depth * rng.uniform(0, 0.6))
        if not road.is_side_street(s + length / 2, side, length / 2):
            _bush(builder, rng, x, s + rng.uniform(0, length), rng.uniform(0.7, 2.2))


def _kerb(builder: MeshBuilder, rng: np.random.Generator, road: Road, side: int) -> None:
    """Lamps in a row; signs, lights, posts and boxes here and there; poles with wires."""
    x, y = road.edge_m(side) + side * (0.5 if road.walk_m else 1.3), -road.curb_m
    _lamps(builder, rng, road, side)
    s = rng.uniform(3, 12)
    is_town = road.place not in ("rural", "forest")
    while s < 70:
        if not road.is_side_street(s, side, 0.5):
            where = (x + side * rng.uniform(0, 0.4), y, s)
            _kerb_thing(builder, rng, where, side, is_town=is_town)
        s += rng.uniform(3, 14) * (1 if is_town else 1.8)
    for street in road.side_streets:
        if side in street.sides and rng.random() < 0.4:
            light = furniture.traffic_light(int(rng.integers(4)))
            builder.add(place(light, (x, y, street.s_m - street.half_m - 1), 0, (-side, 1, 1)))
    if rng.random() < 0.25:
        _wires(builder, rng, x + side * rng.uniform(0.5, 3))


def _lamps(builder: MeshBuilder, rng: np.random.Generator, road: Road, side: int) -> None:
    if rng.random() > {"forest": 0.1, "rural": 0.3}.get(road.place, 0.7):
        return
    x, y = road.edge_m(side) + side * (0.5 if road.walk_m else 1.3), -road.curb_m
    yaw = 0.0 if side < 0 else np.pi
    number, step = int(rng.integers(6)), rng.uniform(16, 34)
    for s in np.arange(rng.uniform(2, 25), 110, step):
        if not road.is_side_street(s, side):
            builder.add(place(furniture.lamp(number), (x, y, s), yaw))


def _kerb_thing(
    builder: MeshBuilder,
    rng: np.random.Generator,
    where: tuple[Number, Number, Number],
    side: int,
    *,
    is_town: bool,
) -> None:
    kind = rng.random()
    if kind < 0.4:
        model = furniture.sign(int(rng.integers(20)))
        builder.add(place(model, where, rng.normal(0, 0.12) + np.pi * (rng.random() < 0.2)))
    elif kind < 0.8 or not is_town:
        number = int(rng.choice([0, 1, 2, 3, 4, 5])) if is_town else 3
        builder.add(place(furniture.small_thing(number), where, rng.normal(0, 0.1)))
    else:
        _tree(builder, rng, where[0] + side * 0.4, where[2], rng.uniform(3.5, 7))


def _wires(builder: MeshBuilder, rng: np.random.Generator, x: Number) -> None:
    """Wooden poles with cables between them."""
    height, step = rng.uniform(6, 8), rng.uniform(22, 38)
    places = np.arange(rng.uniform(-15, 10), 120, step)
    builder.begin_thing()
    for s in places:
        builder.tube((x, 0.2, s), (x, -height, s), (0.12, 0.09), furniture.WOOD, 8)
        builder.box((x, -height + 0.3, s), (1.4, 0.1, 0.1), furniture.WOOD)
    for start, stop in pairwise(places):
        for shift in (-0.6, 0.6):
            ends = [np.array([x + shift, -height + 0.22, s]) for s in (start, stop)]
            furniture.add_wires(builder, *ends)


def _house(
    builder: MeshBuilder,
    rng: np.random.Generator,
    road: Road,
    side: int,
    where: tuple[Number, Number, Number, Number],
) -> None:
    start, stop, back, height = where
    plot = Plot(
        x_m=road.plot_m(side) + side * (back + 0.15),
        z_m=(start, stop),
        side=side,
        depth_m=rng.uniform(7, 12),
        height_m=height,
        ground_m=-road.curb_m + 0.2,
    )
    add_house(builder, rng, plot, draw_style(rng, with_details=start < _DETAIL_M))


def _border(
    builder: MeshBuilder,
    rng: np.random.Generator,
    road: Road,
    side: int,
    where: tuple[Number, Number, int],
) -> None:
    """A line of hedge or fence pieces at the back of the pavement; kind 0 is none."""
    start, stop, kind = where
    if kind == 0:
        return
    number, height = int(rng.integers(20)), rng.uniform(0.7, 1.9)
    color = vegetation.leaf_color(rng)
    for s in np.arange(start + 2, min(stop, 95), furniture.FENCE_M):
        if road.is_side_street(s, side, 2.2):
            continue
        where_m = (road.plot_m(side) + side * 0.45, -road.curb_m, s)
        if kind == 1:
            model = vegetation.hedge(int(rng.integers(vegetation.HEDGES)))
            builder.add(place(model, where_m, 0, (1, height, 1), {"leaf": color}))
        else:
            builder.add(place(furniture.fence(number), where_m))


def _tree(
    builder: MeshBuilder, rng: np.random.Generator, x: Number, s: float, height: Number | None
) -> None:
    tall = rng.uniform(5, 12) if height is None else height
    number = int(rng.integers(vegetation.TREES))
    wide = tall * rng.uniform(0.85, 1.15)
    model = vegetation.tree(number, int(s > 24) + int(s > 48 or abs(x) > 25))
    scale = np.array([wide, tall, wide]) / 10
    tints = {"leaf": vegetation.leaf_color(rng)}
    builder.add(place(model, (x, 0, s), rng.uniform(0, 6.28), scale, tints))


def _bush(
    builder: MeshBuilder, rng: np.random.Generator, x: Number, s: float, size: Number
) -> None:
    model = vegetation.bush(int(rng.integers(vegetation.BUSHES)), int(s > 20))
    scale = size * rng.uniform(0.7, 1.3, 3)
    tints = {"leaf": vegetation.leaf_color(rng)}
    builder.add(place(model, (x, 0, s), rng.uniform(0, 6.28), scale, tints))


def _is_free(road: Road, side: int, s: Number, length: float) -> bool:
    return not road.is_side_street(s + length / 2, side, length / 2 + 1)


def _horizon(builder: MeshBuilder, rng: np.random.Generator, road: Road) -> None:
    """Trees across the end of the road's straight part, so that the view is closed somewhere."""
    if rng.random() < 0.85:
        for _ in range(int(rng.integers(30, 90))):
            side = int(rng.choice([-1, 1]))
            x = road.plot_m(side) + side * rng.uniform(2, 90)
            _tree(builder, rng, x, rng.uniform(90, 230), rng.uniform(7, 16))
    if rng.random() < 0.6:
        s, half = rng.uniform(170, 300), rng.uniform(60, 160)
        line = (-half, s, half, s + rng.uniform(-40, 40))
        vegetation.add_wood_edge(builder, rng, line, rng.uniform(7, 14))
