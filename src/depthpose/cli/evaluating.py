"""The work behind ``depthpose depth evaluate``."""

import sys
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from depthpose.cli.methods import Method
from depthpose.core.report import Section, markdown_table, write_page, write_table
from depthpose.core.run import environment, read_settings
from depthpose.depth.evaluate import PROTOCOLS, Protocol, evaluate, has_truth
from depthpose.depth.kitti import Dataset, open_dataset
from depthpose.depth.predictions import predict


def open_frames(data: Path, split: str | None) -> Dataset:
    """Open the dataset and say what it is."""
    dataset = open_dataset(data, split)
    print(f"{dataset.name}: {len(dataset)} frames, layout {dataset.layout}")
    return dataset


def predict_all(dataset: Dataset, method: Method, rule: Protocol, folder: Path) -> Path:
    """Predict every frame that has a right view and truth to compare with; give the folder."""
    frames = list(enumerate(dataset.frames))
    usable = [i for i, frame in frames if frame.right is not None and has_truth(frame, rule)]
    names = [dataset.frames[i].name for i in usable]
    readers = [partial(dataset.read_input, i) for i in usable]
    home = folder / method.name
    written = predict(method.net, readers, names, home, method.settings)
    for _ in tqdm(written, method.name, total=len(names), disable=None, unit=" frames"):
        pass
    return home


def measure(
    dataset: Dataset, folders: Sequence[Path], protocol: str, caps_m: Sequence[float], out: Path
) -> int:
    """Measure the predictions, write rows.json, rows.csv, table.md and report.html, and print."""
    rows: list[dict[str, Any]] = []
    frames: list[dict[str, Any]] = []
    skipped: dict[str, str] = {}
    for folder in folders:
        result = evaluate(dataset, folder, protocol, caps_m, _show_progress)
        rows += [_describe(folder) | row for row in result.rows]
        frames += [{"method": _describe(folder)["method"]} | row for row in result.per_frame]
        skipped |= result.skipped
    write_table(out, rows)
    write_table(out, frames, name="frames")
    page = out / "report.html"
    write_page(
        page, f"{protocol} on {dataset.name}", _sections(rows, frames, skipped), environment()
    )
    print(markdown_table(rows))
    for name, why in skipped.items():
        print(f"skipped: {name}: {why}", file=sys.stderr)
    print(f"{len(skipped)} frames skipped; the page: {page}")
    return 0


def _show_progress(frames: Sequence[int]) -> Iterable[int]:
    return tqdm(frames, unit=" frames", disable=None)


def _describe(predictions: Path) -> dict[str, Any]:
    """Columns that say whose predictions these are."""
    settings = read_settings(predictions)
    if settings is None:
        return {"method": predictions.name, "weights": "", "weights_sha256": ""}
    holes = {True: " (holes filled)", False: " (matched pixels)"}
    suffix = holes.get(settings.get("with_filled_holes", ""), "")
    return {
        "method": settings.get("matcher", "") + suffix,
        "weights": settings.get("weights", ""),
        "weights_sha256": settings.get("weights_sha256", "")[:12],
    }


def _sections(
    rows: list[dict[str, Any]], frames: list[dict[str, Any]], skipped: dict[str, str]
) -> list[Section]:
    protocol = rows[0]["protocol"]
    summary = f"{protocol}: {PROTOCOLS[protocol].summary}."
    without_truth = [{"frame": name, "why": why} for name, why in skipped.items()]
    sections = [
        Section(title="Mean over frames", text=summary, rows=rows),
        Section(title="Each frame", rows=frames),
        Section(title="Skipped frames", rows=without_truth),
    ]
    return [section for section in sections if section.rows]
