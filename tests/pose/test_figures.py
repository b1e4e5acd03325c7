import math

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw
from tests.pose.synthetic_objects import bracket

from depthpose.core.errors import InputError
from depthpose.thesis.pose_figures import (
    arrange_grid,
    draw_colored_cloud,
    draw_directions,
    draw_discs,
    spectral,
)
from depthpose.thesis.tsne import embed_line, joint_probabilities, kl_gradient


def test_neighbourhoods_have_the_perplexity_that_was_asked_for() -> None:
    x = torch.randn(90, 5, generator=torch.Generator().manual_seed(0))
    P = joint_probabilities(x, 20.0)
    assert float(P.sum()) == pytest.approx(1.0)
    assert torch.allclose(P, P.T)
    assert float(P.diagonal().sum()) == 0.0
    # On a regular ring every neighbourhood is alike, and P's rows are those neighbourhoods.
    angle = torch.arange(120) * (2 * math.pi / 120)
    rows = 120 * joint_probabilities(torch.stack([angle.cos(), angle.sin()], 1), 20.0)
    entropy = -torch.where(rows > 0, rows * rows.log(), 0).sum(1)
    assert torch.allclose(entropy.exp(), torch.tensor(20.0).double(), atol=1e-3)


def test_the_gradient_is_that_of_the_divergence() -> None:
    P = joint_probabilities(torch.randn(40, 3, generator=torch.Generator().manual_seed(1)), 8.0)
    y = torch.randn(40, generator=torch.Generator().manual_seed(2)).double().requires_grad_()
    near = (1 / (1 + (y[:, None] - y).square())) * (1 - torch.eye(40).double())
    Q = near / near.sum()
    seen = P > 0
    (P[seen] * (P[seen] / Q[seen]).log()).sum().backward()
    assert y.grad is not None
    assert torch.allclose(kl_gradient(P, y.detach()), y.grad, atol=1e-10)


def test_groups_of_features_get_colours_of_their_own() -> None:
    generator = torch.Generator().manual_seed(3)
    middles = 8 * torch.randn(3, 16, generator=generator)
    x = torch.cat([m + torch.randn(60, 16, generator=generator) for m in middles])
    y = embed_line(x, 20.0)
    assert float(y.min()) == 0.0
    assert float(y.max()) == 1.0
    spans = sorted((float(part.min()), float(part.max())) for part in y.split(60))
    assert spans[0][1] < spans[1][0]
    assert spans[1][1] < spans[2][0]
    assert torch.equal(embed_line(x, 20.0), y)
    with pytest.raises(InputError, match="t-SNE of 50 points with a perplexity of 20"):
        embed_line(x[:50], 20.0)


def test_colours_go_from_red_over_yellow_to_blue() -> None:
    red, yellow, blue = spectral(torch.tensor([0.0, 0.5, 1.0]))
    assert red[0] > 0.5 > red[2]
    assert min(yellow[:2]) > 0.9
    assert blue[2] > 0.5 > blue[1]


def test_near_points_cover_far_ones() -> None:
    places = torch.tensor([[5.0, 5.0, 1.0], [5.0, 5.0, 2.0], [-9.0, 5.0, 0.0]])
    colors = torch.eye(3)
    image = Image.new("RGB", (11, 11), "white")
    draw_discs(ImageDraw.Draw(image), places, colors, 2.0)
    assert image.getpixel((5, 5)) == (255, 0, 0)
    assert 13 <= int((np.asarray(image) < 255).any(-1).sum()) <= 21


def test_a_cloud_is_drawn_over_its_model_from_where_it_was_seen() -> None:
    model = bracket()
    cloud = model.vertices_m[model.vertices_m[:, 1] > 0.02]
    image = draw_colored_cloud(cloud, torch.zeros(len(cloud)), model, 200)
    is_black = (image.sum(0) == 0).sum()
    is_red = ((image[0] > 0.5) & (image[1] < 0.1)).sum()
    assert int(is_black) > 2000
    assert int(is_red) > 50


def test_the_field_shows_where_directions_meet() -> None:
    points = torch.tensor([[-0.1, -0.1, 1.0], [0.1, -0.1, 1.0], [0.1, 0.1, 1.0], [-0.1, 0.1, 1.0]])
    true, voted = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.05, 0.0, 0.9])
    ways = torch.nn.functional.normalize(true - points, dim=-1)
    alone = draw_directions(points, ways, true, None, 200)
    both = draw_directions(points, ways, true, voted, 200)
    assert alone[:, 100, 100].tolist() == pytest.approx([0.95, 0.75, 0.0], abs=0.01)
    is_red = (both[0] > 0.8) & (both[1] < 0.1)
    rows, columns = is_red.nonzero(as_tuple=True)
    scale = (200 - 66) / 0.2
    assert float(columns.double().mean()) == pytest.approx(100 + 0.05 * scale, abs=1)
    assert float(rows.double().mean()) == pytest.approx(100, abs=1)
    # Each of the four arrows begins at its point and leads inward.
    ink = both[2] - both[0] > 0.3
    for x, y in points[:, :2].tolist():
        u, v = 100 + x * scale, 100 + y * scale
        inward = ink[
            int(v - y * 60) - 3 : int(v - y * 60) + 4, int(u - x * 60) - 3 : int(u - x * 60) + 4
        ]
        assert bool(inward.any())


def test_pictures_of_different_sizes_share_a_grid() -> None:
    grid = arrange_grid([torch.zeros(3, 10, 20), torch.zeros(3, 8, 8), torch.zeros(3, 4, 4)], 2)
    assert grid.shape == (3, 28, 48)
    assert int((grid.sum(0) == 0).sum()) == 200 + 64 + 16
    with pytest.raises(InputError, match="a figure of no picture"):
        arrange_grid([], 2)
