"""Statistics of synthetic and real streets: layout, disparity and brightness.

    python bench/streets_statistics.py --number 40

reads the real pairs of ``$DEPTHPOSE_DATA`` and renders synthetic ones of the same rig; it prints a
table and writes ``out/streets_statistics/`` (a figure for each measure). Figures of KITTI's data
fall under its licence and are never committed.
"""

import argparse
import os
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

from depthpose.core.files import read_depth_png, read_image, write_json
from depthpose.depth.config import StreetsConfig
from depthpose.depth.synthetic import draw_street

ROWS, SIZE = 36, (640, 360)
BINS = np.arange(0, 101, 4.0)


def statistics(images: list, disparities: list, scale: float) -> dict[str, np.ndarray]:
    """Means over frames, by row and by bin; disparity in pixels of full size."""
    by_row, share, brightness, contrast, histogram = [], [], [], [], np.zeros(len(BINS) - 1)
    levels, texture, color = np.zeros(32), [], []
    for image, disparity in zip(images, disparities, strict=True):
        full = (disparity / scale).numpy()
        parts = np.array_split(full, ROWS)
        known = [part[np.isfinite(part)] for part in parts]
        by_row.append([np.median(part) if len(part) else np.nan for part in known])
        share.append([np.isfinite(part).mean() for part in parts])
        grey = np.array_split(image.mean(0).numpy(), ROWS)
        brightness.append([part.mean() for part in grey])
        contrast.append([part.std() for part in grey])
        texture.append([np.abs(np.diff(part, axis=1)).mean() for part in grey])
        spread = (image.amax(0) - image.amin(0)).numpy()
        color.append([part.mean() for part in np.array_split(spread, ROWS)])
        histogram += np.histogram(full[np.isfinite(full)], BINS)[0]
        levels += np.histogram(image.mean(0).numpy(), 32, (0, 1))[0]
    return {
        "disparity by row [px]": np.nanmedian(by_row, 0),
        "known share by row": np.mean(share, 0),
        "brightness by row": np.mean(brightness, 0),
        "contrast by row": np.mean(contrast, 0),
        "texture by row": np.mean(texture, 0),
        "colour by row": np.mean(color, 0),
        "disparity histogram": histogram / histogram.sum(),
        "grey levels": levels / levels.sum(),
    }


def read_real(number: int, scale: float) -> tuple[list, list]:
    """Real pairs' left images at ``scale``, and their disparity (sparse, pixels of that scale)."""
    home = Path(os.environ["DEPTHPOSE_DATA"]) / "depth/street_pairs/kitti2015_train_drives"
    lefts = sorted((home / "left").iterdir())
    lefts = lefts[:: max(1, len(lefts) // number)]
    images, disparities = [], []
    for path in lefts:
        image = read_image(path)
        size = (round(image.shape[1] * scale), round(image.shape[2] * scale))
        images.append(torch.nn.functional.interpolate(image[None], size, mode="area")[0])
        disparities.append(read_depth_png(home / "disp_occ" / f"{path.stem}.png") * scale)
    return images, disparities


def draw_curves(path: Path, name: str, curves: dict[str, np.ndarray]) -> None:
    """Draw a curve of each kind, real black and synthetic red."""
    picture = Image.new("RGB", SIZE, "white")
    pen = ImageDraw.Draw(picture)
    top = max(float(np.nanmax(curve)) for curve in curves.values()) * 1.05
    pen.text((10, 5), f"{name}   (black real, red synthetic; top {top:.3g})", fill="black")
    for color, curve in zip(("black", "red"), curves.values(), strict=True):
        x = np.linspace(20, SIZE[0] - 20, len(curve))
        y = SIZE[1] - 15 - curve / top * (SIZE[1] - 45)
        points = [(float(a), float(b)) for a, b in zip(x, y, strict=True) if np.isfinite(b)]
        pen.line(points, fill=color, width=2)
    picture.save(path)


def main() -> None:
    """Draw, read, compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--number", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--scale", type=float, default=0.5)
    parser.add_argument("--out", type=Path, default=Path("out/streets_statistics"))
    words = parser.parse_args()
    torch.set_num_threads(1)
    config = StreetsConfig(scale=words.scale)
    frames = [draw_street(config, words.first + index) for index in range(words.number)]
    real_images, real_disparities = read_real(words.number, words.scale)
    real = statistics(real_images, real_disparities, words.scale)
    synthetic = statistics([f.left for f in frames], [f.disparity_px for f in frames], words.scale)
    words.out.mkdir(parents=True, exist_ok=True)
    for name in real:
        draw_curves(words.out / f"{name.split(' [')[0].replace(' ', '_')}.png", name,
                    {"real": real[name], "synthetic": synthetic[name]})  # fmt: skip
        print(f"{name:24s} real", np.round(real[name][::3], 3))
        print(f"{'':24s} synthetic", np.round(synthetic[name][::3], 3))
    sky = np.mean([float(f.is_sky.float().mean()) for f in frames])
    road = np.mean([float(f.is_road.float().mean()) for f in frames])
    occluded = np.mean([float(f.occluded.float().mean()) for f in frames])
    print(f"synthetic: sky {sky:.3f}, road {road:.3f}, occluded {occluded:.3f} of the pixels")
    bright = [float(one["brightness by row"].mean()) for one in (real, synthetic)]
    print(f"mean brightness: real {bright[0]:.3f}, synthetic {bright[1]:.3f}")
    # JSON has no NaN: these are rows without data.
    listed = {
        kind: {
            name: [x if np.isfinite(x) else None for x in map(float, v)] for name, v in one.items()
        }
        for kind, one in (("real", real), ("synthetic", synthetic))
    }
    write_json(words.out / "statistics.json", listed)


if __name__ == "__main__":
    main()
