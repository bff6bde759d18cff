"""Ctrl-C and `kill`: the first asks a run to save and stop, the second ends it at once."""

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_ONE = 0.5  # s in which signals count as one: a wrapper passes on what the terminal sent to all


class Interrupted(Exception):
    """The run has stopped as a signal asked; everything is saved."""

    def __init__(self, number: int):
        """Of the signal with that number."""
        super().__init__(signal.Signals(number).name)
        self.exit_code = 128 + number


class Interruption:
    """Whether a run has been asked to stop."""

    def __init__(self) -> None:
        """Not asked yet."""
        self.asked: int | None = None  # the signal's number

    def check(self) -> None:
        """Where everything is saved: stops, if asked to.

        Raises:
          Interrupted: with the signal.
        """
        if self.asked:
            raise Interrupted(self.asked)

    def stop(self) -> None:
        """Asks for it, as a signal does."""
        self._ask(signal.SIGTERM)

    @contextlib.contextmanager
    def listening(self, last_words: str) -> Iterator[None]:
        """Listens to signals instead of raising KeyboardInterrupt; `last_words` go with the second.

        Python runs handlers between two of its instructions, and one of JAX's may take minutes. So
        a thread waits for the signals, which the interpreter writes to a socket at once.
        """
        ear, mouth = socket.socketpair()
        mouth.setblocking(False)
        thread = threading.Thread(target=self._listen, args=(ear, last_words), daemon=True)
        wakeup = signal.set_wakeup_fd(mouth.fileno(), warn_on_full_buffer=False)
        handlers = {number: signal.signal(number, self._ask) for number in _SIGNALS}
        thread.start()
        try:
            yield
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
            signal.set_wakeup_fd(wakeup)
            mouth.close()
            thread.join()
            ear.close()

    def _ask(self, number: int, _: object = None) -> None:
        self.asked = self.asked or number

    def _listen(self, ear: socket.socket, last_words: str) -> None:
        first = None
        while number := ear.recv(1):
            if number[0] in _SIGNALS:
                self._ask(number[0])
                first = first or time.monotonic()
                if time.monotonic() - first > _ONE:
                    print(last_words, file=sys.stderr, flush=True)
                    os._exit(128 + number[0])
