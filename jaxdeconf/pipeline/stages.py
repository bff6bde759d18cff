"""How a run goes through its stages: each is loaded, or done and saved, with a bar and a clock.

Written once: `stage` for what is done in one piece, `watch` for what is trained. It is the `watch`
that the page of the method, `deconfound`, leaves open.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf.learn.fit import FitState, Objective, Training, told
from jaxdeconf.pipeline.checkpoint import fingerprint
from jaxdeconf.pipeline.clock import Clock
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.store import Store

# Of work that a kill may cost; a save takes a few tenths of one.
SAVE_SECONDS = 30.0


@dataclass(frozen=True)
class Run:
    """A run in progress: the question, the disk and the screen, and what has come of it.

    Its stages may go on side by side, in threads.
    """

    config: Any  # what the store holds it by, with a seed
    store: Store
    reporter: Reporter
    interruption: Interruption = field(default_factory=Interruption)
    clock: Clock = field(default_factory=Clock)
    history: dict[str, list[list[float]]] = field(default_factory=dict)  # see `watch`
    _beginning: dict[Objective, threading.Lock] = field(default_factory=dict)

    @property
    def key(self) -> Array:
        """The key that every random choice of the run follows from, by name."""
        return jax.random.key(self.config.seed)

    @property
    def seconds(self) -> dict[str, float]:
        """By stage; see `Clock`."""
        return self.clock.seconds

    @contextlib.contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """A bar and a clock around what is done in one piece."""
        with self.reporter.bar(name, 1) as bar:
            with self.clock.running(name):
                yield
            bar.update(1, "")

    def stage(
        self, name: str, compute: Callable[[], Any], made_from: Mapping[str, str] | None = None
    ) -> Any:
        """A stage in one piece: loaded if it was done before, else computed and saved.

        Args:
          name: of the stage.
          compute: makes a pytree of arrays.
          made_from: names and fingerprints of what it follows from.
        """
        saved = self.store.load(name, compute, made_from or {})
        if saved is not None:
            value, notes = saved
            self.clock.seconds[name] = notes["seconds"]
            return value
        self.interruption.check()
        with self.timed(name):
            value = jax.tree.map(jnp.asarray, jax.block_until_ready(compute()))
        self.store.save(name, 0, value, {"seconds": self.seconds[name]}, made_from or {})
        self.interruption.check()
        return value

    def watch(
        self,
        name: str,
        training: Training,
        data: Any = None,
        visits: Sequence[int] = (),
        visit: Callable[[Any], list[float]] | None = None,
    ) -> FitState:
        """A training: begun, or gone on with from where it was saved; to be a `fit.Watch`.

        `history[name]` becomes a list of [epoch, mean loss since the last visit, *visit(...)].

        Args:
          name: of the stage.
          training: what is trained.
          data: a pytree that its data were made from, for checkpoints to know by.
          visits: ascending steps, the last one among them, at which it is looked at.
          visit: of what is trained by then, to numbers.
        Raises:
          FloatingPointError: at a loss or a weight that is not finite; that is not saved.
          Interrupted: after saving, if the run has been asked to stop.
        """
        total = training.config.total_steps(training.samples)
        made_from = {"collect": fingerprint(data), "view": fingerprint(training.made_from)}
        # What a method trains before its policy is not gone through again for shapes.
        like = training.like or training.data
        saved = self.store.load(name, lambda: training.start(like()), made_from)
        state, notes = saved or (None, {"seconds": 0.0, "history": [], "losses": []})
        if state is None or int(state.step) < total:
            with self.clock.running(name, notes["seconds"]):
                made = training.data()
                training = training._replace(data=lambda: made)  # a bar of its own is over by now
                going_on = self._train(name, training, state, notes, visits, visit)
                with contextlib.closing(going_on) as states:  # the bar is gone if this stops
                    for state in states:
                        self._save(name, state, notes, made_from)
                        self.interruption.check()
            assert state is not None
        self.clock.seconds[name], self.history[name] = notes["seconds"], notes["history"]
        return state

    def _train(
        self,
        name: str,
        training: Training,
        state: FitState | None,
        notes: dict[str, Any],
        visits: Sequence[int],
        visit: Callable[[Any], list[float]] | None,
    ) -> Generator[FitState, None, None]:
        """Goes on with a training and its notes; yields what is to be saved: where it is visited,
        when the last save is long ago, and to stop."""
        config, total = training.config, training.config.total_steps(training.samples)
        per_epoch, saved_at = config.steps_per_epoch(training.samples), time.monotonic()
        with self.reporter.bar(name, total, int(state.step) if state else 0) as bar:
            chunks = self._first_alone(training.objective, training.chunks(name, state, visits))
            for reached, metrics in bar.track(chunks, config):
                notes["losses"] = [*notes["losses"], told(metrics)]
                visited = int(reached.step) in (*visits, total)
                if visited:
                    seen = visit(training.trained(reached)) if visit else []
                    point = [int(reached.step) / per_epoch, float(np.mean(notes["losses"]))]
                    notes |= {"history": [*notes["history"], [*point, *seen]], "losses": []}
                late = time.monotonic() - saved_at > SAVE_SECONDS
                if visited or late or self.interruption.asked:
                    notes["seconds"] = self.clock.read(name)
                    yield reached
                    saved_at = time.monotonic()

    def _first_alone(self, objective: Objective, chunks: Iterator[Any]) -> Iterator[Any]:
        """A training's chunks, of which the first compiles: what begins beside it then need not."""
        with self._beginning.setdefault(objective, threading.Lock()):
            first = next(chunks)
        yield first
        yield from chunks

    def _save(
        self, name: str, state: FitState, notes: dict[str, Any], made_from: Mapping[str, str]
    ) -> None:
        if not finite(state):
            raise FloatingPointError(f"{name}, step {state.step}: weights are not finite")
        self.store.save(name, int(state.step), state, notes, made_from)


def finite(tree: Any) -> bool:
    """Whether all numbers of a pytree are finite."""
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))
