"""Standard output and error that may be closed or full: the work goes on without them."""

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class Output:
    """A standard stream that remembers why it could not be written, in place of raising it.

    Args:
        stream: what is written to; None where the process began without.
    """

    def __init__(self, stream: Any) -> None:  # noqa: ANN401  whatever stands in its place
        self._is_closed = stream is None
        self._stream = open(os.devnull, "w", encoding="utf-8") if stream is None else stream  # noqa: PTH123, SIM115
        self.failure: OSError | None = None
        if (reconfigure := getattr(self._stream, "reconfigure", None)) is not None:
            reconfigure(errors="backslashreplace")  # names of files need not be UTF-8

    def write(self, text: str) -> int:
        """Write text, unless an earlier write has failed."""
        if self._is_closed and self.failure is None:
            self.failure = OSError(errno.EBADF, "it is closed")
        self._try(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Write what is buffered, unless an earlier write has failed."""
        self._try(self._stream.flush)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  whatever a stream has
        """Give what the stream has."""
        return getattr(self._stream, name)

    def _try(self, write: Any) -> None:  # noqa: ANN401
        if self.failure is not None:
            return
        try:
            write()
        except OSError as error:
            self.failure = error
            with open(os.devnull, "w", encoding="utf-8") as nothing:  # noqa: PTH123
                os.dup2(nothing.fileno(), self._stream.fileno())  # for what is buffered


@contextmanager
def lasting_streams() -> Iterator[Output]:
    """Let a command print though its streams are closed or full; gives standard output.

    The numbers of closed streams are taken, so that no file gets them and is written into.
    """
    before = sys.stdout, sys.stderr
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
    sys.stdin = sys.stdin or open(os.devnull, encoding="utf-8")  # noqa: PTH123, SIM115
    output, errors = Output(sys.stdout), Output(sys.stderr)
    sys.stdout, sys.stderr = output, errors
    try:
        yield output
        output.flush()
        errors.flush()
    finally:
        sys.stdout, sys.stderr = (old or new for old, new in zip(before, (output, errors)))  # noqa: B905
