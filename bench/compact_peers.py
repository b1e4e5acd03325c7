"""Time of the light matcher beside two published compact designs, rebuilt plainly, in one process.

    python bench/compact_peers.py [--threads 2] [--repeats 7] [--size 375 1242]

StereoNet (Khamis et al., ECCV 2018; matching at 1/8, three refinements) and CoEx (Bangunharcana et
al., IROS 2021; MobileNetV2) have the sizes that their papers give, for 192 disparities. Their
weights are random: only time is measured, not accuracy. They run in eager mode with their batch
norms, as their authors run them, on normalised images; ours runs as it ships, from images to
disparity. The methods alternate.
"""

import time
from collections.abc import Callable
from typing import Literal

import torch
import torch.nn.functional as F
from shared import make_parser
from torch import Tensor, nn

from depthpose.core.camera import StereoRig
from depthpose.core.checkpoint import find_weights
from depthpose.depth.config import MatcherConfig, SGBMConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.stereo import SGBMMatcher
from depthpose.depth.types import DepthInput
from depthpose.report.page import format_markdown_table

DISPARITIES = 192
FOCAL_PX = 721.5


def conv(dims: Literal[2, 3], ins: int, outs: int, k: int = 3, s: int = 1, d: int = 1) -> nn.Module:
    """Build a convolution of size k, stride s and dilation d, with batch norm and leaky ReLU."""
    convolution = nn.Conv2d if dims == 2 else nn.Conv3d
    norm = nn.BatchNorm2d if dims == 2 else nn.BatchNorm3d
    return nn.Sequential(
        convolution(ins, outs, k, s, d * (k // 2), d, bias=False), norm(outs), nn.LeakyReLU(0.2)
    )


def deconv(dims: Literal[2, 3], ins: int, outs: int) -> nn.Module:
    """Build a transposed convolution that doubles the size, with batch norm and leaky ReLU."""
    convolution = nn.ConvTranspose2d if dims == 2 else nn.ConvTranspose3d
    norm = nn.BatchNorm2d if dims == 2 else nn.BatchNorm3d
    return nn.Sequential(convolution(ins, outs, 4, 2, 1, bias=False), norm(outs), nn.LeakyReLU(0.2))


def shifted(right: Tensor, count: int) -> list[Tensor]:
    """Shift the right features by each disparity, with zeros at the left."""
    return [F.pad(right, (k, 0))[..., : right.shape[-1]] for k in range(count)]


class Residual(nn.Module):
    """Residual block of two dilated convolutions."""

    def __init__(self, width: int, dilation: int = 1) -> None:
        super().__init__()
        self.body = nn.Sequential(
            conv(2, width, width, d=dilation),
            nn.Conv2d(width, width, 3, 1, dilation, dilation, bias=False),
            nn.BatchNorm2d(width),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Add the convolved features."""
        return F.leaky_relu(x + self.body(x), 0.2)


class StereoNet(nn.Module):
    """Feature differences at 1/8, five 3D convolutions, three refinements by the image."""

    def __init__(self) -> None:
        super().__init__()
        down = [nn.Conv2d(ins, 32, 5, 2, 2) for ins in (3, 32, 32)]
        self.features = nn.Sequential(
            *down, *(Residual(32) for _ in range(6)), nn.Conv2d(32, 32, 3, 1, 1)
        )
        self.filter = nn.Sequential(
            *(conv(3, 32, 32) for _ in range(4)), nn.Conv3d(32, 1, 3, padding=1)
        )
        self.refine = nn.ModuleList(
            nn.Sequential(
                conv(2, 4, 32), *(Residual(32, d) for d in (1, 2, 4, 8, 1, 1)),
                nn.Conv2d(32, 1, 3, 1, 1),
            )
            for _ in range(3)
        )  # fmt: skip

    def forward(self, left: Tensor, right: Tensor) -> Tensor:
        """Match at 1/8, then enlarge in three steps."""
        left_features = self.features(left)
        right_features = self.features(right)
        count = DISPARITIES // 8
        differences = [left_features - features for features in shifted(right_features, count)]
        cost = self.filter(torch.stack(differences, 2))[:, 0]
        probability = (-cost).softmax(1)
        disparities = torch.arange(count, dtype=probability.dtype)[:, None, None]
        disparity = (probability * disparities).sum(1, keepdim=True)
        for refine, divisor in zip(self.refine, (4, 2, 1), strict=True):
            size = (left.shape[-2] // divisor, left.shape[-1] // divisor)
            disparity = 2 * F.interpolate(disparity, size, mode="bilinear")
            image = F.interpolate(left, size, mode="bilinear")
            disparity = F.relu(disparity + refine(torch.cat([disparity, image], 1)))
        return disparity[:, 0]


class Inverted(nn.Module):
    """Block of MobileNetV2."""

    def __init__(self, ins: int, outs: int, s: int, expansion: int) -> None:
        super().__init__()
        wide = ins * expansion
        expand = [nn.Conv2d(ins, wide, 1, bias=False), nn.BatchNorm2d(wide), nn.ReLU6()]
        self.body = nn.Sequential(
            *(expand if expansion > 1 else []),
            nn.Conv2d(wide, wide, 3, s, 1, groups=wide, bias=False), nn.BatchNorm2d(wide),
            nn.ReLU6(), nn.Conv2d(wide, outs, 1, bias=False), nn.BatchNorm2d(outs),
        )  # fmt: skip
        self.is_residual = s == 1 and ins == outs

    def forward(self, x: Tensor) -> Tensor:
        """Compute the block's features."""
        return x + self.body(x) if self.is_residual else self.body(x)


class MobileNet(nn.Module):
    """MobileNetV2 up to 1/32; features of 1/4, 1/8, 1/16 and 1/32."""

    STAGES = (
        ((16, 1, 1, 1), (24, 2, 2, 6)), ((32, 3, 2, 6),), ((64, 4, 2, 6), (96, 3, 1, 6)),
        ((160, 3, 2, 6),),
    )  # fmt: skip
    """Of each stage: output channels, number of blocks, stride, expansion."""

    def __init__(self) -> None:
        super().__init__()
        ins = 32
        stages = []
        self.stem = conv(2, 3, ins, s=2)
        for stage in self.STAGES:
            blocks = []
            for outs, count, stride, expansion in stage:
                for k in range(count):
                    blocks.append(Inverted(ins, outs, stride if k == 0 else 1, expansion))
                    ins = outs
            stages.append(nn.Sequential(*blocks))
        self.stages = nn.ModuleList(stages)

    def forward(self, image: Tensor) -> list[Tensor]:
        """Compute the four levels."""
        x = self.stem(image)
        levels = []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        return levels


class Excite(nn.Module):
    """Scale a volume's channels at each pixel by features of the left image."""

    def __init__(self, image: int, volume: int) -> None:
        super().__init__()
        self.weights = nn.Sequential(
            conv(2, image, image // 2, 1), nn.Conv2d(image // 2, volume, 1)
        )

    def forward(self, volume: Tensor, image: Tensor) -> Tensor:
        """Multiply each channel by its weight."""
        return torch.sigmoid(self.weights(image))[:, :, None] * volume


class CoEx(nn.Module):
    """Correlation at 1/4, excited hourglass, two best disparities, learned enlargement."""

    WIDTHS = (8, 16, 32, 48)
    IMAGE = (96, 64, 192, 160)

    def __init__(self) -> None:
        super().__init__()
        self.backbone = MobileNet()
        self.up = nn.ModuleList([deconv(2, 160, 96), deconv(2, 192, 32), deconv(2, 64, 24)])
        self.join = nn.ModuleList([conv(2, 192, 192), conv(2, 64, 64), conv(2, 48, 48)])
        self.stem_2 = nn.Sequential(conv(2, 3, 32, s=2), conv(2, 32, 32))
        self.stem_4 = nn.Sequential(conv(2, 32, 48, s=2), conv(2, 48, 48))
        self.describe = nn.Sequential(conv(2, 96, 48), nn.Conv2d(48, 48, 1))
        self.stem_3d = conv(3, 1, 8)
        pairs = list(zip(self.WIDTHS, self.WIDTHS[1:], strict=False))
        self.down = nn.ModuleList(
            nn.Sequential(conv(3, ins, outs, s=2), conv(3, outs, outs)) for ins, outs in pairs
        )
        self.rise = nn.ModuleList(deconv(3, outs, ins) for ins, outs in reversed(pairs[1:]))
        self.merge = nn.ModuleList(
            nn.Sequential(
                conv(3, 2 * width, width, 1), conv(3, width, width), conv(3, width, width)
            )
            for width in (32, 16)
        )
        self.last = nn.ConvTranspose3d(16, 1, 4, 2, 1)
        self.excite = nn.ModuleList(map(Excite, self.IMAGE, self.WIDTHS))
        self.excite_up = nn.ModuleList(map(Excite, (192, 64), (32, 16)))
        self.spread = nn.Sequential(conv(2, 96, 32), conv(2, 32, 32))
        self.weights = nn.Sequential(deconv(2, 32, 32), conv(2, 64, 32), deconv(2, 32, 9))

    def describe_image(self, image: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Compute features of 1/2 and of 1/4, and those of all levels that excite the volume."""
        quarter, eighth, sixteenth, last = self.backbone(image)
        levels = [last]
        x = last
        for up, join, skip in zip(self.up, self.join, (sixteenth, eighth, quarter), strict=True):
            x = join(torch.cat([up(x), skip], 1))
            levels.insert(0, x)
        half = self.stem_2(image)
        quarter = torch.cat([levels[0], self.stem_4(half)], 1)
        return half, quarter, [quarter, *levels[1:]]

    def forward(self, left: Tensor, right: Tensor) -> Tensor:
        """Correlate at 1/4, filter the volume, and enlarge the two best disparities."""
        half, quarter, levels = self.describe_image(left)
        _, right_quarter, _ = self.describe_image(right)
        left_descriptor = F.normalize(self.describe(quarter), dim=1)
        right_descriptor = F.normalize(self.describe(right_quarter), dim=1)
        shifted_right = shifted(right_descriptor, DISPARITIES // 4)
        correlations = [(left_descriptor * descriptor).sum(1) for descriptor in shifted_right]
        volume = torch.stack(correlations, 1)[:, None]
        x = self.excite[0](self.stem_3d(volume), levels[0])
        skips = [x]
        for down, excite, level in zip(self.down, list(self.excite)[1:], levels[1:], strict=True):
            x = excite(down(x), level)
            skips.append(x)
        steps = zip(self.rise, self.merge, self.excite_up, (2, 1), strict=True)
        for rise, merge, excite, level in steps:
            merged = merge(torch.cat([rise(x), skips[level]], 1))
            x = excite(merged, levels[level])
        scores = self.last(x)[:, 0]
        best = scores.topk(2, 1)
        disparity = (best.values.softmax(1) * best.indices).sum(1, keepdim=True)
        enlarged = self.weights[0](self.spread(quarter))
        logits = self.weights[2](self.weights[1](torch.cat([enlarged, half], 1)))
        weights = logits.softmax(1)
        batch, _, height, width = disparity.shape
        neighbours = F.unfold(disparity, 3, padding=1).reshape(batch, 9, height, width)
        neighbours = F.interpolate(neighbours, (4 * height, 4 * width), mode="nearest")
        return 4 * (weights * neighbours).sum(1)


def match_by_peer(
    network: nn.Module, size: tuple[int, int], precision: str
) -> Callable[[], object]:
    """Make a call that matches random images, padded to sides that the network takes."""
    height, width = (32 * -(-side // 32) for side in size)
    views = torch.rand(2, 1, 3, height, width)
    network.eval()

    def match() -> Tensor:
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            return network(views[0], views[1])

    return match


def match_by_ours(
    config: MatcherConfig | SGBMConfig, size: tuple[int, int]
) -> Callable[[], object]:
    """Make a call that matches as users run it, from images to disparity."""
    height, width = size
    K = torch.tensor([[FOCAL_PX, 0, width / 2], [0, FOCAL_PX, height / 2], [0, 0, 1]])
    rig = StereoRig(width=width, height=height, K=K.double(), baseline_m=0.54)
    views = torch.rand(2, 3, height, width)
    pair = DepthInput(name="pair", left=views[0], right=views[1], camera=rig)
    if isinstance(config, SGBMConfig):
        net = FakestereoNet(SGBMMatcher(config), with_check=False)
    else:
        net = FakestereoNet.load(find_weights("default"), config=config, with_check=False)
    return lambda: net.estimate_input(pair)


def main() -> None:
    """Print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--size", type=int, nargs=2, default=(375, 1242), metavar=("H", "W"))
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    size = (options.size[0], options.size[1])
    matchers: dict[str, Callable[[], object]] = {
        "SGBM, 192 disparities": match_by_ours(SGBMConfig(num_disparities=192), size)
    }
    for precision in ("fp32", "bf16"):
        for speed in ("quick", "fine"):
            config = MatcherConfig(speed=speed, precision=precision)
            matchers[f"`default`, {speed}, {precision}"] = match_by_ours(config, size)
        for peer in (StereoNet(), CoEx()):
            matchers[f"{type(peer).__name__}, {precision}"] = match_by_peer(peer, size, precision)
    wall_s: dict[str, list[float]] = {name: [] for name in matchers}
    cpu_s: dict[str, list[float]] = {name: [] for name in matchers}
    for _ in range(options.repeats + 1):
        for name, match in matchers.items():
            start_s = time.perf_counter()
            start_cpu_s = time.process_time()
            match()
            wall_s[name].append(time.perf_counter() - start_s)
            cpu_s[name].append(time.process_time() - start_cpu_s)
    rows = [
        {
            "matcher": name,
            "seconds": f"{min(wall_s[name][1:]):.2f}",  # the first run compiles
            "processor seconds": f"{min(cpu_s[name][1:]):.2f}",
        }
        for name in matchers
    ]
    print(f"{options.threads} threads, {size[0]}x{size[1]}, least of {options.repeats}")
    print(format_markdown_table(rows))


if __name__ == "__main__":
    main()
