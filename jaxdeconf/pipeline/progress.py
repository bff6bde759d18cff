"""A bar per stage on a terminal; elsewhere, in a batch's log say, a line as each stage ends."""

import contextlib
import threading
import time
from collections.abc import Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from jaxdeconf.learn.fit import FitConfig, FitState


class Reporter:
    """What a run says to a person while it works."""

    def __init__(self, console: Console | None = None):
        """Speaks on `console`, by default standard error."""
        self.console = console or Console(stderr=True)
        self._shown, self._bars, self._lock = self._progress(), 0, threading.Lock()

    @contextlib.contextmanager
    def bar(self, stage: str, total: int, done: int = 0) -> Iterator["Bar"]:
        """A bar for `total` steps of a stage, of which `done` are behind us.

        Those of stages that go on at a time stand one below the other.
        """
        with self._lock:
            if not self._bars:
                self._shown = self._progress()
                self._shown.start()
            self._bars += 1
        bar = Bar(self._shown, stage, total, done)
        try:
            yield bar
        finally:
            with self._lock:
                self._bars -= 1
                if not self._bars:
                    self._shown.stop()
        if self._shown.disable:
            self.console.out(f"{stage}: {bar.said()}", highlight=False)

    def _progress(self) -> Progress:
        return Progress(
            TextColumn("{task.description:<22}"),
            BarColumn(),
            TextColumn("{task.completed:>6.0f}/{task.total:.0f}"),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True),
            TextColumn("{task.fields[note]}"),
            console=self.console,
            # FORCE_COLOR makes a terminal of a file, for colours: not one to paint a bar on.
            disable=not (self.console.is_terminal and self.console.file.isatty()),
        )


class Bar:
    """One stage's bar."""

    def __init__(self, progress: Progress, stage: str, total: int, done: int):
        """Use `Reporter.bar`."""
        self._progress = progress
        self._task = progress.add_task(stage, total=total, completed=done, note="compiling")

    def said(self) -> str:
        """How long it took, and its last note."""
        task = next(task for task in self._progress.tasks if task.id == self._task)
        return ", ".join(filter(None, [f"{task.elapsed:.1f} s", task.fields["note"]]))

    def update(self, done: int, note: str) -> None:
        """Sets the bar to `done` steps, with a note beside it."""
        self._progress.update(self._task, completed=done, note=note)

    def track(
        self, chunks: Iterator[tuple[FitState, dict[str, float]]], config: FitConfig
    ) -> Iterator[tuple[FitState, dict[str, float]]]:
        """Passes a training through, showing its loss and images/s."""
        clock, previous = time.perf_counter(), None
        for state, metrics in chunks:
            step, now = int(state.step), time.perf_counter()
            note = f"loss {metrics['loss']:.4g}"
            if previous is not None:  # the first chunk's time is the compiler's
                note += f"  {(step - previous) * config.batch_size / (now - clock):,.0f} images/s"
            self.update(step, note)
            clock, previous = now, step
            yield state, metrics
            clock += time.perf_counter() - now  # what the caller does is not training
