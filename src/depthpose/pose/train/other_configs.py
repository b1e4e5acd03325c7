"""Settings of the trainings of the baselines and of segmentation."""

from dataclasses import dataclass, field

from depthpose.core.config import check_settings
from depthpose.core.errors import InputError
from depthpose.core.loop import AdamConfig, LoopConfig
from depthpose.pose.baselines.config import DepthImageConfig, PointNetConfig
from depthpose.pose.config import CloudConfig, ObjectsConfig
from depthpose.pose.segmentation import SegmentationConfig
from depthpose.pose.train.config import (
    FramesConfig,
    HeldOutConfig,
    ModelsConfig,
    PoseTraining,
)


@dataclass(frozen=True, kw_only=True)
class PointNetTraining(PoseTraining):
    """The PointNet learns to point at keypoints: data, loss and voting are those of ours."""

    network: PointNetConfig = field(  # pyright: ignore[reportIncompatibleVariableOverride]
        default_factory=PointNetConfig
    )
    """The network; its classes and keypoints follow from the models."""


@dataclass(frozen=True, kw_only=True)
class DepthImageTraining:
    """A network learns to regress the pose from the masked depth image."""

    models: ModelsConfig = field(default_factory=ModelsConfig)
    """What is learnt."""

    objects: ObjectsConfig = field(default_factory=ObjectsConfig)
    """Synthetic views to learn from."""

    frames: FramesConfig | None = None
    """Real frames to learn from, beside them."""

    cloud: CloudConfig = field(default_factory=CloudConfig)
    """How a view is lifted for the refinement that may follow."""

    network: DepthImageConfig = field(default_factory=DepthImageConfig)
    """The network; its classes follow from the models."""

    start: str | None = None
    """Weights to begin with."""

    surface_points: int = 500
    """Points of the model whose distances are the loss."""

    adam: AdamConfig = field(
        default_factory=lambda: AdamConfig(learning_rate=1e-3, schedule="cosine", warmup_steps=50)
    )
    """The optimiser."""

    held_out: HeldOutConfig = field(default_factory=HeldOutConfig)
    """Views of the validation."""

    loop: LoopConfig = field(
        default_factory=lambda: LoopConfig(
            steps=10000, batch_size=16, clip_norm=1.0, ema_decay=0.999, save_every_steps=500
        )
    )
    """How long."""

    with_half: bool = False
    """Write the weights in 16 bits."""

    def __post_init__(self) -> None:
        """Refuse a loss of nothing."""
        check_settings(self, surface_points="[3, inf)")


@dataclass(frozen=True, kw_only=True)
class ImagesConfig:
    """Annotated images of a folder in BOP's or LineMOD's layout."""

    folder: str = ""
    """Of the data set."""

    split: str = "train"
    """Which part of it."""

    objects: tuple[int, ...] = ()
    """Numbers of the objects to find; none: all that occur."""

    limit: int | None = None
    """At most so many images, evenly taken; None: all."""

    with_cache: bool = True
    """Keep images in memory after the first reading."""


@dataclass(frozen=True, kw_only=True)
class ImageAugmentConfig:
    """Random changes of an image and its masks."""

    crop_px: tuple[int, int] = (384, 512)
    """Rows and columns that are seen of an image at the network's size; multiples of 32."""

    scale: tuple[float, float] = (0.75, 1.5)
    """Times the network's own size."""

    flip_share: float = 0.0
    """Share of mirrored images. A mirrored object is another object, unless it is mirror-symmetric;
    for segmentation alone it is one more appearance."""

    jitter: float = 0.3
    """Brightness, contrast and saturation change by up to this share, each color by a third of
    it."""

    def __post_init__(self) -> None:
        """Refuse windows and ranges that cannot be."""
        check_settings(self, scale="(0, 10]", flip_share="[0, 1]", jitter="[0, 1)")
        if any(side < 32 or side % 32 for side in self.crop_px):
            raise InputError(
                f"crop_px is {self.crop_px}, but the coarsest feature is 32 pixels wide; take "
                "multiples of 32"
            )
        if self.scale[0] > self.scale[1]:
            raise InputError(f"scale must be a range, the lower end first, got {self.scale}")


@dataclass(frozen=True, kw_only=True)
class SegmentationTraining:
    """FCN learns the masks of known objects."""

    images: ImagesConfig = field(default_factory=ImagesConfig)
    """What is learnt from; pixels that no mask covers are background."""

    held_out: ImagesConfig | None = None
    """Images of the validation."""

    network: SegmentationConfig = field(default_factory=SegmentationConfig)
    """The network."""

    start: str | None = None
    """An encoder to begin with, as ``weights import resnet18`` leaves it; None: random numbers."""

    augment: ImageAugmentConfig = field(default_factory=ImageAugmentConfig)
    """Random changes."""

    object_weight: float = 3.0
    """A pixel of an object counts so many times a pixel of the background."""

    adam: AdamConfig = field(
        default_factory=lambda: AdamConfig(learning_rate=1e-3, schedule="cosine", warmup_steps=20)
    )
    """The optimiser."""

    loop: LoopConfig = field(
        default_factory=lambda: LoopConfig(
            steps=2000, batch_size=4, clip_norm=1.0, save_every_steps=200
        )
    )
    """How long."""

    with_half: bool = False
    """Write the weights in 16 bits."""

    def __post_init__(self) -> None:
        """Refuse a loss that ignores the objects."""
        check_settings(self, object_weight="(0, inf)")
