"""Options that a command would ignore: they are refused before it runs, with the reason."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from depthpose.cli.arguments import Option
from depthpose.core.errors import InputError


class TypedOptions(dict[str, list[str]]):
    """The words after each option as they were typed, by the option's name.

    An option that was not typed has no words.
    """

    def __missing__(self, name: str) -> list[str]:
        """Return no words, and do not store them: ``in`` tells which options were typed."""
        return []


Condition = Callable[[TypedOptions], bool]


def any_typed(*names: str) -> Condition:
    """Make the condition that any of these options is typed."""
    return lambda typed: any(name in typed for name in names)


def none_typed(*names: str) -> Condition:
    """Make the condition that none of these options is typed."""
    return lambda typed: not any(name in typed for name in names)


def has_word(name: str, word: str) -> Condition:
    """Make the condition that an option is typed with this word."""
    return lambda typed: word in typed[name]


def all_begin(name: str, *prefixes: str) -> Condition:
    """Make the condition that an option has words, all of which begin with one of the prefixes."""
    return lambda typed: (
        bool(typed[name]) and all(word.startswith(prefixes) for word in typed[name])
    )


def both(first: Condition, second: Condition) -> Condition:
    """Make the condition that two conditions hold."""
    return lambda typed: first(typed) and second(typed)


_is_on_ray = has_word("engine", "ray")


def _is_not_on_ray(typed: TypedOptions) -> bool:
    """Whether the command does the work itself, without workers."""
    return not _is_on_ray(typed)


def is_registration(method: str | None, *, has_cad: bool) -> bool:
    """Whether models are registered without a network: by ``--method``, or as CAD files are.

    ``method``: the word of ``--method``; None: it was not typed.
    """
    return method == "register" or (method is None and has_cad)


def _is_registered(typed: TypedOptions) -> bool:
    """Whether the typed options ask for a registration."""
    method = " ".join(typed["method"]) if "method" in typed else None
    return is_registration(method, has_cad="cad" in typed)


def _is_searched(typed: TypedOptions) -> bool:
    """Whether whole depth images are searched: nothing says where objects are in them."""
    has_images = "depth" in typed or "left" in typed
    has_regions = bool({"mask", "box", "detections"} & typed.keys())
    return has_images and not has_regions and not _is_on_ray(typed)


def _has_many_regions(typed: TypedOptions) -> bool:
    """Whether a depth image may have several objects, by detections or boxes."""
    return "detections" in typed or len(typed["box"]) > 1


def _has_unused_gpus(typed: TypedOptions) -> bool:
    """Whether workers get a GPU, but compute on the processor."""
    is_on_cpu = typed["device"][:1] in ([], ["cpu"])
    has_gpus = typed["worker-gpus"][:1] not in (["0"], ["0.0"])
    return is_on_cpu and has_gpus


def _has_no_matcher_network(typed: TypedOptions) -> bool:
    """Whether depth of one image is that of the generator, or of OpenCV's matcher."""
    return "own" in typed["answer"] or "sgbm" in typed["matcher"]


def _are_models_folders(typed: TypedOptions) -> bool:
    """Whether ``--models`` names the folder of a dataset, and no model file."""
    return all(Path(word).is_dir() for word in typed["models"])


@dataclass(frozen=True, kw_only=True)
class _Rule:
    """Options that some commands ignore under a condition, and the reason for the user."""

    commands: tuple[str, ...]  #: names of the commands
    when: Condition  #: whether these options are ignored
    ignored: tuple[str, ...]  #: names of the options, with hyphens
    reason: str  #: words of the error


_POSE = ("pose predict", "pose track")
_ON_ENGINES = ("pose predict", "depth predict", "depth match")
_POSES_OF_THESIS = (
    "reproduce 3.1", "reproduce 3.2", "reproduce 3.3", "figure 3-2", "figure 3-4", "figure 3-5",
)  # fmt: skip
_NETWORK = ("precision", "max-memory")
"""Options of a matcher with weights."""

_RULES = (
    _Rule(
        commands=_POSE,
        when=_is_registered,
        ignored=("weights", "voting", "hypotheses", "batch", "device"),
        reason="CAD files are posed without a network, one input after the other on the processor",
    ),
    _Rule(
        commands=_POSE,
        when=has_word("method", "network"),
        ignored=("cad", "symmetry"),
        reason="weights know their own objects; leave --method network out, or train weights "
        "of this part by 'depthpose pose train --cad'",
    ),
    _Rule(
        commands=_POSE,
        when=none_typed("cad", "bin"),
        ignored=("cad-unit",),
        reason="it is the unit of --cad, and no CAD file is given",
    ),
    _Rule(
        commands=("pose predict",),
        when=any_typed("bop", "cloud"),
        ignored=("bin", "bin-pose", "empty-frame"),
        reason="they are of a depth image; give --depth",
    ),
    _Rule(
        commands=("pose predict",),
        when=_is_on_ray,
        ignored=(
            "bin",
            "bin-pose",
            "empty-frame",
            "color",
            "color-camera",
            "color-from-depth",
            "labels",
        ),
        reason="workers do not read it; leave --engine out",
    ),
    _Rule(
        commands=("pose predict",),
        when=any_typed("bin"),
        ignored=("empty-frame",),
        reason="--bin says what there is without the parts",
    ),
    _Rule(
        commands=("pose predict",),
        when=none_typed("bin"),
        ignored=("bin-pose",),
        reason="it is of --bin; give the CAD file of the bin too",
    ),
    _Rule(
        commands=_POSE,
        when=any_typed("bop"),
        ignored=("cad",),
        reason="the models of --bop are taken",
    ),
    _Rule(
        commands=_POSE,
        when=any_typed("bop"),
        ignored=("mask", "box", "detections", "labels", "camera", "focal-px", "unit"),
        reason="a dataset says its cameras and units itself, and its masks are chosen by --masks",
    ),
    _Rule(
        commands=_POSE,
        when=any_typed("bop"),
        ignored=("base-from-camera",),
        reason="the cameras of a dataset move",
    ),
    _Rule(
        commands=("pose predict",),
        when=both(any_typed("bop"), _is_on_ray),
        ignored=("engine",),
        reason="a dataset is posed by this process, or shared by those of torchrun",
    ),
    _Rule(
        commands=("pose predict",),
        when=none_typed("bop"),
        ignored=("split", "masks", "targets"),
        reason="--bop names no dataset; the mask of a depth image is given by --mask",
    ),
    _Rule(
        commands=_POSE,
        when=any_typed("cloud"),
        ignored=("mask", "box", "detections", "labels", "camera", "focal-px"),
        reason="a cloud is of the object alone, in the camera's frame",
    ),
    _Rule(
        commands=("pose predict", "depth predict"),
        when=any_typed("camera"),
        ignored=("focal-px", "fov"),
        reason="--camera has the focal length",
    ),
    _Rule(
        commands=("depth predict",),
        when=any_typed("focal-px"),
        ignored=("fov",),
        reason="--focal-px is the focal length",
    ),
    _Rule(
        commands=("pose predict",),
        when=has_word("voting", "least-squares"),
        ignored=("hypotheses",),
        reason="--voting least-squares draws no hypotheses",
    ),
    _Rule(
        commands=("pose predict",),
        when=none_typed("left"),
        ignored=("right", "matcher", "min-confidence"),
        reason="it is of a pair, and there is none; give --left",
    ),
    _Rule(
        commands=("pose predict",),
        when=both(any_typed("left"), _is_on_ray),
        ignored=("engine",),
        reason="pairs are matched and posed by this process",
    ),
    _Rule(
        commands=("pose predict",),
        when=has_word("matcher", "sgbm"),
        ignored=("min-confidence",),
        reason="sgbm has no confidence",
    ),
    _Rule(
        commands=("pose predict",),
        when=_is_searched,
        ignored=("batch", "register-refused", "labels"),
        reason="an image without --mask, --box or --detections is searched alone, and "
        "registers nothing; give one of them",
    ),
    _Rule(
        commands=("pose predict",),
        when=any_typed("box"),
        ignored=("labels",),
        reason="all boxes are of one object; say which by --object, or give --detections",
    ),
    _Rule(
        commands=("pose predict",),
        when=_has_many_regions,
        ignored=("engine",),
        reason="workers give one pose for each depth image, by --mask or one --box; leave "
        "--engine out",
    ),
    _Rule(
        commands=("pose track",),
        when=none_typed("bop"),
        ignored=("split",),
        reason="it is of a dataset; give --bop",
    ),
    _Rule(
        commands=("pose track",),
        when=any_typed("bop"),
        ignored=("first",),
        reason="a dataset has many sequences and one pose is given; give the frames of one by"
        " --depth",
    ),
    _Rule(
        commands=("pose evaluate",),
        when=none_typed("weights"),
        ignored=("masks", "voting", "icp", "device"),
        reason="nothing is estimated: --csv and --predictions are measured as they are",
    ),
    _Rule(
        commands=("pose evaluate",),
        when=all_begin("weights", "register"),
        ignored=("voting", "device"),
        reason="register does not vote, and computes on the processor",
    ),
    _Rule(
        commands=_ON_ENGINES,
        when=_is_not_on_ray,
        ignored=("address", "workers", "worker-cpus", "worker-gpus", "block"),
        reason="--engine ray takes it, and is not given; add it",
    ),
    _Rule(
        commands=_ON_ENGINES,
        when=_has_unused_gpus,
        ignored=("worker-gpus",),
        reason="the workers compute on the processor without --device cuda",
    ),
    _Rule(
        commands=("depth predict",),
        when=any_typed("camera-height"),
        ignored=("known-distance",),
        reason="--camera-height sets the scale",
    ),
    _Rule(
        commands=("depth predict",),
        when=any_typed("matcher"),
        ignored=("answer",),
        reason="the depth is that of --matcher on the synthesised view",
    ),
    _Rule(
        commands=("depth predict",),
        when=_has_no_matcher_network,
        ignored=_NETWORK,
        reason="no matcher with weights runs here",
    ),
    _Rule(
        commands=("depth match",),
        when=any_typed("matcher"),
        ignored=("weights",),
        reason="--matcher matches the pair",
    ),
    _Rule(
        commands=("depth match",),
        when=has_word("matcher", "sgbm"),
        ignored=("device", "speed", *_NETWORK, "left-right-check", "max-disparity"),
        reason="sgbm has no weights",
    ),
    _Rule(
        commands=("depth evaluate",),
        when=none_typed("baseline"),
        ignored=("train", "train-without"),
        reason="--baseline takes it, and is not given; add it",
    ),
    _Rule(
        commands=("depth evaluate", "reproduce"),
        when=none_typed("train"),
        ignored=("train-without",),
        reason="it leaves frames out of --train, and none is given",
    ),
    _Rule(
        commands=("depth evaluate",),
        when=none_typed("matcher"),
        ignored=("holes",),
        reason="it is for --matcher sgbm",
    ),
    _Rule(
        commands=("depth evaluate",),
        when=has_word("protocol", "kitti-2015"),
        ignored=("cap",),
        reason="--protocol kitti-2015 measures disparity, without a limit in metres",
    ),
    _Rule(
        commands=("depth evaluate",),
        when=all_begin("weights", "quick:", "fine:"),
        ignored=("speed",),
        reason="'quick:' and 'fine:' say the speed of these weights",
    ),
    _Rule(
        commands=("depth evaluate", "reproduce"),
        when=all_begin("weights", "own:", "sgbm:"),
        ignored=_NETWORK,
        reason="with 'own:' and 'sgbm:' no matcher with weights runs",
    ),
    _Rule(
        commands=("depth evaluate", "reproduce"),
        when=none_typed("weights"),
        ignored=("device", *_NETWORK, "speed"),
        reason="no network is measured",
    ),
    _Rule(
        commands=("weights complete",),
        when=_are_models_folders,
        ignored=("unit",),
        reason="the models of a dataset are in mm; --unit is for a model file",
    ),
    _Rule(
        commands=_POSES_OF_THESIS,
        when=none_typed("linemod", "bop"),
        ignored=("objects", "split"),
        reason="it chooses from a dataset, and none is named; give --linemod or --bop",
    ),
    _Rule(
        commands=_POSES_OF_THESIS,
        when=any_typed("linemod"),
        ignored=("bop",),
        reason="--linemod names the dataset, and one is measured",
    ),
    _Rule(
        commands=("reproduce 3.3",),
        when=any_typed("linemod", "bop"),
        ignored=("synthetic",),
        reason="views are rendered where no dataset is given",
    ),
)
"""Looked through in this order; the first rule that applies gives the reason."""


def refuse_ignored(command: str, words: Sequence[str]) -> None:
    """Refuse options that a command would ignore.

    Args:
        command: its name, such as ``pose predict``.
        words: the words that were typed after it.

    Raises:
        InputError: names the options, as they were typed, and the reason.
    """
    typed, spelling = _parse_words(words)
    for rule in _RULES:
        ignored = [spelling[name] for name in rule.ignored if name in typed]
        if ignored and command in rule.commands and rule.when(typed):
            options = " and ".join(ignored)
            raise InputError(f"{options}: has no effect here; {rule.reason}. Leave {options} out")


def refuse_empty(options: Sequence[Option], words: Sequence[str]) -> None:
    """Refuse an empty name of a file, folder or weights, as of an unset variable of a script.

    Args:
        options: options of the command.
        words: the words that were typed after it.

    Raises:
        InputError: a name is empty.
    """
    typed, spelling = _parse_words(words)
    for option in options:
        name = option.name.replace("_", "-")
        if option.kind is not None and typed[name][:1] == [""]:
            raise InputError(
                f"{spelling[name]} is empty; name a file or folder (the current folder is '.'), or "
                "check the variable that should hold it"
            )


def _parse_words(words: Sequence[str]) -> tuple[TypedOptions, dict[str, str]]:
    """Sort words by the option that they follow; words before any option are left out.

    Names of options have hyphens, and no ``no-`` in front; ``--name=word`` is taken apart.

    Returns:
        The words after each option, and each option as it was typed, both by the option's name.
    """
    typed = TypedOptions()
    spelling: dict[str, str] = {}
    values: list[str] = []  # of the last option
    for word in words:
        if not word.startswith("--"):
            values.append(word)
            continue
        option, sign, value = word.removeprefix("--").partition("=")
        name = option.replace("_", "-").removeprefix("no-")
        spelling[name] = f"--{option}"
        values = typed.setdefault(name, [])
        if sign:
            values.append(value)
    return typed, spelling
