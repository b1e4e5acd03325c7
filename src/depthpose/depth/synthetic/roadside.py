"""The objects beside a road: houses, plants and street furniture.

They are built along the straight road (see ``road``): x to the right, s ahead.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from depthpose.depth.synthetic.buildings import Plot, add_house
from depthpose.depth.synthetic.materials import Appearance, Number
from depthpose.depth.synthetic.mesh import MeshBuilder, place_model
from depthpose.depth.synthetic.plants import (
    BUSH_COUNT,
    HEDGE_COUNT,
    TREE_COUNT,
    TREE_HEIGHT_M,
    add_wood_edge,
    draw_leaf_color,
    make_bush,
    make_hedge,
    make_tree,
)
from depthpose.depth.synthetic.road import SIDES, Road
from depthpose.depth.synthetic.street_furniture import (
    DARK_METAL,
    FENCE_M,
    GUIDE_POST,
    make_fence,
    make_lamp,
    make_sign,
    make_small_object,
    make_traffic_light,
)

_FAR_M = 130.0
"""Distance up to which the roadside has objects."""
_DETAIL_M = 45.0
"""Distance up to which houses have details."""
_COUNTRY_FAR_M = _FAR_M + 30
"""The same in the country."""
_HOUSE_MARGIN_M = 1
"""Least distance of a house from a side street."""
_LAMP_COUNT = 6
_SIGN_COUNT = 20
_TRAFFIC_LIGHT_COUNT = 4
_FENCE_COUNT = 20
"""Number of models of each, of which one is drawn."""

_Border = Literal["none", "hedge", "fence"]
_BORDERS: tuple[_Border, ...] = ("none", "hedge", "fence", "fence")
"""Borders between pavement and plots; a kind is repeated in proportion to how often it is drawn."""
_BORDER_START_M = -8
_BORDER_REACH_M = 95
"""Extent of a border along the whole road, and end of every border."""
_BORDER_MARGIN_M = 2.2
"""Least distance of the middle of a piece of border, 4 m long, from a side street."""

_COARSE_TREE_M = 24
_COARSEST_TREE_M = 48
_COARSEST_TREE_ASIDE_M = 25
_COARSE_BUSH_M = 20
"""Distances from which trees and bushes have fewer leaves."""
_WOOD = Appearance("wood", (0.16, 0.12, 0.09))


def add_roadside(builder: MeshBuilder, road: Road) -> None:
    """Add houses, plants and street furniture on both sides, and the background at the end."""
    rng = builder.rng
    roadsides = {side: _Roadside(builder, road, side) for side in SIDES}
    for roadside in roadsides.values():
        match road.place:
            case "city":
                roadside.add_city()
            case "suburb":
                roadside.add_suburb()
            case "avenue":
                roadside.add_avenue()
            case _:
                roadside.add_country()
        roadside.add_kerb()
        roadside.add_background_wood()

    # Trees across the end of the road's straight part, and a wood behind them.
    if rng.random() < 0.85:
        for _ in range(int(rng.integers(30, 90))):
            roadside = roadsides[int(rng.choice([-1, 1]))]
            x = roadside.x_behind_walk(rng.uniform(2, 90))
            roadside.add_tree(x, rng.uniform(90, 230), rng.uniform(7, 16))
    if rng.random() < 0.6:
        s = rng.uniform(170, 300)
        half = rng.uniform(60, 160)
        stop = (half, s + rng.uniform(-40, 40))
        add_wood_edge(builder, (-half, s), stop, rng.uniform(7, 14))


def _draw_border(rng: np.random.Generator) -> _Border:
    """Draw a kind of border."""
    return _BORDERS[int(rng.integers(len(_BORDERS)))]


@dataclass(frozen=True, eq=False)
class _Roadside:
    """Builds the objects on one side of a road; every ``add`` method adds to the builder's mesh."""

    builder: MeshBuilder
    road: Road
    side: int  # 1 right, -1 left

    def x_behind_walk(self, distance_m: Number) -> Number:
        """Return x at a distance behind the pavement and verge, where the plots begin."""
        road = self.road
        plot_m = road.edge_m[self.side] + self.side * (road.verge_m + road.walk_m)
        return plot_m + self.side * distance_m

    def _is_free(self, s_m: Number, length_m: Number, margin_m: Number) -> bool:
        """Whether no side street joins along a plot from ``s_m`` on, or within a margin of it."""
        half = length_m / 2
        return not self.road.is_side_street(s_m + half, self.side, half + margin_m)

    def add_city(self) -> None:
        """Add houses at the pavement, wall to wall, at times a row of trees on the pavement."""
        rng = self.builder.rng
        if self.road.walk_m > 2 and rng.random() < 0.55:
            self.add_tree_row(self.road.edge_m[self.side] + self.side * 0.9)
        s = rng.uniform(-12, -4)
        set_back = rng.uniform(0, 3) * (rng.random() < 0.4)
        usual_height = rng.uniform(6, 17)
        while s < _FAR_M:
            length = rng.uniform(8, 20)
            if self._is_free(s, length, _HOUSE_MARGIN_M):
                height = usual_height * rng.uniform(0.75, 1.25)
                self.add_house(s, length, set_back + rng.uniform(0, 0.6), height)
            elif rng.random() < 0.5:
                self.add_tree(self.x_behind_walk(rng.uniform(6, 12)), s, rng.uniform(5, 12))
            s += length + (rng.uniform(2, 9) if rng.random() < 0.3 else 0.0)

    def add_suburb(self) -> None:
        """Add houses behind hedges and fences, with trees and bushes about them."""
        rng = self.builder.rng
        s = rng.uniform(-12, -2)
        set_back = rng.uniform(2.5, 7)
        border = _draw_border(rng)
        while s < _FAR_M:
            length = rng.uniform(8, 15)
            if not self._is_free(s, length, _HOUSE_MARGIN_M):
                s += length
                continue

            # The house, which some plots lack.
            if rng.random() < 0.78:
                house_set_back = set_back * rng.uniform(0.8, 1.3)
                self.add_house(s, length, house_set_back, rng.uniform(3.5, 7.5))

            # The border: often that of the plot before, and a little longer than the plot, to close
            # the gap to the next one.
            border = _draw_border(rng) if rng.random() < 0.5 else border
            self.add_border(s, s + length + 3, border)

            # Trees before the house, and bushes near the pavement.
            for _ in range(int(rng.integers(0, 3))):
                x = self.x_behind_walk(rng.uniform(1.3, set_back + 1))
                self.add_tree(x, s + rng.uniform(0, length), rng.uniform(3, 9))
            for _ in range(int(rng.integers(1, 5))):
                x = self.x_behind_walk(rng.uniform(0.9, 3))
                self.add_bush(x, s + rng.uniform(0, length), rng.uniform(0.6, 1.9))
            gap = rng.uniform(1.5, 7)
            s += length + gap

    def add_avenue(self) -> None:
        """Add rows of trees, hedges or rails of a wide road, and set-back houses or copses."""
        rng = self.builder.rng
        has_row, has_border, has_houses = rng.random(3) < (0.7, 0.5, 0.35)
        border = _draw_border(rng)
        if has_row:
            from_edge = rng.uniform(1.2, max(1.5, self.road.verge_m))
            self.add_tree_row(self.road.edge_m[self.side] + self.side * from_edge)
        if has_border:
            self.add_border(_BORDER_START_M, _BORDER_REACH_M, border)
        s = rng.uniform(-10, 5)
        while s < _FAR_M:
            length = rng.uniform(10, 26)
            is_free = self._is_free(s, length, _HOUSE_MARGIN_M)
            if has_houses and rng.random() < 0.7 and is_free:
                self.add_house(s, length, rng.uniform(5, 22), rng.uniform(5, 16))
            else:
                self.add_copse(s, length, rng.uniform(4, 14))
            s += length + rng.uniform(0, 10)

    def add_country(self) -> None:
        """Add the edge of a forest, or fields with copses and at times a border."""
        if self.road.place == "forest":
            self._add_forest_edge()
        else:
            self._add_fields()

    def _add_forest_edge(self) -> None:
        """Add one or two rows of trees, and bushes, ever farther apart with distance."""
        rng = self.builder.rng
        edge = rng.uniform(1.0, 4.5)
        height = rng.uniform(9, 15)
        s = rng.uniform(-10, -4)
        while s < _COUNTRY_FAR_M:
            row_depths = (0.0, 4.5) if s < 60 else (0.0,)  # far away one row hides the other
            for depth in row_depths:
                x = self.x_behind_walk(edge + depth + rng.uniform(0, 2.5))
                self.add_tree(x, s + rng.uniform(-2, 2), height * rng.uniform(0.75, 1.25))
            if rng.random() < 0.8:
                x = self.x_behind_walk(edge + rng.uniform(-0.4, 1.5))
                self.add_bush(x, s + rng.uniform(0, 3), rng.uniform(0.8, 2.6))
            s += rng.uniform(2.6, 5) + max(0.0, s) * 0.04

    def _add_fields(self) -> None:
        """Add many copses, or few that lie farther from the road, and at times a border."""
        rng = self.builder.rng
        is_open = rng.random() < 0.55
        # Drawn for the forest's edge, which is not here: a change would change earlier scenes.
        rng.uniform(1.0, 4.5)
        rng.uniform(9, 15)
        s = rng.uniform(-10, -4)
        while s < _COUNTRY_FAR_M:
            if rng.random() < (0.25 if is_open else 0.9):
                self.add_copse(s, 12.0, 25.0 if is_open else 7.0)
            s += rng.uniform(8, 18)
        if rng.random() < 0.45:
            self.add_border(_BORDER_START_M, 90, _draw_border(rng))

    def add_background_wood(self) -> None:
        """Add at times the edge of a wood: right behind a forest's first trees, else far behind."""
        rng = self.builder.rng
        is_forest = self.road.place == "forest"
        probability = {"forest": 0.9, "city": 0.1, "suburb": 0.35}.get(self.road.place, 0.55)
        if rng.random() > probability:
            return
        distance = rng.uniform(8, 13) if is_forest else rng.uniform(14, 55)
        usual_height = 13.0 if is_forest else 9.0
        s = rng.uniform(-10, 0 if is_forest else 60)
        x = self.x_behind_walk(distance)
        stop_s = s + rng.uniform(60, 200)
        stop_x = x + self.side * rng.uniform(-2, 15)
        height = usual_height * rng.uniform(0.7, 1.3)
        add_wood_edge(self.builder, (x, s), (stop_x, stop_s), height)

    def add_copse(self, s: Number, length: Number, depth: Number) -> None:
        """Add some trees and bushes on a plot of a length and depth, unless a street is there."""
        rng = self.builder.rng
        is_free = self._is_free(s, length, margin_m=0)
        # Places are drawn for a plot in a street too: without them, earlier scenes would change.
        for _ in range(int(rng.integers(1, 7))):
            x = self.x_behind_walk(1.5 + depth * rng.uniform(0, 1))
            if is_free:
                self.add_tree(x, s + rng.uniform(0, length), rng.uniform(4, 13))
        for _ in range(int(rng.integers(0, 4))):
            x = self.x_behind_walk(0.8 + depth * rng.uniform(0, 0.6))
            if is_free:
                self.add_bush(x, s + rng.uniform(0, length), rng.uniform(0.7, 2.2))

    def add_kerb(self) -> None:
        """Add what stands at the kerb: lamps, signs, small objects, traffic lights, cables."""
        rng = self.builder.rng
        from_edge = 0.5 if self.road.walk_m else 1.3  # on the pavement, or else on the grass
        x = self.road.edge_m[self.side] + self.side * from_edge
        self._add_lamps(x)
        self._add_signs_and_objects(x)
        self._add_traffic_lights(x)
        if rng.random() < 0.25:
            self.add_cables(x + self.side * rng.uniform(0.5, 3))

    def _add_lamps(self, x: Number) -> None:
        """Add lamps of one model at even distances, in most towns."""
        rng = self.builder.rng
        probability = {"forest": 0.1, "rural": 0.3}.get(self.road.place, 0.7)
        if rng.random() > probability:
            return
        model = make_lamp(int(rng.integers(_LAMP_COUNT)))
        step = rng.uniform(16, 34)
        yaw = 0.0 if self.side < 0 else np.pi  # the arm reaches over the road
        for s in np.arange(rng.uniform(2, 25), 110, step):
            if not self.road.is_side_street(s, self.side):
                self.builder.add_model(place_model(model, (x, -self.road.curb_m, s), yaw))

    def _add_signs_and_objects(self, x: Number) -> None:
        """Add signs, small objects and trees in towns; signs and guide posts in the country."""
        rng = self.builder.rng
        s = rng.uniform(3, 12)
        is_town = self.road.place not in ("rural", "forest")
        while s < 70:
            if not self.road.is_side_street(s, self.side, 0.5):
                position = (x + self.side * rng.uniform(0, 0.4), -self.road.curb_m, s)
                choice = rng.random()
                if choice < 0.4:
                    model = make_sign(int(rng.integers(_SIGN_COUNT)))
                    lean = rng.normal(0, 0.12)
                    is_from_behind = rng.random() < 0.2
                    yaw = lean + np.pi * is_from_behind
                    self.builder.add_model(place_model(model, position, yaw))
                elif choice < 0.8 or not is_town:
                    number = int(rng.choice([0, 1, 2, 3, 4, 5])) if is_town else GUIDE_POST
                    yaw = rng.normal(0, 0.1)
                    model = place_model(make_small_object(number), position, yaw)
                    self.builder.add_model(model)
                else:
                    self.add_tree(position[0] + self.side * 0.4, s, rng.uniform(3.5, 7))
            s += rng.uniform(3, 14) * (1 if is_town else 1.8)

    def _add_traffic_lights(self, x: Number) -> None:
        """Add traffic lights before some side streets; their arms reach over the road."""
        rng = self.builder.rng
        for street in self.road.side_streets:
            if self.side in street.sides and rng.random() < 0.4:
                model = make_traffic_light(int(rng.integers(_TRAFFIC_LIGHT_COUNT)))
                position = (x, -self.road.curb_m, street.s_m - street.half_m - 1)
                mirror_x = (-self.side, 1, 1)
                self.builder.add_model(place_model(model, position, 0, mirror_x))

    def add_cables(self, x_m: Number) -> None:
        """Add a row of wooden poles along the road, and two cables that hang between them."""
        rng = self.builder.rng
        height = rng.uniform(6, 8)
        step = rng.uniform(22, 38)
        pole_s = np.arange(rng.uniform(-15, 10), 120, step)
        self.builder.begin_object()
        for s in pole_s:
            self.builder.add_tube((x_m, 0.2, s), (x_m, -height, s), (0.12, 0.09), _WOOD, 8)
            self.builder.add_box((x_m, -height + 0.3, s), (1.4, 0.1, 0.1), _WOOD)

        # A cable sags in a parabola, by a fiftieth of its length.
        share = np.linspace(0, 1, 7)[:, None]
        for ends in pairwise(pole_s):
            for offset in (-0.6, 0.6):
                start, stop = (np.array([x_m + offset, -height + 0.22, s]) for s in ends)
                points = start * (1 - share) + stop * share
                sag_share = (4 * share * (1 - share))[:, 0] * 0.02
                points[:, 1] += sag_share * np.linalg.norm(stop - start)
                for here, there in pairwise(points):
                    self.builder.add_tube(here, there, 0.018, DARK_METAL, 3)

    def add_house(self, s: Number, length: Number, set_back: Number, height: float) -> None:
        """Add a house at a distance ``set_back`` behind the pavement."""
        plot = Plot(
            x_m=self.x_behind_walk(set_back + 0.15),
            start_m=s,
            stop_m=s + length,
            side=self.side,
            depth_m=self.builder.rng.uniform(7, 12),
            height_m=height,
            ground_m=-self.road.curb_m + 0.2,
        )
        add_house(self.builder, plot, with_details=s < _DETAIL_M)

    def add_border(self, start: Number, stop: Number, kind: _Border) -> None:
        """Add pieces of hedge or fence at the back of the pavement, between two positions s."""
        if kind == "none":
            return
        rng = self.builder.rng
        # All three are drawn for either kind: otherwise earlier scenes would change.
        fence_number = int(rng.integers(_FENCE_COUNT))
        height = rng.uniform(0.7, 1.9)
        color = draw_leaf_color(rng)
        for s in np.arange(start + FENCE_M / 2, min(stop, _BORDER_REACH_M), FENCE_M):
            if self.road.is_side_street(s, self.side, _BORDER_MARGIN_M):
                continue
            position = (self.x_behind_walk(0.45), -self.road.curb_m, s)
            if kind == "hedge":
                model = make_hedge(int(rng.integers(HEDGE_COUNT)))
                piece = place_model(model, position, 0, (1, height, 1), {"leaf": color})
            else:
                piece = place_model(make_fence(fence_number), position)
            self.builder.add_model(piece)

    def add_tree_row(self, x: Number) -> None:
        """Add a row of trees along the road, at nearly even distances."""
        rng = self.builder.rng
        step = rng.uniform(6, 14)
        height = rng.uniform(5, 13)
        for s in np.arange(rng.uniform(-8, 6), _FAR_M, step):
            if not self.road.is_side_street(s, self.side, 2) and rng.random() < 0.85:
                tree_x = x + rng.normal(0, 0.3)
                tree_s = s + rng.normal(0, 0.8)
                self.add_tree(tree_x, tree_s, height * rng.uniform(0.8, 1.2))

    def add_tree(self, x_m: Number, s_m: Number, height_m: Number) -> None:
        """Add a tree of a random model at x and s, with fewer leaves where it is far away."""
        rng = self.builder.rng
        number = int(rng.integers(TREE_COUNT))
        width_m = height_m * rng.uniform(0.85, 1.15)
        is_far = s_m > _COARSE_TREE_M
        is_very_far = s_m > _COARSEST_TREE_M or abs(x_m) > _COARSEST_TREE_ASIDE_M
        coarseness = int(is_far) + int(is_very_far)
        model = make_tree(number, coarseness)
        scale = np.array([width_m, height_m, width_m]) / TREE_HEIGHT_M
        tints = {"leaf": draw_leaf_color(rng)}
        yaw = rng.uniform(0, 6.28)
        self.builder.add_model(place_model(model, (x_m, 0, s_m), yaw, scale, tints))

    def add_bush(self, x_m: Number, s_m: Number, height_m: Number) -> None:
        """Add a bush of a random model at x and s, with fewer leaves where it is far away."""
        rng = self.builder.rng
        number = int(rng.integers(BUSH_COUNT))
        model = make_bush(number, coarseness=int(s_m > _COARSE_BUSH_M))
        scale = height_m * rng.uniform(0.7, 1.3, 3)
        tints = {"leaf": draw_leaf_color(rng)}
        yaw = rng.uniform(0, 6.28)
        self.builder.add_model(place_model(model, (x_m, 0, s_m), yaw, scale, tints))
