"""The options of commands: their types and how ``--help`` shows them; what is refused early.

Types become words (``{None}|PATH`` is PATH), and a default that is nothing is not shown. Paths and
weights that do not exist are refused before anything is loaded, and so is what has no effect.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from difflib import get_close_matches
from enum import Enum
from inspect import BoundArguments, signature, unwrap
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import tyro

from depthpose.core.errors import InputError
from depthpose.core.hub import find_weights, is_on_hub


class _Names(Enum):
    """What the value of an option names, where its type alone does not say it."""

    INPUT = "what is read"
    NEW = "what need not exist"
    WEIGHTS = "weights"


Source = Annotated[str, _Names.INPUT]
"""A file, folder, pattern or URL that is read; a ``Path`` is a file or folder that is read."""
NewPath = Annotated[Path, _Names.NEW]
"""A file or folder that need not exist: it is written, or the command itself says it is missing."""
NewPlace = Annotated[str, _Names.NEW]  # a folder or URL that is written
WeightsName = Annotated[str, _Names.WEIGHTS]  # weights, by name or file, or a word in their place

_WORDS = ("sgbm", "nothing", "register")  # what may be said in place of weights
_PREFIXES = "^(both|sgbm|own|matched|quick|fine):"
"""Before the name of weights: how they are used."""
_POSITIONAL = get_args(tyro.conf.Positional[int])[1]
_OF_TYPES = {Path: "PATH", str: "TEXT", int: "N", float: "NUMBER"}
_NOTHING = ("", "None")
Group = TypeVar("Group")
Config = TypeVar("Config", bound=Any)


def shown_as(metavar: str | None, help: str | None = None) -> Any:  # noqa: ANN401  tyro's own object
    """Show an option with this in the place of its value; None: as tyro does."""
    return tyro.conf.arg(
        metavar=metavar,
        help=help,
        help_behavior_hint=lambda default: "" if default in _NOTHING else f"(default: {default})",
    )


Device = Annotated[str, shown_as("DEVICE", help="cpu, cuda, cuda:1, ...")]


@dataclass_transform(frozen_default=True, kw_only_default=True)
def group(options: type[Group]) -> type[Group]:
    """Make a class a frozen dataclass of options, all of which a command gets by a parameter."""
    options = dataclass(frozen=True, kw_only=True)(options)
    for name, hint in get_type_hints(options, include_extras=True).items():
        if name in options.__annotations__:
            options.__annotations__[name] = _worded(hint)
    return options


def parser_of(command: Callable[..., int]) -> Callable[..., BoundArguments]:
    """Give tyro what parses a command's arguments: its signature, with option types in words."""
    hints = get_type_hints(command, include_extras=True)
    shape = signature(command)
    for name, parameter in shape.parameters.items():
        if not is_dataclass(parameter.default):
            hints[name] = _worded(hints[name])
    worded = [p.replace(annotation=hints[n]) for n, p in shape.parameters.items()]

    def parse(*words: object, **options: object) -> BoundArguments:
        return shape.bind(*words, **options)

    function = unwrap(parse)  # tyro looks behind what checks types in tests, and so do we
    function.__doc__, function.__module__ = command.__doc__, command.__module__
    function.__annotations__ = hints
    vars(function)["__signature__"] = shape.replace(parameters=worded)
    return function


def _worded(hint: Any) -> Any:  # noqa: ANN401  any type
    if any(getattr(mark, "metavar", None) for mark in getattr(hint, "__metadata__", ())):
        return hint  # it says itself how it is shown
    return Annotated[hint, shown_as(_metavar(hint))]


def _metavar(hint: Any) -> str | None:  # noqa: ANN401
    """Name a value; None where tyro's own name will do: of positional arguments and flags."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        if _POSITIONAL in parts or not any(isinstance(mark, _Names) for mark in parts):
            return None
        return "NAME|FILE" if _Names.WEIGHTS in parts else "PATH"
    if origin in (Union, UnionType):
        return _metavar(next(part for part in parts if part is not NoneType))
    if origin is Literal:
        return f"{{{','.join(map(str, parts))}}}"
    if origin in (tuple, list):
        one = _metavar(parts[0])
        return one and (f"{one} ..." if parts[1:] in ((), (...,)) else " ".join([one] * len(parts)))
    return _OF_TYPES.get(hint)


def _names(hint: Any) -> _Names | None:  # noqa: ANN401
    """Say what values of a type name, alone or in a tuple or a list."""
    if hint is Path:
        return _Names.INPUT
    parts = get_args(hint)
    own = next((part for part in parts if isinstance(part, _Names)), None)
    return own or next((found for part in parts if (found := _names(part)) is not None), None)


def _options_of(command: Callable[..., int]) -> Iterator[tuple[str, str, _Names | None]]:
    """Give the parameter, option and kind of each option; of groups too."""
    hints = get_type_hints(command, include_extras=True)
    for name, parameter in signature(command).parameters.items():
        if is_dataclass(parameter.default):
            fields = get_type_hints(type(parameter.default), include_extras=True)
            yield from ((name, field, _names(hint)) for field, hint in fields.items())
        elif name in hints:
            yield name, name, _names(hints[name])


def refuse_empty(command: Callable[..., int], words: Sequence[str]) -> None:
    """Refuse a file or folder without a name, as of a script whose variable is unset."""
    paths = {option for _, option, kind in _options_of(command) if kind is not None}
    for word, after in pairwise([*words, "end"]):
        option, sign, value = word.partition("=")
        is_path = option.startswith("--") and option[2:].replace("-", "_") in paths
        if is_path and (value if sign else after) == "":
            raise InputError(
                f"{option} is empty; name a file or folder (the current folder is '.'), or check "
                "the variable that should hold it"
            )


def refuse_missing(command: Callable[..., int], values: Mapping[str, Any]) -> None:
    """Refuse paths and weights that do not exist."""
    for name, option, kind in _options_of(command):
        if name not in values or kind in (None, _Names.NEW):
            continue
        value = values[name] if name == option else getattr(values[name], option)
        for one in value if isinstance(value, list | tuple) else [value]:
            if kind is _Names.WEIGHTS and one is not None:
                bare = re.sub(_PREFIXES, "", one)
                if bare not in _WORDS and not is_on_hub(bare):
                    find_weights(bare)
            elif one is not None and not any(mark in str(one) for mark in ("://", *"*?[{")):
                wanted = Path(one)
                if wanted.exists():
                    continue
                home = wanted.parent
                beside = [path.name for path in home.iterdir()] if home.is_dir() else []
                near = get_close_matches(wanted.name, beside, n=1)
                hint = f"did you mean {str(home / near[0])!r}?" if near else "check the path"
                raise InputError(f"{one}: there is no such file or folder; {hint}")


def refuse_below(least: int, option: str, value: int, usual: str) -> None:
    """Refuse a count that is too small."""
    if value < least:
        raise InputError(f"{option} {value}: give {least} or more, such as {usual}")


def changed(config: Config, **values: object) -> Config:
    """Give a config with other values; None leaves a setting as it is."""
    return replace(config, **{k: v for k, v in values.items() if v is not None})


class Typed(dict[str, list[str]]):
    """The words after each option as they were typed, by its name; none of an absent one."""

    def __missing__(self, name: str) -> list[str]:
        """Give no words, and remember none."""
        return []

    def all_begin(self, option: str, *prefixes: str) -> bool:
        """Whether an option has words, and all of them begin so."""
        return bool(self[option]) and all(word.startswith(prefixes) for word in self[option])


_NETWORK = "precision max-memory"
_OF_FOLDER = "it chooses from a data set, and none is named; give --linemod or --bop"
_Case = Callable[[Typed], bool]
_RULES: tuple[tuple[str, _Case, str, str], ...] = (
    ("pose predict, pose track", lambda o: "register" in o["method"],
     "weights voting hypotheses batch device",
     "--method register fits the CAD file alone, one input after the other on the processor"),
    ("pose predict, pose track", lambda o: "register" not in o["method"], "cad",
     "weights know their own objects; add --method register, or train weights of this part by "
     "'depthpose pose train --cad'"),
    ("pose predict, pose track", lambda o: "cad" not in o, "cad-unit",
     "it is the unit of --cad, and no CAD file is given"),
    ("pose predict, pose track", lambda o: "bop" in o, "cad", "the models of --bop are taken"),
    ("pose predict, pose track", lambda o: "bop" in o, "mask camera focal-px unit",
     "a data set says its cameras and units itself, and its masks are chosen by --masks"),
    ("pose predict", lambda o: "bop" in o and "ray" in o["engine"], "engine",
     "a data set is posed by this process, or shared by those of torchrun"),
    ("pose predict", lambda o: "bop" not in o, "split masks targets",
     "--bop names no data set; the mask of a depth image is given by --mask"),
    ("pose predict, pose track", lambda o: "cloud" in o, "mask camera focal-px",
     "a cloud is of the object alone, in the camera's frame"),
    ("pose predict, depth predict", lambda o: "camera" in o, "focal-px fov",
     "--camera has the focal length"),
    ("depth predict", lambda o: "focal-px" in o, "fov", "--focal-px is the focal length"),
    ("pose predict", lambda o: "least-squares" in o["voting"], "hypotheses",
     "--voting least-squares draws no hypotheses"),
    ("pose predict", lambda o: "depth" in o and "mask" not in o and "ray" not in o["engine"],
     "batch register-refused",
     "an image without --mask is searched alone, and registers nothing; give --mask"),
    ("pose track", lambda o: "bop" not in o, "split", "it is of a data set; give --bop"),
    ("pose track", lambda o: "bop" in o, "first",
     "a data set has many sequences and one pose is given; give the frames of one by --depth"),
    ("pose evaluate", lambda o: "weights" not in o, "masks voting icp device",
     "nothing is estimated: --csv and --predictions are measured as they are"),
    ("pose evaluate", lambda o: o.all_begin("weights", "register"), "voting device",
     "register does not vote, and computes on the processor"),
    ("pose predict, depth predict, depth match",
     lambda o: "ray" not in o["engine"], "address workers worker-cpus worker-gpus block",
     "--engine ray takes it, and is not given; add it"),
    ("pose predict, depth predict, depth match",
     lambda o: o["device"][:1] in ([], ["cpu"]) and o["worker-gpus"][:1] not in (["0"], ["0.0"]),
     "worker-gpus", "the workers compute on the processor without --device cuda"),
    ("depth predict", lambda o: "camera-height" in o, "known-distance",
     "--camera-height sets the scale"),
    ("depth predict", lambda o: "matcher" in o, "answer",
     "the depth is that of --matcher on the synthesised view"),
    ("depth predict", lambda o: "own" in o["answer"] or "sgbm" in o["matcher"], _NETWORK,
     "no matcher with weights runs here"),
    ("depth match", lambda o: "matcher" in o, "weights", "--matcher matches the pair"),
    ("depth match", lambda o: "sgbm" in o["matcher"],
     f"device speed {_NETWORK} left-right-check",
     "sgbm has no weights"),
    ("depth evaluate", lambda o: "baseline" not in o, "train train-without",
     "--baseline takes it, and is not given; add it"),
    ("depth evaluate, reproduce", lambda o: "train" not in o, "train-without",
     "it leaves frames out of --train, and none is given"),
    ("depth evaluate", lambda o: "matcher" not in o, "holes", "it is for --matcher sgbm"),
    ("depth evaluate", lambda o: "kitti-2015" in o["protocol"], "cap",
     "--protocol kitti-2015 measures disparity, without a limit in metres"),
    ("depth evaluate", lambda o: o.all_begin("weights", "quick:", "fine:"), "speed",
     "'quick:' and 'fine:' say the speed of these weights"),
    ("depth evaluate, reproduce", lambda o: o.all_begin("weights", "own:", "sgbm:"), _NETWORK,
     "with 'own:' and 'sgbm:' no matcher with weights runs"),
    ("depth evaluate, reproduce", lambda o: "weights" not in o, f"device {_NETWORK} speed",
     "no network is measured"),
    ("weights complete", lambda o: all(Path(word).is_dir() for word in o["models"]), "unit",
     "the models of a data set are in mm; --unit is for a model file"),
    ("reproduce 3.1, reproduce 3.2, reproduce 3.3, figure 3-2, figure 3-4, figure 3-5",
     lambda o: "linemod" not in o and "bop" not in o, "objects split", _OF_FOLDER),
    ("reproduce 3.1, reproduce 3.2, reproduce 3.3, figure 3-2, figure 3-4, figure 3-5",
     lambda o: "linemod" in o, "bop", "--linemod names the data set, and one is measured"),
    ("reproduce 3.3", lambda o: "linemod" in o or "bop" in o, "synthetic",
     "views are rendered where no data set is given"),
)  # fmt: skip
"""Commands, in which case they ignore options, which, and why."""


def refuse_ignored_options(command: str, words: Sequence[str]) -> None:
    """Refuse what the command would ignore."""
    typed, spelled = Typed(), dict[str, str]()
    here: list[str] = []
    for word in words:
        if word.startswith("--"):
            option, sign, value = word.removeprefix("--").partition("=")
            name = option.replace("_", "-").removeprefix("no-")
            spelled[name], here = f"--{option}", typed.setdefault(name, [])
            here += [value] if sign else []
        else:
            here.append(word)
    for commands, case, options, why in _RULES:
        ignored = [spelled[name] for name in options.split() if name in typed]
        if ignored and command in commands.split(", ") and case(typed):
            named = " and ".join(ignored)
            raise InputError(f"{named}: has no effect here; {why}. Leave {named} out")
