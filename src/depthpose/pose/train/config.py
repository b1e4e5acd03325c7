"""Settings of the trainings."""

import dataclasses
from dataclasses import dataclass, field
from typing import Annotated

from depthpose.core.config import ASCENDING, Settings
from depthpose.core.errors import InputError, refuse_unknown
from depthpose.core.loop import AdamConfig, LoopConfig, TrainingConfig
from depthpose.core.units import Unit
from depthpose.pose.config import OCCLUSIONS, CloudConfig, MeshConfig, ObjectsConfig
from depthpose.pose.losses import POINT_LOSSES
from depthpose.pose.networks.baselines import DepthImageConfig, PointNetConfig
from depthpose.pose.networks.fcn import SegmentationConfig
from depthpose.pose.networks.resunet import ResUNetConfig


@dataclass(frozen=True, kw_only=True)
class ModelsConfig(Settings):
    """The objects that are learnt: CAD files, or models of a dataset, or parts of our own."""

    cad: tuple[str, ...] = ()
    """Model files; each object is called as its file."""

    unit: Unit | None = None
    """Unit of the numbers in the CAD files, which do not say it themselves."""

    bop: str | None = None
    """Folder of a dataset, whose models are taken in place of CAD files."""

    parts: tuple[str, ...] = ()
    """Names of synthetic parts (bracket, flange, mug, connector, spool), in place of either."""

    objects: tuple[int, ...] = ()
    """Numbers of the dataset's objects; none: all."""

    mesh: MeshConfig = MeshConfig()
    """Keypoints of each."""

    with_found_symmetries: bool = False
    """Look for symmetries of models that declare none, and count the copies as right."""

    symmetry_tolerance: Annotated[float, "(0, 1)"] = 0.02
    """How far, in diameters, a turned copy may lie off. Scans, rough and dented, take more."""

    licence: str = "not stated; that of the models binds"
    """Under which the weights may be used."""

    terms: str = ""
    """Said whenever the weights are loaded; for licences that bind the user."""


@dataclass(frozen=True, kw_only=True)
class FramesConfig(Settings):
    """Annotated real frames among the synthetic views."""

    folder: str = ""
    """Folder of a dataset in BOP's or LineMOD's layout."""

    split: str = "train"
    """Which part of it."""

    share: Annotated[float, "(0, 1]"] = 1.0
    """Share of the samples that are such frames; the others are synthetic."""

    with_roll: bool = True
    """Turn the camera of a frame about its optical axis at random: as true as the frame. Only
    clouds are turned, not the depth images of the regressing baseline."""

    def __post_init__(self) -> None:
        if not self.folder:
            raise InputError("frames has no folder; name a dataset, or leave frames out")
        super().__post_init__()


@dataclass(frozen=True, kw_only=True)
class HeldOutConfig(Settings):
    """Synthetic views of the validation; no training uses one."""

    number: Annotated[int, "[1, inf)"] = 25
    """Number of views of each object at each occlusion."""

    occlusions: Annotated[tuple[float, ...], OCCLUSIONS] = (0.0, 0.3)
    """Occluded shares of the silhouette."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.occlusions:
            raise InputError("held_out.occlusions is (); nothing would be measured; take (0, 0.3)")


@dataclass(frozen=True, kw_only=True)
class ViewsTraining(TrainingConfig):
    """What the trainings on views of known objects have in common."""

    models: ModelsConfig = ModelsConfig()
    """What is learnt."""

    objects: ObjectsConfig = ObjectsConfig()
    """Synthetic views to learn from."""

    frames: FramesConfig | None = None
    """Real frames to learn from, beside them."""

    cloud: CloudConfig = CloudConfig()
    """How a view is lifted to a cloud."""

    start: str | None = None
    """Weights to begin with; of directions, those of other objects give all but the last layer."""

    held_out: HeldOutConfig = HeldOutConfig()
    """Views of the validation."""

    with_half: bool = False
    """Write the weights in 16 bits."""

    adam: AdamConfig = AdamConfig(learning_rate=1e-3, schedule="cosine", warmup_steps=50)
    """The optimiser."""


@dataclass(frozen=True, kw_only=True)
class PoseTraining(ViewsTraining):
    """The direction network learns to point at keypoints."""

    first_alone: Annotated[int, "[0, inf)"] = 0
    """Synthetic views at the start that all show the first object. Several objects together take
    long to get beyond votes for the middle of the cloud; one alone does not, the others follow."""

    cloud: CloudConfig = CloudConfig(max_points=1000, with_shape=True)
    """Voxel size, points of a cloud, and what the network gets of each voxel."""

    network: ResUNetConfig = ResUNetConfig(
        first_kernel=5, encoder=(16, 32, 64, 128), decoder=(32, 32, 32, 64)
    )
    """The network; its classes and keypoints follow from the models."""

    loss: str = "mse"
    """Loss of the directions: mse, cosine, l1, or another of ``pose.losses.POINT_LOSSES``."""

    adam: AdamConfig = AdamConfig(learning_rate=3e-3, schedule="cosine", warmup_steps=50)
    """The optimiser."""

    loop: LoopConfig = LoopConfig(
        steps=10000, batch_size=8, clip_norm=1.0, ema_decay=0.999, save_every_steps=500
    )
    """How long."""

    def __post_init__(self) -> None:
        refuse_unknown("loss", self.loss, POINT_LOSSES)
        super().__post_init__()


def configure_own_part(start: str) -> PoseTraining:
    """Make the settings to train one part from a trained backbone, ``start``.

    They are those of ``configs/pose/own-part.yaml``; a test in ``tests/test_cli_pose_train.py``
    compares them. The backbone learns on as it ships, with batch norm folded into its convolutions:
    with new norms, statistics of small batches would replace what it learnt (docs/experiments.md).
    The 5,300 steps take 6 to 11 minutes on two cores.
    """
    training = PoseTraining()
    return dataclasses.replace(
        training,
        start=start,
        network=dataclasses.replace(training.network, norm="none", with_bias=True),
        adam=dataclasses.replace(training.adam, learning_rate=1e-3),
        loop=dataclasses.replace(training.loop, steps=5300, validate_every_steps=2000, workers=1),
    )


@dataclass(frozen=True, kw_only=True)
class PointNetTraining(PoseTraining):
    """The PointNet learns to point at keypoints: data, loss and voting are those of ours."""

    network: PointNetConfig = field(  # pyright: ignore[reportIncompatibleVariableOverride]
        default_factory=PointNetConfig
    )
    """The network; its classes and keypoints follow from the models."""


@dataclass(frozen=True, kw_only=True)
class DepthImageTraining(ViewsTraining):
    """A network learns to regress the pose from the masked depth image."""

    network: DepthImageConfig = DepthImageConfig()
    """The network; its classes follow from the models."""

    surface_points: Annotated[int, "[3, inf)"] = 500
    """Points of the model whose distances are the loss."""

    loop: LoopConfig = LoopConfig(
        steps=10000, batch_size=16, clip_norm=1.0, ema_decay=0.999, save_every_steps=500
    )
    """How long."""


@dataclass(frozen=True, kw_only=True)
class ImagesConfig:
    """Annotated images of a folder in BOP's or LineMOD's layout."""

    folder: str = ""
    """Folder of the dataset."""

    split: str = "train"
    """Which part of it."""

    objects: tuple[int, ...] = ()
    """Numbers of the objects to find; none: all that occur."""

    with_cache: bool = True
    """Keep images in memory after the first reading."""


@dataclass(frozen=True, kw_only=True)
class ImageAugmentConfig(Settings):
    """Random changes of an image and its masks."""

    crop_px: tuple[int, int] = (384, 512)
    """Rows and columns that are seen of an image at the network's size; multiples of 32."""

    scale: Annotated[tuple[float, float], "(0, 10]", ASCENDING] = (0.75, 1.5)
    """Times the network's own size."""

    jitter: Annotated[float, "[0, 1)"] = 0.3
    """Brightness, contrast and saturation change by up to this share, each color by a third of
    it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(side < 32 or side % 32 for side in self.crop_px):
            raise InputError(
                f"crop_px is {self.crop_px}, but the coarsest feature is 32 pixels wide; take "
                "multiples of 32"
            )


@dataclass(frozen=True, kw_only=True)
class SegmentationTraining(TrainingConfig):
    """FCN learns the masks of known objects."""

    images: ImagesConfig = ImagesConfig()
    """What is learnt from; pixels that no mask covers are background."""

    held_out: ImagesConfig | None = None
    """Images of the validation."""

    network: SegmentationConfig = SegmentationConfig()
    """The network."""

    start: str | None = None
    """An encoder to begin with, as ``weights import resnet18`` leaves it; None: random numbers."""

    augment: ImageAugmentConfig = ImageAugmentConfig()
    """Random changes."""

    object_weight: Annotated[float, "(0, inf)"] = 3.0
    """Weight of a pixel of an object in the loss; one of the background has 1."""

    adam: AdamConfig = AdamConfig(learning_rate=1e-3, schedule="cosine", warmup_steps=20)
    """The optimiser."""

    loop: LoopConfig = LoopConfig(steps=2000, batch_size=4, clip_norm=1.0, save_every_steps=200)
    """How long."""

    with_half: bool = False
    """Write the weights in 16 bits."""
