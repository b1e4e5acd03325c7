"""The command line: parse arguments, call a package, write what it returns.

Only commands print. A command's function is imported when it is named and imports what is heavy
when it runs, so that every ``--help`` is quick.
"""

import errno
import os
import platform
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from depthpose import __version__
from depthpose.core.errors import (
    InputError,
    MissingExtraError,
    Notice,
    full_memory,
    nearest_name,
)

COMMANDS = {
    "demo": (
        "demo:demo", "synthetic parts, a real pair, a street from one image: out/demo/report.html"),
    "doctor": (
        "doctor:doctor", "what is installed, and a test of depth and pose; or what files are"),
    "serve": ("serve:serve", "depth and poses by a page in your browser, on this machine"),
    "pose predict": ("pose:predict", "a cloud, a masked depth image, or a data set, to poses"),
    "pose track": ("pose:track", "follow an object through depth images or clouds"),
    "pose train": ("train:pose_train", "your CAD file, or a config, to a network that poses it"),
    "pose evaluate": ("pose:evaluate", "measure poses on a BOP or LineMOD data set"),
    "depth match": ("depth:match", "a real stereo pair, or many, to metric depth"),
    "depth predict": ("depth:predict", "one image, or many, or a video, to metric depth"),
    "depth train": (
        "train:depth_train", "stages view, select, stereo, finetune of generator, matcher"),
    "depth calibrate": ("train:calibrate", "set when an image is refused as out of distribution"),
    "depth evaluate": ("depth:evaluate", "measure predictions by a named protocol"),
    "data make streets": (
        "data:make_streets", "synthetic streets with exact disparity and LiDAR, in KITTI's layout"),
    "data make near": (
        "data:make_near", "synthetic rooms, tables, bins and shelves with exact disparity"),
    "data make objects": (
        "data:make_objects", "synthetic frames of your CAD files on a table, in BOP's layout"),
    "data rectify": (
        "data:rectify", "raw pairs and their calibration to rectified pairs for depth match"),
    "data split": (
        "data:split", "pictures and videos that hold both views to a left and a right folder"),
    "data check": ("data:check", "read a whole data set and list what is wrong"),
    "data label": (
        "data:label", "truth for pairs that have none, by a matcher, where both views agree"),
    "data pack": ("data:pack", "a data set as tar shards: few large files, from a disk or a store"),
    "weights list": ("weights:list_weights", "list the weights"),
    "weights show": ("weights:show_weights", "print what a weights file holds"),
    "weights pack": ("weights:pack_weights", "one file of a generator and a matcher, with a card"),
    "weights complete": (
        "weights:complete_weights", "add meshes to pose weights that came without"),
    "weights import": ("weights:import_weights", "import a published checkpoint, safely"),
    "export depth": ("weights:export_depth", "depth as an ONNX file, proven to agree"),
    "export pose": ("weights:export_pose", "the network of directions as an ONNX file"),
    "reproduce": ("thesis:reproduce", "a table of chapter 2: published rows, ours, difference"),
    "reproduce 3.1": ("thesis:table_3_1", "the method beside its baselines, by object"),
    "reproduce 3.2": ("thesis:table_3_2", "LineMOD: published rows, ours, difference"),
    "reproduce 3.3": ("thesis:table_3_3", "RANSAC against least squares"),
    "figure": ("thesis:figure", "a figure of chapter 2 from your frames and weights"),
    "figure 3-2": ("thesis:figure_3_2", "features of points in one colour scale (t-SNE)"),
    "figure 3-4": ("thesis:figure_3_4", "true and predicted directions to a keypoint"),
    "figure 3-5": ("thesis:figure_3_5", "boxes of true and estimated poses"),
}  # fmt: skip
_TITLES = {
    "demo doctor serve": "to begin",
    "pose": "poses from a depth sensor",
    "depth": "depth from images",
    "data": "data sets",
    "weights export": "weights",
    "reproduce figure": "the tables and figures of the thesis",
}
"""A title for each group of commands, by the first words of its commands."""
_THESIS = ("reproduce", "figure")
_OF_THESIS = {
    "reproduce ID": "a table: 2.1, 2.2, 2.3, 3.1, 3.2 or 3.3, published rows beside ours",
    "figure ID": "a figure: 2-1, 2-5, 3-2, 3-4 or 3-5, from your frames and weights",
}
"""In place of a line for each table and figure where all commands are listed."""
_EXIT_CODES = """exit codes:
  0    done
  1    done, but something in the input failed, or the output could not be written (it is named)
  2    wrong usage or unreadable input
  130  interrupted"""


_LEAST_KIB = 750_000
"""Of address space; where torch and SciPy find less, they end the process without a reason."""
_OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)
"""Errors of a disk where a library or a temporary file writes; our own writers catch them."""
_OF_A_PATH = (errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.ELOOP, errno.EISDIR,
              errno.ENOTDIR)  # fmt: skip
"""Errors of a path that is looked at before it is read."""


def main(words: Sequence[str] | None = None) -> int:
    """Run the command of these words, by default the process's own, and give the exit code.

    0: done. 1: something in the input failed, or the output cannot be written. 2: unusable.
    130: interrupted. 141: nobody reads the output.
    """
    lock = sys.modules.get("depthpose.core.run")  # not imported for --help
    before = lock.held_folders() if lock is not None else ()
    as_usual = warnings.formatwarning
    shown: set[str] = set()

    def in_a_line(message: Warning | str, kind: type[Warning], *place: Any, **line: Any) -> str:  # noqa: ANN401
        """Show each of our notices once, without the file and line of the code that gives it."""
        if not issubclass(kind, Notice):
            return as_usual(message, kind, *place, **line)
        text = f"depthpose: {message}\n"
        if text in shown:  # of a file that is read once more for the report
            return ""
        shown.add(text)
        return text

    with lasting_streams() as output:
        warnings.formatwarning = in_a_line
        try:
            code = _run(list(sys.argv[1:] if words is None else words))
        except (InputError, MissingExtraError) as error:
            code = _fail(f"error: {error}")
        except KeyboardInterrupt as stop:
            code = _fail(f"{str(stop) or 'interrupted'}; what was finished is kept", 130)
        except Exception as error:
            if (reason := _explained(error)) is None:
                raise
            code = _fail(f"error: {reason}")
        finally:
            warnings.formatwarning = as_usual
            if (lock := sys.modules.get("depthpose.core.run")) is not None:
                lock.release_folders(but=before)
    if output.failure is None:
        return code
    if isinstance(output.failure, BrokenPipeError):  # nobody reads it any longer, as in '| head'
        return 141
    reason = output.failure.strerror
    lost = f"standard output: cannot be written: {reason}; all files are written as without it"
    return _fail(f"error: {lost}", code or 1)


def _fail(reason: str, code: int = 2) -> int:
    print(f"depthpose: {reason}", file=sys.stderr)
    return code


def _explained(error: Exception) -> str | None:
    """Explain a full memory, a full disk or an unusable path in a line; None of any other error."""
    if (reason := full_memory(error)) is not None:
        return f"{reason}; what was finished is kept"
    if not isinstance(error, OSError) or error.errno not in (*_OF_THE_DISK, *_OF_A_PATH):
        return None
    from tempfile import gettempdir

    place = error.filename or f"a temporary file in {gettempdir()}"
    return (
        f"{place}: cannot be written: {error.strerror}; free the space, or choose another place "
        "(TMPDIR names that of temporary files)"
    )


@dataclass(eq=False)
class Output:
    """A standard stream that remembers why it could not be written, in place of raising it."""

    stream: Any  #: what is written to
    is_lost: bool = False  #: the process began without it, and ``stream`` stands in its place
    failure: OSError | None = None

    def write(self, text: str) -> int:
        """Write text at once, unless an earlier write has failed."""
        if self.failure is None:
            try:
                if self.is_lost:
                    raise OSError(errno.EBADF, "it is closed")  # noqa: TRY301
                self.stream.write(text)
                self.stream.flush()
            except OSError as error:
                self.failure = error
                with suppress(OSError), open(os.devnull, "wb") as nothing:  # noqa: PTH123
                    os.dup2(nothing.fileno(), self.stream.fileno())  # for what is buffered
        return len(text)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  whatever a stream has
        """Give what the stream has."""
        return getattr(self.stream, name)


@contextmanager
def lasting_streams() -> Iterator[Output]:
    """Let a command print though its streams are closed or full; gives standard output.

    The numbers of closed streams are taken, so that no file gets them and is written into.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
    before = sys.stdin, sys.stdout, sys.stderr
    with ExitStack() as opened:
        names = zip(before, "rww", strict=True)
        real = [s or opened.enter_context(open(os.devnull, mode)) for s, mode in names]  # noqa: PTH123
        output, errors = (Output(real[k], is_lost=before[k] is None) for k in (1, 2))
        for stream in (output, errors):
            if (reconfigure := getattr(stream, "reconfigure", None)) is not None:
                reconfigure(errors="backslashreplace")  # names of files need not be UTF-8
        sys.stdin = real[0]
        sys.stdout = output
        sys.stderr = errors
        try:
            yield output
        finally:
            sys.stdin, sys.stdout, sys.stderr = before


def _list_commands(group: str, described: Mapping[str, str]) -> str:
    """Write the help of a group of commands, or of all of them: a line each, under titles."""
    width = max(map(len, described)) + 2
    lines = [f"usage: depthpose {group or 'COMMAND'} ... [--help]", ""]
    lines += ["The 6-DoF pose of a known object from a depth sensor, and metric depth from images."]
    for first_words, title in _TITLES.items():
        names = [name for name in described if name.split()[0] in first_words.split()]
        if names:
            lines += ["", f"{title}:", *(f"  {name:<{width}}{described[name]}" for name in names)]
    return "\n".join([*lines, "", _EXIT_CODES])


def _run(words: list[str]) -> int:
    """Read the words after ``depthpose`` as a command and its options, and call it."""
    if words in (["--version"], ["-V"]):
        from importlib.metadata import version  # not for --help, which it would double

        from depthpose.cli.doctor import device_names

        versions = f"torch {version('torch')}, Python {platform.python_version()}"
        print(f"depthpose {__version__} ({versions}, {device_names()})")  # for a bug report
        return 0
    names = (" ".join(words[:length]) for length in (3, 2, 1))
    name = next((name for name in names if name in COMMANDS), None)
    if name is None:
        asked_help = {"-h", "--help"} & set(words)
        group = words[0] if words and not words[0].startswith("-") else ""
        groups = {name.partition(" ")[0] for name in COMMANDS}
        if group and group not in groups:
            return _fail(f"error: no command {group!r}; {nearest_name(group, groups)}")
        inside = {name: what for name, (_, what) in COMMANDS.items() if name.startswith(group)}
        verb = next((word for word in words[1:] if not word.startswith("-")), "")
        if group and verb:
            near = nearest_name(verb, [name.partition(" ")[2] for name in inside])
            print(f"depthpose {group}: error: no command {verb!r}; {near}", file=sys.stderr)
            return 2
        if not group:
            inside = {
                n: what for n, what in inside.items() if n.split()[0] not in _THESIS
            } | _OF_THESIS
        stream = sys.stdout if asked_help else sys.stderr
        print(_list_commands(group, inside), file=stream)
        return 0 if asked_help else 2
    rest = words[len(name.split()) :]
    import tyro

    from depthpose.cli import arguments, ignored_options

    home, _, function = COMMANDS[name][0].partition(":")
    command: Callable[..., int] = getattr(import_module(f"depthpose.cli.{home}"), function)
    parse, options = arguments.parser_of(command)
    try:
        parsed = tyro.cli(
            parse,
            prog=f"depthpose {name}",
            description=arguments.description_of(command),
            args=rest,
            config=(tyro.conf.PositionalMetavarFromFieldName, tyro.conf.OmitArgPrefixes),
        )
    except SystemExit as stop:  # tyro has printed help (0) or the wrong arguments (2)
        return int(stop.code or 0)
    ignored_options.refuse_empty(options, rest)
    ignored_options.refuse_ignored(name, rest)
    arguments.refuse_missing(options, parsed.arguments)
    if sys.platform != "win32":
        import resource

        if 0 <= (limit := resource.getrlimit(resource.RLIMIT_AS)[0]) < _LEAST_KIB * 1024:
            raise InputError(f"the limit of {limit // 1024} KiB (ulimit -v) is below the "
                             f"{_LEAST_KIB} that the libraries alone take; raise it")  # fmt: skip
    return command(*parsed.args, **parsed.kwargs)
