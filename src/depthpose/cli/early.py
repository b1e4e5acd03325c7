"""Paths and weights that lead nowhere, told before anything heavy is imported."""

from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path

from depthpose.core.errors import InputError
from depthpose.core.hub import is_on_hub
from depthpose.core.shipped import find_weights

PATHS = frozenset({
    *("images", "left", "right", "camera", "cloud", "depth", "mask", "bop", "data", "held_out"),
    *("train", "evaluation", "path", "config", "cad", "csv", "predictions", "targets", "file"),
    *("models", "kitti", "linemod", "results"),
})  # fmt: skip
"""Arguments of commands that name files or folders that are read."""
WEIGHTS = frozenset({"weights", "pose_weights", "matcher", "generator", "start", "encoder"})
"""Arguments that name weights, by name or file."""
_WORDS = ("psmnet", "sgbm", "nothing", "open3d")
"""What they may say in place of weights."""
_PREFIXES = ("both:", "sgbm:", "own:", "matched:", "joined:", "quick:", "fine:")
"""Before the name of weights: how they are used."""


def refuse_missing(given: Mapping[str, object]) -> None:
    """Refuse what a command would look for in vain.

    Args:
        given: the arguments of a command by name.

    Raises:
        InputError: a path or weights that are not there.
    """
    for name, value in given.items():
        for one in value if isinstance(value, list | tuple) else [value]:
            if name in PATHS and isinstance(one, str | Path):
                _refuse_path(str(one))
            elif name in WEIGHTS and isinstance(one, str):
                _refuse_weights(one)


def _refuse_path(path: str) -> None:
    if any(mark in path for mark in ("://", "*", "?", "[", "{")) or Path(path).exists():
        return
    wanted = Path(path)
    beside = [p.name for p in wanted.parent.iterdir()] if wanted.parent.is_dir() else []
    near = get_close_matches(wanted.name, beside, n=1)
    hint = f"; did you mean {str(wanted.parent / near[0])!r}?" if near else "; check the path"
    raise InputError(f"{path}: there is no such file or folder{hint}")


def _refuse_weights(name: str) -> None:
    for prefix in _PREFIXES:
        name = name.removeprefix(prefix)
    if name not in _WORDS and not is_on_hub(name):
        find_weights(name)
