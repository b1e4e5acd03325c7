"""``depthpose reproduce all``: from a data set on disk to all tables of a chapter."""

import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

from depthpose.core.errors import InputError

_TRAINED_ON = ("--trained-on", "KITTI raw", "--licence", "not stated; that of KITTI binds")
_POSE = {
    "thesis": "pose",
    "thesis-pointnet": "pointnet",
    "thesis-depth-image": "depth-image",
    "thesis-masks": "segmentation",
}
"""Configs of chapter 3, the network that each trains, and the name of its weights."""


class Step(NamedTuple):
    """One command: its description, the arguments of ``depthpose``, and the file that it makes.

    It is done again if a file of earlier steps, ``of``, is newer. ``is_replaced``: an older file
    and its card are deleted first, because the command replaces none.
    """

    what: str
    words: Sequence[str]
    makes: Path
    of: Sequence[Path] = ()
    is_replaced: bool = False

    @property
    def is_done(self) -> bool:
        """Whether what it makes is there, and not older than what it is made of."""
        if not self.makes.is_file():
            return False
        made = self.makes.stat().st_mtime
        return all(path.is_file() and path.stat().st_mtime <= made for path in self.of)


def reproduce_all(
    out: Path,
    kitti: Path | None = None,
    linemod: Path | None = None,
    configs: Path = Path("configs"),
    split: str = "eigen-test",
    protocol: str = "eigen-raw",
    device: Literal["auto", "cpu"] = "auto",
) -> int:
    """Reproduce all tables of the thesis from data on disk: trainings first, then tables.

    From KITTI: the generator, the matcher and fine-tuning, then tables 2.1, 2.2 and 2.3. From
    Linemod_preprocessed: the network of directions, its two baselines and the segmentation, then
    tables 3.1, 3.2 and 3.3, with true and with found masks, poses by votes alone as published.
    Each step is a command, which is printed. Run again, it skips finished steps and resumes an
    interrupted training. The thesis's trainings take days on a GPU.

        depthpose reproduce all --kitti /data/kitti --out out/thesis
        depthpose reproduce all --linemod /data/Linemod_preprocessed --out out/thesis

    Args:
        out: folder of trainings and tables.
        kitti: KITTI raw with LiDAR: drives of training and test.
        linemod: Linemod_preprocessed.
        configs: folder of depth/view.yaml, stereo.yaml, finetune.yaml, and of pose/thesis.yaml,
            thesis-pointnet.yaml, thesis-depth-image.yaml, thesis-masks.yaml (see the repository).
        split: KITTI frames of the tables: eigen-test, a file of frames, or all.
        protocol: how depth is compared; eigen-raw is the thesis's.
        device: auto: a GPU where there is one; cpu: none.
    """
    from depthpose.core.run import find_rank

    if kitti is None and linemod is None:
        raise InputError("there is nothing to reproduce from: give --kitti or --linemod FOLDER.")
    if find_rank().world > 1:
        raise InputError(
            "'reproduce all' runs its steps one after the other in one process; launch the "
            "trainings that it prints one by one, then run it again"
        )
    steps: list[Step] = []
    if kitti is not None:
        steps += _depth_steps(kitti, configs, out / "depth", device, split, protocol)
    if linemod is not None:
        steps += _pose_steps(linemod, configs, out / "pose", device)
    return walk(steps)


def _depth_steps(
    kitti: Path, configs: Path, home: Path, device: str, split: str, protocol: str
) -> list[Step]:
    """List the steps from KITTI to tables 2.1, 2.2 and 2.3."""
    from depthpose.cli.depth.evaluating import open_frames

    open_frames(kitti, None if split == "all" else split)  # not only after days of training
    names = [f"depth/{stage}.yaml" for stage in ("view", "stereo", "finetune")]
    _claim(home, kitti, configs, names, {"split": split, "protocol": protocol})
    generator, matcher = home / "view/generator.safetensors", home / "stereo/matcher.safetensors"
    apart, tuned = home / "apart.safetensors", home / "finetune/fakestereo.safetensors"
    begin = ("--generator", str(generator), "--matcher", str(matcher))
    pack = ("weights", "pack", str(generator), "--matcher", str(matcher), "--out", str(apart))
    train = partial(_training, kitti, configs, device)
    how = ("--kitti", str(kitti), "--split", split, "--protocol", protocol)
    table = partial(_table, home, device, how)
    return [
        train("depth/view.yaml", ("depth", "train", "view"), generator),
        train("depth/stereo.yaml", ("depth", "train", "stereo"), matcher),
        Step("both in one file", (*pack, *_TRAINED_ON), apart, (generator, matcher), True),
        table("2.1", (apart,)),
        table("2.2", (matcher,)),
        train("depth/finetune.yaml", ("depth", "train", "finetune", *begin), tuned)._replace(
            of=(generator, matcher)
        ),
        table("2.3", (apart, tuned)),
    ]


def _pose_steps(linemod: Path, configs: Path, home: Path, device: str) -> list[Step]:
    """List the steps from Linemod_preprocessed to tables 3.1, 3.2 and 3.3."""
    from depthpose.pose.datasets import open_bop

    dataset = open_bop(linemod, "test")
    print(f"{linemod}: {len(dataset.instances)} instances to test on")
    _claim(home, linemod, configs, [f"pose/{name}.yaml" for name in _POSE], {})
    steps: list[Step] = []
    for name, what in _POSE.items():
        words, makes = ("pose", "train", "--what", what), home / f"{what}/{what}.safetensors"
        steps.append(_training(linemod, configs, device, f"pose/{name}.yaml", words, makes))
    ours, pointnet, depth_image, masks = [step.makes for step in steps]
    data = ("--linemod", str(linemod))
    shown = (*data, "--no-icp", "--masks", "truth", str(masks))
    for number, weights in (("3.1", (ours, pointnet, depth_image)), ("3.2", (ours,))):
        table = _table(home, device, shown, number, weights)
        steps.append(table._replace(of=(*weights, masks)))
    return [*steps, _table(home, device, data, "3.3", (ours,))]


def walk(steps: Sequence[Step]) -> int:
    """Run what is not done, to the first that fails; give its exit code, or the largest."""
    from depthpose.cli import main

    code = 0
    for number, step in enumerate(steps, 1):
        head = f"[{number}/{len(steps)}] {step.what}"
        if step.is_done:
            print(f"{head}: done, {step.makes}", flush=True)
            continue
        print(f"{head}: depthpose {shlex.join(step.words)}", flush=True)
        if step.is_replaced:
            for path in (step.makes, step.makes.with_suffix(".md")):
                path.unlink(missing_ok=True)
        own = main(step.words)
        if own > 1:
            return own
        code = max(code, own)
    return code


def _training(
    data: Path, configs: Path, device: str, config: str, words: Sequence[str], makes: Path
) -> Step:
    """Make the step of a training, which is resumed if it was stopped."""
    end = ("--config", str(configs / config), "--data", str(data))
    end += ("--out", str(makes.parent), "--device", device, "--resume")
    return Step(f"training by {config}", (*words, *end), makes)


def _table(
    home: Path, device: str, words: Sequence[str], number: str, weights: Sequence[Path]
) -> Step:
    import torch

    out = home / f"table-{number}"
    every = ("reproduce", number, *words, "--weights", *map(str, weights), "--out", str(out))
    if number != "3.3":  # it has no such option
        is_gpu = device == "auto" and torch.cuda.is_available()
        every += ("--device", "cuda" if is_gpu else "cpu")
    return Step(f"table {number}", every, out / "report.html", weights)


def _claim(
    home: Path, data: Path, configs: Path, names: Sequence[str], settings: Mapping[str, str]
) -> None:
    """Claim the folder for this data, these configs and this protocol."""
    from depthpose.core.checkpoint import file_sha256
    from depthpose.core.run import claim_folder

    missing = [name for name in names if not (configs / name).is_file()]
    if missing:
        raise InputError(
            f"{configs}: there is no {missing[0]}; give the folder of the thesis's configs, which "
            "is in the repository, by --configs"
        )
    files = {name: file_sha256(configs / name) for name in names}
    claim_folder(home, {"data": str(data.resolve()), "configs": files, **settings})
