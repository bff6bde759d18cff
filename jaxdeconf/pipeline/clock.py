"""How long a run's stages take, where several go on at a time."""

import contextlib
import threading
import time
from collections.abc import Iterator


class Clock:
    """Seconds by stage. Stages side by side share the time that passes, so that all add up."""

    def __init__(self) -> None:
        """Nothing has taken any time yet."""
        self.seconds: dict[str, float] = {}
        self._running: list[str] = []
        self._read = 0.0  # when it was last shared out
        self._lock = threading.Lock()

    @contextlib.contextmanager
    def running(self, stage: str, before: float = 0.0) -> Iterator[None]:
        """A stage goes on, which has taken some seconds before."""
        with self._lock:
            self._share()
            self.seconds[stage] = before
            self._running.append(stage)
        try:
            yield
        finally:
            with self._lock:
                self._share()
                self._running.remove(stage)

    def read(self, stage: str) -> float:
        """A stage's seconds up to now."""
        with self._lock:
            self._share()
            return self.seconds[stage]

    def _share(self) -> None:
        now = time.perf_counter()
        for stage in self._running:
            self.seconds[stage] += (now - self._read) / len(self._running)
        self._read = now
