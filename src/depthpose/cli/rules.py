"""Which options have no effect beside others, or without them: one table, and what refuses them."""

from collections.abc import Callable, Sequence
from pathlib import Path

from depthpose.core.errors import InputError


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
     "batch view register-refused",
     "an image without --mask is searched alone, not shown, and registers nothing; give --mask"),
    ("pose track", lambda o: "bop" not in o, "split", "it is of a data set; give --bop"),
    ("pose track", lambda o: "bop" in o, "first",
     "a data set has many sequences and one pose is given; give the frames of one by --depth"),
    ("pose evaluate", lambda o: "weights" not in o, "masks voting icp device",
     "nothing is estimated: --csv and --predictions are measured as they are"),
    ("pose evaluate", lambda o: o.all_begin("weights", "register", "open3d"), "voting device",
     "register and open3d do not vote, and compute on the processor"),
    ("pose predict, depth predict, depth match, depth evaluate",
     lambda o: "ray" not in o["engine"], "address workers worker-cpus worker-gpus block shards",
     "--engine ray takes it, and is not given; add it"),
    ("pose predict, depth predict", lambda o: "ray" in o["engine"], "view",
     "the workers of --engine ray show nothing"),
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
     f"device speed {_NETWORK} tile left-right-check",
     "sgbm has no weights"),
    ("depth evaluate", lambda o: "baseline" not in o and "floor" not in o, "train train-without",
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
    ("data export-depth", lambda o: "colmap" in o["format"], "files",
     "--format colmap has one kind of file; --files is for nerfstudio"),
    ("data export-depth", lambda o: "colmap" not in o["format"], "images",
     "it is for --format colmap"),
    ("weights complete", lambda o: all(Path(word).is_dir() for word in o["models"]), "unit",
     "the models of a data set are in mm; --unit is for a model file"),
    ("reproduce all", lambda o: "kitti" not in o, "split protocol",
     "--kitti takes it, and is not given; add it"),
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
