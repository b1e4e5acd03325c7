"""The work behind ``depthpose figure 3-2``, ``3-4`` and ``3-5``."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.cli.thesis.views import Views
from depthpose.core.errors import InputError
from depthpose.core.files import write_image
from depthpose.core.run import environment
from depthpose.pose.datasets import BopDataset, Instance
from depthpose.pose.datasets.dataset import read_instance_mask
from depthpose.pose.estimator import GeoPoseNet
from depthpose.pose.predictions import read_predictions
from depthpose.pose.voting import vote_ransac
from depthpose.report.choose import spread_evenly
from depthpose.report.overlay import picture_of
from depthpose.report.pose import close_up, draw_boxes
from depthpose.report.tables import Picture, Section, write_page
from depthpose.thesis.pose_figures import arrange_grid, draw_features, draw_field, seen_points
from depthpose.thesis.tsne import embed_line
from depthpose.thesis.voting import VotingCase, cases_of

_MOST_POINTS = 4000
"""Of a t-SNE: its time grows with the square."""
_SCAN_POINTS = 1500

BOXES = "Boxes: truth green and dashed, estimate blue and solid."


class Panel(NamedTuple):
    """One picture of a figure, and what it shows."""

    caption: str
    image: Float[Tensor, "3 h w"]


def write_figure(number: str, text: str, panels: Sequence[Panel], out: Path, columns: int) -> int:
    """Write the figure, each panel, and a page that explains it, to a folder that is claimed."""
    path = out / f"figure-{number}.png"
    write_image(path, arrange_grid([panel.image for panel in panels], columns))
    pictures: list[Picture] = []
    for k, panel in enumerate(panels, 1):
        file = out / "panels" / f"{number}.{k}.png"
        write_image(file, panel.image)
        pictures.append(Picture(path=file, caption=panel.caption))
    section = Section(title="Panels", text=text, pictures=pictures)
    write_page(out / "report.html", f"Figure {number}", [section], environment())
    captions = "; ".join(panel.caption for panel in panels)
    print(f"{path}: {captions}. {text}")
    return 0


def feature_panels(net: GeoPoseNet, views: Views, perplexity: float) -> list[Panel]:
    """Draw the features of each view, in one colour scale for all.

    Raises:
        InputError: no view can be posed, or they have too few points in all.
    """
    models = {model.name: model for model in net.weights.models}
    found = [(view, seen_points(net, view.input)) for view in views.samples]
    seen = [(view, *pair) for view, pair in found if pair is not None]
    if not seen:
        raise InputError(f"none of the {len(views.samples)} views has enough points to be posed")
    step = -(-sum(len(features) for _, _, features in seen) // _MOST_POINTS)
    shares = embed_line(torch.cat([features[::step] for _, _, features in seen]), perplexity)
    counts = [len(features[::step]) for _, _, features in seen]
    panels: list[Panel] = []
    for (view, points_m, _), share in zip(seen, shares.split(counts), strict=True):
        model_from_camera = view.truth.camera_from_model.inverse()
        local = model_from_camera.apply(points_m[::step].to(model_from_camera.R))
        image = draw_features(local, share, models[view.input.object])
        panels.append(Panel(view.input.name, image))
    return panels


def field_panels(net: GeoPoseNet, views: Views, keypoint: int | None) -> list[Panel]:
    """Draw the field of one keypoint of one view: the one whose vote errs most.

    Raises:
        InputError: no view can be posed, or there is no such keypoint.
    """
    found = list(cases_of(net, views.samples, _SCAN_POINTS))
    cases = {k: case for k, case in enumerate(found) if case is not None}
    if not cases:
        raise InputError(f"none of the {len(views.samples)} views has enough points to be posed")
    votes = {
        k: vote_ransac(case.points_m, case.directions, None, net.config.voting).keypoints_m
        for k, case in cases.items()
    }
    truths = {k: _true_keypoints(case) for k, case in cases.items()}
    index, which = _worst({k: (votes[k] - truths[k]).norm(dim=-1) for k in cases}, keypoint)
    case, true_m, voted_m = cases[index], truths[index][which], votes[index][which]
    exact = torch.nn.functional.normalize(true_m - case.points_m, dim=-1)
    error_mm = 1000 * float((voted_m - true_m).norm())
    view = views.samples[index]
    image, _ = close_up(views.picture(index), view.input.mask, view.input.K)
    predicted = draw_field(case.points_m, case.directions[:, which], true_m, voted_m)
    said = f"(c) predicted directions; the voted keypoint errs by {error_mm:.1f} mm"
    return [
        Panel(f"(a) {view.input.name}, keypoint {which}", image),
        Panel("(b) true directions and keypoint", draw_field(case.points_m, exact, true_m)),
        Panel(said, predicted),
    ]


def _worst(errors: dict[int, Float[Tensor, " k"]], keypoint: int | None) -> tuple[int, int]:
    """Give the view and the keypoint that err most; of one keypoint, the view."""
    count = len(next(iter(errors.values())))
    if keypoint is not None and not 0 <= keypoint < count:
        raise InputError(f"--keypoint {keypoint}: there are {count}, from 0 on")
    own = {k: e if keypoint is None else e[[keypoint]] for k, e in errors.items()}
    index = max(own, key=lambda k: float(own[k].max()))
    return index, int(errors[index].argmax()) if keypoint is None else keypoint


def box_panels(net: GeoPoseNet, views: Views) -> list[Panel]:
    """Draw the boxes of true and estimated poses."""
    models = {model.name: model for model in net.weights.models}
    panels: list[Panel] = []
    for k, view in enumerate(views.samples):
        found = net.estimate_many([view.input])[0]
        poses = (view.truth.camera_from_model, found.camera_from_model)
        picture, K = close_up(views.picture(k), view.input.mask, view.input.K)
        image = draw_boxes(picture, poses, models[view.input.object], K)
        caption = (
            view.input.name if found.is_posed else f"{view.input.name}: refused, {found.reason}"
        )
        panels.append(Panel(caption, image))
    return panels


def picture_sections(
    dataset: BopDataset, folders: Sequence[Path], number: int, out: Path
) -> list[Section]:
    """Draw some instances of each set of predictions, from the files that were measured."""
    places = spread_evenly(len(dataset), number)
    sections: list[Section] = []
    for folder in folders:
        known = {p.estimate.name: p.estimate for p in read_predictions(folder)}
        pictures: list[Picture] = []
        for instance in (dataset.instances[i] for i in places):
            estimate = known.get(instance.name)
            if estimate is None:  # of a detection: it bears no instance's name
                continue
            poses = (instance.camera_from_model, estimate.camera_from_model)
            model = dataset.objects[instance.object_id]
            picture, K = close_up(*_picture_of(instance), instance.K)
            image = draw_boxes(picture, poses, model, K)
            path = out / "figures" / folder.name / f"3-5_{instance.name}.jpg"
            write_image(path, image)
            caption = instance.name if estimate.is_posed else f"{instance.name}: {estimate.reason}"
            pictures.append(Picture(path=path, caption=caption))
        if pictures:
            title = f"Figure 3-5: {folder.name}"
            sections.append(Section(title=title, text=BOXES, pictures=pictures))
    return sections


def _picture_of(instance: Instance) -> tuple[Float[Tensor, "3 h w"], Bool[Tensor, "h w"]]:
    """Read the picture, or the depth in grey, and the annotated mask."""
    return picture_of(instance), read_instance_mask(instance)


def _true_keypoints(case: VotingCase) -> Float[Tensor, "k 3"]:
    pose = case.truth.float()
    return pose.apply(case.model.keypoints_m.float())
