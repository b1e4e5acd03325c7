"""Images that weights refuse as unlike those of their training: real streets, and other images.

    python bench/out_of_distribution.py --samples $DEPTHPOSE_DATA [--weights default kitti-nc]
        [--pictures FOLDER ...]

Streets: KITTI's, KITTI-360's and those of six cameras of another car (DGP), with their own focal
lengths. Other images: pictures of scikit-image, scikit-learn and matplotlib, and of folders, and
their quarters and strips; indoor pictures, noise, one colour, gradients, text, shapes; streets
rotated, mirrored vertically, in inverted colours, cut to the part above the horizon, or enlarged
four times, all with an unchanged focal length. Prints how many of each kind are refused, and writes
the confidence of each image to images.json.
"""

import dataclasses
import importlib.util
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import skimage.data
import torch
from PIL import Image, ImageDraw, ImageFont
from shared import group_rows, make_parser
from torch import Tensor

from depthpose.core.camera import Camera
from depthpose.core.files import read_image
from depthpose.demo import read_motorcycle
from depthpose.depth.config import MatcherConfig
from depthpose.depth.datasets import open_dataset
from depthpose.depth.disparity import resize_image
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.types import DepthInput
from depthpose.report.page import format_markdown_table, write_table

TRAINED = ("street_pairs/kitti2015_train_drives", "street_pairs/kitti_object_more",
           "street_pairs/kitti_single", "more/kitti_road", "more/kitti_object_csc420",
           "more/kitti_single_more")  # fmt: skip
"""Pairs of KITTI's training drives: the limit of `kitti-nc` was chosen on them."""
EVALUATION_FRAMES = ("train_000007", "train_000008", "train_000009", "train_000010", "train_000013")
"""Frames of the folders above that belong to evaluation drives."""
EVALUATION = ("street_pairs/kitti2015_eval_drives", "street_pairs/kitti_raw_0056",
             "more/kitti_road_unknown_drive")  # fmt: skip
FOCAL_0052_PX = 721.5377
PICTURES = ("astronaut", "brick", "camera", "cat", "cell", "checkerboard", "clock", "coffee",
            "coins", "grass", "gravel", "horse", "hubble_deep_field", "immunohistochemistry",
            "logo", "moon", "page", "retina", "rocket", "text")  # fmt: skip
USUAL_FOCAL_LENGTH = 0.8
"""Of an image of unknown focal length, in its longer side: that of a phone."""
MAX_SIDE_PX = 1300
Row = dict[str, Any]
KITTI360_PX = 552.55


def with_camera(name: str, image: Tensor, focal_px: float | None = None) -> DepthInput:
    """Make an input whose optical axis goes through its centre."""
    height, width = image.shape[1:]
    f = USUAL_FOCAL_LENGTH * max(height, width) if focal_px is None else focal_px
    K = torch.tensor([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]]).double()
    return DepthInput(
        name=name, left=image, right=None, camera=Camera(width=width, height=height, K=K)
    )


def dgp(folder: Path) -> Iterator[DepthInput]:
    """Read the pictures of scenes in DGP's layout, with their intrinsics."""
    for scene in sorted(folder.glob("scene_*")):
        (calibration,) = scene.glob("calibration/*.json")
        cameras = json.loads(calibration.read_text())
        intrinsics = dict(zip(cameras["names"], cameras["intrinsics"], strict=True))
        for path in sorted(scene.glob("rgb/*/*.jpg")):
            focal_px = intrinsics[path.parent.name]["fx"]
            yield with_camera(path.stem, read_image(path), focal_px)


def pairs(samples: Path, folders: tuple[str, ...]) -> Iterator[tuple[str, DepthInput]]:
    """Read the left images of folders of pairs, with their source."""
    for folder in folders:
        dataset = open_dataset(samples / "depth" / folder)
        for index in range(len(dataset)):
            image = dataset.read_input(index)
            is_evaluation = folder in EVALUATION or image.name in EVALUATION_FRAMES
            yield f"KITTI, {'evaluation' if is_evaluation else 'training'} drives", image


def streets(samples: Path) -> Iterator[tuple[str, DepthInput]]:
    """Read real streets, with their source."""
    yield from pairs(samples, TRAINED + EVALUATION)
    for path in sorted((samples / "depth/kitti_raw").glob("*/*_drive_0052_sync/image_02/data/*")):
        yield "KITTI, evaluation drives", with_camera(path.stem, read_image(path), FOCAL_0052_PX)
    for path in sorted((samples / "depth/more/kitti360/left").glob("*")):
        yield "KITTI-360", with_camera(path.stem, read_image(path), KITTI360_PX)
    for image in dgp(samples / "depth/more/tri_dgp"):
        yield "DGP, six cameras", image


def picture(name: str) -> Tensor:
    """Read a picture of scikit-image in RGB."""
    pixels = np.asarray(getattr(skimage.data, name)())
    pixels = pixels.astype(np.uint8) * (255 if pixels.dtype == bool else 1)
    rgb = np.repeat(pixels[..., None], 3, 2) if pixels.ndim == 2 else pixels[..., :3]
    return torch.from_numpy(rgb.copy()).permute(2, 0, 1).float() / 255


def package_pictures() -> Iterator[tuple[str, Tensor]]:
    """Read the pictures in scikit-learn and matplotlib, where these are installed."""
    for package, pattern in (("sklearn", "datasets/images/*.jpg"),
                             ("matplotlib", "mpl-data/sample_data/*.jpg")):  # fmt: skip
        spec = importlib.util.find_spec(package)
        if spec is not None and spec.origin is not None:
            for path in sorted(Path(spec.origin).parent.glob(pattern)):
                yield path.stem, read_image(path)


def shapes() -> Iterator[tuple[str, Tensor]]:
    """Generate noise, one colour, gradients, text, checks, stripes and polygons."""
    rng = np.random.default_rng(5)
    for index in range(16):
        height, width = ((375, 1242), (480, 640), (900, 1600), (640, 480))[index % 4]
        coarse = torch.from_numpy(rng.random((3, height // (1 + index % 4), width // 4))).float()
        yield "white noise", resize_image(coarse, height, width)
        yield "fractal noise", fractal_noise(rng, height, width)
        first, second = torch.from_numpy(rng.random((2, 3, 1, 1))).float()
        yield "one colour", first.expand(3, height, width).contiguous()
        downward = torch.linspace(0, 1, height)[:, None]
        rightward = torch.linspace(0, 1, width)
        weight = (downward if index % 2 else rightward).expand(height, width)
        yield "gradients", torch.lerp(first, second, weight)
        side = int(rng.integers(8, 80))
        row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        is_second = (row // side + (column // side if index % 2 else 0)) % 2
        yield "checks and stripes", torch.lerp(first, second, is_second.float())
        yield "polygons", as_tensor(polygons(rng, height, width))
        yield "text", as_tensor(text(rng))


def fractal_noise(rng: np.random.Generator, height: int, width: int) -> Tensor:
    """Generate noise whose amplitude falls with a random power of the frequency."""
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
    amplitude = 1 / np.maximum(frequency, 1 / max(height, width)) ** rng.uniform(0.6, 2.2)
    waves = [amplitude * np.exp(2j * np.pi * rng.random(amplitude.shape)) for _ in range(3)]
    noise = np.stack([np.fft.irfft2(wave, (height, width)) for wave in waves])
    noise = (noise - noise.mean()) / noise.std() * 0.18 + 0.5
    return torch.from_numpy(noise.clip(0, 1)).float()


def as_tensor(image: Image.Image) -> Tensor:
    """Turn an RGB image into a tensor (3, height, width) from 0 to 1."""
    return torch.from_numpy(np.array(image)).permute(2, 0, 1).float() / 255


def polygons(rng: np.random.Generator, height: int, width: int) -> Image.Image:
    """Draw forty polygons of random colours."""
    image = Image.new("RGB", (width, height), tuple(rng.integers(0, 256, 3).tolist()))
    for _ in range(40):
        x, y = rng.random(2) * (width, height)
        radius = rng.uniform(10, height / 2)
        angles = np.sort(rng.random(int(rng.integers(3, 8)))) * 2 * math.pi
        corners = [(x + radius * math.cos(a), y + radius * math.sin(a)) for a in angles]
        ImageDraw.Draw(image).polygon(corners, fill=tuple(rng.integers(0, 256, 3).tolist()))
    return image


def text(rng: np.random.Generator) -> Image.Image:
    """Draw a page of random words."""
    size = int(rng.integers(12, 34))
    image = Image.new("RGB", (1000, 700), tuple(rng.integers(225, 256, 3).tolist()))
    letters = list("abcdefghijklmnoprstuvwxyz")
    for y in range(20, 680, int(size * 1.4)):
        words = ("".join(rng.choice(letters, int(rng.integers(2, 10)))) for _ in range(20))
        ImageDraw.Draw(image).text(
            (30, y), " ".join(words), (20, 20, 20), font=ImageFont.load_default(size)
        )
    return image


def changed(street: DepthInput) -> Iterator[tuple[str, DepthInput]]:
    """Change a street to images that no camera of a car takes."""
    assert street.camera is not None
    image, focal_px = street.left, float(street.camera.K[0, 0])
    height, width = image.shape[1:]
    middle = image[:, height * 3 // 8 : height * 5 // 8, width * 3 // 8 : width * 5 // 8]
    for kind, changed_image in (
        ("streets turned by 90 degrees", image.rot90(1, (1, 2))),
        ("streets turned by 180 degrees", image.rot90(2, (1, 2))),
        ("streets mirrored vertically", image.flip(1)),
        ("negatives", 1 - image),
        ("negatives upside down", 1 - image.flip(1)),
        ("streets above the horizon", image[:, : height * 7 // 20]),
        ("streets enlarged four times", middle),
    ):
        yield kind, with_camera(street.name, changed_image.contiguous(), focal_px)


def whole_pictures(folders: list[Path]) -> Iterator[tuple[str, str, Tensor]]:
    """Read the pictures of packages and of folders: source, name, RGB."""
    for name in PICTURES:
        yield "scikit-image", name, picture(name)
    for name, image in package_pictures():
        yield "other packages", name, image
    for folder in folders:
        paths = (path for path in folder.rglob("*") if path.suffix in (".jpg", ".jpeg", ".png"))
        for path in sorted(paths):
            yield folder.name, path.stem, shrunk(read_image(path))


def parts(picture: Tensor) -> Iterator[tuple[str, Tensor]]:
    """Cut a picture: all of it, a strip of the proportions of KITTI's images, its quarters."""
    yield "pictures", picture
    height, width = picture.shape[1:]
    rows = width * 3 // 10
    if rows < height:
        top = (height - rows) // 2
        yield "strips", picture[:, top : top + rows].contiguous()
    for k in range(4):
        top, left = k // 2 * (height // 2), k % 2 * (width // 2)
        part = picture[:, top : top + height // 2, left : left + width // 2]
        yield "quarters", part.contiguous()


def other_images(samples: Path, folders: list[Path]) -> Iterator[tuple[str, DepthInput]]:
    """Read and generate images that are no street, or no street as the camera of a car sees it."""
    for source, name, image in whole_pictures(folders):
        for kind, part in parts(image):
            yield f"{kind}, {source}", with_camera(name, part)
    for path in sorted((samples / "depth/middlebury").glob("*/*/im0.png")):
        yield "indoors", with_camera(path.parent.name, read_image(path))
    for path in sorted((samples / "pose").glob("*/test/**/rgb/*")):
        yield "indoors", with_camera(path.stem, read_image(path), 570.0)
    for kind, image in shapes():
        yield kind, with_camera(kind, image)
    for index, (_, street) in enumerate(pairs(samples, TRAINED)):
        if index % 6 == 0:
            yield from changed(street)


def shrunk(image: Tensor) -> Tensor:
    """Resize a picture whose longer side is more than 1300 px."""
    height, width = image.shape[1:]
    scale = min(MAX_SIDE_PX / max(height, width), 1)
    return resize_image(image, round(height * scale), round(width * scale))


def judge_images(weights: str, samples: Path, folders: list[Path]) -> Iterator[Row]:
    """Estimate each image; yield its confidence, and whether it is refused."""
    config = MatcherConfig(speed="quick")
    net = FakestereoNet.load(weights, allow_ood=True, config=config)
    for is_street, images in ((True, streets(samples)), (False, other_images(samples, folders))):
        for kind, image in images:
            estimate = net.estimate_input(dataclasses.replace(image, right=None))
            yield {
                "weights": weights,
                "images": kind,
                "street": is_street,
                "name": image.name,
                "confidence": estimate.image_confidence,
                "refused": bool(estimate.warning),
            }


def summary(images: list[Row]) -> list[Row]:
    """Count the refused images of each kind, and of all streets and all others."""
    in_all = [
        image | {"images": "all streets" if image["street"] else "all others"} for image in images
    ]
    rows = []
    groups = group_rows(images + in_all, "weights", "images", "street")
    for (weights, kind, is_street), group in groups.items():
        confidence = [image["confidence"] for image in group]
        rows.append(
            {
                "weights": weights,
                "images": kind,
                "street": is_street,
                "number": len(group),
                "refused": sum(image["refused"] for image in group),
                "least": min(confidence),
                "median": float(np.median(confidence)),
                "most": max(confidence),
            }
        )
    return rows


def measure_motorcycle(weights: str) -> Row:
    """Measure the error on Middlebury's Motorcycle, an indoor scene, and the warning about it."""
    sample = read_motorcycle()
    assert sample is not None
    truth_m = sample.truth.depth_m
    net = FakestereoNet.load(weights, allow_ood=True)
    estimate = net.estimate_input(dataclasses.replace(sample.input, right=None))
    assert truth_m is not None
    assert estimate.depth_m is not None
    is_measured = truth_m.isfinite() & estimate.depth_m.isfinite()
    ratio = (estimate.depth_m / truth_m)[is_measured]
    return {
        "weights": weights,
        "image": "Motorcycle, 2 to 5 m",
        "AbsRel": float((ratio - 1).abs().mean()),
        "median ratio": float(ratio.median()),
        "said": estimate.warning,
    }


def main() -> None:
    """Measure each set of weights; write the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--samples", type=Path, required=True)
    parser.add_argument("--pictures", type=Path, nargs="*", default=[])
    parser.add_argument("--weights", nargs="+", default=["default", "kitti-nc"])
    parser.add_argument("--out", type=Path, default=Path("out/bench/out_of_distribution"))
    options = parser.parse_args()
    images: list[Row] = []
    for weights in options.weights:
        images += judge_images(weights, options.samples, options.pictures)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "images.json").write_text(json.dumps(images, indent=0))
    rows = summary(images)
    write_table(options.out, rows, name="out_of_distribution")
    print(format_markdown_table(rows))
    print(format_markdown_table([measure_motorcycle(weights) for weights in options.weights]))


if __name__ == "__main__":
    main()
