"""``depthpose reproduce all``: from a data set on disk to all tables of a chapter."""

import shlex
from collections.abc import Mapping, Sequence
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
    """One command.

    Attributes:
        what: its description.
        words: arguments of ``depthpose``.
        makes: the file that it writes.
        of: files of earlier steps that it reads; it is done again if one is newer.
        is_replaced: an older ``makes`` and its card are deleted first, because the command replaces
            no file.
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


class Source(NamedTuple):
    """Where data and configs are, where results go, and how they are measured."""

    data: Path
    configs: Path
    out: Path
    device: Literal["auto", "cpu"]

    @property
    def table_device(self) -> str:
        """Name of the device for the commands of tables."""
        import torch

        return "cuda" if self.device == "auto" and torch.cuda.is_available() else "cpu"


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
        steps += depth_steps(Source(kitti, configs, out, device), split, protocol)
    if linemod is not None:
        steps += pose_steps(Source(linemod, configs, out, device))
    return walk(steps)


def depth_steps(source: Source, split: str, protocol: str) -> list[Step]:
    """List the steps from KITTI to tables 2.1, 2.2 and 2.3.

    Raises:
        InputError: frames of the tables are missing, or the folder is that of other settings.
    """
    home = _claim_depth(source, split, protocol)
    generator, matcher = home / "view/generator.safetensors", home / "stereo/matcher.safetensors"
    apart, tuned = home / "apart.safetensors", home / "finetune/fakestereo.safetensors"
    begin = ("--generator", str(generator), "--matcher", str(matcher))
    pack = ("weights", "pack", str(generator), "--matcher", str(matcher), "--out", str(apart))
    how = ("--split", split, "--protocol", protocol)

    def trained(stage: str, makes: Path, *more: str, of: Sequence[Path] = ()) -> Step:
        return _training(source, ("depth", "train", stage, *more), f"depth/{stage}.yaml", makes, of)

    def table(number: str, *weights: Path) -> Step:
        words = ("reproduce", number, "--kitti", str(source.data), *how)
        return _table(number, words, weights, source, home)

    return [
        trained("view", generator),
        trained("stereo", matcher),
        Step("both in one file", (*pack, *_TRAINED_ON), apart, (generator, matcher), True),
        table("2.1", apart),
        table("2.2", matcher),
        trained("finetune", tuned, *begin, of=(generator, matcher)),
        table("2.3", apart, tuned),
    ]


def _claim_depth(source: Source, split: str, protocol: str) -> Path:
    """Claim the folder of the steps from KITTI, whose frames must be there; give it."""
    from depthpose.cli.depth.evaluating import open_frames

    open_frames(source.data, None if split == "all" else split)  # not only after days of training
    home = source.out / "depth"
    configs = [f"depth/{stage}.yaml" for stage in ("view", "stereo", "finetune")]
    _claim(home, source, configs, {"split": split, "protocol": protocol})
    return home


def pose_steps(source: Source) -> list[Step]:
    """List the steps from Linemod_preprocessed to tables 3.1, 3.2 and 3.3.

    Raises:
        InputError: test frames are missing, or the folder is that of other settings.
    """
    from depthpose.pose.datasets import open_bop

    dataset = open_bop(source.data, "test")
    print(f"{source.data}: {len(dataset.instances)} instances to test on")
    home = source.out / "pose"
    _claim(home, source, [f"pose/{name}.yaml" for name in _POSE], {})
    steps = [
        _training(
            source,
            ("pose", "train", "--what", what),
            f"pose/{name}.yaml",
            home / f"{what}/{what}.safetensors",
        )
        for name, what in _POSE.items()
    ]
    return [*steps, *_pose_tables(source, home, [step.makes for step in steps])]


def _pose_tables(source: Source, home: Path, weights: Sequence[Path]) -> list[Step]:
    ours, pointnet, depth_image, masks = weights
    shown = ("--no-icp", "--masks", "truth", str(masks))
    steps: list[Step] = []
    for number, more, own in (
        ("3.1", shown, (ours, pointnet, depth_image)),
        ("3.2", shown, (ours,)),
        ("3.3", (), (ours,)),
    ):
        words = ("reproduce", number, "--linemod", str(source.data), *more)
        table = _table(number, words, own, source, home)
        steps.append(table._replace(of=(*table.of, masks)) if more else table)
    return steps


def walk(steps: Sequence[Step]) -> int:
    """Run the steps that are not done; stop at the first that fails.

    Returns:
        The exit code of the commands: the one that stopped, or the largest.
    """
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
        found = main(step.words)
        if found > 1:
            return found
        code = max(code, found)
    return code


def _training(
    source: Source, words: Sequence[str], config: str, makes: Path, of: Sequence[Path] = ()
) -> Step:
    """Make the step of a training, which is resumed if it was stopped."""
    end = ("--config", str(source.configs / config), "--data", str(source.data))
    end += ("--out", str(makes.parent), "--device", source.device, "--resume")
    return Step(f"training by {config}", (*words, *end), makes, of)


def _table(
    number: str, words: Sequence[str], weights: Sequence[Path], source: Source, home: Path
) -> Step:
    out = home / f"table-{number}"
    end = ("--weights", *map(str, weights), "--out", str(out))
    device = () if number == "3.3" else ("--device", source.table_device)
    return Step(f"table {number}", (*words, *end, *device), out / "report.html", weights)


def _claim(home: Path, source: Source, configs: Sequence[str], settings: Mapping[str, str]) -> None:
    """Claim the folder for this data, these configs and this protocol."""
    from depthpose.core.checkpoint import file_sha256
    from depthpose.core.run import claim_folder

    missing = [name for name in configs if not (source.configs / name).is_file()]
    if missing:
        raise InputError(
            f"{source.configs}: there is no {missing[0]}; give the folder of the thesis's configs, "
            "which is in the repository, by --configs"
        )
    files = {name: file_sha256(source.configs / name) for name in configs}
    claim_folder(home, {"data": str(source.data.resolve()), "configs": files, **settings})
