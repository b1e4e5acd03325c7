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
    describe_full_memory,
    suggest_name,
)

COMMANDS = {
    "demo": (
        "demo:demo", "synthetic parts, a real pair, a street from one image: out/demo/report.html"),
    "doctor": (
        "doctor:doctor", "what is installed, and a test of depth and pose; or what files are"),
    "serve": ("serve:serve", "depth and poses by a page in your browser, on this machine"),
    "pose predict": (
        "pose.commands:predict_poses", "a cloud, a masked depth image, or a dataset, to poses"),
    "pose track": ("pose.commands:track_object", "follow an object through depth images or clouds"),
    "pose train": ("train:train_pose", "your CAD file, or a config, to a network that poses it"),
    "pose evaluate": ("pose.commands:evaluate_poses", "measure poses on a BOP or LineMOD dataset"),
    "depth match": ("depth.commands:match_pairs", "a real stereo pair, or many, to metric depth"),
    "depth predict": (
        "depth.commands:predict_depth", "one image, or many, or a video, to metric depth"),
    "depth train": (
        "train:train_depth", "stages view, select, stereo, finetune of generator, matcher"),
    "depth calibrate": (
        "train:calibrate_refusal", "set when an image is refused as out of distribution"),
    "depth evaluate": ("depth.commands:evaluate_depth", "measure predictions by a named protocol"),
    "data make streets": (
        "data.make:make_streets",
        "synthetic streets with exact disparity and LiDAR, in KITTI's layout"),
    "data make near": (
        "data.make:make_near", "synthetic rooms, tables, bins and shelves with exact disparity"),
    "data make objects": (
        "data.make:make_objects", "synthetic frames of your CAD files on a table, in BOP's layout"),
    "data rectify": (
        "data.pairs:rectify_pairs",
        "raw pairs and their calibration to rectified pairs for depth match"),
    "data split": (
        "data.pairs:split_pairs",
        "pictures and videos that hold both views to a left and a right folder"),
    "data check": ("data.commands:check_dataset", "read a whole dataset and list what is wrong"),
    "data label": (
        "data.commands:label_dataset",
        "truth for pairs that have none, by a matcher, where both views agree"),
    "data pack": (
        "data.commands:pack_dataset",
        "a dataset as tar shards: few large files, from a disk or a store"),
    "weights list": ("weights:list_weights", "list the weights"),
    "weights show": ("weights:show_weights", "print what a weights file holds"),
    "weights pack": ("weights:pack_weights", "one file of a generator and a matcher, with a card"),
    "weights complete": (
        "weights:complete_weights", "add meshes to pose weights that came without"),
    "weights import": ("weights:import_weights", "import a published checkpoint, safely"),
    "export depth": ("weights:export_depth", "depth as an ONNX file, proven to agree"),
    "export pose": ("weights:export_pose", "the network of directions as an ONNX file"),
    "reproduce": (
        "thesis.commands:reproduce_table",
        "a table of chapter 2: published rows, ours, difference"),
    "reproduce 3.1": (
        "thesis.commands:reproduce_table_3_1", "the method beside its baselines, by object"),
    "reproduce 3.2": (
        "thesis.commands:reproduce_table_3_2", "LineMOD: published rows, ours, difference"),
    "reproduce 3.3": ("thesis.commands:reproduce_table_3_3", "RANSAC against least squares"),
    "figure": ("thesis.commands:draw_figure", "a figure of chapter 2 from your frames and weights"),
    "figure 3-2": (
        "thesis.commands:draw_figure_3_2", "features of points in one colour scale (t-SNE)"),
    "figure 3-4": (
        "thesis.commands:draw_figure_3_4", "true and predicted directions to a keypoint"),
    "figure 3-5": ("thesis.commands:draw_figure_3_5", "boxes of true and estimated poses"),
}  # fmt: skip
_TITLES = {
    "demo doctor serve": "to begin",
    "pose": "poses from a depth sensor",
    "depth": "depth from images",
    "data": "datasets",
    "weights export": "weights",
    "reproduce figure": "the tables and figures of the thesis",
}
"""A title for each group of commands, by the first words of its commands."""
_THESIS_GROUPS = ("reproduce", "figure")
_THESIS_SUMMARY = {
    "reproduce ID": "a table: 2.1, 2.2, 2.3, 3.1, 3.2 or 3.3, published rows beside ours",
    "figure ID": "a figure: 2-1, 2-5, 3-2, 3-4 or 3-5, from your frames and weights",
}
"""In place of a line for each table and figure where all commands are listed."""
_EXIT_CODES = """exit codes:
  0    done
  1    done, but something in the input failed, or the output could not be written (it is named)
  2    wrong usage or unreadable input
  130  interrupted"""


_MIN_ADDRESS_SPACE_KIB = 750_000
"""Where torch and SciPy find less, they end the process without a reason."""
_MAX_COMMAND_WORDS = 3
"""Words of the longest name of a command, such as ``data make near``."""
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)
"""Errors of a disk where a library or a temporary file writes; our own writers catch them."""
_PATH_ERRORS = (errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.ELOOP, errno.EISDIR,
              errno.ENOTDIR)  # fmt: skip
"""Errors of a path that is looked at before it is read."""


def main(words: Sequence[str] | None = None) -> int:
    """Run the command of these words, by default the process's own, and return the exit code.

    0: done. 1: something in the input failed, or the output cannot be written. 2: wrong usage or
    unreadable input. 130: interrupted. 141: nobody reads the output.
    """
    # The folders that the command claims are released at its end. Their module is looked up and
    # not imported, for --help does without it.
    run_module = sys.modules.get("depthpose.core.run_folder")
    held_before = () if run_module is None else run_module.held_folders()
    usual_format = warnings.formatwarning
    with lasting_streams() as output:
        warnings.formatwarning = _make_notice_format(usual_format)
        try:
            code = _run(list(sys.argv[1:] if words is None else words))
        except (InputError, MissingExtraError) as error:
            code = _print_failure(f"error: {error}")
        except KeyboardInterrupt as stop:
            code = _print_failure(f"{str(stop) or 'interrupted'}; what was finished is kept", 130)
        except Exception as error:
            reason = _explain_system_error(error)
            if reason is None:
                raise
            code = _print_failure(f"error: {reason}")
        finally:
            warnings.formatwarning = usual_format
            run_module = sys.modules.get("depthpose.core.run_folder")
            if run_module is not None:
                run_module.release_folders(but=held_before)

    # What could not be printed fails the command too.
    if output.failure is None:
        return code
    if isinstance(output.failure, BrokenPipeError):  # nobody reads it any longer, as in '| head'
        return 141
    reason = f"cannot be written: {output.failure.strerror}; all files are written as without it"
    return _print_failure(f"error: standard output: {reason}", code or 1)


def _make_notice_format(usual_format: Callable[..., str]) -> Callable[..., str]:
    """Make a format of warnings that shows each :class:`Notice` once, as a line without its source.

    Other warnings look as usual, by ``usual_format``.
    """
    shown: set[str] = set()

    def format_warning(
        message: Warning | str,
        category: type[Warning],
        *place: Any,  # noqa: ANN401  file and line of the code
        **source: Any,  # noqa: ANN401
    ) -> str:
        """Format a warning; an empty text where the same notice was shown before."""
        if not issubclass(category, Notice):
            return usual_format(message, category, *place, **source)
        text = f"depthpose: {message}\n"
        if text in shown:  # a file is read once more for the report
            return ""
        shown.add(text)
        return text

    return format_warning


def _print_failure(reason: str, code: int = 2) -> int:
    """Print why the command failed, and return its exit code."""
    print(f"depthpose: {reason}", file=sys.stderr)
    return code


def _explain_system_error(error: Exception) -> str | None:
    """Explain a full memory, a full disk or an unusable path in a line; None for other errors."""
    reason = describe_full_memory(error)
    if reason is not None:
        return f"{reason}; what was finished is kept"
    if not isinstance(error, OSError) or error.errno not in (*_DISK_ERRORS, *_PATH_ERRORS):
        return None
    from tempfile import gettempdir

    path = error.filename or f"a temporary file in {gettempdir()}"
    return (
        f"{path}: cannot be written: {error.strerror}; free the space, or choose another place "
        "(TMPDIR names that of temporary files)"
    )


@dataclass(eq=False)
class SafeStream:
    """A standard stream that keeps the error of a write, in place of raising it."""

    stream: Any  #: what is written to
    is_missing: bool = False  #: the process began without it, and ``stream`` is only in its place
    failure: OSError | None = None  #: error of the first write that failed; None: none has

    def write(self, text: str) -> int:
        """Write text at once, unless an earlier write has failed."""
        if self.failure is None:
            try:
                if self.is_missing:
                    raise OSError(errno.EBADF, "it is closed")  # noqa: TRY301
                self.stream.write(text)
                self.stream.flush()
            except OSError as error:
                self.failure = error
                # What is still in the stream's buffer must go somewhere when the process ends.
                with suppress(OSError), open(os.devnull, "wb") as nowhere:  # noqa: PTH123
                    os.dup2(nowhere.fileno(), self.stream.fileno())
        return len(text)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  whatever a stream has
        """Return any other attribute of the stream."""
        return getattr(self.stream, name)


@contextmanager
def lasting_streams() -> Iterator[SafeStream]:
    """Let a command run to its end even if its standard streams are closed or full.

    Yields standard output, whose ``failure`` tells afterwards whether all was printed.
    """
    # Descriptors 0, 1 and 2 of closed streams are taken: else the next file that is opened gets
    # one of them, and what is printed is written into that file.
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free descriptor

    before = sys.stdin, sys.stdout, sys.stderr
    with ExitStack() as opened:  # a stream that the process began without is the null device
        stdin, stdout, stderr = (
            stream or opened.enter_context(open(os.devnull, mode))  # noqa: PTH123
            for stream, mode in zip(before, "rww", strict=True)
        )
        output = SafeStream(stdout, is_missing=before[1] is None)
        errors = SafeStream(stderr, is_missing=before[2] is None)
        for stream in (output, errors):
            reconfigure = getattr(stream, "reconfigure", None)
            if reconfigure is not None:
                reconfigure(errors="backslashreplace")  # names of files need not be UTF-8
        sys.stdin = stdin
        sys.stdout = output
        sys.stderr = errors
        try:
            yield output
        finally:
            sys.stdin, sys.stdout, sys.stderr = before


def _format_commands(group: str, summaries: Mapping[str, str]) -> str:
    """Format the help of a group of commands, or of all: a line for each command, under titles.

    ``group``: first word of its commands, empty for all; ``summaries``: a line about each command,
    by name.
    """
    width = max(map(len, summaries)) + 2
    lines = [f"usage: depthpose {group or 'COMMAND'} ... [--help]", ""]
    lines += ["The 6-DoF pose of a known object from a depth sensor, and metric depth from images."]
    for first_words, title in _TITLES.items():
        names = [name for name in summaries if name.split()[0] in first_words.split()]
        if names:
            lines += ["", f"{title}:", *(f"  {name:<{width}}{summaries[name]}" for name in names)]
    return "\n".join([*lines, "", _EXIT_CODES])


def _run(words: list[str]) -> int:
    """Parse the words after ``depthpose`` as a command and its options, and call it.

    Returns the exit code.
    """
    if words in (["--version"], ["-V"]):
        return _print_version()
    lengths = range(_MAX_COMMAND_WORDS, 0, -1)
    prefixes = (" ".join(words[:length]) for length in lengths)
    name = next((prefix for prefix in prefixes if prefix in COMMANDS), None)
    if name is None:
        return _list_commands(words)

    option_words = words[len(name.split()) :]
    import tyro

    from depthpose.cli import arguments, option_rules

    module, _, function = COMMANDS[name][0].partition(":")
    command: Callable[..., int] = getattr(import_module(f"depthpose.cli.{module}"), function)
    parse, options = arguments.make_parser(command)
    try:
        parsed = tyro.cli(
            parse,
            prog=f"depthpose {name}",
            description=arguments.format_description(command),
            args=option_words,
            config=(tyro.conf.PositionalMetavarFromFieldName, tyro.conf.OmitArgPrefixes),
        )
    except SystemExit as stop:  # tyro has printed help (0) or the wrong arguments (2)
        return int(stop.code or 0)
    option_rules.refuse_empty(options, option_words)
    option_rules.refuse_combinations(name, option_words)
    arguments.refuse_unusable(parsed.arguments)
    _refuse_small_address_space()  # before weights are looked up, which loads torch
    arguments.refuse_missing(options, parsed.arguments)
    return command(*parsed.args, **parsed.kwargs)


def _print_version() -> int:
    """Print what a bug report needs, versions and devices, and return the exit code."""
    from importlib.metadata import version  # not for --help, which it would double

    from depthpose.cli.doctor import list_device_names

    versions = f"torch {version('torch')}, Python {platform.python_version()}"
    print(f"depthpose {__version__} ({versions}, {list_device_names()})")
    return 0


def _list_commands(words: Sequence[str]) -> int:
    """Print the commands of a group, or of all, where the words name no command.

    An unknown group, or command of a group, is an error that names the nearest one. Returns the
    exit code.
    """
    is_help = bool({"-h", "--help"} & set(words))
    group = words[0] if words and not words[0].startswith("-") else ""
    groups = {name.partition(" ")[0] for name in COMMANDS}
    if group and group not in groups:
        return _print_failure(f"error: no command {group!r}; {suggest_name(group, groups)}")
    summaries = {name: summary for name, (_, summary) in COMMANDS.items() if name.startswith(group)}
    verb = next((word for word in words[1:] if not word.startswith("-")), "")
    if group and verb:
        nearest = suggest_name(verb, [name.partition(" ")[2] for name in summaries])
        print(f"depthpose {group}: error: no command {verb!r}; {nearest}", file=sys.stderr)
        return 2

    if not group:  # a line stands for all tables of the thesis, and a line for all figures
        for name in list(summaries):
            if name.split()[0] in _THESIS_GROUPS:
                del summaries[name]
        summaries |= _THESIS_SUMMARY
    print(_format_commands(group, summaries), file=sys.stdout if is_help else sys.stderr)
    return 0 if is_help else 2


def _refuse_small_address_space() -> None:
    """Refuse a limit of memory (``ulimit -v``) within which the libraries cannot be loaded."""
    if sys.platform == "win32":
        return
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if 0 <= limit < _MIN_ADDRESS_SPACE_KIB * 1024:
        raise InputError(
            f"the limit of {limit // 1024} KiB (ulimit -v) is below the {_MIN_ADDRESS_SPACE_KIB} "
            "that the libraries alone take; raise it"
        )
