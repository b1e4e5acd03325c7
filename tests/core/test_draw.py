import torch

from depthpose.core.draw import (
    draw_depth,
    draw_disparity,
    draw_lines,
    draw_outline,
    draw_points,
    draw_share,
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
    drawn = draw_lines(black, ends, (1.0, 0.0, 0.5), width_px=1)
    ink = (drawn[0] > 0).nonzero().tolist()
    assert [5, 2] in ink
    assert [5, 7] in ink
    assert {v for v, _ in ink} == {5, 15}
    assert max(u for _, u in ink) == 29
    assert float(drawn[2].max()) == 0.5
    assert float(black.max()) == 0
    dashed = draw_lines(black, ends[:1], (1.0, 0.0, 0.0), width_px=1, dash_px=3.0)
    assert 4 < int((dashed[0] > 0).sum()) < int((drawn[0, 5] > 0).sum())


def test_the_outline_lies_inside_the_mask() -> None:
    mask = torch.zeros(10, 10, dtype=torch.bool)
    mask[2:8, 3:9] = True
    drawn = draw_outline(torch.zeros(3, 10, 10), mask, (0.0, 1.0, 0.0))[1] > 0
    assert int(drawn.sum()) == 36 - 16
    assert not bool((drawn & ~mask).any())
