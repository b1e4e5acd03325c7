"""Knobs of the trainings of the baselines: the same views, other networks."""

from dataclasses import dataclass, field

from depthpose.core.errors import InputError
from depthpose.core.loop import AdamConfig, LoopConfig
from depthpose.pose.baselines.config import DepthImageConfig, PointNetConfig
from depthpose.pose.config import CloudConfig, ObjectsConfig
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
    """Made views to learn from."""

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
    """What validation looks at."""

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
        if self.surface_points < 3:
            raise InputError(
                f"surface_points is {self.surface_points}, but 3 points fix a pose; take 500"
            )
