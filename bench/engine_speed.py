"""Images a second without ``--engine`` and by ``--engine ray`` with 1 and 2 workers.

Run: ``.venv/bin/python bench/engine_speed.py --images 500`` (needs the extra ``ray``). Each command
is a separate process, timed from its start to its end. This includes Ray's start, which is also
measured by a run of one image. The peak memory is that of the command's own process.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

from depthpose.core.files import write_image
from depthpose.core.run import environment
from depthpose.report.page import markdown_table, write_table


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=500)
    parser.add_argument("--size", type=int, nargs=2, default=(96, 160), metavar=("H", "W"))
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = _measure(Path(folder), asked)
    write_table(asked.out, rows, name="engine_speed")
    print(markdown_table(rows))
    print(environment())


def _measure(home: Path, asked: argparse.Namespace) -> list[dict[str, object]]:
    image = torch.rand(3, *asked.size, generator=torch.Generator().manual_seed(0))
    for number in range(asked.images):
        write_image(home / "in" / f"{number:06d}.png", image)
    write_image(home / "one" / "0.png", image)
    ways = [("plain", [])] + [
        (f"ray, {n} workers", ["--engine", "ray", "--workers", str(n)]) for n in asked.workers
    ]
    rows: list[dict[str, object]] = []
    for name, words in ways:
        start_s, _ = _run(home / "one", home / f"one-{name}", words)
        whole_s, peak_mb = _run(home / "in", home / f"all-{name}", words)
        rows.append(
            {
                "way": name, "images": asked.images, "one_image_s": round(start_s, 1),
                "all_s": round(whole_s, 1), "images_per_s": round(asked.images / whole_s, 2),
                "images_per_s_without_start": round((asked.images - 1) / (whole_s - start_s), 2),
                "peak_mb_of_any_command": peak_mb,
            }
        )  # fmt: skip
    return rows


def _run(images: Path, out: Path, words: list[str]) -> tuple[float, int]:
    start = time.monotonic()
    command = [sys.executable, "-m", "depthpose", "depth", "predict", str(images),
               "--allow-ood", "--focal-px", "120", "--out", str(out), *words]  # fmt: skip
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    peak_kb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return time.monotonic() - start, peak_kb // 1000


if __name__ == "__main__":
    main()
