"""Settings of the stages; the defaults of the thesis's three are its schedules (2.4.2, 2.5.3)."""

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

from depthpose.core.config import config_from_dict, config_to_dict
from depthpose.core.errors import InputError, refuse_unknown
from depthpose.core.loop import AdamConfig, LoopConfig, TrainingConfig
from depthpose.depth.config import (
    DegradeConfig,
    GeneratorConfig,
    PairsConfig,
    SelectionConfig,
)
from depthpose.depth.losses import ADVERSARIAL_LOSSES
from depthpose.depth.weights import MATCHERS


@dataclass(frozen=True, kw_only=True)
class ViewTraining(TrainingConfig):
    """Stage 1: the generator learns to draw right views (thesis, 2.4.2)."""

    generator: GeneratorConfig = field(default_factory=GeneratorConfig)
    """The network that is trained."""

    discriminator: Literal["patch", "pixel", "none"] = "patch"
    """Scores patches or single pixels; none: L1 alone."""

    discriminator_width: Annotated[int, "[1, inf)"] = 64
    """Channels of the discriminator's first layer."""

    gan_mode: str = "vanilla"
    """vanilla: cross entropy on logits; lsgan: least squares; see ``losses.ADVERSARIAL_LOSSES``."""

    l1_weight: Annotated[float, "[0, inf)"] = 100.0
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
    """Training pairs; their truth is not used."""

    held_out: PairsConfig | None = None
    """Pairs for validation."""

    loop: LoopConfig = field(default_factory=lambda: LoopConfig(epochs=200.0))
    """Length, batches, seed and precision of the training."""

    def __post_init__(self) -> None:
        refuse_unknown("gan_mode", self.gan_mode, ADVERSARIAL_LOSSES)
        super().__post_init__()


@dataclass(frozen=True, kw_only=True)
class EncoderTraining(TrainingConfig):
    """What the trainings have whose network may begin with an encoder of ImageNet."""

    WEIGHTS_SETTINGS: ClassVar[tuple[str, ...]] = ("start", "encoder")

    start: str | None = None
    """Weights of the whole network to begin with (or a whole set)."""

    encoder: str | None = None
    """Weights of the encoder to begin with ('depthpose weights import efficientnet-lite0'); of
    matchers only the light one has an encoder."""

    with_frozen_stem: bool = True
    """Keep the encoder's first layers and its batch norm statistics: right for ImageNet's weights,
    wrong for an encoder that begins at random."""

    encoder_rate: Annotated[float, "[0, 1]"] = 0.3
    """Learning rate of the encoder as a share of the rest's."""

    def refuse_frozen_random(self) -> None:
        """Refuse to freeze the first layers of an encoder that begins with random weights.

        Raises:
            InputError: ``with_frozen_stem`` is set, and neither ``encoder`` nor ``start``.
        """
        if self.with_frozen_stem and self.encoder is None and self.start is None:
            raise InputError(
                "with_frozen_stem keeps the encoder's first layers as they are, and nothing says "
                "what they begin with: give --encoder ('depthpose weights import "
                "efficientnet-lite0'), --start, or with_frozen_stem: false with encoder_rate: 1.0."
            )


@dataclass(frozen=True, kw_only=True)
class SelectTraining(EncoderTraining):
    """Stage 1 of the generator that selects, in place of :class:`ViewTraining`."""

    generator: SelectionConfig = field(default_factory=SelectionConfig)
    """The network that is trained."""

    plane_weight: Annotated[float, "[0, inf)"] = 0.2
    """Weight of the cross entropy over sky and disparities."""

    right_share: Annotated[float, "[0, inf)"] = 0.5
    """Weight of the right view's disparity against the left one's."""

    view_weight: Annotated[float, "[0, inf)"] = 1.0
    """Weight of the drawn right view, where there is a real one."""

    adam: AdamConfig = field(
        default_factory=lambda: AdamConfig(
            learning_rate=1e-3, schedule="cosine", warmup_steps=100, weight_decay=1e-2
        )
    )
    """The optimiser."""

    pairs: PairsConfig = field(default_factory=PairsConfig)
    """Training pairs; frames without truth or without a right view teach what they can."""

    more: PairsConfig | None = None
    """Other pairs to mix in, e.g. real ones beside synthetic ones."""

    more_share: Annotated[float, "[0, 1]"] = 0.5
    """Share of the samples that come from ``more``."""

    degrade: DegradeConfig = field(default_factory=DegradeConfig)
    """Changes of the input image alone."""

    style_share: Annotated[float, "[0, 1]"] = 0.0
    """Share of the early features of the encoder, batch by batch, that get other styles: half helps
    where synthetic images train for real ones (:class:`~depthpose.depth.encoder.MixedStyle`)."""

    held_out: PairsConfig | None = None
    """Pairs for validation."""

    loop: LoopConfig = field(
        default_factory=lambda: LoopConfig(steps=20_000, batch_size=8, clip_norm=5.0)
    )
    """Length, batches, seed and precision of the training."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for pairs in (self.pairs, self.more):
            if pairs is None:
                continue
            augment = pairs.augment
            if augment.per_view or augment.erased_share or augment.misaligned_px:
                raise InputError(
                    "pairs.augment changes each view on its own (per_view, erased_share or "
                    "misaligned_px), and this training compares them; omit these"
                )


@dataclass(frozen=True, kw_only=True)
class StereoTraining(EncoderTraining):
    """Stage 2: the matcher learns disparity from pairs with truth (thesis, 2.4.2)."""

    kind: str = "psmnet"
    """The network that is trained, by its name in ``depth.weights.MATCHERS``: psmnet, light."""

    network: dict[str, object] = field(default_factory=dict)
    """Settings of the network, those of the config of its kind; others have their defaults, which
    are filled in. To take another kind, give both anew."""

    with_frozen_norms: bool = False
    """Keep the statistics of every batch norm, the encoder's and the rest's: right for a few steps
    of small batches from trained weights."""

    sky_weight: Annotated[float, "[0, 1]"] = 0.0
    """Weight of the sky; 0 leaves it out. It is taught a disparity of 0, each pixel with so much
    weight where another one with truth has 1; networks with a class of the sky (``with_sky``) are
    taught that class instead, and this is the weight of its cross entropy."""

    sky_alone: bool = False
    """Train the class of the sky alone: the rest of the network stays as it began."""

    adam: AdamConfig = field(default_factory=lambda: AdamConfig(schedule="halving"))
    """The optimiser: 1e-4, halved every quarter of the training."""

    pairs: PairsConfig = field(default_factory=PairsConfig)
    """Training pairs, with disparity or depth."""

    held_out: PairsConfig | None = None
    """Pairs for validation."""

    loop: LoopConfig = field(default_factory=lambda: LoopConfig(epochs=20.0))
    """Length, batches, seed and precision of the training."""

    def __post_init__(self) -> None:
        refuse_unknown("kind", self.kind, MATCHERS)
        super().__post_init__()
        # With every default, so that the config that a run writes is a full record.
        object.__setattr__(self, "network", config_to_dict(self.network_config))
        self._refuse_missing_encoder()
        self._refuse_unlearnt_sky()

    def _refuse_missing_encoder(self) -> None:
        """Refuse settings of an encoder for a network that has none."""
        # A setting counts as given where it differs from its default.
        if self.kind == "psmnet" and (self.encoder_rate != 0.3 or not self.with_frozen_stem):
            raise InputError(
                "encoder_rate and with_frozen_stem are for the encoder of the light network, which "
                "PSMNet does not have; leave them out, or give kind: light"
            )

    def _refuse_unlearnt_sky(self) -> None:
        """Refuse a class of the sky without weight, and training one that is not there."""
        has_sky = self.network_config.with_sky
        if has_sky and self.sky_weight == 0:
            raise InputError(
                "with_sky is true and sky_weight 0, so the sky would not be learnt; set sky_weight "
                "to 0.5, or leave with_sky out"
            )
        if self.sky_alone and (self.start is None or not has_sky):
            raise InputError(
                "sky_alone trains the class of the sky of a trained matcher; give start, and "
                "with_sky: true to the network"
            )

    @property
    def network_config(self) -> Any:  # noqa: ANN401  the config of its kind
        """Config of the network that is trained, a :class:`NetworkConfig` of its kind."""
        return config_from_dict(self.network, MATCHERS[self.kind].config, source="network")


@dataclass(frozen=True, kw_only=True)
class FinetuneTraining(TrainingConfig):
    """Stage 3: the generator learns depth through the frozen matcher (thesis, 2.5.3)."""

    WEIGHTS_SETTINGS: ClassVar[tuple[str, ...]] = ("generator", "matcher")

    generator: str = ""
    """Weights of the generator to begin with (or a whole set)."""

    matcher: str = ""
    """Weights of the matcher, which stays as it is (or a whole set)."""

    l1_weight: Annotated[float, "[0, inf)"] = 0.0
    """Weight of L1 to the real right view beside the depth loss; the thesis has none."""

    adam: AdamConfig = field(default_factory=lambda: AdamConfig(beta1=0.5))
    """The generator's optimiser."""

    pairs: PairsConfig = field(default_factory=PairsConfig)
    """Training pairs, with disparity or depth."""

    held_out: PairsConfig | None = None
    """Pairs for validation."""

    loop: LoopConfig = field(default_factory=lambda: LoopConfig(epochs=60.0))
    """Length, batches, seed and precision of the training."""
