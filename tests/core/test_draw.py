import io
from base64 import b64decode
from itertools import pairwise

import numpy as np
import pytest
import torch
from PIL import Image

from depthpose.core.draw import (
    draw_depth,
    draw_disparity,
    draw_error_points,
    draw_lines,
    draw_outline,
    draw_points,
    draw_share,
)
from depthpose.report.page import (
    Drawing,
    embed_picture,
    make_depth_color_bar,
    make_rising_color_bar,
)


def test_near_is_brighter_than_far_all_along() -> None:
    depth_m = torch.linspace(3, 80, 400)[None]
    weights = torch.tensor([0.299, 0.587, 0.114])[:, None, None]
    brightness = (draw_depth(depth_m) * weights).sum(0)[0]
    assert bool((brightness.diff() < 0).all())


def test_the_scale_is_fixed() -> None:
    one, other = draw_depth(torch.tensor([[5.0, 10.0]])), draw_depth(torch.tensor([[10.0, 70.0]]))
    assert torch.equal(one[:, 0, 1], other[:, 0, 0])


def test_invalid_is_grey() -> None:
    nothing = torch.tensor([[torch.nan]])
    for picture in (draw_depth(nothing), draw_disparity(nothing), draw_share(nothing)):
        assert picture.flatten().tolist() == [0.5, 0.5, 0.5]


def test_points_are_grown_and_the_nearest_wins() -> None:
    depth_m = torch.full((5, 7), torch.nan)
    depth_m[2, 2], depth_m[2, 3] = 10.0, 20.0
    picture = draw_points(torch.ones(3, 5, 7), depth_m)
    near = draw_depth(torch.full((1, 1), 10.0))[:, 0, 0]
    assert torch.equal(picture[:, 1, 3], near)
    assert torch.equal(picture[:, 0, 0], torch.full((3,), 0.35))


def test_points_grow_to_the_size_that_is_asked_for() -> None:
    depth_m = torch.full((9, 9), torch.nan)
    depth_m[4, 4] = 10.0
    picture = draw_points(torch.ones(3, 9, 9), depth_m, radius_px=2)
    assert int((picture[0] != 0.35).sum()) == 25


def test_lines_are_where_they_should_be() -> None:
    black = torch.zeros(3, 20, 30)
    ends = torch.tensor([[[2.0, 5], [12, 5]], [[float("nan"), 1], [3, 3]], [[25, 15], [99, 15]]])
    drawn = draw_lines(black, ends, (1.0, 0.0, 0.5))
    ink = (drawn[0] > 0).nonzero().tolist()
    assert [5, 2] in ink
    assert [5, 7] in ink
    assert {v for v, _ in ink} == {5, 6, 15, 16}
    assert max(u for _, u in ink) == 29
    assert float(drawn[2].max()) == 0.5
    assert float(black.max()) == 0
    dashed = draw_lines(black, ends[:1], (1.0, 0.0, 0.0), dash_px=3.0)
    # Dashes and gaps of 3 px from the start on; the brush is 2 px wide.
    assert (dashed[0, 5] > 0).nonzero().flatten().tolist() == [2, 3, 4, 5, 8, 9, 10, 11]


def test_the_outline_lies_inside_the_mask() -> None:
    mask = torch.zeros(10, 10, dtype=torch.bool)
    mask[2:8, 3:9] = True
    drawn = draw_outline(torch.zeros(3, 10, 10), mask, (0.0, 1.0, 0.0))[1] > 0
    assert int(drawn.sum()) == 36 - 16
    assert not bool((drawn & ~mask).any())


def test_the_marks_of_a_bar_stand_where_their_colours_are() -> None:
    for near_m, far_m in ((3.0, 80.0), (0.25, 7.0), (1.5, 8.0)):
        bar = make_depth_color_bar(near_m, far_m)
        places, words = zip(*bar.marks, strict=True)
        assert (words[0], words[-1]) == (f"{near_m:g}", f"{far_m:g}")
        assert min(b - a for a, b in pairwise(places)) >= 0.08 - 1e-9
        metres = torch.tensor([[float(word) for word in words]])
        shares = torch.tensor([list(places)]).float()
        assert torch.allclose(draw_depth(metres, near_m, far_m), draw_share(shares), atol=1e-5)
    assert [word for _, word in make_depth_color_bar().marks] == ["3", "5", "10", "20", "50", "80"]


def test_a_rising_bar_ends_in_the_brightest_colour() -> None:
    bar = make_rising_color_bar("error [px]", 4.0, has_more=True)
    assert bar.marks == [(0.0, "0"), (0.5, "2"), (1.0, "4+")]
    for color, share in ((bar.colors[0], 1.0), (bar.colors[-1], 0.0)):
        assert draw_share(torch.tensor([[share]])).flatten().tolist() == pytest.approx(color)


def test_of_errors_that_overlap_the_largest_is_seen() -> None:
    error = torch.full((5, 7), torch.nan)
    error[2, 2], error[2, 3] = 1.0, 4.0
    picture = draw_error_points(torch.ones(3, 5, 7), error, 4.0)
    assert torch.equal(picture[:, 1, 3], draw_share(torch.zeros(1, 1))[:, 0, 0])
    assert torch.equal(picture[:, 2, 1], draw_share(torch.full((1, 1), 0.75))[:, 0, 0])
    assert torch.equal(picture[:, 0, 0], torch.full((3,), 0.35))


def test_a_large_picture_shrinks_and_a_small_one_stays() -> None:
    image = torch.rand(3, 40, 60)
    wide = torch.rand(3, 1, 5000)
    for most, picture, size in (
        (2400, image, (60, 40)),
        (600, image, (30, 20)),
        (10, wide, (223, 1)),
    ):
        width, height, address = embed_picture(Drawing(image=picture, caption=""), most)
        assert (width, height) == (picture.shape[2], picture.shape[1])
        shown = Image.open(io.BytesIO(b64decode(address.removeprefix("data:image/jpeg;base64,"))))
        assert shown.size == size
        brightness = torch.from_numpy(np.array(shown)).double().mean() / 255
        assert torch.allclose(brightness, picture.double().mean(), atol=0.01)
