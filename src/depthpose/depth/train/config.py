"""Knobs of the three stages; the defaults are the thesis's schedules (2.4.2, 2.5.3)."""

from dataclasses import dataclass, field
from typing import Literal

from depthpose.core.loop import AdamConfig, LoopConfig
from depthpose.depth.config import GeneratorConfig, PairsConfig, PSMNetConfig


@dataclass(frozen=True, kw_only=True)
class ViewTraining:
    """Stage 1: the generator learns to draw right views (thesis, 2.4.2)."""

    generator: GeneratorConfig = field(default_factory=GeneratorConfig)
    """The network that is trained."""

    discriminator: Literal["patch", "pixel", "none"] = "patch"
    """Who judges it; none: L1 alone."""

    discriminator_width: int = 64
    """Channels of the discriminator's first layer."""

    gan_mode: Literal["vanilla", "lsgan"] = "vanilla"
    """Cross entropy on logits, or least squares."""

    l1_weight: float = 100.0
    """Weight of L1 against the adversarial loss."""

    start: str | None = None
    """Weights to begin with (generator, or a whole set)."""

    generator_adam: AdamConfig = field(
        default_factory=lambda: AdamConfig(beta1=0.5, schedule="constant-linear")
    )
    """The generator's optimiser."""

    discriminator_adam: AdamConfig = field(
        default_factory=lambda: AdamConfig(beta1=0.5, schedule="constant-linear")
    )
    """The discriminator's optimiser."""

    pairs: PairsConfig = field(default_factory=PairsConfig)
    """Training pairs; their truth is not looked at."""

    held_out: PairsConfig | None = None
    """Pairs that validation looks at."""

    loop: LoopConfig = field(default_factory=lambda: LoopConfig(epochs=200.0))
    """How long."""


@dataclass(frozen=True, kw_only=True)
class StereoTraining:
    """Stage 2: the matcher learns disparity from pairs with truth (thesis, 2.4.2)."""

    matcher: PSMNetConfig = field(default_factory=PSMNetConfig)
    """The network that is trained."""

    start: str | None = None
    """Weights to begin with (PSMNet, or a whole set)."""

    adam: AdamConfig = field(default_factory=lambda: AdamConfig(schedule="halving"))
    """The optimiser: 1e-4, halved every quarter of the training."""

    pairs: PairsConfig = field(default_factory=PairsConfig)
    """Training pairs, with disparity or depth."""

    held_out: PairsConfig | None = None
    """Pairs that validation looks at."""

    loop: LoopConfig = field(default_factory=lambda: LoopConfig(epochs=20.0))
    """How long."""


@dataclass(frozen=True, kw_only=True)
class FinetuneTraining:
    """Stage 3: the generator learns depth through the frozen matcher (thesis, 2.5.3)."""

    generator: str = ""
    """Weights of the generator to begin with (or a whole set)."""

    matcher: str = ""
    """Weights of the matcher, which stays as it is (or a whole set)."""

    l1_weight: float = 0.0
    """Weight of L1 to the real right view beside the depth loss; the thesis has none."""

    adam: AdamConfig = field(default_factory=lambda: AdamConfig(beta1=0.5))
    """The generator's optimiser."""

    pairs: PairsConfig = field(default_factory=PairsConfig)
    """Training pairs, with disparity or depth."""

    held_out: PairsConfig | None = None
    """Pairs that validation looks at."""

    loop: LoopConfig = field(default_factory=lambda: LoopConfig(epochs=60.0))
    """How long."""
