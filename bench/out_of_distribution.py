"""Images that weights refuse as unlike those of their training: real streets, and other images.

    python bench/out_of_distribution.py --samples $DEPTHPOSE_DATA [--weights default kitti-nc]

Streets: KITTI's, KITTI-360's and those of six cameras of another car (DGP), with their own focal
lengths. Unlike: pictures of scikit-image, scikit-learn and matplotlib and their quarters, indoor
pictures, noise, one colour, gradients; streets turned, in inverted colours upside down, cut to the
part above the horizon, or enlarged four times, all with an unchanged focal length. Writes what was
measured of each image to images.json.
"""

import argparse
import dataclasses
import importlib.util
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import skimage.data
import torch
from torch import Tensor

from depthpose.core.camera import Camera
from depthpose.core.files import read_image
from depthpose.demo import read_motorcycle
from depthpose.depth.config import MatcherConfig
from depthpose.depth.datasets import open_dataset
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.ground import is_road
from depthpose.depth.types import StereoInput
from depthpose.report.page import markdown_table, write_table

PAIRS = ("street_pairs/kitti2015_train_drives", "street_pairs/kitti_object_more",
         "street_pairs/kitti_single", "street_pairs/kitti2015_eval_drives", "more/kitti_road",
         "more/kitti_object_csc420", "more/kitti_road_unknown_drive")  # fmt: skip
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


def streets(samples: Path) -> Iterator[tuple[str, StereoInput]]:
    """Give real streets, with their source."""
    for folder in PAIRS:
        dataset = open_dataset(samples / "depth" / folder)
        for index in range(len(dataset)):
            yield f"KITTI, {Path(folder).name}", dataset.read_input(index)
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


def unlike(samples: Path) -> Iterator[tuple[str, StereoInput]]:
    """Give images that are no street, or streets with a wrong focal length."""
    generator = torch.Generator().manual_seed(0)
    for name in PICTURES:
        yield "scikit-image's pictures", given(name, picture(name))
    for name, whole in others():
        yield "other packages' pictures", given(name, whole)
    whole_pictures = [(name, picture(name)) for name in PICTURES] + list(others())
    for name, whole in whole_pictures:
        rows, columns = (side // 2 for side in whole.shape[1:])
        for k in range(4):
            down, right = k // 2 * rows, k % 2 * columns
            part = whole[:, down : down + rows, right : right + columns]
            yield "quarters of pictures", given(f"{name} {k}", part.contiguous())
    for path in sorted((samples / "depth/middlebury").glob("*/*/im0.png")):
        yield "indoors", given(path.parent.name, read_image(path))
    for path in sorted((samples / "pose").glob("*/test/**/rgb/*")):
        yield "indoors", given(path.stem, read_image(path), 570.0)
    for number in range(12):
        size = (3, 375 // (1 + number % 4), 1242 // (1 + number % 4))
        rough = torch.rand(size, generator=generator)
        smooth = torch.nn.functional.interpolate(rough[None], (375, 1242), mode="bilinear")[0]
        yield "noise", given("noise", smooth, 721.5)
        colour = torch.rand(3, 1, 1, generator=generator).expand(3, 375, 1242)
        yield "one colour", given("flat", colour.contiguous(), 721.5)
        fade = torch.linspace(0, 1, 375)[:, None].expand(3, 375, 1242)
        fade = (fade.flip(1) if number % 2 else fade) * colour
        yield "gradients", given("fade", fade.contiguous(), 721.5)
    dataset = open_dataset(samples / "depth" / PAIRS[0])
    for index in range(0, len(dataset), 3):
        street = dataset.read_input(index)
        assert street.camera is not None
        image, focal_px = street.left, float(street.camera.K[0, 0])
        turned = image.rot90(1, (1, 2)).contiguous()
        yield "streets turned by 90 degrees", given("r", turned, focal_px)
        yield "streets upside down", given("u", image.rot90(2, (1, 2)).contiguous(), focal_px)
        yield "negatives upside down", given("n", 1 - image.flip(1), focal_px)
        yield "streets above the horizon", given("s", image[:, :130], focal_px)
        yield "streets enlarged four times", given("z", image[:, 140:240, 450:800], focal_px)
        yield "streets of twice the focal length", given("f", image, 2 * focal_px)


def look_at(weights: str, samples: Path) -> Iterator[dict[str, Any]]:
    """Give what decides on each image, and whether it is refused."""
    config = MatcherConfig(speed="quick")
    net = FakestereoNet.load(weights, allow_ood=True, config=config)
    for is_street, images in ((True, streets(samples)), (False, unlike(samples))):
        for kind, image in images:
            found = net.estimate_pair(dataclasses.replace(image, right=None))
            yield {
                "weights": weights, "images": kind, "street": is_street, "name": image.name,
                "confidence": found.image_confidence, "road": is_road(found.ground),
                "refused": bool(found.warning),
            }  # fmt: skip


def measure(looks: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Give, for each kind of image, how many show a road and how many are refused."""
    kinds = dict.fromkeys((one["weights"], one["images"], one["street"]) for one in looks)
    rows = []
    for weights, kind, is_street in kinds:
        mine = [one for one in looks if (one["weights"], one["images"]) == (weights, kind)]
        confidence = [one["confidence"] for one in mine]
        rows.append({
            "weights": weights, "images": kind, "street": is_street, "number": len(mine),
            "refused": sum(one["refused"] for one in mine), "road": sum(o["road"] for o in mine),
            "least": min(confidence), "median": float(np.median(confidence)),
            "most": max(confidence),
        })  # fmt: skip
    return rows


def indoors(weights: str) -> dict[str, Any]:
    """Give the error on Middlebury's Motorcycle, which is refused by default."""
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
    parser.add_argument("--weights", nargs="+", default=["default", "kitti-nc"])
    parser.add_argument("--out", type=Path, default=Path("out/bench/out_of_distribution"))
    options = parser.parse_args()
    looks = [one for weights in options.weights for one in look_at(weights, options.samples)]
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "images.json").write_text(json.dumps(looks, indent=0))
    rows = measure(looks)
    write_table(options.out, rows, name="out_of_distribution")
    print(markdown_table(rows))
    print(markdown_table([indoors(weights) for weights in options.weights]))


if __name__ == "__main__":
    main()
