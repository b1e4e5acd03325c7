"""Generators that select, untrained: one that is sure of one class, one that says all kinds."""

import dataclasses

import torch
import torch.nn.functional as F
from torch import nn

from depthpose.depth.config import Answer, SelectionConfig
from depthpose.depth.generators import SelectionGenerator

FOCAL_PX, BASELINE_M = 120.0, 0.5
CONFIG = SelectionConfig(
    encoder_width=0.1,
    widths=(4, 4, 4, 4),
    planes=4,
    disparity_px=(1.0, 8.0),
    virtual_focal_px=FOCAL_PX,
    virtual_baseline_m=BASELINE_M,
)


def sure_of(plane: int, answer: Answer = "own") -> SelectionGenerator:
    """A network that says the same class of each pixel of both views: 0 is the sky, k a plane."""
    network = SelectionGenerator(dataclasses.replace(CONFIG, answer=answer)).eval()
    torch.nn.init.zeros_(network.head.weight)
    network.head.bias = nn.Parameter(20.0 * F.one_hot(torch.tensor(plane), 5).repeat(2))
    return network


@torch.no_grad()
def of_all_kinds(answer: Answer = "own") -> SelectionGenerator:
    """A network that says sky of a part of smooth noise, and all disparities of the rest."""
    torch.manual_seed(0)
    network = SelectionGenerator(dataclasses.replace(CONFIG, answer=answer)).train()
    image = F.interpolate(torch.rand(2, 3, 16, 24), (96, 160), mode="bicubic").clamp(0, 1)
    for norm in (part for part in network.modules() if isinstance(part, nn.BatchNorm2d)):
        norm.momentum = 0.5
    for _ in range(8):  # batch norm learns its statistics
        network(image)
    network.eval()
    network.head.weight.mul_(20)
    bias = network.head.bias
    assert bias is not None
    bias.sub_(torch.cat(network(image), 1).mean((0, 2, 3)))
    bias[[0, CONFIG.planes + 1]] += 1.5
    return network
