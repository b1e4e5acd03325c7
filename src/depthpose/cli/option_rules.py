"""Rules of options: what would be ignored, contradicts or lacks another, is refused at once.

They are those that the typed words decide; what depends on files is refused where these are read.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from depthpose.cli.arguments import Option
from depthpose.core.errors import InputError


class TypedOptions(dict[str, list[str]]):
    """The words after each option as they were typed, by the option's name.

    An option that was not typed has no words; flags have none either.
    """

    def __missing__(self, name: str) -> list[str]:
        """Return no words, and do not store them: ``in`` tells which options were typed."""
        return []


Condition = Callable[[TypedOptions], bool]


def any_typed(*names: str) -> Condition:
    """Make the condition that any of these options is typed with a word."""
    return lambda typed: any(typed[name] for name in names)


def none_typed(*names: str) -> Condition:
    """Make the condition that none of these options is typed with a word."""
    return lambda typed: not any(typed[name] for name in names)


def not_one_typed(*names: str) -> Condition:
    """Make the condition that none of these options is typed, or several are."""
    return lambda typed: sum(bool(typed[name]) for name in names) != 1


def not_all_typed(*names: str) -> Condition:
    """Make the condition that one of these options, at least, is not typed."""
    return lambda typed: not all(typed[name] for name in names)


def several_typed(*names: str) -> Condition:
    """Make the condition that several of these options are typed."""
    return lambda typed: sum(bool(typed[name]) for name in names) > 1


def has_word(name: str, word: str) -> Condition:
    """Make the condition that an option is typed with this word."""
    return lambda typed: word in typed[name]


def all_are(name: str, word: str) -> Condition:
    """Make the condition that an option has words, all of which are this one."""
    return lambda typed: bool(typed[name]) and set(typed[name]) == {word}


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
    method = " ".join(typed["method"]) or None
    return is_registration(method, has_cad=bool(typed["cad"]))


def _is_searched(typed: TypedOptions) -> bool:
    """Whether whole depth images are searched: nothing says where objects are in them."""
    has_images = any_typed("depth", "left")
    has_regions = any_typed("mask", "box", "detections")
    return has_images(typed) and not has_regions(typed) and not _is_on_ray(typed)


def _is_nothing_segmented(typed: TypedOptions) -> bool:
    """Whether no weights segment the images of a dataset."""
    without_weights = ("truth", "predicted", "search")
    return all(word in without_weights or word.endswith(".json") for word in typed["masks"])


def _is_on_processor(typed: TypedOptions) -> bool:
    """Whether a registration is all: no pair is matched and no image segmented on a device."""
    return _is_registered(typed) and not typed["left"] and _is_nothing_segmented(typed)


def _has_many_regions(typed: TypedOptions) -> bool:
    """Whether a depth image may have several objects, by detections or boxes."""
    return bool(typed["detections"]) or len(typed["box"]) > 1


def _has_unused_gpus(typed: TypedOptions) -> bool:
    """Whether workers get a GPU, but compute on the processor."""
    is_on_cpu = typed["device"][:1] in ([], ["cpu"])
    has_gpus = typed["worker-gpus"][:1] not in (["0"], ["0.0"])
    return is_on_cpu and has_gpus


def _has_no_matcher_network(typed: TypedOptions) -> bool:
    """Whether depth of one image is that of the generator, or of OpenCV's matcher."""
    return "own" in typed["answer"] or "sgbm" in typed["matcher"]


def _has_matcher_of_other_weights(typed: TypedOptions) -> bool:
    """Whether the synthesised view is matched by other weights than those that synthesise it."""
    return typed["matcher"][:1] not in ([], ["sgbm"])  # what follows may be names of images


def _are_models_folders(typed: TypedOptions) -> bool:
    """Whether ``--models`` names the folder of a dataset, and no model file."""
    return all(Path(word).is_dir() for word in typed["models"])


@dataclass(frozen=True, kw_only=True)
class IgnoredRule:
    """Options that some commands ignore under a condition, and the reason for the user."""

    commands: tuple[str, ...]  #: names of the commands
    when: Condition  #: whether these options are ignored
    ignored: tuple[str, ...]  #: names of the options, with hyphens
    reason: str  #: words of the error


@dataclass(frozen=True, kw_only=True)
class Rule:
    """A combination of options that some commands refuse, and the error."""

    commands: tuple[str, ...]  #: names of the commands
    when: Condition  #: whether the options are so combined
    error: str  #: what is wrong, and the remedy


_POSE = ("pose predict", "pose track")
_ON_ENGINES = ("pose predict", "depth predict", "depth match")
_POSES_OF_THESIS = (
    "reproduce 3.1", "reproduce 3.2", "reproduce 3.3", "figure 3-2", "figure 3-4", "figure 3-5",
)  # fmt: skip
_NETWORK = ("precision", "max-memory")
"""Options of a matcher with weights."""
_BACKGROUND = ("bin", "bin-pose", "empty-frame")
"""Options of what there is in a depth image without the parts."""
_COLOR = ("color", "color-camera", "color-from-depth")
"""Options of the picture beside a depth image."""

IGNORED_RULES = (
    IgnoredRule(
        commands=("pose predict",),
        when=_is_registered,
        ignored=("weights", "voting", "hypotheses", "batch"),
        reason="CAD files are posed without a network, one input after the other",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=_is_on_processor,
        ignored=("device",),
        reason="CAD files are posed without a network, on the processor",
    ),
    IgnoredRule(
        commands=("pose track",),
        when=_is_registered,
        ignored=("weights", "device"),
        reason="CAD files are posed without a network, on the processor",
    ),
    IgnoredRule(
        commands=_POSE,
        when=has_word("method", "network"),
        ignored=("cad", "symmetry"),
        reason="weights know their own objects; leave --method network out, or train weights "
        "of this part by 'depthpose pose train --cad'",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=none_typed("cad", "bin"),
        ignored=("cad-unit",),
        reason="it is the unit of --cad, and no CAD file is given",
    ),
    IgnoredRule(
        commands=("pose track",),
        when=none_typed("cad"),
        ignored=("cad-unit",),
        reason="it is the unit of --cad, and no CAD file is given",
    ),
    IgnoredRule(
        commands=_POSE,
        when=none_typed("cad"),
        ignored=("symmetry",),
        reason="it is of --cad; a network and a dataset have the symmetries that they declare",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=any_typed("bop", "cloud"),
        ignored=(*_BACKGROUND, *_COLOR),
        reason="it is beside a depth image; give --depth",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=_is_on_ray,
        ignored=(*_BACKGROUND, *_COLOR, "labels"),
        reason="workers do not read it; leave --engine out",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=any_typed("bin"),
        ignored=("empty-frame",),
        reason="--bin says what there is without the parts",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=none_typed("bin"),
        ignored=("bin-pose",),
        reason="it is of --bin; give the CAD file of the bin too",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=none_typed("color"),
        ignored=("color-camera", "color-from-depth"),
        reason="it is of --color; give that too",
    ),
    IgnoredRule(
        commands=_POSE,
        when=any_typed("bop"),
        ignored=("cad", "symmetry"),
        reason="the models of --bop are taken, with the symmetries that they declare",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=any_typed("bop"),
        ignored=("mask", "box", "detections", "labels", "camera", "focal-px", "unit"),
        reason="a dataset says its cameras and units itself, and its masks are chosen by --masks",
    ),
    IgnoredRule(
        commands=("pose track",),
        when=any_typed("bop"),
        ignored=("camera", "unit"),
        reason="a dataset says its cameras and units itself",
    ),
    IgnoredRule(
        commands=_POSE,
        when=any_typed("bop"),
        ignored=("base-from-camera",),
        reason="the cameras of a dataset move",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=both(any_typed("bop"), _is_on_ray),
        ignored=("engine",),
        reason="a dataset is posed by this process, or shared by those of torchrun",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=none_typed("bop"),
        ignored=("split", "masks", "targets"),
        reason="--bop names no dataset; the mask of a depth image is given by --mask",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=any_typed("cloud"),
        ignored=("mask", "box", "detections", "labels", "camera", "focal-px"),
        reason="a cloud is of the object alone, in the camera's frame",
    ),
    IgnoredRule(
        commands=("pose track",),
        when=any_typed("cloud"),
        ignored=("camera",),
        reason="clouds are in the camera's frame",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=any_typed("camera"),
        ignored=("focal-px",),
        reason="--camera has the focal length",
    ),
    IgnoredRule(
        commands=("depth predict",),
        when=any_typed("camera"),
        ignored=("focal-px", "fov"),
        reason="--camera has the focal length",
    ),
    IgnoredRule(
        commands=("depth predict",),
        when=any_typed("focal-px"),
        ignored=("fov",),
        reason="--focal-px is the focal length",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=has_word("voting", "least-squares"),
        ignored=("hypotheses",),
        reason="--voting least-squares draws no hypotheses",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=none_typed("left"),
        ignored=("right", "matcher", "min-confidence"),
        reason="it is of a pair, and there is none; give --left",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=both(any_typed("left"), _is_on_ray),
        ignored=("engine",),
        reason="pairs are matched and posed by this process",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=has_word("matcher", "sgbm"),
        ignored=("min-confidence",),
        reason="sgbm has no confidence",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=_is_searched,
        ignored=("batch", "register-refused", "labels"),
        reason="an image without --mask, --box or --detections is searched alone, and "
        "registers nothing; give one of them",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=any_typed("box"),
        ignored=("labels",),
        reason="all boxes are of one object; say which by --object, or give --detections",
    ),
    IgnoredRule(
        commands=("pose predict",),
        when=_has_many_regions,
        ignored=("engine",),
        reason="workers give one pose for each depth image, by --mask or one --box; leave "
        "--engine out",
    ),
    IgnoredRule(
        commands=("pose track",),
        when=none_typed("bop"),
        ignored=("split",),
        reason="it is of a dataset; give --bop",
    ),
    IgnoredRule(
        commands=("pose track",),
        when=any_typed("bop"),
        ignored=("first",),
        reason="a dataset has many sequences and one pose is given; give the frames of one by"
        " --depth",
    ),
    IgnoredRule(
        commands=("pose evaluate",),
        when=none_typed("weights"),
        ignored=("masks", "voting", "icp", "device"),
        reason="nothing is estimated: --csv and --predictions are measured as they are",
    ),
    IgnoredRule(
        commands=("pose evaluate",),
        when=all_are("weights", "register"),
        ignored=("voting",),
        reason="register does not vote",
    ),
    IgnoredRule(
        commands=("pose evaluate",),
        when=both(all_are("weights", "register"), _is_nothing_segmented),
        ignored=("device",),
        reason="register computes on the processor",
    ),
    IgnoredRule(
        commands=_ON_ENGINES,
        when=_is_not_on_ray,
        ignored=("address", "workers", "worker-cpus", "worker-gpus", "block"),
        reason="--engine ray takes it, and is not given; add it",
    ),
    IgnoredRule(
        commands=_ON_ENGINES,
        when=_has_unused_gpus,
        ignored=("worker-gpus",),
        reason="the workers compute on the processor without --device cuda",
    ),
    IgnoredRule(
        commands=("depth predict",),
        when=_is_on_ray,
        ignored=("one-mount",),
        reason="it takes images one after the other, and workers do not; leave --engine out",
    ),
    IgnoredRule(
        commands=("depth match", "depth predict"),
        when=lambda typed: "cloud" not in typed,
        ignored=("min-confidence",),
        reason="it leaves points out of a cloud, and none is written; add --cloud",
    ),
    IgnoredRule(
        commands=("data make objects",),
        when=any_typed("pile"),
        ignored=("clutter",),
        reason="a pile has nothing beside it; omit --pile",
    ),
    IgnoredRule(
        commands=("depth predict",),
        when=any_typed("camera-height"),
        ignored=("known-distance",),
        reason="--camera-height sets the scale",
    ),
    IgnoredRule(
        commands=("depth predict",),
        when=any_typed("matcher"),
        ignored=("answer",),
        reason="the depth is that of --matcher on the synthesised view",
    ),
    IgnoredRule(
        commands=("depth predict",),
        when=_has_no_matcher_network,
        ignored=_NETWORK,
        reason="no matcher with weights runs here",
    ),
    IgnoredRule(
        commands=("depth match",),
        when=any_typed("matcher"),
        ignored=("weights",),
        reason="--matcher matches the pair",
    ),
    IgnoredRule(
        commands=("depth match",),
        when=has_word("matcher", "sgbm"),
        ignored=("device", "speed", *_NETWORK, "left-right-check", "max-disparity"),
        reason="sgbm has no weights",
    ),
    IgnoredRule(
        commands=("depth evaluate",),
        when=none_typed("baseline"),
        ignored=("train", "train-without"),
        reason="--baseline takes it, and is not given; add it",
    ),
    IgnoredRule(
        commands=("depth evaluate", "reproduce"),
        when=none_typed("train"),
        ignored=("train-without",),
        reason="it leaves frames out of --train, and none is given",
    ),
    IgnoredRule(
        commands=("depth evaluate",),
        when=none_typed("matcher"),
        ignored=("holes",),
        reason="it is for --matcher sgbm",
    ),
    IgnoredRule(
        commands=("depth evaluate",),
        when=has_word("protocol", "kitti-2015"),
        ignored=("cap",),
        reason="--protocol kitti-2015 measures disparity, without a limit in metres",
    ),
    IgnoredRule(
        commands=("depth evaluate",),
        when=all_begin("weights", "quick:", "fine:"),
        ignored=("speed",),
        reason="'quick:' and 'fine:' say the speed of these weights",
    ),
    IgnoredRule(
        commands=("depth evaluate", "reproduce"),
        when=all_begin("weights", "own:", "sgbm:"),
        ignored=_NETWORK,
        reason="with 'own:' and 'sgbm:' no matcher with weights runs",
    ),
    IgnoredRule(
        commands=("depth evaluate", "reproduce"),
        when=none_typed("weights"),
        ignored=("device", *_NETWORK, "speed"),
        reason="no network is measured",
    ),
    IgnoredRule(
        commands=("pose train",),
        when=has_word("what", "segmentation"),
        ignored=("cad", "unit", "symmetries"),
        reason="'segmentation' learns from pictures: make them by 'depthpose data make objects "
        "--cad ...' and name the folder in the config",
    ),
    IgnoredRule(
        commands=("weights complete",),
        when=_are_models_folders,
        ignored=("unit",),
        reason="the models of a dataset are in mm; --unit is for a model file",
    ),
    IgnoredRule(
        commands=_POSES_OF_THESIS,
        when=none_typed("linemod", "bop"),
        ignored=("objects", "split"),
        reason="it chooses from a dataset, and none is named; give --linemod or --bop",
    ),
    IgnoredRule(
        commands=_POSES_OF_THESIS,
        when=any_typed("linemod"),
        ignored=("bop",),
        reason="--linemod names the dataset, and one is measured",
    ),
    IgnoredRule(
        commands=("reproduce 3.3",),
        when=any_typed("linemod", "bop"),
        ignored=("synthetic",),
        reason="views are rendered where no dataset is given",
    ),
)
"""Looked through in this order; the first rule that applies gives the reason."""

RULES = (
    Rule(
        commands=("pose predict",),
        when=not_one_typed("cloud", "depth", "left", "bop"),
        error="give one of --cloud, --depth, --left and --bop: a cloud, a depth image with --mask "
        "and --camera, a pair with --camera, or a dataset",
    ),
    Rule(
        commands=("pose track",),
        when=not_one_typed("depth", "cloud", "bop"),
        error="give one of --depth with --camera, --cloud and --bop",
    ),
    Rule(
        commands=("pose predict",),
        when=both(any_typed("depth"), none_typed("camera", "focal-px")),
        error="--depth needs --camera or --focal-px beside it",
    ),
    Rule(
        commands=("pose track",),
        when=both(any_typed("depth"), none_typed("camera")),
        error="--depth needs --camera beside it",
    ),
    Rule(
        commands=("pose predict",),
        when=both(any_typed("left"), not_all_typed("right", "camera")),
        error="--left needs --right and --camera beside it: the other view, and the file of the "
        'rig with "baseline_m"',
    ),
    Rule(
        commands=("pose predict",),
        when=several_typed("mask", "box", "detections"),
        error="--mask, --box and --detections say where objects are; give one of them",
    ),
    Rule(
        commands=("pose predict",),
        when=both(any_typed("bin"), none_typed("bin-pose")),
        error="--bin: where is it? Give --bin-pose, a text file with its 4x4 matrix "
        "camera_from_model in metres, or --empty-frame in place of both",
    ),
    Rule(
        commands=_POSE,
        when=has_word("weights", "register"),
        error="--weights register: registration is asked for by --method register, with --cad or "
        "--bop",
    ),
    Rule(
        commands=_POSE,
        when=both(has_word("method", "register"), none_typed("cad", "bop")),
        error="--method register looks for CAD files: give --cad part.stl --unit mm, or --bop, "
        "whose models it takes",
    ),
    Rule(
        commands=("pose evaluate",),
        when=none_typed("weights", "csv", "predictions"),
        error="measure --weights FILE, --csv FILE or --predictions DIR, or several.",
    ),
    Rule(
        commands=("depth predict",),
        when=both(_is_on_ray, _has_matcher_of_other_weights),
        error="--engine ray takes --matcher sgbm or the weights' own; make one file of both by "
        "'depthpose weights pack G --matcher S --trained-on DATA --licence L --out W'",
    ),
    Rule(
        commands=("depth evaluate",),
        when=none_typed("weights", "matcher", "predictions", "baseline"),
        error="measure --weights FILE, --matcher sgbm, --predictions DIR or --baseline rows, or "
        "several.",
    ),
    Rule(
        commands=("depth evaluate",),
        when=both(any_typed("baseline"), none_typed("train")),
        error="a baseline is fitted to training frames: give --train FOLDER, or several.",
    ),
    Rule(
        commands=("reproduce 3.1", "reproduce 3.2"),
        when=none_typed("linemod", "bop"),
        error="there are no poses to measure; give --linemod FOLDER, or --bop FOLDER.",
    ),
    Rule(
        commands=("reproduce 3.2",),
        when=none_typed("weights", "csv"),
        error="table 3.2: there is nothing to measure; give --weights FILE or --csv.",
    ),
)
"""Looked through in this order, where nothing is ignored."""


def refuse_combinations(command: str, words: Sequence[str]) -> None:
    """Refuse options that a command would ignore, or that contradict or lack another.

    Args:
        command: its name, such as ``pose predict``.
        words: the words that were typed after it.

    Raises:
        InputError: names the options, as they were typed where they are ignored, and the reason.
    """
    typed, spelling = _parse_words(words)
    for rule in IGNORED_RULES:
        ignored = [spelling[name] for name in rule.ignored if name in typed]
        if ignored and command in rule.commands and rule.when(typed):
            options = " and ".join(ignored)
            raise InputError(f"{options}: has no effect here; {rule.reason}. Leave {options} out")
    for rule in RULES:
        if command in rule.commands and rule.when(typed):
            raise InputError(rule.error)


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

    Names of options have hyphens, and no ``no-`` in front; ``--name=word`` is taken apart. An
    option whose word is ``None`` counts as left out.

    Returns:
        The words after each option, and each option as it was typed, both by the option's name.
    """
    typed = TypedOptions()
    spelling: dict[str, str] = {}
    name = ""  # of the last option
    for word in words:
        values = [word]
        if word.startswith("--"):
            option, sign, value = word.removeprefix("--").partition("=")
            name = option.replace("_", "-").removeprefix("no-")
            spelling[name] = f"--{option}"
            values = [value] if sign else []
        if values == ["None"]:
            typed.pop(name, None)
        elif name:
            typed.setdefault(name, []).extend(values)
    return typed, spelling
