"""A bar per stage on a terminal; elsewhere, in a batch's log say, a line as each stage ends."""

import time
from collections.abc import Iterator
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from jaxdeconf.learn.fit import FitConfig, FitState


class Reporter:
    """What a run says to a person while it works."""

    def __init__(self, console: Console | None = None):
        """Speaks on `console`, by default standard error."""
        self.console = console or Console(stderr=True)

    def bar(self, stage: str, total: int, done: int = 0) -> "Bar":
        """A bar for `total` steps of a stage, of which `done` are behind us."""
        return Bar(self.console, stage, total, done)


class Bar:
    """One stage's bar; a context manager."""

    def __init__(self, console: Console, stage: str, total: int, done: int):
        """Use `Reporter.bar`."""
        self._stage = stage
        self._progress = Progress(
            TextColumn("{task.description:<22}"),
            BarColumn(),
            TextColumn("{task.completed:>6.0f}/{task.total:.0f}"),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True),
            TextColumn("{task.fields[note]}"),
            console=console,
            # FORCE_COLOR makes a terminal of a file, for colours: not one to paint a bar on.
            disable=not (console.is_terminal and console.file.isatty()),
        )
        self._task = self._progress.add_task(stage, total=total, completed=done, note="compiling")

    def __enter__(self) -> "Bar":
        self._progress.start()
        return self

    def __exit__(self, kind: type | None, *_: Any) -> None:
        self._progress.stop()
        if kind is None and self._progress.disable:
            (task,) = self._progress.tasks
            said = ", ".join(filter(None, [f"{task.elapsed:.1f} s", task.fields["note"]]))
            self._progress.console.out(f"{self._stage}: {said}", highlight=False)

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
