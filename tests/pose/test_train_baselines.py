"""Baselines and segmentation in the loop: they train, resume, and leave files that estimate."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from tests.pose.stopping import StoppedError, stop_after
from tests.pose.synthetic_objects import bottle, bracket

from depthpose.core.checkpoint import (
    Checkpoint,
    LicenceNotice,
    read_checkpoint,
    save_checkpoint,
    warn_of_terms,
)
from depthpose.core.errors import InputError
from depthpose.core.files import write_image
from depthpose.core.loop import (
    AdamConfig,
    LoopConfig,
    TrainingRun,
    make_sample_generator,
    read_metrics,
    shuffle_index,
)
from depthpose.core.rigid import Rigid
from depthpose.pose.config import CloudConfig, ObjectsConfig
from depthpose.pose.datasets import BopFrame, BopObject, write_bop_models, write_bop_scene
from depthpose.pose.network_pose import DepthImageRegressor, GeoPoseNet
from depthpose.pose.networks.baselines import DepthImageConfig, DepthImageNet, PointNetConfig
from depthpose.pose.networks.fcn import ResNet18, SegmentationConfig
from depthpose.pose.segmentation import Segmenter
from depthpose.pose.synthetic import SyntheticViews
from depthpose.pose.synthetic.random_numbers import uniform
from depthpose.pose.train import (
    STAGES,
    DepthImageTraining,
    HeldOutConfig,
    ModelsConfig,
    PointNetTraining,
    SegmentationTraining,
)
from depthpose.pose.train.config import ImageAugmentConfig, ImagesConfig
from depthpose.pose.train.masks import (
    AnnotatedImages,
    LabelledImage,
    TrainingImages,
    cut_window,
)
from depthpose.pose.train.poses import DepthImageTask, TrainingCrops, stack_symmetries
from depthpose.pose.types import CloudInput
from depthpose.pose.weights import read_pose_weights

LOOP = LoopConfig(steps=2, batch_size=2, device="cpu", log_every_steps=1)
VIEWS = ObjectsConfig(number=8, views=2, resolution=(0.25, 0.25), distance_m=(0.6, 0.7))
HELD_OUT = HeldOutConfig(number=1, occlusions=(0.0,))


@pytest.fixture(scope="module")
def models_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models")
    write_bop_models(folder, [bracket()])
    return folder


def pointnet_config(folder: Path) -> PointNetTraining:
    network = PointNetConfig(local=(4, 4), pooled=(4, 4, 8), head=(8, 8, 8))
    return PointNetTraining(
        models=ModelsConfig(bop=str(folder)), objects=VIEWS, network=network, held_out=HELD_OUT,
        cloud=CloudConfig(max_points=50), loop=LOOP,
    )  # fmt: skip


def depth_image_config(folder: Path) -> DepthImageTraining:
    return DepthImageTraining(
        models=ModelsConfig(bop=str(folder)), objects=VIEWS, held_out=HELD_OUT, loop=LOOP,
        network=DepthImageConfig(crop_px=32, widths=(4, 4, 8, 8)), surface_points=50,
    )  # fmt: skip


def test_the_pointnet_trains_and_its_file_is_an_estimators(
    models_folder: Path, tmp_path: Path
) -> None:
    config = pointnet_config(models_folder)
    path = STAGES["pointnet"][1](config, TrainingRun(folder=tmp_path))
    assert path == tmp_path / "pointnet.safetensors"
    rows = read_metrics(tmp_path)
    assert "held_out/occluded_0/ransac_add_10" in rows[-1]
    net = GeoPoseNet.load(path)
    assert net.objects == ("bracket",)
    (found,) = net.estimate_many([SyntheticViews([bracket()], VIEWS)[0].input])
    assert found.is_ok or found.reason


def test_the_depth_image_trains_and_its_file_is_a_regressors(
    models_folder: Path, tmp_path: Path
) -> None:
    config = depth_image_config(models_folder)
    models = dataclasses.replace(config.models, licence="MIT", terms="For research alone.")
    config = dataclasses.replace(config, models=models)
    path = STAGES["depth-image"][1](config, TrainingRun(folder=tmp_path))
    assert path == tmp_path / "depth-image.safetensors"
    assert "held_out/occluded_0/regressed_median" in read_metrics(tmp_path)[-1]
    card = path.with_suffix(".md").read_text()
    for said in (
        "- **Objects**: bracket (268 mm)\n",
        "- **Trained on**: synthetic views of bracket\n",
        "- **Licence**: MIT\n",
        "- **Terms**: For research alone.\n",
        "`depthpose pose train --what depth-image --config config.yaml --out ",
        "- **Time**: 2 steps in ",
        "| occluded % | right % | ",
    ):
        assert said in card
    weights = read_pose_weights(path)
    with pytest.warns(LicenceNotice, match="For research alone"):
        warn_of_terms(weights.facts)
    regressor = DepthImageRegressor(weights)
    view = SyntheticViews([bracket()], VIEWS).view(0).input
    found, refused = regressor.estimate_many(
        [view, dataclasses.replace(view, mask=view.mask & False)]
    )
    assert found.is_ok
    assert set(found.seconds) == {"network", "icp"}
    assert (refused.status, refused.is_ok) == ("too few points", False)
    cloud = CloudInput(name="c", points_m=torch.rand(50, 3), object="bracket")
    cropped = dataclasses.replace(view, mask=view.mask[:9])
    found = regressor.estimate_many([dataclasses.replace(view, object="cup"), cloud, cropped])
    assert [one.status for one in found] == ["unreadable"] * 3
    assert "'cup': the weights do not know it" in found[0].reason
    assert "takes a depth image with a mask" in found[1].reason
    assert "give the mask of this very image" in found[2].reason
    with pytest.raises(InputError, match="takes a depth image with a mask"):
        regressor.estimate(cloud=cloud.points_m, object="bracket")


def test_weights_of_the_other_kind_are_refused_with_the_class_to_take(
    models_folder: Path, tmp_path: Path
) -> None:
    votes = STAGES["pointnet"][1](
        pointnet_config(models_folder), TrainingRun(folder=tmp_path / "p")
    )
    depth = STAGES["depth-image"][1](
        depth_image_config(models_folder), TrainingRun(folder=tmp_path / "d")
    )
    with pytest.raises(InputError, match="to DepthImageRegressor"):
        GeoPoseNet.load(depth)
    with pytest.raises(InputError, match="load them as GeoPoseNet"):
        DepthImageRegressor(read_pose_weights(votes))
    other = dataclasses.replace(depth_image_config(models_folder), start=str(votes))
    with pytest.raises(InputError, match="Give weights of that network"):
        STAGES["depth-image"][1](other, TrainingRun(folder=tmp_path / "o"))


def test_the_loss_of_a_depth_image_falls(models_folder: Path, tmp_path: Path) -> None:
    config = dataclasses.replace(
        depth_image_config(models_folder),
        loop=LoopConfig(steps=40, batch_size=4, device="cpu", log_every_steps=10),
        adam=AdamConfig(learning_rate=3e-3),
    )
    STAGES["depth-image"][1](config, TrainingRun(folder=tmp_path))
    losses = [row["network/loss"] for row in read_metrics(tmp_path) if "network/loss" in row]
    assert losses[-1] < 0.85 * losses[0]


def test_crops_carry_the_truth_of_their_view() -> None:
    config = DepthImageTraining(objects=VIEWS, network=DepthImageConfig(crop_px=32))
    crops = TrainingCrops([bracket(), bottle()], config, 0)
    sample, view = crops[3], SyntheticViews([bracket(), bottle()], VIEWS).view(3)
    assert int(sample.class_of) == 1
    torch.testing.assert_close(sample.R, view.truth.camera_from_model.R.float())
    assert len(crops) == 8


def test_points_and_copies_have_one_shape_for_all_objects() -> None:
    models = [bracket(), bottle()]
    sparse = dataclasses.replace(models[1], faces=models[1].faces[:0])
    network = DepthImageConfig(classes=2, widths=(8, 8, 8, 8))
    config = DepthImageTraining(network=network, surface_points=2000)
    task = DepthImageTask(DepthImageNet(network), (models[0], sparse), config)
    assert len(sparse.vertices_m) < 2000
    assert task._points_m.shape == (2, 2000, 3)
    copies = stack_symmetries(models, 0.2).float()
    assert copies.R.shape[:2] == (2, 16)
    assert bool((copies.R[0] == torch.eye(3)).all())
    around = copies.apply(models[1].vertices_m.expand(2, 16, -1, -1))[1]
    reach_m = around[..., :2].norm(dim=-1)
    torch.testing.assert_close(reach_m, reach_m[:1].expand_as(reach_m))


# images


def colored_frame(number: int, size: tuple[int, int] = (48, 64)) -> BopFrame:
    """A red box of object 7 and a green one of object 3 on noise."""
    generator = torch.Generator().manual_seed(number)
    rgb = 0.3 * torch.rand(3, *size, generator=generator)
    masks = torch.zeros(2, *size, dtype=torch.bool)
    for k in (0, 1):
        top, left = (int(torch.randint(14, (), generator=generator)) for _ in range(2))
        masks[k, top : top + 30, left + 30 * k : left + 30 * k + 18] = True
        rgb[k][masks[k]] += 0.6
    pose = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 1.0]))
    objects = [
        BopObject(number=n, camera_from_model=pose, visible=m, silhouette=m)
        for n, m in zip((7, 3), masks, strict=True)
    ]
    K = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    depth_m = torch.ones(size)
    return BopFrame(number=number, K=K, depth_m=depth_m, objects=objects, rgb=rgb)


@pytest.fixture(scope="module")
def colored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("colored")
    other = dataclasses.replace(bottle(), number=3)
    write_bop_models(folder, [bracket(), other])
    write_bop_scene(folder, "train", 1, [colored_frame(k) for k in range(6)])
    write_bop_scene(folder, "test", 1, [colored_frame(k) for k in range(6, 8)])
    return folder


def test_labels_are_the_classes_of_the_masks(colored: Path) -> None:
    images = AnnotatedImages(ImagesConfig(folder=str(colored)))
    assert images.objects == {3: "bottle", 7: "bracket"}
    for _ in range(2):  # read, then out of memory
        image, labels = images[2]
        red, green = (o.visible for o in colored_frame(2).objects)
        assert torch.equal(labels == 1, green)
        assert torch.equal(labels == 2, red & ~green)
        assert float(image[0][labels == 2].mean()) > 0.5
    only = AnnotatedImages(ImagesConfig(folder=str(colored), objects=(7,)))
    assert (len(only), tuple(only.objects.values()), only[0].labels.unique().tolist()) == (
        6, ("bracket",), [0, 1],
    )  # fmt: skip


def test_images_without_what_is_asked_are_refused(colored: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="name a folder in BOP's layout"):
        AnnotatedImages(ImagesConfig())
    with pytest.raises(InputError, match=r"none of the objects \[5\]; it has \[3, 7\]"):
        AnnotatedImages(ImagesConfig(folder=str(colored), objects=(5,)))
    write_bop_models(tmp_path, [bracket()])
    write_bop_scene(tmp_path, "train", 1, [dataclasses.replace(colored_frame(0), rgb=None)])
    with pytest.raises(InputError, match="'train' has no picture"):
        AnnotatedImages(ImagesConfig(folder=str(tmp_path)))


def test_a_picture_of_another_size_than_its_mask_is_refused(colored: Path, tmp_path: Path) -> None:
    write_bop_models(tmp_path, [bracket(), dataclasses.replace(bottle(), number=3)])
    scene = write_bop_scene(tmp_path, "train", 1, [colored_frame(0)])
    write_image(scene / "rgb" / "000000.png", torch.zeros(3, 24, 32))
    with pytest.raises(InputError, match="the mask is 64x48, but the picture 32x24"):
        AnnotatedImages(ImagesConfig(folder=str(tmp_path)))[0]


@pytest.mark.parametrize("scale", [0.5, 1.0, 1.7])
def test_a_window_keeps_image_and_labels_together(scale: float) -> None:
    """The image shows its own labels: after the cut it still does."""
    labels = F.interpolate(
        torch.randint(3, (1, 1, 6, 8), generator=torch.Generator().manual_seed(0)).float(),
        (120, 160),
    )[0, 0].long()
    image = torch.stack([(labels == k).float() for k in range(3)])
    for seed in range(5):
        generator = torch.Generator().manual_seed(seed)
        cut = cut_window(LabelledImage(image, labels), scale, (64, 96), generator)
        assert cut.image.shape == (3, 64, 96)
        rows, columns = round(120 * scale), round(160 * scale)  # a small image is filled up
        right = (cut.image.argmax(0) == cut.labels)[:rows, :columns]
        assert float(right.float().mean()) > 0.97


def segmentation_config(folder: Path, steps: int) -> SegmentationTraining:
    return SegmentationTraining(
        images=ImagesConfig(folder=str(folder)),
        held_out=ImagesConfig(folder=str(folder), split="test"),
        network=SegmentationConfig(widths=(8, 8, 16, 16), long_side_px=64),
        augment=ImageAugmentConfig(crop_px=(64, 64), scale=(0.9, 1.1), jitter=0.1),
        adam=AdamConfig(learning_rate=1e-2),
        loop=LoopConfig(steps=steps, batch_size=4, device="cpu", log_every_steps=5),
    )


def test_segmentation_learns_colored_boxes_and_says_where(colored: Path, tmp_path: Path) -> None:
    config = segmentation_config(colored, 60)
    path = STAGES["segmentation"][1](config, TrainingRun(folder=tmp_path / "whole"))
    last = read_metrics(tmp_path / "whole")[-1]
    assert last["held_out/iou_objects"] > 0.5
    image = colored_frame(7).rgb
    assert image is not None
    found = Segmenter.load(path).segment(image)
    assert set(found.masks) <= {"bottle", "bracket"}
    assert (tmp_path / "whole/pictures/0000060_found_truth.png").is_file()
    card = path.with_suffix(".md").read_text()
    for said in (
        "- **Objects**: bottle, bracket\n",
        f"- **Trained on**: {colored.name}\n",
        "- **Licence**: not stated; that of the training data binds\n",
        "`depthpose pose train --what segmentation --config config.yaml --out whole`",
        "- **Time**: 60 steps in ",
        f"| iou_objects | {last['held_out/iou_objects']:.4g} |",
    ):
        assert said in card
    assert "Terms" not in card
    settings = json.loads((tmp_path / "whole/run.json").read_text())
    assert settings["settings"]["stage"] == "SegmentationTraining"


def test_segmentation_starts_from_an_encoder(colored: Path, tmp_path: Path) -> None:
    torch.manual_seed(1)
    encoder = ResNet18(widths=(8, 8, 16, 16))
    path = tmp_path / "encoder.safetensors"
    facts = {"terms": "For research alone."}
    state = encoder.state_dict()
    save_checkpoint(path, Checkpoint(kind="resnet18", config={}, state=state, facts=facts))
    config = dataclasses.replace(
        segmentation_config(colored, 1), start=str(path), adam=AdamConfig(learning_rate=1e-9)
    )
    with pytest.warns(LicenceNotice, match="For research alone"):
        trained = STAGES["segmentation"][1](config, TrainingRun(folder=tmp_path / "run"))
    assert "- **Began with**: encoder\n- **Terms**: For research alone.\n" in (
        trained.with_suffix(".md").read_text()
    )
    with pytest.warns(LicenceNotice, match="For research alone"):
        kept = Segmenter.load(trained).weights.network.encoder.state_dict()
    name = "layer3.0.conv1.weight"
    torch.testing.assert_close(kept[name], encoder.state_dict()[name])


@pytest.mark.parametrize("what", ["pointnet", "depth-image", "segmentation"])
def test_a_resumed_training_ends_as_one_that_nothing_stopped(
    what: str, models_folder: Path, colored: Path, tmp_path: Path
) -> None:
    config = {
        "pointnet": lambda: pointnet_config(models_folder),
        "depth-image": lambda: depth_image_config(models_folder),
        "segmentation": lambda: segmentation_config(colored, 3),
    }[what]()
    loop = LoopConfig(steps=3, batch_size=2, device="cpu", log_every_steps=1, save_every_steps=1)
    config, train = dataclasses.replace(config, loop=loop), STAGES[what][1]
    whole = train(config, TrainingRun(folder=tmp_path / "whole"))
    with pytest.raises(StoppedError):
        train(config, TrainingRun(folder=tmp_path / "cut", on_step=stop_after(2)))
    cut = train(config, TrainingRun(folder=tmp_path / "cut", resume=True))
    one, other = (read_checkpoint(path).state for path in (whole, cut))
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_training_images_are_the_same_for_the_same_index(colored: Path) -> None:
    config = segmentation_config(colored, 1)
    images = AnnotatedImages(config.images)
    samples = TrainingImages(images, config.augment, config.network.long_side_px, 3)
    again = TrainingImages(images, config.augment, config.network.long_side_px, 3)
    assert torch.equal(samples[11].image, again[11].image)
    assert torch.equal(samples[11].labels, again[11].labels)
    assert not torch.equal(samples[11].image, samples[12].image)


def test_colors_change_within_their_bounds_and_nothing_else_does(colored: Path) -> None:
    config = segmentation_config(colored, 1)
    images, side_px = AnnotatedImages(config.images), config.network.long_side_px
    plain, changed = (
        TrainingImages(images, dataclasses.replace(config.augment, jitter=jitter), side_px, 3)[11]
        for jitter in (0.0, 0.3)
    )
    given, generator = images[shuffle_index(11, len(images), 3)], make_sample_generator(11, 3)
    scale = side_px / max(given.image.shape[-2:]) * uniform(generator, *config.augment.scale)
    cut = cut_window(given, scale, config.augment.crop_px, generator)
    torch.testing.assert_close(plain.image, cut.image)
    assert torch.equal(plain.labels, changed.labels)
    assert not torch.equal(plain.image, changed.image)
    assert 0 <= float(changed.image.min()) <= float(changed.image.max()) <= 1


def test_a_crop_that_the_network_cannot_halve_is_refused() -> None:
    with pytest.raises(InputError, match="multiples of 32"):
        ImageAugmentConfig(crop_px=(100, 64))
