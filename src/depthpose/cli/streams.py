"""Standard output and error that may be closed or full: the work goes on without them."""

import errno
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any


class Output:
    """A standard stream that remembers why it could not be written, in place of raising it.

    ``is_lost``: the process began without it, and ``stream`` only stands in its place.
    """

    def __init__(self, stream: Any, *, is_lost: bool = False) -> None:  # noqa: ANN401
        self._stream, self._is_lost = stream, is_lost
        self.failure: OSError | None = None
        if (reconfigure := getattr(stream, "reconfigure", None)) is not None:
            reconfigure(errors="backslashreplace")  # names of files need not be UTF-8

    def write(self, text: str) -> int:
        """Write text, unless an earlier write has failed."""
        if self._is_lost and self.failure is None:
            self.failure = OSError(errno.EBADF, "it is closed")
        self._try(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Write what is buffered, unless an earlier write has failed."""
        self._try(self._stream.flush)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  whatever a stream has
        """Give what the stream has."""
        return getattr(self._stream, name)

    def _try(self, write: Callable[[], object]) -> None:
        if self.failure is not None:
            return
        try:
            write()
        except OSError as error:
            self.failure = error
            with suppress(OSError), open(os.devnull, "wb") as nothing:  # noqa: PTH123
                os.dup2(nothing.fileno(), self._stream.fileno())  # for what is buffered


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
        sys.stdin, sys.stdout, sys.stderr = real[0], output, errors
        try:
            yield output
            output.flush()
            errors.flush()
        finally:
            sys.stdin, sys.stdout, sys.stderr = before
