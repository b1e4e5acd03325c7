"""Batch norm folded into the convolution before it, and put in again to learn on."""

import dataclasses
from collections.abc import Callable

import torch

from depthpose.pose.network.resunet import ConvNorm, ResUNet
from depthpose.pose.sparse import Voxels


@torch.no_grad()
def fold_norms(network: ResUNet) -> ResUNet:
    """Give a norm-free network, in eval mode, that answers what ``network.eval()`` answers.

    In eval mode batch norm is ``(x - mean) * scale + shift`` with constant numbers, and a
    convolution before it absorbs them: ``weight * scale``, ``shift + (bias - mean) * scale``.
    """
    if network.config.norm == "none":
        return network
    config = dataclasses.replace(network.config, norm="none", with_bias=True)
    folded = ResUNet(config).to(next(network.parameters()))
    norms = {name for name, module in network.named_modules() if isinstance(module, ConvNorm)}
    mine, theirs = dict(network.named_modules()), dict(folded.named_modules())
    others = {k: v for k, v in network.state_dict().items() if k.startswith(("final.", "mix."))}
    folded.load_state_dict(others, strict=False)
    for name in norms:
        _fold(mine[name], theirs[name])  # pyright: ignore[reportArgumentType]
    return folded.eval()


def _fold(source: ConvNorm, target: ConvNorm) -> None:
    norm, into = source.norm, target.conv.bias
    assert norm is not None and norm.running_var is not None and norm.running_mean is not None  # noqa: PT018
    assert into is not None
    scale = norm.weight * (norm.running_var + norm.eps).rsqrt()
    bias = 0.0 if source.conv.bias is None else source.conv.bias
    target.conv.weight.copy_(source.conv.weight * scale)
    into.copy_(norm.bias + (bias - norm.running_mean) * scale)


@torch.no_grad()
def unfold_norms(folded: ResUNet, network: ResUNet, voxels: Voxels) -> None:
    """Give a network with batch norm the weights of one without, so that it can learn on.

    The statistics that folding took are lost; those of ``voxels`` replace them. On these the
    network answers in training and in eval mode what ``folded`` does.

    Args:
        folded: without norms.
        network: of the same widths, with batch norm; if it has other classes, its last layer stays.
        voxels: clouds like those to come.
    """
    theirs, mine = dict(folded.named_modules()), dict(network.named_modules())
    seen: dict[str, torch.Tensor] = {}

    def see(name: str) -> Callable[[torch.nn.Module, object, Voxels], None]:
        return lambda _module, _inputs, out: seen.update({name: out.features})

    norms = [name for name, module in theirs.items() if isinstance(module, ConvNorm)]
    hooks = [theirs[name].register_forward_hook(see(name)) for name in norms]
    folded.eval()(voxels)
    for hook in hooks:
        hook.remove()
    for name in norms:
        _unfold(theirs[name], mine[name], seen[name])  # pyright: ignore[reportArgumentType]
    parts = ("mix.", "final.") if folded.config.outputs == network.config.outputs else ("mix.",)
    others = {k: v for k, v in folded.state_dict().items() if k.startswith(parts)}
    known = network.state_dict()
    network.load_state_dict({k: v for k, v in others.items() if k in known}, strict=False)


def _unfold(source: ConvNorm, target: ConvNorm, outputs: torch.Tensor) -> None:
    norm, bias = target.norm, source.conv.bias
    assert norm is not None and norm.running_var is not None and norm.running_mean is not None  # noqa: PT018
    assert bias is not None
    variance, mean = torch.var_mean(outputs, 0, correction=0)
    target.conv.weight.copy_(source.conv.weight)
    own = 0.0 if target.conv.bias is None else target.conv.bias
    norm.running_mean.copy_(mean - bias + own)
    norm.running_var.copy_(variance)
    norm.weight.copy_((variance + norm.eps).sqrt())
    norm.bias.copy_(mean)
