"""Batch norm folded into the convolution before it: the same network, without norms."""

import dataclasses

import torch

from depthpose.pose.network.resunet import ConvNorm, ResUNet


@torch.no_grad()
def fold_norms(network: ResUNet) -> ResUNet:
    """Give a norm-free network, in eval mode, that answers what ``network.eval()`` answers.

    In eval mode batch norm is ``(x - mean) * scale + shift`` with numbers that stand still, and a
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
