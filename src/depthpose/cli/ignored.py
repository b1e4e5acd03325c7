"""Options that a command would take and ignore beside others: each is refused by its name."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from depthpose.core.errors import InputError

Given = Mapping[str, Sequence[str]]
"""Options as they were typed, without dashes, and the words after each."""


class _Rule(NamedTuple):
    """In which case some commands ignore options, and why."""

    commands: tuple[str, ...]
    case: Callable[[Given], bool]
    options: tuple[str, ...]
    why: str


def _is(option: str, *values: str) -> Callable[[Given], bool]:
    return lambda given: bool(set(given.get(option, ())) & set(values))


def _without(*options: str) -> Callable[[Given], bool]:
    return lambda given: not any(option in given for option in options)


def _all_begin(option: str, *prefixes: str) -> Callable[[Given], bool]:
    return lambda given: all(word.startswith(prefixes) for word in given.get(option, [""]))


def _has_idle_gpus(given: Given) -> bool:
    on_cpu = given.get("device", ["cpu"])[:1] == ["cpu"]
    return on_cpu and given.get("worker-gpus", ["0"])[:1] not in (["0"], ["0.0"])


_POSES = ("pose predict", "pose track")
_MEASURED = ("pose evaluate",)
_RULES = (
    _Rule(_POSES, _is("method", "register"),
          ("weights", "voting", "hypotheses", "batch", "device"),
          "--method register fits the CAD file alone, one input after the other on the processor"),
    _Rule(("pose predict",), _is("voting", "least-squares"), ("hypotheses",),
          "--voting least-squares draws no hypotheses"),
    _Rule(("pose predict",), lambda given: "depth" in given and "mask" not in given, ("batch",),
          "an image without --mask is searched alone"),
    _Rule(("pose predict", "depth predict"), _is("engine", "ray"), ("view",),
          "the workers of --engine ray show nothing"),
    _Rule(("pose predict", "depth predict", "depth match"), _has_idle_gpus, ("worker-gpus",),
          "the workers compute on the processor without --device cuda"),
    _Rule(("pose track",), _without("bop"), ("split",), "it is of a data set; give --bop"),
    _Rule(_MEASURED, _without("weights"), ("masks", "voting", "icp", "device"),
          "nothing is estimated: --csv and --predictions are measured as they are"),
    _Rule(_MEASURED, _all_begin("weights", "register", "open3d"), ("voting", "device"),
          "register and open3d do not vote, and compute on the processor"),
    _Rule(("depth predict",), _is("answer", "own"), ("precision", "max-memory"),
          "they are for a matcher with weights, and with --answer own none runs"),
    _Rule(("depth evaluate",), _without("baseline", "floor"), ("train", "train-without"),
          "they are for --baseline; add it"),
    _Rule(("depth evaluate",), _without("train"), ("train-without",),
          "it leaves frames out of --train, and none is given"),
    _Rule(("depth evaluate",), _without("matcher"), ("holes",), "it is for --matcher sgbm"),
    _Rule(("depth evaluate",), _is("protocol", "kitti-2015"), ("cap",),
          "--protocol kitti-2015 measures disparity, without a limit in metres"),
    _Rule(("depth evaluate",), _all_begin("weights", "quick:", "fine:"), ("speed",),
          "'quick:' and 'fine:' say the speed of these weights"),
    _Rule(("depth evaluate",), _all_begin("weights", "own:"), ("precision", "max-memory"),
          "they are for a matcher with weights, and with 'own:' none runs"),
    _Rule(("data export-depth",), _is("format", "colmap"), ("files",),
          "--format colmap has one kind of file; --files is for nerfstudio"),
    _Rule(("weights complete",), lambda given: all(Path(w).is_dir() for w in given["models"]),
          ("unit",), "the models of a data set are in mm; --unit is for a model file"),
    _Rule(("pose calibrate",), _is("negatives", "0"), ("max-negative-share",),
          "with --negatives 0 there are none"),
    _Rule(("reproduce all",), _without("kitti"), ("split", "protocol"), "they are for --kitti"),
)  # fmt: skip


def refuse_ignored_options(command: str, words: Sequence[str]) -> None:
    """Refuse what the command would ignore.

    Args:
        command: its name.
        words: what follows the name.

    Raises:
        InputError: options that have no effect beside the others; why, and to leave them out.
    """
    given: dict[str, list[str]] = {}
    typed: dict[str, str] = {}
    here: list[str] = []
    for word in words:
        if word.startswith("--"):
            option, sign, value = word.removeprefix("--").partition("=")
            name = option.replace("_", "-").removeprefix("no-")
            typed[name], here = f"--{option}", given.setdefault(name, [])
            here += [value] if sign else []
        else:
            here.append(word)
    for rule in _RULES:
        ignored = [name for name in rule.options if name in given]
        if command in rule.commands and ignored and rule.case(given):
            named = " and ".join(typed[name] for name in ignored)
            raise InputError(f"{named}: has no effect here; {rule.why}. Leave {named} out")
