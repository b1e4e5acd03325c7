"""Fit the layer by which a generator's weights know a street, on features of its encoder.

    python bench/street_head.py default --out default.safetensors
    python bench/street_head.py kitti-nc --samples $DEPTHPOSE_DATA --out kitti-nc.safetensors
    ... [--pictures FOLDER ...] [--least 0] [--l2 0.01]

Streets: synthetic ones by cameras of many mounts, as drawn and degraded; with --samples those of
KITTI's training drives too. Others: pictures of packages and of folders, noise, shapes, text, and
the streets turned, mirrored and in inverted colours (out_of_distribution.py). A logistic
regression; prints what is refused of each kind by a fit without that kind. The limit, --least, is
in the logit; what is written has it at a probability of a half.
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
from torch import Tensor
from torch.nn import functional as F

from depthpose.core.checkpoint import find_weights
from depthpose.depth.disparity import resize_image
from depthpose.depth.synthesis import SelectionGenerator, pad_to_multiple
from depthpose.depth.synthetic.dataset import draw_light, draw_sensors, expose, view_from
from depthpose.depth.synthetic.mesh import NUMBER
from depthpose.depth.synthetic.scene import make_scene
from depthpose.depth.synthetic.shading import prepare
from depthpose.depth.types import StereoInput
from depthpose.depth.weights import read_depth_weights, write_depth_weights
from depthpose.report.page import markdown_table

ROWS, COLUMNS = 224, 480


def rotation(pitch: float, yaw: float, roll: float) -> np.ndarray:
    """Turn about x, then y, then z [radians]: camera from world."""
    c, s = np.cos([pitch, yaw, roll]), np.sin([pitch, yaw, roll])
    x = np.array([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
    y = np.array([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]])
    z = np.array([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
    return z @ x @ y


def view(seed: int, index: int) -> StereoInput | None:
    """Draw a synthetic street by a random camera: 1 to 3 m high, tilted up to 6 degrees; or None.

    The axis lies up to 0.85 focal lengths off the centre, which is what a part of a wide view sees;
    half are near the mount of KITTI's cars. None where something stands right before the camera.
    """
    rng = np.random.default_rng([81, seed, index])
    scene = make_scene((seed, index), 1.65)
    world = scene.mesh.corners.astype(float) @ scene.camera_from_world - [0, 1.65, 0]
    normals = scene.mesh.normals @ scene.camera_from_world.astype(np.float32)
    road = world[scene.mesh.material == NUMBER["road"]].reshape(-1, 3)
    along = rng.uniform(0, 60)
    near = road[np.argsort(np.abs(road[:, 2] - along))[:20]]
    f = float(np.exp(rng.uniform(math.log(360), math.log(600))))
    if rng.random() < 0.5:
        height_m, pitch, roll = rng.normal(1.65, 0.06), rng.normal(0, 0.012), rng.normal(0, 0.009)
        cx, cy = COLUMNS / 2 + rng.uniform(-0.3, 0.3) * f, ROWS / 2 + rng.uniform(-20, 20)
    else:
        height_m = float(np.exp(rng.uniform(0, math.log(3))))
        pitch, roll = np.deg2rad(rng.uniform(-6, 6)), np.deg2rad(rng.normal(0, 2))
        cx, cy = COLUMNS / 2 + rng.uniform(-0.85, 0.85) * f, ROWS / 2 + rng.uniform(-70, 70)
    R = rotation(pitch, rng.normal(0, 0.1), roll)
    eye = np.array([near[:, 0].mean() + rng.normal(0, 0.3), near[:, 1].mean() - height_m, along])
    corners = ((world - eye) @ R.T).astype(np.float32)
    mesh = dataclasses.replace(
        scene.mesh, corners=corners, normals=normals @ R.T.astype(np.float32)
    ).part(corners[:, :, 2].max(1) > -12)
    stage = prepare(dataclasses.replace(scene, mesh=mesh, camera_from_world=R), ROWS * COLUMNS)
    K = torch.tensor([[f, 0, cx], [0, f, cy], [0, 0, 1]], dtype=torch.float64)
    sight = view_from(stage, K, (ROWS, COLUMNS), torch.zeros(3))
    if float((sight.raster.depth_m < 2).float().mean()) > 0.15:
        return None
    light = draw_light(stage, sight)
    return images.given(f"{index}", expose(light, draw_sensors(rng, light, 0.3)[0]), f)


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


def gather(options: argparse.Namespace) -> Iterator[tuple[str, bool, StereoInput]]:
    """Give images with their kind (of streets, where they come from), and whether they are one."""
    rng = np.random.default_rng(1)
    for index in range(options.views):
        street = view(options.seed, index)
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
    for source, name, whole in images.whole_pictures(options.pictures):
        for _, part in images.parts(whole):
            yield source, False, images.given(name, part)
    for kind, image in images.shapes():
        yield kind, False, images.given(kind, image)


@torch.no_grad()
def features(generator: SelectionGenerator, street: StereoInput) -> np.ndarray:
    """Give what the layer reads: three moments over the rows of the deepest features."""
    assert street.camera is not None
    share = generator.config.virtual_focal_px / float(street.camera.K[0, 0])
    rows, columns = (max(round(side * share), 2) for side in street.left.shape[1:])
    small = resize_image(street.left, rows, columns)[None]
    layer = torch.nn.Linear(3 * generator.encoder.channels[-1], 1)
    seen: list[torch.Tensor] = []
    layer.register_forward_hook(lambda _module, given, _found: seen.append(given[0]))
    own, generator.street = generator.street, layer
    generator.street_probability(generator.encoder(pad_to_multiple(small, 32))[-1])
    generator.street = own
    return seen[0][0].numpy()


def fit(x: np.ndarray, is_street: np.ndarray, kinds: np.ndarray, l2: float) -> np.ndarray:
    """Fit a logistic regression; both classes weigh the same, kinds by the root of their number."""
    weight = np.zeros(len(x))
    for answer in (True, False):
        for kind in np.unique(kinds[is_street == answer]):
            mine = (kinds == kind) & (is_street == answer)
            weight[mine] = mine.sum() ** -0.5
        weight[is_street == answer] /= 2 * weight[is_street == answer].sum()
    mean = weight @ x
    spread = np.sqrt(weight @ (x - mean) ** 2) + 1e-3
    given = torch.from_numpy(np.c_[(x - mean) / spread, np.ones(len(x))])
    wanted, counted = torch.from_numpy(is_street.astype(float)), torch.from_numpy(weight)
    slopes = torch.zeros(given.shape[1], dtype=torch.float64, requires_grad=True)
    solver = torch.optim.LBFGS([slopes], max_iter=60, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        solver.zero_grad()
        errors = F.binary_cross_entropy_with_logits(given @ slopes, wanted, reduction="none")
        total = counted @ errors + l2 * slopes[:-1].square().sum()
        total.backward()
        return total

    solver.step(loss)
    found = slopes.detach().numpy()
    return np.r_[found[:-1] / spread, found[-1] - found[:-1] @ (mean / spread)]


def main() -> None:
    """Gather, fit, score each kind by a fit without it, write the weights."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("weights")
    parser.add_argument("--views", type=int, default=330)
    parser.add_argument("--seed", type=int, default=43)
    parser.add_argument("--samples", type=Path)
    parser.add_argument("--pictures", type=Path, nargs="*", default=[])
    parser.add_argument("--least", type=float, default=0.0)
    parser.add_argument("--l2", type=float, default=0.01)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    found = read_depth_weights(find_weights(options.weights))
    generator = found.generator
    assert isinstance(generator, SelectionGenerator)
    looks = [(kind, is_street, features(generator, image))
             for kind, is_street, image in gather(options)]  # fmt: skip
    kinds, is_street = np.array([one[0] for one in looks]), np.array([one[1] for one in looks])
    x = np.stack([one[2] for one in looks]).astype(float)
    rows: list[dict[str, Any]] = []
    for kind in dict.fromkeys(kinds.tolist()):
        mine = kinds == kind
        slopes = fit(x[~mine], is_street[~mine], kinds[~mine], options.l2)
        logit = x[mine] @ slopes[:-1] + slopes[-1]
        rows.append({
            "images": kind, "street": bool(is_street[mine][0]), "number": int(mine.sum()),
            "refused": int((logit < options.least).sum()), "least": logit.min(),
            "median": float(np.median(logit)), "most": logit.max(),
        })  # fmt: skip
    print(markdown_table(rows))
    slopes = fit(x, is_street, kinds, options.l2)
    generator.config = dataclasses.replace(generator.config, with_street=True, least_confidence=0.5)
    generator.street = torch.nn.Linear(x.shape[1], 1)
    generator.street.weight.data = torch.from_numpy(slopes[None, :-1]).float()
    generator.street.bias.data = torch.tensor([slopes[-1] - options.least]).float()
    write_depth_weights(
        options.out, generator=generator, matcher=found.matcher, facts=found.facts, with_half=True
    )


if __name__ == "__main__":
    main()
