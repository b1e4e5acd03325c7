"""Tables and figures of chapter 3: predict, measure, join with the printed rows, draw, write."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from depthpose.cli import file_names
from depthpose.cli.arguments import refuse_below
from depthpose.cli.pose.dataset import match_names, open_dataset
from depthpose.cli.pose.evaluate import (
    SCORING_NOTE,
    join_evaluations,
    measure_predictions,
    predict_instances,
    print_instances,
    write_detail_tables,
)
from depthpose.cli.pose.masks import Masks, find_mask_file, prepare_masks
from depthpose.cli.pose.methods import build_methods
from depthpose.cli.pose.options import PoseDataOptions, PoseTableOptions
from depthpose.cli.thesis.depth import write_report
from depthpose.core.checkpoint import file_sha256, find_weights
from depthpose.core.config import config_to_dict
from depthpose.core.environment import describe_environment
from depthpose.core.errors import InputError
from depthpose.core.files import write_image
from depthpose.core.run_folder import claim_folder
from depthpose.pose.config import EvaluationConfig, ObjectsConfig
from depthpose.pose.datasets import BopDataset, Instance
from depthpose.pose.datasets.dataset import read_instance_mask
from depthpose.pose.evaluate import hash_frames
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.predictions import read_predictions
from depthpose.pose.propose import vote_ransac
from depthpose.pose.synthetic import SyntheticViews
from depthpose.pose.types import ViewSample
from depthpose.report import page
from depthpose.report.page import Drawing, PictureFile, Section
from depthpose.report.pose import cut_close_up, draw_grey_depth, draw_pose, read_instance_image
from depthpose.thesis import pose_figures, pose_tables
from depthpose.thesis.pose_voting import VotingCase, collect_votes, compare_voting
from depthpose.thesis.tsne import embed_line

_SYNTHETIC_SEED = 3303
"""Seed of the synthetic views for tables and figures; no training uses it."""
_MAX_TSNE_POINTS = 4000
"""Most points of a t-SNE, whose time grows with their square."""
_MAX_VOTING_POINTS = 1500
"""Most points of a view that vote in figure 3-4."""
_FIGURE_TEXTS = {
    "3-2": "Alike features have alike colours (t-SNE to one number for all clouds, Spectral); the "
    "model is black, each cloud posed on it by the truth.",
    "3-4": "Plane of x (right) and y (down); star: true keypoint; cross: voted, by RANSAC.",
    "3-5": "Boxes: truth green and dashed, estimate blue and solid.",
}
"""What stands below each figure."""
_PERCENT_NOTE = (
    "Percent of instances whose ADD (ADD-S where there is a star, or a declared symmetry) is "
    "below 10 % of the diameter. Ours: a missing or refused estimate is a failure; see the "
    "columns for masks, diameters and the list of frames."
)
_DIFFERENCE_NOTES = {
    "3.1": "Differences: the first weights less each of the others.",
    "3.2": (
        "Published rows: as printed, of the 13 objects; those with RGB see what ours does "
        "not, most train a network for each object, and their lists of frames and diameters "
        "differ (see the notes). Differences: ours minus the rows of one network for all objects. "
        "The thesis's own row is not in the text that is at hand."
    ),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class ThesisViews:
    """Views with truth for a table or figure, of a dataset or synthetic."""

    samples: Sequence[ViewSample]  #: the views, whose objects have the names of the network
    instances: Sequence[Instance | None]  #: instance of each in the dataset; None: synthetic
    columns: dict[str, Any]  #: what tables say of the views beside the numbers measured on them
    settings: dict[str, Any]  #: JSON values that decide which views they are

    def draw_close_up(self, index: int) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "3 3"]]:
        """Draw the part of a view that shows the object: its picture, or its depth in grey.

        Returns:
            The close-up, and its K.
        """
        instance = self.instances[index]
        view = self.samples[index].input
        if instance is None or instance.rgb is None:
            picture = draw_grey_depth(view.depth_m)
        else:
            picture = read_instance_image(instance)
        return cut_close_up(picture, view.mask, view.K)


def _render_views(net: GeoPoseNet, count: int) -> ThesisViews:
    """Render synthetic views of the network's objects."""
    config = ObjectsConfig(number=count, seed=_SYNTHETIC_SEED)
    objects = SyntheticViews(net.weights.models, config, net.weights.cloud)
    return ThesisViews(
        samples=[objects.view(i) for i in range(count)],
        instances=[None] * count,
        columns={"frames": f"synthetic, seed {_SYNTHETIC_SEED}"},
        settings={"synthetic": count, "seed": _SYNTHETIC_SEED},
    )


def _read_views(
    net: GeoPoseNet, folder: Path, data: PoseDataOptions, number: int | None
) -> ThesisViews:
    """Read views of a dataset.

    Args:
        net: network whose names the objects get.
        folder: folder of the dataset.
        data: its split, and the objects that are kept.
        number: how many views, spread evenly; None: all.
    """
    dataset = open_dataset(folder, data.split, objects=data.objects)
    print_instances(dataset)
    columns = {
        "frames": f"{folder.resolve().name} {data.split}",
        "frames_sha256": hash_frames(dataset.instances)[:12],
    }
    if number is not None and number < len(dataset):
        instances = [dataset.instances[i] for i in page.spread_evenly(len(dataset), number)]
        dataset = replace(dataset, instances=instances)

    # Views of instances call the object as the weights do.
    names = match_names(dataset, net.weights.models)
    samples: list[ViewSample] = []
    for instance in dataset.instances:
        view = dataset.view(instance)
        named_input = replace(view.input, object=names[instance.object_id])
        samples.append(replace(view, input=named_input))

    settings = {
        "data": str(dataset.folder.resolve()),
        "split": dataset.split,
        "frames_sha256": hash_frames(dataset.instances),
    }
    return ThesisViews(
        samples=samples, instances=dataset.instances, columns=columns, settings=settings
    )


def reproduce_by_object(
    number: str,
    data: PoseDataOptions,
    options: PoseTableOptions,
    weights: Sequence[str],
    csv: Sequence[Path],
    out: Path,
) -> int:
    """Make table 3.1 or 3.2: predict what is missing, measure, join with published rows, write.

    Args:
        number: number of the table; 3.2 has published rows.
        data: the dataset.
        options: how poses are estimated, measured and shown.
        weights: files or names, each a method.
        csv: BOP results of other methods.
        out: folder of the files.

    Returns:
        The exit code.
    """
    assert data.folder is not None

    # The instances, the methods, and all that decides the numbers.
    dataset = open_dataset(data.folder, data.split, options.targets, data.objects)
    print_instances(dataset)
    models = tuple(dataset.objects.values())
    with_published = number == "3.2"
    if with_published:
        numbers = {model.name: pose_tables.find_linemod_number(model) for model in models}
    else:
        numbers = {model.name: model.number for model in models}
    methods = build_methods(weights, options.config, models)
    rule = EvaluationConfig(diameters=options.diameters, with_vsd=options.vsd)
    settings = {
        "table": number,
        "data": str(dataset.folder.resolve()),
        "split": dataset.split,
        "frames_sha256": hash_frames(dataset.instances),
        "rule": config_to_dict(rule),
        "methods": {method.name: dict(method.settings) for method in methods},
        "masks": [_describe_masks(kind) for kind in options.masks] if methods else [],
        "csv": [file_names.name_with_checksum(path) for path in csv],
    }
    results = (
        *page.list_table_files("rows", "all", "instances", "risk"),
        "report.md",
        "report.html",
    )
    claim_folder(out, settings, (*results, "predictions", "detections", "figures"))

    # Predict what is missing, measure, and join with the published rows.
    all_masks: list[Masks] = []
    if methods:
        all_masks = prepare_masks(options.masks, dataset, out, options.device)
    folders = [
        predict_instances(dataset, method, masks, out) for method in methods for masks in all_masks
    ]
    evaluations = measure_predictions(dataset, [*folders, *csv], rule)
    measured = join_evaluations(evaluations)
    rows = pose_tables.join_by_object(measured.rows, numbers, with_published=with_published)
    all_columns = [row.columns() for row in measured.rows]
    page.write_table(out, rows)
    page.write_table(out, all_columns, name="all")

    # The page: tables, then some instances of each method.
    figures = [_write_pose_figures(dataset, folder, out, options.pictures) for folder in folders]
    text = f"{_PERCENT_NOTE} {_DIFFERENCE_NOTES[number]}"
    sections = [
        Section(title="Percent by object", text=text, rows=rows),
        Section(title="All numbers", text=SCORING_NOTE, rows=all_columns),
        *(figure for figure in figures if figure.pictures),
        *write_detail_tables(measured, out),
    ]
    title = f"{pose_tables.TITLES[number]}, on {dataset.folder.resolve().name}"
    write_report(title, sections, out)
    return 0


def _describe_masks(kind: str) -> str:
    """Describe a kind of masks for the record of a run: its word, or its file with a checksum."""
    path = find_mask_file(kind)
    return kind if path is None else file_names.name_with_checksum(path)


def _write_pose_figures(dataset: BopDataset, predictions: Path, out: Path, count: int) -> Section:
    """Draw figure 3-5 of some instances and write the pictures; return a section that shows them.

    Args:
        dataset: dataset with the instances.
        predictions: folder of a method's ``poses.json``.
        out: folder of the report; the pictures are written to ``OUT/figures``.
        count: how many instances, spread evenly; one without an estimate is left out.
    """
    estimates = {p.estimate.name: p.estimate for p in read_predictions(predictions)}
    pictures: list[PictureFile] = []
    for index in page.spread_evenly(len(dataset), count):
        instance = dataset.instances[index]
        estimate = estimates.get(instance.name)
        if estimate is None:  # estimates of detections do not have the names of instances
            continue
        picture, K = cut_close_up(
            read_instance_image(instance), read_instance_mask(instance), instance.K
        )
        model = dataset.objects[instance.object_id]
        drawn = draw_pose(picture, estimate.camera_from_model, model, K, instance.camera_from_model)
        path = out / "figures" / predictions.name / f"3-5_{instance.name}.jpg"
        write_image(path, drawn)
        caption = instance.name if estimate.is_posed else f"{instance.name}: {estimate.reason}"
        pictures.append(PictureFile(path=path, caption=caption))
    title = f"Figure 3-5: {predictions.name}"
    return Section(title=title, text=_FIGURE_TEXTS["3-5"], pictures=pictures)


def reproduce_voting(
    weights: str, data: PoseDataOptions, synthetic: int, points: Sequence[int], out: Path
) -> int:
    """Make table 3.3: ways of voting on the same directions, a block for each number of points.

    Args:
        weights: name or file of the network's weights.
        data: the dataset; without a folder the views are synthetic.
        synthetic: number of synthetic views.
        points: maximum voting points per view, one block of rows for each.
        out: folder of the files.

    Returns:
        The exit code.
    """
    path = find_weights(weights)
    net = GeoPoseNet.load(path)
    if data.folder is None:
        views = _render_views(net, synthetic)
    else:
        views = _read_views(net, data.folder, data, number=None)
    sha256 = file_sha256(path)
    columns = {"weights": path.stem, "weights_sha256": sha256[:12], **views.columns}
    settings = {
        "command": "reproduce 3.3",
        "weights_sha256": sha256,
        "points": list(points),
        **views.settings,
    }
    claim_folder(out, settings, [*page.list_table_files("rows"), "report.md", "report.html"])

    rows: list[dict[str, Any]] = []
    for max_points in points:
        samples = tqdm(views.samples, f"{max_points} points", disable=None)
        cases = list(collect_votes(net, samples, max_points))
        rows += [row | columns for row in compare_voting(cases, max_points)]
    page.write_table(out, rows)

    text = (
        "Success: percent of instances whose ADD(-S) is below 10 % of the diameter, without ICP; "
        "milliseconds: processor time of one thread for all keypoints of a cloud, the median. "
        "'points': at most so many; 'votes': how many the clouds had on average. "
        "Times faster: than the loop. All rows of a block saw the same directions."
    )
    sections = [Section(title="RANSAC against least squares", text=text, rows=rows)]
    write_report(f"{pose_tables.TITLES['3.3']}, {columns['frames']}", sections, out)
    return 0


def write_figure(
    figure: str,
    weights: str,
    data: PoseDataOptions,
    number: int,
    out: Path,
    draw_panels: Callable[[GeoPoseNet, ThesisViews], list[Drawing]],
    drawing_settings: Mapping[str, object],
    columns: int,
) -> int:
    """Draw the panels of a figure, arrange them in columns, and write figure, panels and page.

    Args:
        figure: number of the figure in the thesis.
        weights: name or file of the network's weights.
        data: the dataset; without a folder the views are synthetic.
        number: how many views.
        out: folder of the figure.
        draw_panels: draws the panels of the views.
        drawing_settings: what decides its drawing, for the record of the run.
        columns: how many panels stand side by side.

    Returns:
        The exit code.
    """
    refuse_below(1, "--number", number, "4")
    net = GeoPoseNet.load(weights)
    if data.folder is None:
        views = _render_views(net, number)
    else:
        views = _read_views(net, data.folder, data, number)
    path = out / f"figure-{figure}.png"
    text = _FIGURE_TEXTS[figure]
    settings = {
        "command": f"figure {figure}",
        "weights_sha256": file_sha256(find_weights(weights)),
        **views.settings,
        **drawing_settings,
    }
    claim_folder(out, settings, (path.name, "panels", "report.html"))
    panels = draw_panels(net, views)
    write_image(path, pose_figures.arrange_grid([panel.image for panel in panels], columns))
    pictures: list[PictureFile] = []
    for k, panel in enumerate(panels, 1):
        file = out / "panels" / f"{figure}.{k}.png"
        write_image(file, panel.image)
        pictures.append(PictureFile(path=file, caption=panel.caption))
    section = Section(title="Panels", text=text, pictures=pictures)
    page.write_page(out / "report.html", f"Figure {figure}", [section], describe_environment())
    print(f"{path}: {'; '.join(panel.caption for panel in panels)}. {text}")
    return 0


def draw_feature_panels(net: GeoPoseNet, views: ThesisViews, perplexity: float) -> list[Drawing]:
    """Draw the features of each view as colours, by one t-SNE for all views (figure 3-2).

    ``perplexity``: of the t-SNE, about how many neighbours a point has.

    Raises:
        InputError: no view has enough points to be posed.
    """
    models = {model.name: model for model in net.weights.models}
    usable: list[ViewSample] = []
    points_m: list[Tensor] = []
    features: list[Tensor] = []
    for view in views.samples:
        featured = pose_figures.compute_features(net, view.input)
        if featured is not None:
            usable.append(view)
            points_m.append(featured[0])
            features.append(featured[1])
    if not usable:
        raise InputError(f"none of the {len(views.samples)} views has enough points to be posed")

    # Every STEP-th point of each view, so that there are not too many for a t-SNE.
    step = math.ceil(sum(map(len, features)) / _MAX_TSNE_POINTS)
    thinned = [part[::step] for part in features]
    embedded = embed_line(torch.cat(thinned), perplexity)
    values = embedded.split([len(part) for part in thinned])

    panels: list[Drawing] = []
    for view, view_points_m, view_values in zip(usable, points_m, values, strict=True):
        model_from_camera = view.truth.camera_from_model.inverse()
        local_m = model_from_camera.apply(view_points_m[::step].to(model_from_camera.R))
        image = pose_figures.draw_colored_cloud(local_m, view_values, models[view.input.object])
        panels.append(Drawing(image=image, caption=view.input.name))
    return panels


@dataclass(frozen=True, kw_only=True, eq=False)
class _KeypointVote:
    """A keypoint of a view: where it is, and where it is voted to be [m, camera frame]."""

    view: int  #: index of the view
    case: VotingCase  #: the votes for all keypoints of the view
    keypoint: int  #: index of the keypoint
    true_m: Float[Tensor, "3"]
    voted_m: Float[Tensor, "3"]
    error_m: float  #: distance between the two


def _find_worst_vote(net: GeoPoseNet, views: ThesisViews, keypoint: int | None) -> _KeypointVote:
    """Vote in all views, and find the keypoint with the largest error.

    ``keypoint``: number, from 0 on, of the only keypoint to look at in each view; None: at all.

    Raises:
        InputError: there is no such keypoint, or no view has enough points to be posed.
    """
    votes: list[_KeypointVote] = []
    for index, case in enumerate(collect_votes(net, views.samples, _MAX_VOTING_POINTS)):
        if case is None:
            continue
        voted_m = vote_ransac(case.points_m, case.directions, None, net.config.voting).keypoints_m
        true_m = case.truth.float().apply(case.model.keypoints_m.float())
        if keypoint is not None and not 0 <= keypoint < len(true_m):
            raise InputError(f"--keypoint {keypoint}: there are {len(true_m)}, from 0 on")
        errors_m = (voted_m - true_m).norm(dim=-1)
        k = int(errors_m.argmax()) if keypoint is None else keypoint
        vote = _KeypointVote(
            view=index,
            case=case,
            keypoint=k,
            true_m=true_m[k],
            voted_m=voted_m[k],
            error_m=float(errors_m[k]),
        )
        votes.append(vote)
    if not votes:
        raise InputError(f"none of the {len(views.samples)} views has enough points to be posed")

    return max(votes, key=lambda vote: vote.error_m)


def draw_direction_panels(
    net: GeoPoseNet, views: ThesisViews, keypoint: int | None
) -> list[Drawing]:
    """Draw true and predicted directions to the keypoint whose vote errs most (figure 3-4).

    ``keypoint``: number, from 0 on, of the only keypoint to look at in each view; None: at all.

    Raises:
        InputError: there is no such keypoint, or no view has enough points to be posed.
    """
    worst = _find_worst_vote(net, views, keypoint)
    points_m = worst.case.points_m
    true_directions = torch.nn.functional.normalize(worst.true_m - points_m, dim=-1)
    predicted = worst.case.directions[:, worst.keypoint]
    image, _ = views.draw_close_up(worst.view)
    name = views.samples[worst.view].input.name
    error_mm = 1000 * worst.error_m
    return [
        Drawing(image=image, caption=f"(a) {name}, keypoint {worst.keypoint}"),
        Drawing(
            image=pose_figures.draw_directions(points_m, true_directions, worst.true_m),
            caption="(b) true directions and keypoint",
        ),
        Drawing(
            image=pose_figures.draw_directions(points_m, predicted, worst.true_m, worst.voted_m),
            caption=f"(c) predicted directions; the voted keypoint errs by {error_mm:.1f} mm",
        ),
    ]


def draw_box_panels(net: GeoPoseNet, views: ThesisViews) -> list[Drawing]:
    """Draw the boxes of true and estimated poses over close-ups (figure 3-5)."""
    models = {model.name: model for model in net.weights.models}
    panels: list[Drawing] = []
    for k, view in enumerate(views.samples):
        (estimate,) = net.estimate_many([view.input])
        picture, K = views.draw_close_up(k)
        true = view.truth.camera_from_model
        estimated = estimate.camera_from_model
        name = view.input.name
        image = draw_pose(picture, estimated, models[view.input.object], K, true)
        caption = name if estimate.is_posed else f"{name}: refused, {estimate.reason}"
        panels.append(Drawing(image=image, caption=caption))
    return panels
