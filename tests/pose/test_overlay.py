"""What a 3D view shows of a pose."""

import pytest
import torch
from tests.pose.synthetic_objects import Oracle, box_faces, bracket, cloud_of, pose_at, tiny_weights

from depthpose.core.camera import project
from depthpose.core.files import PointCloud
from depthpose.core.rigid import Rigid
from depthpose.pose.mesh import make_model
from depthpose.pose.types import CloudInput, ObjectModel
from depthpose.report.page import LineSegments
from depthpose.report.pose import (
    TRUTH,
    cut_close_up,
    make_keypoint_layers,
    make_pose_layers,
    make_truth_layers,
    make_vote_layer,
)


def cube(*, with_repeats: bool = False, faces: int = 12) -> ObjectModel:
    corners, every = box_faces()
    if with_repeats:  # as STL has them
        return make_model(corners[every].flatten(0, 1), torch.arange(36).view(12, 3), name="cube")
    return make_model(corners, every[:faces], name="cube")


def lengths(model: ObjectModel) -> list[float]:
    unmoved = Rigid(torch.eye(3).double(), torch.zeros(3).double())
    layers = {layer.name: layer.shape for layer in make_pose_layers(unmoved, model)}
    edges = layers["its edges"]
    assert isinstance(edges, LineSegments)
    return (edges.ends_m[:, 0] - edges.ends_m[:, 1]).norm(dim=-1).tolist()


def test_the_edges_of_a_cube_are_twelve_and_no_diagonal() -> None:
    for model in (cube(), cube(with_repeats=True)):
        assert lengths(model) == [1.0] * 12


def test_an_open_sheet_shows_its_border() -> None:
    assert lengths(cube(faces=2)) == [1.0] * 4


def test_a_posed_model_lies_where_its_pose_says() -> None:
    pose, model = pose_at(), bracket()
    layers = {layer.name: layer.shape for layer in make_pose_layers(pose, model)}
    surface, box = layers["posed model"], layers["its box"]
    assert isinstance(surface, PointCloud)
    assert isinstance(box, LineSegments)
    back_m = pose.inverse().apply(surface.points)
    low_m, high_m = model.vertices_m.amin(0), model.vertices_m.amax(0)
    assert (back_m > low_m - 1e-6).all()
    assert (back_m < high_m + 1e-6).all()
    corners_m = pose.inverse().apply(box.ends_m.flatten(0, 1))
    torch.testing.assert_close(corners_m.amin(0), low_m)
    torch.testing.assert_close(corners_m.amax(0), high_m)
    truth = {layer.name: layer.shape for layer in make_truth_layers(pose, model)}
    for own, true in (("its box", "true box"), ("its edges", "true edges")):
        one, other = layers[own], truth.pop(true)
        assert isinstance(one, LineSegments)
        assert isinstance(other, LineSegments)
        assert torch.equal(one.ends_m, other.ends_m)
        assert torch.equal(other.color, torch.tensor(TRUTH).expand(len(other.ends_m), 3))
    assert not truth


def test_a_model_of_points_has_no_edges() -> None:
    model = make_model(torch.rand(50, 3), torch.empty(0, 3, dtype=torch.long), name="points")
    assert "its edges" not in [layer.name for layer in make_pose_layers(pose_at(), model)]


def test_true_votes_end_at_their_keypoints() -> None:
    pose, model = pose_at(), bracket()
    net = Oracle(tiny_weights(model), [pose])
    given = CloudInput(name="c", points_m=cloud_of(model, pose), object=model.name)
    found, voted = net.estimate_with_votes(given)
    assert net.calls == [1], "the network runs once for both"
    assert found.is_ok
    (alone,) = net.estimate_many([given])
    assert found.camera_from_model is not None
    assert alone.camera_from_model is not None
    assert torch.equal(found.camera_from_model.t_m, alone.camera_from_model.t_m)
    assert voted is not None
    keypoints_m = pose.apply(model.keypoints_m)
    layer = make_vote_layer(voted.points_m, voted.directions[..., :3], keypoints_m)
    assert isinstance(layer.shape, LineSegments)
    assert not layer.is_shown
    tips_m = layer.shape.ends_m[:, 1].unflatten(0, (-1, 8))
    torch.testing.assert_close(tips_m, keypoints_m.expand_as(tips_m), atol=1e-5, rtol=0.0)


def test_what_cannot_be_posed_casts_no_votes() -> None:
    model = bracket()
    net = Oracle(tiny_weights(model), [pose_at()])
    empty = CloudInput(name="c", points_m=torch.empty(0, 3), object=model.name)
    found, voted = net.estimate_with_votes(empty)
    assert (found.is_ok, voted, net.calls) == (False, None, [])


def test_a_refused_pose_still_shows_what_was_voted() -> None:
    model = bracket()
    (voted,) = make_keypoint_layers(model.keypoints_m, None, model)
    assert isinstance(voted.shape, LineSegments)
    middles_m = voted.shape.ends_m.mean(1).unflatten(0, (-1, 3))
    torch.testing.assert_close(middles_m, model.keypoints_m[:, None].expand_as(middles_m))
    assert len(make_keypoint_layers(model.keypoints_m, pose_at(), model)) == 2


@pytest.mark.parametrize("place", [(120, 90), (0, 5), (198, 149)])
def test_a_close_up_draws_a_pose_where_the_picture_shows_it(place: tuple[int, int]) -> None:
    """Also at the border of the picture, beyond which the close-up is black."""
    column, row = place
    K = torch.tensor([[200.0, 0, 99.5], [0, 180, 74.5], [0, 0, 1]], dtype=torch.float64)
    image = torch.zeros(3, 150, 200)
    image[:, row, column] = 1
    mask = torch.zeros(150, 200, dtype=torch.bool)
    mask[max(row - 8, 0) : row + 9, max(column - 12, 0) : column + 13] = True
    near, near_K = cut_close_up(image, mask, K)
    rows, columns = (near[0] > 0.5).nonzero(as_tuple=True)
    middle = torch.stack([columns.double().mean(), rows.double().mean()])
    ray = torch.linalg.inv(K) @ torch.tensor([column, row, 1.0], dtype=torch.float64)
    assert torch.allclose(project(ray[None], near_K)[0], middle, atol=1.0)
    assert len(rows) > 25
