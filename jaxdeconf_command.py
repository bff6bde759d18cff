"""The command `jaxdeconf` as a process: from its first line on, Ctrl-C ends it without a word.

It stands beside the package, whose import takes seconds and must be ended by Ctrl-C, too.
"""

import io
import os
import signal
import sys
from collections.abc import Sequence


class _Screen(io.FileIO):
    """A stream whose reader may leave: a run does not die because nobody looks any more."""

    def write(self, data):
        try:
            return super().write(data)
        except OSError:  # `| head` has seen enough, the terminal is closed, the log's disk is full
            return len(data)


def main(arguments: Sequence[str] | None = None) -> int:
    """`commands.main.main`, whose exit code it returns, with the signals and streams of a process.

    Args:
      arguments: those of the command line.
    """
    # Beside other processes, the threads of a linear algebra library wait for one another: of a
    # matrix of 600 × 600, eigenvectors took 4.3 s on a busy machine, on one thread 0.02 s.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Not by an exception, which an import may catch. A run listens by itself once it has a state.
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    for name in ("stdout", "stderr"):
        if (stream := getattr(sys, name)) is not None:
            raw = io.BufferedWriter(_Screen(stream.fileno(), "w", closefd=False))
            words = io.TextIOWrapper(raw, stream.encoding, "backslashreplace", line_buffering=True)
            setattr(sys, name, words)
    from jaxdeconf.commands.main import main

    return main(arguments)
