"""Images that weights refuse as unlike those of their training: real streets, and other images.

    python bench/out_of_distribution.py --samples $DEPTHPOSE_DATA [--weights default kitti-nc]
        [--pictures FOLDER ...]

Streets: KITTI's, KITTI-360's and those of six cameras of another car (DGP), with their own focal
lengths. Unlike: pictures of scikit-image, scikit-learn and matplotlib, and of folders, and their
quarters and strips, indoor pictures, noise, one colour, gradients, text, shapes; streets turned,
mirrored vertically, in inverted colours, cut to the part above the horizon, or enlarged four times,
all with an unchanged focal length. Prints a confusion table by kinds, and writes what was measured
of each image to images.json.
"""

import argparse
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
from torch import Tensor

from depthpose.core.camera import Camera
from depthpose.core.files import read_image
from depthpose.demo import read_motorcycle
from depthpose.depth.config import MatcherConfig
from depthpose.depth.datasets import open_dataset
from depthpose.depth.disparity import resize_image
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.types import StereoInput
from depthpose.report.page import markdown_table, write_table

TRAINED = ("street_pairs/kitti2015_train_drives", "street_pairs/kitti_object_more",
           "street_pairs/kitti_single", "more/kitti_road", "more/kitti_object_csc420",
           "more/kitti_single_more")  # fmt: skip
"""Pairs of KITTI's training drives: the limit of `kitti-nc` was chosen on them."""
OF_EVALUATION = ("train_000007", "train_000008", "train_000009", "train_000010", "train_000013")
"""Frames among them that are of evaluation drives."""
KEPT_BACK = ("street_pairs/kitti2015_eval_drives", "street_pairs/kitti_raw_0056",
             "more/kitti_road_unknown_drive")  # fmt: skip
FOCAL_0052_PX = 721.5377
PICTURES = ("astronaut", "brick", "camera", "cat", "cell", "checkerboard", "clock", "coffee",
            "coins", "grass", "gravel", "horse", "hubble_deep_field", "immunohistochemistry",
            "logo", "moon", "page", "retina", "rocket", "text")  # fmt: skip
PHONE = 0.8
"""Focal length of images without one, in widths."""
KITTI360_PX = 552.55


def given(name: str, image: Tensor, focal_px: float | None = None) -> StereoInput:
    """Make an input whose optical axis goes through its centre."""
    height, width = image.shape[1:]
    f = PHONE * max(height, width) if focal_px is None else focal_px
    K = torch.tensor([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]]).double()
    return StereoInput(
        name=name, left=image, right=None, camera=Camera(width=width, height=height, K=K)
    )


def dgp(folder: Path) -> Iterator[StereoInput]:
    """Read the pictures of scenes in DGP's layout, with their intrinsics."""
    for scene in sorted(folder.glob("scene_*")):
        (calibration,) = scene.glob("calibration/*.json")
        facts = json.loads(calibration.read_text())
        focal_px = {n: k["fx"] for n, k in zip(facts["names"], facts["intrinsics"], strict=True)}
        for path in sorted(scene.glob("rgb/*/*.jpg")):
            yield given(path.stem, read_image(path), focal_px[path.parent.name])


def pairs(samples: Path, folders: tuple[str, ...]) -> Iterator[tuple[str, StereoInput]]:
    """Give the left images of folders of pairs, with their source."""
    for folder in folders:
        dataset = open_dataset(samples / "depth" / folder)
        for index in range(len(dataset)):
            image = dataset.read_input(index)
            is_kept = folder in KEPT_BACK or image.name in OF_EVALUATION
            yield f"KITTI, {'evaluation' if is_kept else 'training'} drives", image


def streets(samples: Path) -> Iterator[tuple[str, StereoInput]]:
    """Give real streets, with their source."""
    yield from pairs(samples, TRAINED + KEPT_BACK)
    for path in sorted((samples / "depth/kitti_raw").glob("*/*_drive_0052_sync/image_02/data/*")):
        yield "KITTI, evaluation drives", given(path.stem, read_image(path), FOCAL_0052_PX)
    for path in sorted((samples / "depth/more/kitti360/left").glob("*")):
        yield "KITTI-360", given(path.stem, read_image(path), KITTI360_PX)
    for image in dgp(samples / "depth/more/tri_dgp"):
        yield "DGP, six cameras", image


def picture(name: str) -> Tensor:
    """Give a picture of scikit-image in RGB."""
    found = np.asarray(getattr(skimage.data, name)())
    found = found.astype(np.uint8) * (255 if found.dtype == bool else 1)
    rgb = np.repeat(found[..., None], 3, 2) if found.ndim == 2 else found[..., :3]
    return torch.from_numpy(rgb.copy()).permute(2, 0, 1).float() / 255


def others() -> Iterator[tuple[str, Tensor]]:
    """Give the pictures that scikit-learn and matplotlib bring along, as far as they are there."""
    for package, pattern in (("sklearn", "datasets/images/*.jpg"),
                             ("matplotlib", "mpl-data/sample_data/*.jpg")):  # fmt: skip
        found = importlib.util.find_spec(package)
        if found is not None and found.origin is not None:
            for path in sorted(Path(found.origin).parent.glob(pattern)):
                yield path.stem, read_image(path)


def shapes() -> Iterator[tuple[str, Tensor]]:
    """Give noise, one colour, gradients, text, checks, stripes and polygons."""
    rng = np.random.default_rng(5)
    for number in range(16):
        height, width = ((375, 1242), (480, 640), (900, 1600), (640, 480))[number % 4]
        rough = torch.from_numpy(rng.random((3, height // (1 + number % 4), width // 4))).float()
        yield "white noise", resize_image(rough, height, width)
        frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
        size = 1 / np.maximum(frequency, 1 / max(height, width)) ** rng.uniform(0.6, 2.2)
        waves = [size * np.exp(2j * np.pi * rng.random(size.shape)) for _ in range(3)]
        cloud = np.stack([np.fft.irfft2(wave, (height, width)) for wave in waves])
        cloud = (cloud - cloud.mean()) / cloud.std() * 0.18 + 0.5
        yield "fractal noise", torch.from_numpy(cloud.clip(0, 1)).float()
        one, other = torch.from_numpy(rng.random((2, 3, 1, 1))).float()
        yield "one colour", one.expand(3, height, width).contiguous()
        row, column = torch.linspace(0, 1, height)[:, None], torch.linspace(0, 1, width)
        fade = (row if number % 2 else column).expand(height, width)
        yield "gradients", torch.lerp(one, other, fade)
        side = int(rng.integers(8, 80))
        v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        check = (v // side + (u // side if number % 2 else 0)) % 2
        yield "checks and stripes", torch.lerp(one, other, check.float())
        for kind, drawn in (("polygons", polygons(rng, height, width)), ("text", text(rng))):
            yield kind, torch.from_numpy(np.array(drawn)).permute(2, 0, 1).float() / 255


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


def changed(street: StereoInput) -> Iterator[tuple[str, StereoInput]]:
    """Give a street as no camera of a car sees it."""
    assert street.camera is not None
    image, focal_px = street.left, float(street.camera.K[0, 0])
    height, width = image.shape[1:]
    middle = image[:, height * 3 // 8 : height * 5 // 8, width * 3 // 8 : width * 5 // 8]
    for kind, made in (
        ("streets turned by 90 degrees", image.rot90(1, (1, 2))),
        ("streets turned by 180 degrees", image.rot90(2, (1, 2))),
        ("streets mirrored vertically", image.flip(1)),
        ("negatives", 1 - image),
        ("negatives upside down", 1 - image.flip(1)),
        ("streets above the horizon", image[:, : height * 7 // 20]),
        ("streets enlarged four times", middle),
    ):
        yield kind, given(street.name, made.contiguous(), focal_px)


def whole_pictures(folders: list[Path]) -> Iterator[tuple[str, str, Tensor]]:
    """Give the pictures of packages and of folders: source, name, RGB."""
    for name in PICTURES:
        yield "scikit-image", name, picture(name)
    for name, whole in others():
        yield "other packages", name, whole
    for folder in folders:
        paths = (path for path in folder.rglob("*") if path.suffix in (".jpg", ".jpeg", ".png"))
        for path in sorted(paths):
            yield folder.name, path.stem, small(read_image(path))


def parts(whole: Tensor) -> Iterator[tuple[str, Tensor]]:
    """Give a picture, its quarters, and a strip through its middle, as wide as KITTI's images."""
    yield "pictures", whole
    height, width = whole.shape[1:]
    rows = width * 3 // 10
    if rows < height:
        yield "strips", whole[:, (height - rows) // 2 :][:, :rows].contiguous()
    for k in range(4):
        down, right = k // 2 * (height // 2), k % 2 * (width // 2)
        part = whole[:, down : down + height // 2, right : right + width // 2]
        yield "quarters", part.contiguous()


def unlike(samples: Path, folders: list[Path]) -> Iterator[tuple[str, StereoInput]]:
    """Give images that are no street, or a street as no camera of a car sees it."""
    for source, name, whole in whole_pictures(folders):
        for kind, part in parts(whole):
            yield f"{kind}, {source}", given(name, part)
    for path in sorted((samples / "depth/middlebury").glob("*/*/im0.png")):
        yield "indoors", given(path.parent.name, read_image(path))
    for path in sorted((samples / "pose").glob("*/test/**/rgb/*")):
        yield "indoors", given(path.stem, read_image(path), 570.0)
    for kind, image in shapes():
        yield kind, given(kind, image)
    for index, (_, street) in enumerate(pairs(samples, TRAINED)):
        if index % 6 == 0:
            yield from changed(street)


def small(image: Tensor) -> Tensor:
    """Bring a picture to 1300 px at most."""
    height, width = image.shape[1:]
    share = min(1300 / max(height, width), 1)
    return resize_image(image, round(height * share), round(width * share))


def look_at(weights: str, samples: Path, folders: list[Path]) -> Iterator[dict[str, Any]]:
    """Give what decides on each image, and whether it is refused."""
    config = MatcherConfig(speed="quick")
    net = FakestereoNet.load(weights, allow_ood=True, config=config)
    for is_street, images in ((True, streets(samples)), (False, unlike(samples, folders))):
        for kind, image in images:
            found = net.estimate_pair(dataclasses.replace(image, right=None))
            yield {
                "weights": weights, "images": kind, "street": is_street, "name": image.name,
                "confidence": found.image_confidence, "refused": bool(found.warning),
            }  # fmt: skip


def measure(looks: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Give, for each kind of image and of all, how many are refused."""
    looks = looks + [
        one | {"images": "all streets" if one["street"] else "all others"} for one in looks
    ]
    kinds = dict.fromkeys((one["weights"], one["images"], one["street"]) for one in looks)
    rows = []
    for weights, kind, is_street in kinds:
        mine = [one for one in looks if (one["weights"], one["images"]) == (weights, kind)]
        confidence = [one["confidence"] for one in mine]
        rows.append({
            "weights": weights, "images": kind, "street": is_street, "number": len(mine),
            "refused": sum(one["refused"] for one in mine),
            "least": min(confidence), "median": float(np.median(confidence)),
            "most": max(confidence),
        })  # fmt: skip
    return rows


def indoors(weights: str) -> dict[str, Any]:
    """Give the error on Middlebury's Motorcycle, an indoor scene, and whether it is refused."""
    sample = read_motorcycle()
    assert sample is not None
    truth_m = sample.truth.depth_m
    net = FakestereoNet.load(weights, allow_ood=True)
    found = net.estimate_pair(dataclasses.replace(sample.input, right=None))
    assert truth_m is not None
    assert found.depth_m is not None
    ratio = (found.depth_m / truth_m)[truth_m.isfinite() & found.depth_m.isfinite()]
    error = {"AbsRel": float((ratio - 1).abs().mean()), "median ratio": float(ratio.median())}
    return {"weights": weights, "image": "Motorcycle, 2 to 5 m", **error, "said": found.warning}


def main() -> None:
    """Measure each set of weights; write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--samples", type=Path, required=True)
    parser.add_argument("--pictures", type=Path, nargs="*", default=[])
    parser.add_argument("--weights", nargs="+", default=["default", "kitti-nc"])
    parser.add_argument("--out", type=Path, default=Path("out/bench/out_of_distribution"))
    options = parser.parse_args()
    looks = [one for weights in options.weights
             for one in look_at(weights, options.samples, options.pictures)]  # fmt: skip
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "images.json").write_text(json.dumps(looks, indent=0))
    rows = measure(looks)
    write_table(options.out, rows, name="out_of_distribution")
    print(markdown_table(rows))
    print(markdown_table([indoors(weights) for weights in options.weights]))


if __name__ == "__main__":
    main()
