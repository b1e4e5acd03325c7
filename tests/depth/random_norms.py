"""Networks of matchers, untrained, whose batch norms do something."""

from typing import TypeVar

from torch import nn

NetworkT = TypeVar("NetworkT", bound=nn.Module)


def with_random_norms(network: NetworkT) -> NetworkT:
    """Give each batch norm random statistics and weights; eval mode."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d | nn.BatchNorm3d):
            assert module.running_mean is not None
            assert module.running_var is not None
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.5, 1.5)
            module.weight.data.uniform_(0.5, 1.2)
            module.bias.data.normal_(0, 0.1)
    return network.eval()
