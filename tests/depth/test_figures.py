import pytest
import torch

from depthpose.core.draw import draw_depth
from depthpose.core.errors import InputError
from depthpose.depth.types import DepthEstimate, DepthInput
from depthpose.report.page import Drawing
from depthpose.thesis.depth import arrange_columns, draw_figure_2_1, draw_figure_2_5

H, W = 20, 60


def pair(with_right: bool = True) -> DepthInput:
    right = torch.rand(3, H, W) if with_right else None
    return DepthInput(name="f", left=torch.rand(3, H, W), right=right, camera=None)


def estimate(depth_m: float | None = 10.0, with_right: bool = True) -> DepthEstimate:
    return DepthEstimate(
        input=pair(with_right=not with_right),
        depth_m=None if depth_m is None else torch.full((H, W), depth_m),
        disparity_px=torch.ones(H, W),
        right=torch.rand(3, H, W) if with_right else None,
    )


def lidar() -> torch.Tensor:
    depth_m = torch.full((H, W), torch.nan)
    depth_m[10, 30] = 10.0
    return depth_m


def test_a_column_of_figure_2_5_is_in_the_order_of_the_thesis() -> None:
    frame, shown = pair(), estimate()
    panels = draw_figure_2_5(frame, lidar(), shown)
    assert [panel.caption for panel in panels] == [
        "left image", "real right image", "predicted depth", "predicted right image", "LiDAR",
    ]  # fmt: skip
    assert panels[0].image is frame.left
    assert panels[3].image is shown.right


def test_what_a_frame_lacks_is_left_out() -> None:
    panels = draw_figure_2_5(pair(with_right=False), None, estimate(with_right=False))
    assert [panel.caption for panel in panels] == ["left image", "predicted depth"]


def test_figure_2_1_has_six_panels() -> None:
    panels = draw_figure_2_1(pair(), lidar(), estimate(10.0), estimate(20.0))
    assert [panel.caption[:3] for panel in panels] == ["(a)", "(b)", "(c)", "(d)", "(e)", "(f)"]
    assert not torch.equal(panels[3].image, panels[4].image)


def test_one_depth_has_one_colour_in_every_panel() -> None:
    panels = draw_figure_2_1(pair(), lidar(), estimate(10.0), estimate(10.0))
    color = draw_depth(torch.full((1, 1), 10.0))[:, 0, 0]
    for k in (3, 4, 5):
        assert torch.equal(panels[k].image[:, 10, 30], color)
    assert int((panels[5].image == color[:, None, None]).all(0).sum()) == 25  # seen when shrunk


@pytest.mark.parametrize(
    ("frame", "mono", "message"),
    [
        (pair(with_right=False), estimate(), "the frame has no right view"),
        (pair(), estimate(with_right=False), "no view was synthesised"),
        (pair(), estimate(None), "a figure shows metres"),
    ],
)
def test_what_figure_2_1_cannot_show_is_said(
    frame: DepthInput, mono: DepthEstimate, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        draw_figure_2_1(frame, lidar(), mono, estimate())


def test_panels_stand_where_they_belong() -> None:
    red, green = torch.zeros(3, 10, 20), torch.zeros(3, 12, 20)
    red[0], green[1] = 1.0, 1.0
    columns = [[Drawing(caption="", image=red)] * 2, [Drawing(caption="", image=green)]]
    grid = arrange_columns(columns, width_px=20)
    assert grid.shape == (3, 12 + 8 + 10 + 8 + 18, 48)
    assert grid[:, 5, 5].tolist() == grid[:, 25, 5].tolist() == [1, 0, 0]
    assert grid[:, 5, 35].tolist() == [0, 1, 0]
    assert grid[:, 25, 35].tolist() == grid[:, 5, 24].tolist() == [1, 1, 1]


def test_the_bar_runs_from_near_to_far() -> None:
    grid = arrange_columns([[Drawing(caption="", image=torch.ones(3, 4, 40))]], width_px=40)
    ends = draw_depth(torch.tensor([[3.0, 80.0]]))
    assert torch.allclose(grid[:, -1, 0], ends[:, 0, 0], atol=1e-3)
    assert torch.allclose(grid[:, -1, -1], ends[:, 0, 1], atol=1e-3)


def test_nothing_cannot_be_arranged() -> None:
    with pytest.raises(InputError, match="a figure of no panel"):
        arrange_columns([])
