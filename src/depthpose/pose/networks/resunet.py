"""The sparse ResUNet that predicts directions to keypoints."""

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.config import Settings
from depthpose.core.errors import InputError
from depthpose.pose.networks.sparse import RowNorm, SparseConv, SparseConvTranspose, Voxels
from depthpose.pose.types import VotingPoints

Widths = tuple[int, int, int, int]  #: channels of the four levels


@dataclass(frozen=True, kw_only=True)
class ResUNetConfig(Settings):
    """Size of the network (FCGF's ResUNetBN2C, Choy et al. ICCV 2019, figure 3-3 of the thesis)."""

    classes: Annotated[int, "[1, inf)"] = 13
    """Objects that one network knows; which of them a cloud is of is part of the input."""

    keypoints: Annotated[int, "[1, inf)"] = 8
    """Keypoints of each object."""

    norm: Literal["batch", "none"] = "batch"
    """batch trains within hundreds of steps and is folded for use. none is the published network,
    which hardly trains from random weights, though its residual branches are initialised smaller;
    with a trained backbone in which norms are folded it learns another part faster than batch."""

    with_bias: bool = False
    """A bias for each inner convolution, as folding batch norm leaves one."""

    first_kernel: int = 7
    """Size of the first convolution's kernel, in voxels: 1, 3, 5 or 7."""

    encoder: Annotated[Widths, "[1, inf)"] = (32, 64, 128, 256)
    """Channels of the levels going down, finest first."""

    decoder: Annotated[Widths, "[1, inf)"] = (64, 64, 64, 128)
    """Channels of the levels coming up, finest first; the first are the features of a point."""

    inputs: Annotated[int, "[1, inf)"] = 1
    """Features of a voxel that are given: the number 1 alone, or its shape too (9)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.first_kernel not in (1, 3, 5, 7):
            raise InputError(
                f"first_kernel must be 1, 3, 5 or 7 (an odd kernel has a centre), got "
                f"{self.first_kernel}; take 7"
            )


BRANCH_SCALE = 0.25
"""Without norms the second convolution of each block begins this much smaller: seven blocks in a
row then neither explode nor dominate the shortcuts (in the spirit of Fixup, Zhang 2019)."""

NORMED_SCALE = 0.3
"""With batch norm the size of a weight changes no output, only how far a step of Adam turns it:
small weights learn faster. Measured with lr 2e-3: the loss after 100 steps is 0.25, not 0.32."""

MOMENTUM = 0.05  #: of batch norm, as FCGF trains


class ConvNorm(nn.Module):
    """A sparse convolution, followed by batch norm where the config has it."""

    def __init__(
        self,
        config: ResUNetConfig,
        inputs: int,
        outputs: int,
        kernel: int = 3,
        stride: int = 1,
        kind: type[SparseConv] = SparseConv,
    ) -> None:
        super().__init__()
        self.conv = kind(inputs, outputs, kernel, stride, has_bias=config.with_bias)
        self.norm = RowNorm(outputs, momentum=MOMENTUM) if config.norm == "batch" else None
        if self.norm is not None:
            with torch.no_grad():
                self.conv.weight.mul_(NORMED_SCALE)

    def forward(self, voxels: Voxels) -> Voxels:
        """Convolve, and normalise each channel."""
        out = self.conv(voxels)
        return out if self.norm is None else out.with_features(self.norm(out.features))


class ResidualBlock(nn.Module):
    """Two convolutions beside a shortcut: ``relu(x + conv(relu(conv(x))))``."""

    def __init__(self, width: int, config: ResUNetConfig) -> None:
        super().__init__()
        self.first = ConvNorm(config, width, width)
        self.second = ConvNorm(config, width, width)
        if config.norm == "none":
            with torch.no_grad():
                self.second.conv.weight.mul_(BRANCH_SCALE)

    def forward(self, voxels: Voxels) -> Voxels:
        """Add the output of both convolutions to the input, and apply ReLU."""
        inner = self.first(voxels)
        branch = self.second(inner.with_features(F.relu(inner.features)))
        return voxels.with_features(F.relu(branch.features + voxels.features))


class ResUNet(nn.Module):
    """A network from a partial cloud to raw directions from each of its points to each keypoint.

    A U-Net of four levels with a residual block on each, down and up; the features of the way down
    are concatenated with those of the way up.
    """

    def __init__(self, config: ResUNetConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or ResUNetConfig()
        e = config.encoder
        d = config.decoder
        outputs = config.classes * config.keypoints * 3

        # Down: the finest level has the first kernel, each coarser one a stride of 2.
        self.down = nn.ModuleList([ConvNorm(config, config.inputs, e[0], config.first_kernel)])
        self.down.extend(ConvNorm(config, e[i - 1], e[i], 3, 2) for i in (1, 2, 3))
        self.down_blocks = nn.ModuleList(ResidualBlock(width, config) for width in e)

        # Up: all but the coarsest level take the features of the way down beside those below.
        inputs = {3: e[3], 2: e[2] + d[3], 1: e[1] + d[2]}
        self.up = nn.ModuleList(
            ConvNorm(config, inputs[i], d[i], 3, 2, SparseConvTranspose) for i in (3, 2, 1)
        )
        self.up_blocks = nn.ModuleList(ResidualBlock(d[i], config) for i in (3, 2, 1))

        # No norm and no neighbours: the skip of the finest level is mixed point by point.
        self.mix = SparseConv(e[0] + d[1], d[0], 1, has_bias=config.with_bias)
        self.final = SparseConv(d[0], outputs, 1, has_bias=True)
        # The outputs are components of unit vectors: they begin near 0, not twice as long.
        with torch.no_grad():
            self.final.weight.mul_(0.5)
            if config.norm == "batch":
                self.mix.weight.mul_(NORMED_SCALE)
                self.final.weight.mul_(NORMED_SCALE)

    def forward(self, voxels: Voxels) -> Float[Tensor, "points classes keypoints 3"]:
        """Compute the directions of each point to the keypoints of every class.

        They are not normalised: the loss draws them to unit length, and voting normalises them.
        """
        outputs = self.final(self.features(voxels)).at_points()
        return outputs.view(len(outputs), self.config.classes, self.config.keypoints, 3)

    def directions(self, points: VotingPoints) -> Float[Tensor, "points keypoints 3"]:
        """Compute the raw directions of each point to the keypoints of its own class.

        The networks that vote share this method.
        """
        voxels = Voxels.from_points(points.coordinates, points.features)
        features = self.features(voxels).at_points()
        directions = features.new_empty(len(features), self.config.keypoints, 3)

        # The last layer, for no other classes than those that occur.
        assert self.final.bias is not None
        channel_count = self.config.keypoints * 3
        for number in points.class_of_point.unique().tolist():
            assert 0 <= number < self.config.classes, f"class {number} of {self.config.classes}"
            is_of_class = points.class_of_point == number
            channels = slice(number * channel_count, (number + 1) * channel_count)
            weight = self.final.weight[0, :, channels]
            outputs = features[is_of_class] @ weight + self.final.bias[channels]
            outputs = outputs.view(len(outputs), self.config.keypoints, 3)
            directions[is_of_class] = outputs.to(directions)
        return directions

    def features(self, voxels: Voxels) -> Voxels:
        """Compute the input of the last layer: the features of figure 3-2 of the thesis."""
        # Down; the features of each level are kept.
        skips: list[Voxels] = []
        for down, block in zip(self.down, self.down_blocks, strict=True):
            voxels = block(down(voxels))
            skips.append(voxels)

        # Up; those of the way down are added as channels.
        voxels = skips.pop()
        for up, block in zip(self.up, self.up_blocks, strict=True):
            voxels = block(up(voxels))
            skip = skips.pop()
            voxels = voxels.with_features(torch.cat([voxels.features, skip.features], 1))
        mixed = self.mix(voxels)
        return mixed.with_features(F.relu(mixed.features))


@torch.no_grad()
def fold_norms(network: ResUNet) -> ResUNet:
    """Build a network without norms, in eval mode, with the outputs of ``network.eval()``.

    In eval mode batch norm is ``(x - mean) * scale + shift`` with constant numbers, which become
    part of the convolution before it: ``weight * scale``, ``shift + (bias - mean) * scale``. A
    network without norms is returned itself.
    """
    if network.config.norm == "none":
        return network

    # The layers that have no norm stay the same.
    config = dataclasses.replace(network.config, norm="none", with_bias=True)
    folded = ResUNet(config).to(next(network.parameters()))
    state = network.state_dict()
    unnormed = {name: state[name] for name in state if name.startswith(("final.", "mix."))}
    folded.load_state_dict(unnormed, strict=False)

    # Into all others the norm that follows them is folded.
    for name, source in network.named_modules():
        if not isinstance(source, ConvNorm):
            continue
        target = folded.get_submodule(name)
        assert isinstance(target, ConvNorm)
        norm = source.norm
        conv = target.conv
        assert norm is not None and norm.running_var is not None and norm.running_mean is not None  # noqa: PT018
        assert conv.bias is not None
        scale = norm.weight * (norm.running_var + norm.eps).rsqrt()
        bias = 0.0 if source.conv.bias is None else source.conv.bias
        conv.weight.copy_(source.conv.weight * scale)
        conv.bias.copy_(norm.bias + (bias - norm.running_mean) * scale)
    return folded.eval()


@torch.no_grad()
def unfold_norms(folded: ResUNet, network: ResUNet, voxels: Voxels) -> None:
    """Copy the weights of a network without norms into one with batch norm, for further training.

    The statistics that folding removed are replaced by those of ``voxels``, on which ``network``
    then has the outputs of ``folded``, in training and in eval mode.

    Args:
        folded: of :func:`fold_norms`.
        network: changed; if it has another number of classes its last layer stays.
        voxels: clouds like those of the training.
    """
    # The output of each convolution with a norm.
    outputs: dict[ConvNorm, Tensor] = {}

    def keep_output(module: ConvNorm, _inputs: object, out: Voxels) -> None:
        """Keep the output of a module: a forward hook of torch."""
        outputs[module] = out.features

    sources = {
        name: module for name, module in folded.named_modules() if isinstance(module, ConvNorm)
    }
    hooks = [source.register_forward_hook(keep_output) for source in sources.values()]
    folded.eval()(voxels)
    for hook in hooks:
        hook.remove()

    # Each norm gets the statistics of this output, and undoes them by its weight and bias.
    for name, source in sources.items():
        target = network.get_submodule(name)
        assert isinstance(target, ConvNorm)
        conv = target.conv
        norm = target.norm
        bias = source.conv.bias
        assert norm is not None and norm.running_var is not None and norm.running_mean is not None  # noqa: PT018
        assert bias is not None
        variance, mean = torch.var_mean(outputs[source], 0, correction=0)
        conv.weight.copy_(source.conv.weight)
        norm.running_mean.copy_(mean - bias + (0.0 if conv.bias is None else conv.bias))
        norm.running_var.copy_(variance)
        norm.weight.copy_((variance + norm.eps).sqrt())
        norm.bias.copy_(mean)

    # The layers without a norm are copied; the last only where both have the same classes.
    has_same_classes = folded.final.weight.shape == network.final.weight.shape
    layers = ("mix.", "final.") if has_same_classes else ("mix.",)
    names = network.state_dict().keys()
    state = folded.state_dict()
    unnormed = {name: state[name] for name in state if name.startswith(layers) and name in names}
    network.load_state_dict(unnormed, strict=False)
