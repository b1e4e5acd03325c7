import base64

import numpy as np
import torch

from depthpose.core.files import PointCloud
from depthpose.report import page as scenes
from depthpose.report.page import (
    Layer,
    LineSegments,
    Scene,
    make_frame_axes,
    make_lines,
    read_page_file,
)


def decoded(layer: dict) -> tuple[np.ndarray, np.ndarray]:
    steps = np.frombuffer(base64.b64decode(layer["places"]), "<u2").reshape(-1, 3)
    places = np.array(layer["low"]) + steps * np.array(layer["step"])
    colors = np.frombuffer(base64.b64decode(layer["colors"]), np.uint8)
    width = 3 if layer["kind"] == "points" else 6
    return places.reshape(-1, width), colors.reshape(-1, 3)


def test_points_and_lines_come_back_as_they_went() -> None:
    points, color = torch.randn(7, 3), torch.rand(7, 3)
    ends_m = torch.randn(5, 2, 3)
    layers = [
        Layer(name="cloud", shape=PointCloud(points=points, color=color)),
        Layer(name="box", shape=make_lines(ends_m, (1.0, 0.0, 0.2)), is_shown=False),
    ]
    cloud, box = Scene(caption="both", layers=layers).encode()["layers"]
    places, colors = decoded(cloud)
    span_m = float(points.amax() - points.amin())
    np.testing.assert_allclose(places, points.numpy(), atol=span_m / 65535)
    assert np.abs(colors / 255 - color.numpy()).max() <= 0.5 / 255 + 1e-6
    places, colors = decoded(box)
    np.testing.assert_allclose(places, ends_m.reshape(5, 6).numpy(), atol=10 / 65535)
    assert colors.tolist() == [[255, 0, 51]] * 5
    assert (cloud["shown"], box["shown"]) == (True, False)


def test_points_without_colour_are_grey() -> None:
    (layer,) = Scene(
        caption="", layers=[Layer(name="c", shape=PointCloud(points=torch.zeros(2, 3)))]
    ).encode()["layers"]
    _, colors = decoded(layer)
    assert len(set(colors.ravel().tolist())) == 1


def test_many_points_are_thinned_evenly_and_the_page_says_so() -> None:
    count = 3 * scenes.MOST_POINTS
    points = (torch.arange(count) // 3).float()[:, None].expand(-1, 3)
    scene = Scene(caption="", layers=[Layer(name="cloud", shape=PointCloud(points=points))])
    encoded = scene.encode()
    assert encoded["note"] == f"cloud: {scenes.MOST_POINTS} of {count}, thinned evenly"
    places, _ = decoded(encoded["layers"][0])
    # One of each run of three: in order, and no two of one run.
    assert np.array_equal(np.rint(places[:, 0]), np.arange(scenes.MOST_POINTS))
    assert scene.encode() == encoded, "the same every time"


def test_few_points_are_all_shown_and_nothing_is_said() -> None:
    cloud = PointCloud(points=torch.zeros(scenes.MOST_POINTS, 3))
    assert Scene(caption="", layers=[Layer(name="c", shape=cloud)]).encode()["note"] == ""


def test_axes_are_red_green_blue_columns() -> None:
    R = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    axes = make_frame_axes(torch.tensor([1.0, 2, 3]), R, 0.5)
    assert isinstance(axes, LineSegments)
    assert torch.equal(axes.ends_m[:, 0], torch.tensor([[1.0, 2, 3]] * 3))
    assert torch.equal(axes.ends_m[0, 1], torch.tensor([1.0, 2.5, 3]))  # x points along y
    assert axes.color.argmax(1).tolist() == [0, 1, 2]


def test_the_viewer_asks_the_network_for_nothing() -> None:
    script = read_page_file("viewer.js") + read_page_file("page.css")
    for word in ("://", "fetch(", "import ", "url(", "XMLHttpRequest", "</script"):
        assert word not in script
