"""Fit the layer by which a generator tells streets from other images, on features of its encoder.

    python bench/street_head.py default --out default.safetensors
    python bench/street_head.py kitti-nc --samples $DEPTHPOSE_DATA --out kitti-nc.safetensors
    ... [--pictures FOLDER ...] [--least 0] [--l2 0.01]

A logistic regression on streets and other images. Streets: synthetic ones by cameras of many
mounts, clean and degraded; with --samples those of KITTI's training drives too. Others: pictures of
packages and of folders, noise, shapes, text, and the streets rotated, mirrored and in inverted
colours (out_of_distribution.py). Prints how many images of each kind are refused by a fit without
that kind. --least is the limit of the logit; in the written weights it is at a probability of a
half.
"""

import argparse
import dataclasses
import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import out_of_distribution as images
import torch
from PIL import Image
from shared import make_parser
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.checkpoint import find_weights
from depthpose.depth.disparity import resize_image
from depthpose.depth.synthesis import SelectionGenerator, pad_to_multiple
from depthpose.depth.synthetic.materials import MATERIAL_IDS
from depthpose.depth.synthetic.sensor import draw_sensors, expose
from depthpose.depth.synthetic.shading import prepare_stage
from depthpose.depth.synthetic.street import make_street
from depthpose.depth.synthetic.visibility import render_light, view_from
from depthpose.depth.types import DepthInput
from depthpose.depth.weights import read_depth_weights, write_depth_weights
from depthpose.report.page import format_markdown_table

ROWS, COLUMNS = 224, 480


def rotation(pitch: float, yaw: float, roll: float) -> np.ndarray:
    """Turn about x, then y, then z [radians]: camera from world."""
    c, s = np.cos([pitch, yaw, roll]), np.sin([pitch, yaw, roll])
    x = np.array([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
    y = np.array([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]])
    z = np.array([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
    return z @ x @ y


def street_view(seed: int, index: int) -> DepthInput | None:
    """Render a synthetic street by a random camera, 1 to 3 m high and tilted up to 6 degrees.

    The axis lies up to 0.85 focal lengths off the centre, as in a part of a wide view; half of the
    cameras are near the mount of KITTI's cars. None if something stands right before the camera.
    """
    rng = np.random.default_rng([81, seed, index])
    scene = make_street((seed, index), 1.65)
    world_m = scene.mesh.corners.astype(float) @ scene.camera_from_world - [0, 1.65, 0]
    normals = scene.mesh.normals @ scene.camera_from_world.astype(np.float32)
    road_m = world_m[scene.mesh.material == MATERIAL_IDS["road"]].reshape(-1, 3)
    z_m = rng.uniform(0, 60)
    road_here_m = road_m[np.argsort(np.abs(road_m[:, 2] - z_m))[:20]]
    f = float(np.exp(rng.uniform(math.log(360), math.log(600))))
    if rng.random() < 0.5:
        height_m, pitch, roll = rng.normal(1.65, 0.06), rng.normal(0, 0.012), rng.normal(0, 0.009)
        cx, cy = COLUMNS / 2 + rng.uniform(-0.3, 0.3) * f, ROWS / 2 + rng.uniform(-20, 20)
    else:
        height_m = float(np.exp(rng.uniform(0, math.log(3))))
        pitch, roll = np.deg2rad(rng.uniform(-6, 6)), np.deg2rad(rng.normal(0, 2))
        cx, cy = COLUMNS / 2 + rng.uniform(-0.85, 0.85) * f, ROWS / 2 + rng.uniform(-70, 70)
    R = rotation(pitch, rng.normal(0, 0.1), roll)
    x_m = road_here_m[:, 0].mean() + rng.normal(0, 0.3)
    y_m = road_here_m[:, 1].mean() - height_m
    corners = ((world_m - np.array([x_m, y_m, z_m])) @ R.T).astype(np.float32)
    mesh = dataclasses.replace(
        scene.mesh, corners=corners, normals=normals @ R.T.astype(np.float32)
    ).select(corners[:, :, 2].max(1) > -12)
    stage = prepare_stage(
        dataclasses.replace(scene, mesh=mesh, camera_from_world=R), ROWS * COLUMNS
    )
    K = torch.tensor([[f, 0, cx], [0, f, cy], [0, 0, 1]], dtype=torch.float64)
    sight = view_from(stage, K, (ROWS, COLUMNS), torch.zeros(3))
    if float((sight.raster.depth_m < 2).float().mean()) > 0.15:
        return None
    light = render_light(stage, sight)
    sensor, _ = draw_sensors(rng, light, 0.3)
    return images.with_camera(f"{index}", expose(light, sensor), f)


def degraded(image: Tensor, rng: np.random.Generator) -> Tensor:
    """Change light, contrast, haze, colours, sharpness, noise, compression, sides and the frame."""
    height, width = image.shape[1:]
    if rng.random() < 0.35:
        image = (image * float(np.exp(rng.uniform(-2, 0.9)))).clamp(0, 1)
    if rng.random() < 0.35:
        image = image.clamp(0, 1) ** float(np.exp(rng.uniform(-0.7, 0.7)))
    if rng.random() < 0.3:
        share = float(rng.uniform(0.3, 1))
        coarse = resize_image(image, max(int(height * share), 16), max(int(width * share), 16))
        image = resize_image(coarse, height, width)
    if rng.random() < 0.3:
        haze = torch.full_like(image, float(rng.uniform(0.5, 0.95)))
        image = torch.lerp(image, haze, float(rng.uniform(0, 0.6)))
    if rng.random() < 0.3:
        grey = image.mean(0, keepdim=True)
        image = grey + (image - grey) * float(rng.uniform(0, 1.5))
    if rng.random() < 0.3:
        image = image * torch.from_numpy(np.exp(rng.normal(0, 0.15, (3, 1, 1)))).float()
    if rng.random() < 0.3:
        noise = rng.normal(0, rng.uniform(0.01, 0.1), image.shape)
        image = image + torch.from_numpy(noise).float()
    image = image.clamp(0, 1)
    if rng.random() < 0.4:
        file = io.BytesIO()
        pixels = (image * 255).round().byte().permute(1, 2, 0).numpy()
        Image.fromarray(pixels).save(file, "JPEG", quality=int(rng.integers(15, 80)))
        image = torch.from_numpy(np.array(Image.open(file))).permute(2, 0, 1).float() / 255
    if rng.random() < 0.5:
        image = image.flip(2)
    if rng.random() < 0.4:
        left, right = (int(width * share) for share in rng.uniform(0, 0.25, 2))
        top, bottom = (int(height * share) for share in rng.uniform(0, 0.15, 2))
        image = image[:, top : height - bottom, left : width - right]
    return image.contiguous()


def gather(options: argparse.Namespace) -> Iterator[tuple[str, bool, DepthInput]]:
    """Yield images with their kind (of streets their source), and whether they are streets."""
    rng = np.random.default_rng(1)
    for index in range(options.views):
        street = street_view(options.seed, index)
        if street is None:
            continue
        source = f"synthetic streets, {'odd' if index % 2 else 'even'}"
        if index % 4 < 2:
            yield source, True, street
        yield source, True, dataclasses.replace(street, left=degraded(street.left, rng))
        if index % 5 == 0:
            for kind, image in images.changed(street):
                yield f"synthetic {kind}", False, image
    if options.samples is not None:
        for index, (kind, street) in enumerate(images.pairs(options.samples, images.TRAINED)):
            if "training" in kind:
                yield f"KITTI, {index // 12}", True, street
                if index % 5 == 0:
                    for name, image in images.changed(street):
                        yield name, False, image
    for source, name, picture in images.whole_pictures(options.pictures):
        for _, part in images.parts(picture):
            yield source, False, images.with_camera(name, part)
    for kind, image in images.shapes():
        yield kind, False, images.with_camera(kind, image)


@torch.no_grad()
def features(generator: SelectionGenerator, street: DepthInput) -> np.ndarray:
    """Compute the input of the layer: three moments over the rows of the deepest features."""
    assert street.camera is not None
    scale = generator.config.virtual_focal_px / float(street.camera.K[0, 0])
    rows, columns = (max(round(side * scale), 2) for side in street.left.shape[1:])
    image = resize_image(street.left, rows, columns)[None]
    # A layer in place of the generator's keeps what it is given.
    layer = torch.nn.Linear(3 * generator.encoder.channels[-1], 1)
    inputs: list[torch.Tensor] = []
    layer.register_forward_hook(lambda _module, arguments, _output: inputs.append(arguments[0]))
    original_layer = generator.street
    generator.street = layer
    generator.street_probability(generator.encoder(pad_to_multiple(image, 32))[-1])
    generator.street = original_layer
    return inputs[0][0].numpy()


def fit(x: np.ndarray, is_street: np.ndarray, kinds: np.ndarray, l2: float) -> np.ndarray:
    """Fit a logistic regression; both classes weigh the same, kinds by the root of their number.

    Returns the slopes of the features and the offset.
    """
    weight = np.zeros(len(x))
    for in_class in (is_street, ~is_street):
        for kind in np.unique(kinds[in_class]):
            of_kind = (kinds == kind) & in_class
            weight[of_kind] = of_kind.sum() ** -0.5
        weight[in_class] /= 2 * weight[in_class].sum()
    mean = weight @ x
    deviation = np.sqrt(weight @ (x - mean) ** 2) + 1e-3
    inputs = torch.from_numpy(np.c_[(x - mean) / deviation, np.ones(len(x))])
    targets = torch.from_numpy(is_street.astype(float))
    weights = torch.from_numpy(weight)
    coefficients = torch.zeros(inputs.shape[1], dtype=torch.float64, requires_grad=True)
    solver = torch.optim.LBFGS([coefficients], max_iter=60, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        solver.zero_grad()
        logits = inputs @ coefficients
        losses = F.binary_cross_entropy_with_logits(logits, targets, reduction="none")
        total = weights @ losses + l2 * coefficients[:-1].square().sum()
        total.backward()
        return total

    solver.step(loss)
    *slopes, offset = coefficients.detach().numpy()
    slopes = np.array(slopes)
    return np.r_[slopes / deviation, offset - slopes @ (mean / deviation)]


def main() -> None:
    """Gather, fit, score each kind by a fit without it, write the weights."""
    parser = make_parser(__doc__)
    parser.add_argument("weights")
    parser.add_argument("--views", type=int, default=330)
    parser.add_argument("--seed", type=int, default=43)
    parser.add_argument("--samples", type=Path)
    parser.add_argument("--pictures", type=Path, nargs="*", default=[])
    parser.add_argument("--least", type=float, default=0.0)
    parser.add_argument("--l2", type=float, default=0.01)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    weights = read_depth_weights(find_weights(options.weights))
    generator = weights.generator
    assert isinstance(generator, SelectionGenerator)
    kind_of_image: list[str] = []
    is_street_of_image: list[bool] = []
    features_of_image: list[np.ndarray] = []
    for kind, is_street, image in gather(options):
        kind_of_image.append(kind)
        is_street_of_image.append(is_street)
        features_of_image.append(features(generator, image))
    kinds = np.array(kind_of_image)
    is_street = np.array(is_street_of_image)
    x = np.stack(features_of_image).astype(float)
    rows: list[dict[str, Any]] = []
    for kind in dict.fromkeys(kind_of_image):
        of_kind = kinds == kind
        *slopes, offset = fit(x[~of_kind], is_street[~of_kind], kinds[~of_kind], options.l2)
        logit = x[of_kind] @ slopes + offset
        rows.append(
            {
                "images": kind,
                "street": bool(is_street[of_kind][0]),
                "number": int(of_kind.sum()),
                "refused": int((logit < options.least).sum()),
                "least": logit.min(),
                "median": float(np.median(logit)),
                "most": logit.max(),
            }
        )
    print(format_markdown_table(rows))
    *slopes, offset = fit(x, is_street, kinds, options.l2)
    generator.config = dataclasses.replace(generator.config, with_street=True, least_confidence=0.5)
    generator.street = torch.nn.Linear(x.shape[1], 1)
    generator.street.weight.data = torch.tensor([slopes]).float()
    generator.street.bias.data = torch.tensor([offset - options.least]).float()
    write_depth_weights(
        options.out,
        generator=generator,
        matcher=weights.matcher,
        facts=weights.facts,
        with_half=True,
    )


if __name__ == "__main__":
    main()
