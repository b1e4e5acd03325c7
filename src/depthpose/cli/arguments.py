"""The options of commands: their types and how ``--help`` shows them; what is refused early.

Types become words (``{None}|PATH`` is PATH), and a default that is nothing is not shown. Paths and
weights that do not exist are refused before anything is loaded, and so is what has no effect.
"""

import os
import re
import shutil
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass, replace
from difflib import get_close_matches
from enum import Enum
from functools import partial
from inspect import BoundArguments, cleandoc, signature, unwrap
from itertools import groupby
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import docstring_parser
import tyro

from depthpose.core.errors import InputError


class _Names(Enum):
    """What the value of an option names, where its type does not say so."""

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
_WIDEST = 100
"""Characters of a line of help; a wider terminal is not filled, for long lines are hard to read."""
Config = TypeVar("Config", bound=Any)


shown_as = partial(
    tyro.conf.arg,
    help_behavior_hint=lambda default: "" if default in _NOTHING else f"(default: {default})",
)
"""Show an option with this ``metavar`` in the place of its value; None: as tyro does."""

Device = Annotated[str, shown_as(metavar="DEVICE", help="cpu, cuda, cuda:1, ...")]


class Option(NamedTuple):
    """An option of a command, and what its value names, if anything."""

    parameter: str  #: of the command; an option of a group is a field of it
    name: str
    names: _Names | None


def parser_of(
    command: Callable[..., int],
) -> tuple[Callable[..., BoundArguments], list[Option]]:
    """Make the parser of a command for tyro, with its options."""
    hints = get_type_hints(command, include_extras=True)
    shape = signature(command)
    options: list[Option] = []
    for parameter in shape.parameters.values():
        group = type(parameter.default) if is_dataclass(parameter.default) else None
        types = {parameter.name: hints[parameter.name]}
        types = types if group is None else get_type_hints(group, include_extras=True)
        texts = _help_texts(command if group is None else group)
        for name, hint in types.items():
            metavar, names = _described(hint)
            options.append(Option(parameter.name, name, names))
            has_metavar = any(
                hasattr(mark, "metavar") for mark in getattr(hint, "__metadata__", ())
            )
            shown = shown_as(metavar=None if has_metavar else metavar, help=texts.get(name))
            types[name] = Annotated[hint, shown]
        if group is None:
            hints |= types
        else:
            group.__annotations__ = types
    worded = [p.replace(annotation=hints[n]) for n, p in shape.parameters.items()]

    def parse(*words: object, **options: object) -> BoundArguments:
        return shape.bind(*words, **options)

    function = unwrap(parse)  # tyro looks behind what checks types in tests, and so do we
    function.__doc__ = command.__doc__
    function.__module__ = command.__module__
    function.__annotations__ = hints
    vars(function)["__signature__"] = shape.replace(parameters=worded)
    return function, options


def _help_texts(described: type | Callable[..., int]) -> dict[str, str]:
    """Read what the docstrings of a command or a group of options say of each option.

    A text is one line: tyro keeps the line breaks of indented docstrings, which belong to the code.
    """
    texts: dict[str, str] = {}
    for source in reversed(described.mro()) if isinstance(described, type) else [described]:
        if source is not object:
            parameters = docstring_parser.parse_from_object(source).params
            texts |= {p.arg_name: " ".join((p.description or "").split()) for p in parameters}
    return texts


def description_of(command: Callable[..., int]) -> str:
    """Give a command's docstring without its arguments, wrapped to the terminal's width.

    Lines are indented, since tyro joins those that begin with a letter; lines that the docstring
    indents (examples, lists) stay as they are.
    """
    width = min(shutil.get_terminal_size().columns, _WIDEST) - 2
    text = cleandoc(command.__doc__ or "").partition("\nArgs:")[0].strip()
    wrapped: list[str] = []
    for is_prose, run in groupby(text.splitlines(), lambda line: line[:1] not in ("", " ")):
        lines = list(run)
        wrapped += textwrap.wrap(" ".join(lines), width) if is_prose else lines
    return textwrap.indent("\n".join(wrapped), "  ")


def _described(hint: Any) -> tuple[str | None, _Names | None]:  # noqa: ANN401  any type
    """Give the placeholder of a value, None where tyro's will do, and what it names."""
    origin = get_origin(hint)
    parts = get_args(hint)
    if origin is Annotated:
        named = next((mark for mark in parts if isinstance(mark, _Names)), None)
        if named is None:
            return None, _described(parts[0])[1]
        word = "NAME|FILE" if named is _Names.WEIGHTS else "PATH"
        return None if _POSITIONAL in parts else word, named
    if origin in (Union, UnionType):
        return _described(next(part for part in parts if part is not NoneType))
    if origin is Literal:
        return f"{{{','.join(map(str, parts))}}}", None
    if origin in (tuple, list):
        word, names = _described(parts[0])
        many = f"{word} ..." if parts[1:] in ((), (...,)) else " ".join([str(word)] * len(parts))
        return word and many, names
    return _OF_TYPES.get(hint), _Names.INPUT if hint is Path else None


def refuse_missing(options: Sequence[Option], values: Mapping[str, Any]) -> None:
    """Refuse paths and weights that do not exist; paths first: weights are looked up by torch.

    What need not exist is refused where a broken link is on its way.
    """
    for parameter, name, names in sorted(options, key=lambda option: option[2] is _Names.WEIGHTS):
        if parameter not in values or names is None:
            continue
        value = values[parameter] if parameter == name else getattr(values[parameter], name)
        for word in value if isinstance(value, list | tuple) else [value]:
            if names is _Names.WEIGHTS and word is not None:
                bare = re.sub(_PREFIXES, "", word)
                if bare not in _WORDS and not bare.startswith("hf:/"):  # of the hub
                    from depthpose.core.checkpoint import find_weights  # loads torch

                    find_weights(bare)
            elif word is not None and not any(mark in str(word) for mark in ("://", *"*?[{")):
                wanted = Path(word)
                if wanted.exists():
                    continue
                if any(map(os.path.islink, (wanted, *wanted.parents))):
                    from depthpose.core.files.disk import refuse_broken_link  # loads torch

                    refuse_broken_link(wanted)
                if names is _Names.NEW:
                    continue
                home = wanted.parent
                beside = [path.name for path in home.iterdir()] if home.is_dir() else []
                near = get_close_matches(wanted.name, beside, n=1)
                hint = f"did you mean {str(home / near[0])!r}?" if near else "check the path"
                raise InputError(f"{word}: there is no such file or folder; {hint}")


def refuse_below(least: int, option: str, value: int, usual: str) -> None:
    """Refuse a count that is too small."""
    if value < least:
        raise InputError(f"{option} {value}: give {least} or more, such as {usual}")


def changed(config: Config, **values: object) -> Config:
    """Return a config with other values; None leaves a setting as it is."""
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
    ("pose predict, pose track",
     lambda o: "register" in o["method"] or ("cad" in o and "method" not in o),
     "weights voting hypotheses batch device",
     "CAD files are posed without a network, one input after the other on the processor"),
    ("pose predict, pose track", lambda o: "network" in o["method"], "cad symmetry",
     "weights know their own objects; leave --method network out, or train weights of this part by "
     "'depthpose pose train --cad'"),
    ("pose predict, pose track", lambda o: "cad" not in o and "bin" not in o, "cad-unit",
     "it is the unit of --cad, and no CAD file is given"),
    ("pose predict", lambda o: "bop" in o or "cloud" in o, "bin bin-pose empty-frame",
     "they are of a depth image; give --depth"),
    ("pose predict", lambda o: "ray" in o["engine"],
     "bin bin-pose empty-frame color color-camera color-from-depth labels",
     "workers do not read it; leave --engine out"),
    ("pose predict", lambda o: "bin" in o, "empty-frame",
     "--bin says what there is without the parts"),
    ("pose predict", lambda o: "bin" not in o, "bin-pose",
     "it is of --bin; give the CAD file of the bin too"),
    ("pose predict, pose track", lambda o: "bop" in o, "cad", "the models of --bop are taken"),
    ("pose predict, pose track", lambda o: "bop" in o,
     "mask box detections labels camera focal-px unit",
     "a data set says its cameras and units itself, and its masks are chosen by --masks"),
    ("pose predict, pose track", lambda o: "bop" in o, "base-from-camera",
     "the cameras of a data set move"),
    ("pose predict", lambda o: "bop" in o and "ray" in o["engine"], "engine",
     "a data set is posed by this process, or shared by those of torchrun"),
    ("pose predict", lambda o: "bop" not in o, "split masks targets",
     "--bop names no data set; the mask of a depth image is given by --mask"),
    ("pose predict, pose track", lambda o: "cloud" in o,
     "mask box detections labels camera focal-px",
     "a cloud is of the object alone, in the camera's frame"),
    ("pose predict, depth predict", lambda o: "camera" in o, "focal-px fov",
     "--camera has the focal length"),
    ("depth predict", lambda o: "focal-px" in o, "fov", "--focal-px is the focal length"),
    ("pose predict", lambda o: "least-squares" in o["voting"], "hypotheses",
     "--voting least-squares draws no hypotheses"),
    ("pose predict", lambda o: "left" not in o, "right matcher min-confidence",
     "it is of a pair, and there is none; give --left"),
    ("pose predict", lambda o: "left" in o and "ray" in o["engine"], "engine",
     "pairs are matched and posed by this process"),
    ("pose predict", lambda o: "sgbm" in o["matcher"], "min-confidence",
     "sgbm has no confidence"),
    ("pose predict",
     lambda o: ("depth" in o or "left" in o) and not {"mask", "box", "detections"} & o.keys()
     and "ray" not in o["engine"],
     "batch register-refused labels",
     "an image without --mask, --box or --detections is searched alone, and registers nothing; "
     "give one of them"),
    ("pose predict", lambda o: "box" in o, "labels",
     "all boxes are of one object; say which by --object, or give --detections"),
    ("pose predict", lambda o: "detections" in o or len(o["box"]) > 1, "engine",
     "workers give one pose for each depth image, by --mask or one --box; leave --engine out"),
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
     f"device speed {_NETWORK} left-right-check max-disparity",
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


def refuse_words(command: str, options: Sequence[Option], words: Sequence[str]) -> None:
    """Refuse what the command would ignore, and a file or folder without a name.

    Such a name is that of a script whose variable is unset.
    """
    typed = Typed()
    spelled = dict[str, str]()
    values: list[str] = []
    for word in words:
        if word.startswith("--"):
            option, sign, value = word.removeprefix("--").partition("=")
            name = option.replace("_", "-").removeprefix("no-")
            spelled[name] = f"--{option}"
            values = typed.setdefault(name, [])
            values += [value] if sign else []
        else:
            values.append(word)
    for name in (option.name.replace("_", "-") for option in options if option.names is not None):
        if typed.get(name, [])[:1] == [""]:
            raise InputError(
                f"{spelled[name]} is empty; name a file or folder (the current folder is '.'), or "
                "check the variable that should hold it"
            )
    for commands, case, ignored_names, reason in _RULES:
        ignored = [spelled[name] for name in ignored_names.split() if name in typed]
        if ignored and command in commands.split(", ") and case(typed):
            named = " and ".join(ignored)
            raise InputError(f"{named}: has no effect here; {reason}. Leave {named} out")
