"""Images a second without ``--engine`` and by ``--engine ray`` with 1 and 2 workers.

    python bench/engine_speed.py --images 500

Needs the extra ``ray``. Each command is a process of its own, timed from its start to its end. This
includes Ray's start, which a run of one image measures. The peak memory is that of the command's
own process.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from shared import make_parser

from depthpose.core.environment import describe_environment
from depthpose.core.files import write_image
from depthpose.report.page import format_markdown_table, write_table


def main() -> None:
    """Print a Markdown table."""
    parser = make_parser(__doc__)
    parser.add_argument("--images", type=int, default=500)
    parser.add_argument("--size", type=int, nargs=2, default=(96, 160), metavar=("H", "W"))
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(Path(folder), options)
    write_table(options.out, rows, name="engine_speed")
    print(format_markdown_table(rows))
    print(describe_environment())


def measure(folder: Path, options: argparse.Namespace) -> list[dict[str, object]]:
    """Run each engine on one image, then on all of them."""
    image = torch.rand(3, *options.size, generator=torch.Generator().manual_seed(0))
    for number in range(options.images):
        write_image(folder / "in" / f"{number:06d}.png", image)
    write_image(folder / "one" / "0.png", image)
    engines: dict[str, list[str]] = {"plain": []}
    for workers in options.workers:
        engines[f"ray, {workers} workers"] = ["--engine", "ray", "--workers", str(workers)]
    rows: list[dict[str, object]] = []
    for name, arguments in engines.items():
        one_image_s, _ = predict(folder / "one", folder / f"one-{name}", arguments)
        all_s, peak_mb = predict(folder / "in", folder / f"all-{name}", arguments)
        rate_without_start = (options.images - 1) / (all_s - one_image_s)
        rows.append(
            {
                "way": name,
                "images": options.images,
                "one_image_s": round(one_image_s, 1),
                "all_s": round(all_s, 1),
                "images_per_s": round(options.images / all_s, 2),
                "images_per_s_without_start": round(rate_without_start, 2),
                "peak_mb_of_any_command": peak_mb,
            }
        )
    return rows


def predict(images: Path, out: Path, arguments: list[str]) -> tuple[float, int]:
    """Predict the depth of images; return the wall time [s] and the peak memory so far [MB]."""
    start_s = time.monotonic()
    command = [sys.executable, "-m", "depthpose", "depth", "predict", str(images),
               "--allow-ood", "--focal-px", "120", "--out", str(out), *arguments]  # fmt: skip
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wall_s = time.monotonic() - start_s
    peak_kb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return wall_s, peak_kb // 1000


if __name__ == "__main__":
    main()
