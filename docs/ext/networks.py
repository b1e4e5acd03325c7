"""The thesis's diagrams (figures 2-2, 2-3, 2-4, 3-1, 3-3), drawn from the networks themselves.

A page says ``{network} 2-4``. Each network is built by its config of the thesis and shown one
input; every width, kernel, stride, size and count in a picture is read off its modules.
"""

from collections.abc import Callable, Mapping
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import torch
from diagrams import Arrow, Box, draw
from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx
from torch import Tensor, nn

from depthpose.core.camera import back_project
from depthpose.core.config import read_config
from depthpose.core.rigid import fit_rigid
from depthpose.depth.generators import Discriminator, UNetGenerator
from depthpose.depth.losses import disparity_loss
from depthpose.depth.stereo import PSMNet
from depthpose.depth.train.config import StereoTraining, ViewTraining
from depthpose.pose.geometry.grid import voxelise
from depthpose.pose.networks.fcn import FCN
from depthpose.pose.networks.resunet import ResUNet
from depthpose.pose.networks.sparse import Voxels
from depthpose.pose.propose import meet_lines, vote_ransac
from depthpose.pose.train import PoseTraining, SegmentationTraining
from depthpose.pose.types import VotingPoints

CONFIGS = Path(__file__).parents[2] / "configs"
Diagram = tuple[list[Box], list[Arrow]]


class DepthNetworks(NamedTuple):
    """The networks of chapter 2, and the crop that they are trained on."""

    generator: UNetGenerator
    discriminator: Discriminator
    matcher: PSMNet
    crop: tuple[int, int]


class PoseNetworks(NamedTuple):
    """The networks of chapter 3, the side of a voxel [m], width and height of an image."""

    segmentation: FCN
    network: ResUNet
    voxel_m: float
    image_px: tuple[int, int]


@cache
def depth_networks() -> DepthNetworks:
    """Build the networks of configs/depth/view.yaml and stereo.yaml, without memory for weights."""
    view = read_config(CONFIGS / "depth/view.yaml", ViewTraining)
    stereo = read_config(CONFIGS / "depth/stereo.yaml", StereoTraining)
    assert view.discriminator == "patch"
    with torch.device("meta"):
        return DepthNetworks(
            UNetGenerator(view.generator),
            Discriminator("patch", view.discriminator_width),
            PSMNet(stereo.network_config).eval(),
            view.pairs.augment.crop_px,
        )


@cache
def pose_networks() -> PoseNetworks:
    """Build the networks of configs/pose/thesis.yaml and thesis-masks.yaml."""
    pose = read_config(CONFIGS / "pose/thesis.yaml", PoseTraining)
    masks = read_config(CONFIGS / "pose/thesis-masks.yaml", SegmentationTraining)
    with torch.device("meta"):
        segmentation = FCN(len(masks.images.objects), masks.network).eval()
    network = ResUNet(pose.network).eval()
    return PoseNetworks(segmentation, network, pose.cloud.voxel_m, pose.objects.image_px)


def game(found: DepthNetworks) -> Diagram:
    """Figure 2-2: the generator against its discriminator, as stage 1 trains them."""
    image = torch.empty(1, 3, *found.crop, device="meta")
    drawn = found.generator(image)
    logits = found.discriminator(image, drawn)
    boxes = [
        Box("left", 0, 0, ["left view", _shape(image)], "data"),
        Box("G", 0, 1, [f"G: {type(found.generator).__name__}", _weights(found.generator)]),
        Box("drawn", 0, 2, ["drawn right view", _shape(drawn)], "data"),
        Box("right", 1, 2, ["or real right view", _shape(image)], "data"),
        Box("same", 2, 2, ["and left view", _shape(image)], "data"),
        Box("D", 1, 3, [f"D: {type(found.discriminator).__name__}", _weights(found.discriminator)]),
        Box("answer", 1, 4, ["real or drawn?", f"{_shape(logits)} logits", _sees(found)], "data"),
    ]
    pairs = [("left", "G"), ("G", "drawn"), ("drawn", "D"), ("right", "D"), ("same", "D"),
             ("D", "answer")]  # fmt: skip
    return boxes, [Arrow(*pair) for pair in pairs]


def pipeline(found: DepthNetworks) -> Diagram:
    """Figure 2-3: two networks that are trained apart, and put together for an answer."""
    image = torch.empty(1, 3, *found.crop, device="meta")
    disparity = found.matcher(image, image)[-1]
    view, depth = _shape(image), _shape(disparity)
    G = ["G: " + type(found.generator).__name__, _weights(found.generator)]
    D = ["D: " + type(found.discriminator).__name__, _weights(found.discriminator)]
    S = ["S: " + type(found.matcher).__name__, _weights(found.matcher)]
    boxes = [
        Box("t1", 0, 0, ["trained apart: view synthesis"], "title"),
        Box("left1", 1, 0, ["left view", view], "data"),
        Box("G1", 1, 1, G),
        Box("drawn1", 1, 2, ["drawn right view", view], "data"),
        Box("D", 1, 3, D),
        Box("right1", 2, 2, ["real right view", view], "data"),
        Box("t2", 3, 0, ["trained apart: stereo matching"], "title"),
        Box("left2", 4, 0, ["left view", view], "data"),
        Box("S2", 4, 2, S),
        Box("found2", 4, 3, ["disparity", depth], "data"),
        Box("right2", 5, 0, ["real right view", view], "data"),
        Box("lidar", 5, 3, ["LiDAR scan", disparity_loss.__name__], "data"),
        Box("t3", 6, 0, ["depth from one image"], "title"),
        Box("left3", 7, 0, ["left view", view], "data"),
        Box("G3", 8, 0, G),
        Box("drawn3", 8, 1, ["drawn right view", view], "data"),
        Box("S3", 7, 2, S),
        Box("found3", 7, 3, ["disparity", depth], "data"),
    ]
    pairs = [("left1", "G1"), ("G1", "drawn1"), ("drawn1", "D"), ("right1", "D"), ("left2", "S2"),
             ("right2", "S2"), ("S2", "found2"), ("lidar", "found2"), ("left3", "G3"),
             ("G3", "drawn3"), ("drawn3", "S3"), ("left3", "S3"), ("S3", "found3")]  # fmt: skip
    return boxes, [Arrow(*pair) for pair in pairs]


def adversaries(found: DepthNetworks) -> Diagram:
    """Figure 2-4: the U-Net and the discriminator, layer by layer; Ck has k filters."""
    image = torch.empty(1, 3, *found.crop, device="meta")
    sizes = _sizes(found.generator, image)
    down, up = found.generator.down, found.generator.up
    boxes = [Box("in", 0, 0, ["left view", _shape(image)], "data")]
    boxes += [Box(f"d{k}", k + 1, 0, _layer(m, sizes)) for k, m in enumerate(down)]
    boxes += [Box(f"u{k}", k, 1, _layer(m, sizes)) for k, m in enumerate(up)]
    boxes[len(down) + 1] = boxes[len(down) + 1]._replace(
        lines=[*_layer(up[0], sizes)[:-1], f"drawn right view {_size(sizes[up[0]])}"]
    )
    arrows = [Arrow("in", "d0"), Arrow(f"d{len(down) - 1}", f"u{len(up) - 1}")]
    arrows += [Arrow(f"d{k}", f"d{k + 1}") for k in range(len(down) - 1)]
    arrows += [Arrow(f"u{k + 1}", f"u{k}") for k in range(len(up) - 1)]
    arrows += [Arrow(f"d{k}", f"u{k + 1}", is_skip=True) for k in range(len(down) - 1)]
    sizes = _sizes(found.discriminator, image, image)
    convs = [m for m in found.discriminator.modules() if isinstance(m, nn.Conv2d)]
    boxes.append(Box("pair", 0, 2, ["left view, right view", f"{convs[0].in_channels}x"
                                    f"{_size(image.shape)}"], "data"))  # fmt: skip
    boxes += [Box(f"c{k}", k + 1, 2, _conv(m, sizes[m])) for k, m in enumerate(convs)]
    boxes.append(Box("says", len(convs) + 1, 2, ["real or drawn?", _sees(found)], "data"))
    chain = ["pair", *(f"c{k}" for k in range(len(convs))), "says"]
    return boxes, [*arrows, *(Arrow(*pair) for pair in pairwise(chain))]


def method(found: PoseNetworks) -> Diagram:
    """Figure 3-1: from a scene to the pose of one object."""
    image = torch.empty(1, 3, *found.image_px[::-1], device="meta")
    logits = found.segmentation(image)
    features, directions = _answers(found)
    keypoints = found.network.config.keypoints
    boxes = [
        Box("image", 0, 0, ["image of the scene", _shape(image)], "data"),
        Box("fcn", 0, 1, [type(found.segmentation).__name__, _weights(found.segmentation)]),
        Box("mask", 0, 2, ["mask of the object", f"1 of {logits.shape[1]} classes"], "data"),
        Box("depth", 1, 0, ["depth image", f"1x{_size(image.shape)}"], "data"),
        Box("cloud", 1, 2, ["partial cloud", back_project.__name__, "N x 3"], "step"),
        Box("voxels", 1, 3, ["voxels", voxelise.__name__, f"{1000 * found.voxel_m:g} mm"], "step"),
        Box("net", 2, 3, [type(found.network).__name__, _weights(found.network)]),
        Box("features", 2, 2, ["features", _rows(features)], "data"),
        Box("directions", 2, 1, ["directions to keypoints", _rows(directions)], "data"),
        Box("vote", 3, 1, ["vote", vote_ransac.__name__, meet_lines.__name__], "step"),
        Box("keypoints", 3, 2, ["keypoints", f"{keypoints} x 3"], "data"),
        Box("pose", 3, 3, ["pose", f"{fit_rigid.__name__} (SVD)"], "step"),
    ]
    chain = ["image", "fcn", "mask", "cloud", "voxels", "net", "features", "directions", "vote",
             "keypoints", "pose"]  # fmt: skip
    arrows = [Arrow(*pair) for pair in pairwise(chain)]
    return boxes, [*arrows, Arrow("depth", "cloud")]


def sparse(found: PoseNetworks) -> Diagram:
    """Figure 3-3: the sparse ResUNet; F filters, K kernel size, S stride."""
    net, mm = found.network, 1000 * found.voxel_m
    deepest = len(net.down) - 1
    boxes = [Box("in", 0, 0, ["voxels of a partial cloud", f"F {net.config.inputs}"], "data")]
    for level, (conv, block) in enumerate(zip(net.down, net.down_blocks, strict=True)):
        boxes.append(Box(f"d{level}", level + 1, 0, _level("conv", conv, block, mm * 2**level)))
    for level, conv, block in zip(range(deepest, 0, -1), net.up, net.up_blocks, strict=True):
        size = mm * 2 ** (level - 1)
        boxes.append(Box(f"u{level - 1}", level, 1, _level("transposed conv", conv, block, size)))
    boxes.append(Box("mix", 1, 2, [f"conv: {_sparse(net.mix)}", "features of figure 3-2"]))
    boxes.append(Box("final", 2, 2, [f"conv: {_sparse(net.final)}", _product(net)]))
    boxes.append(Box("out", 3, 2, ["directions", _rows(_answers(found)[1])], "data"))
    arrows = [Arrow("in", "d0"), Arrow(f"d{deepest}", f"u{deepest - 1}")]
    arrows += [Arrow(f"d{k}", f"d{k + 1}") for k in range(deepest)]
    arrows += [Arrow(f"u{k + 1}", f"u{k}") for k in range(deepest - 1)]
    arrows += [Arrow(f"d{k}", f"u{k}", is_skip=True) for k in range(deepest)]
    return boxes, [*arrows, Arrow("u0", "mix"), Arrow("mix", "final"), Arrow("final", "out")]


FIGURES: Mapping[str, Callable[[], Diagram]] = {
    "2-2": lambda: game(depth_networks()),
    "2-3": lambda: pipeline(depth_networks()),
    "2-4": lambda: adversaries(depth_networks()),
    "3-1": lambda: method(pose_networks()),
    "3-3": lambda: sparse(pose_networks()),
}
"""What draws each figure of the thesis."""


def _sizes(network: nn.Module, *inputs: Tensor) -> dict[nn.Module, torch.Size]:
    """Shape of what each module answers."""
    found: dict[nn.Module, torch.Size] = {}

    def remember(module: nn.Module, _: Any, answer: Tensor) -> None:  # noqa: ANN401
        found[module] = answer.shape

    hooks = [module.register_forward_hook(remember) for module in network.modules()]
    network(*inputs)
    for hook in hooks:
        hook.remove()
    return found


def _layer(level: nn.Module, sizes: Mapping[nn.Module, torch.Size]) -> list[str]:
    """Say one level of the generator."""
    (conv,) = (m for m in level.modules() if isinstance(m, nn.Conv2d | nn.ConvTranspose2d))
    lines = _conv(conv, sizes[level])
    dropouts = [m for m in level.modules() if isinstance(m, nn.Dropout)]
    return [lines[0] + "".join(f", dropout {m.p:g}" for m in dropouts), lines[1]]


def _conv(conv: nn.Conv2d | nn.ConvTranspose2d, size: torch.Size) -> list[str]:
    kernel, stride = conv.kernel_size, conv.stride
    name = f"C{conv.out_channels}"
    up = " transposed" if isinstance(conv, nn.ConvTranspose2d) else ""
    return [f"{name}: {kernel[0]}x{kernel[1]}{up}, stride {stride[0]}", _size(size)]


def _sees(found: DepthNetworks) -> str:
    """Say the patch that one logit of the discriminator sees."""
    side = 1
    convs = [m for m in found.discriminator.modules() if isinstance(m, nn.Conv2d)]
    for conv in reversed(convs):
        side = (side - 1) * conv.stride[0] + conv.kernel_size[0]
    return f"one a patch of {side}x{side}"


def _level(name: str, conv: nn.Module, block: nn.Module, voxel_mm: float) -> list[str]:
    inner = [m for m in block.modules() if hasattr(m, "kernel")]
    (outer,) = (m for m in conv.modules() if hasattr(m, "kernel"))
    first, *others = {_sparse(m) for m in inner}
    assert not others, "the convolutions of a block are alike"
    return [f"{name}: {_sparse(outer)}", f"block of {len(inner)}: {first}", f"{voxel_mm:g} mm"]


def _sparse(conv: Any) -> str:  # noqa: ANN401 - of SparseConv
    return f"F {conv.weight.shape[2]}, K {conv.kernel}, S {conv.stride}"


def _product(net: ResUNet) -> str:
    c = net.config
    return f"{c.classes} objects x {c.keypoints} keypoints x 3"


def _answers(found: PoseNetworks) -> tuple[torch.Size, torch.Size]:
    """Shapes of the features and of the directions of a small plane's points."""
    across = torch.arange(16)
    plane = torch.cartesian_prod(torch.zeros(1).long(), across, across, torch.zeros(1).long())
    features = torch.ones(len(plane), found.network.config.inputs)
    with torch.no_grad():
        voxels = Voxels.from_points(plane.int(), features)
        points = VotingPoints(
            points_m=plane[:, 1:].float(),
            coordinates=plane.int(),
            features=features,
            class_of_point=torch.zeros(len(plane), dtype=torch.long),
        )
        answers = found.network.directions(points)
        return found.network.features(voxels).at_points().shape, answers.shape


def _weights(module: nn.Module) -> str:
    return f"{sum(p.numel() for p in module.parameters()):,} weights"


def _rows(shape: torch.Size) -> str:
    return " x ".join(["N", *map(str, shape[1:])])


def _shape(batch: Tensor) -> str:
    return "x".join(map(str, batch.shape[1:]))


def _size(shape: torch.Size) -> str:
    return f"{shape[-2]}x{shape[-1]}"


class NetworkPicture(Directive):
    """``{network} FIGURE``."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Draw it into the page."""
        number = self.arguments[0]
        drawn = draw(*FIGURES[number](), label=f"figure {number}")
        return [nodes.raw("", f"<figure>{drawn}</figure>", format="html")]


def setup(app: Sphinx) -> dict[str, bool]:
    """Tell Sphinx of the directive."""
    app.add_directive("network", NetworkPicture)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
