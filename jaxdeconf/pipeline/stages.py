"""How a run goes through its stages: each is loaded, or done and saved, with a bar and a clock.

Written once: `stage` for what is done in one piece, `watch` for what is trained. It is the `watch`
that the page of the method, `deconfound`, leaves open.
"""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf.learn.fit import FitState, Training, told
from jaxdeconf.pipeline.checkpoint import fingerprint
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.store import Store

# Of work that a kill may cost; a save takes a few tenths of one.
SAVE_SECONDS = 30.0


@dataclass(frozen=True)
class Run:
    """A run in progress: the question, the disk and the screen, and what has come of it."""

    config: Any  # what the store holds it by, with a seed
    store: Store
    reporter: Reporter
    interruption: Interruption = field(default_factory=Interruption)
    seconds: dict[str, float] = field(default_factory=dict)  # by stage
    history: dict[str, list[list[float]]] = field(default_factory=dict)  # see `watch`

    @property
    def key(self) -> Array:
        """The key that every random choice of the run follows from, by name."""
        return jax.random.key(self.config.seed)

    @contextlib.contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """A bar and a clock around what is done in one piece."""
        with self.reporter.bar(name, 1) as bar:
            begin = time.perf_counter()
            yield
            self.seconds[name] = time.perf_counter() - begin
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
            self.seconds[name] = notes["seconds"]
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
        config, total = training.config, training.config.total_steps(training.samples)
        per_epoch = config.steps_per_epoch(training.samples)
        made_from = {"collect": fingerprint(data), "view": fingerprint(training.made_from)}
        # What a method trains before its policy is not gone through again for shapes.
        like = training.like or training.data
        saved = self.store.load(name, lambda: training.start(like()), made_from)
        state, notes = saved or (None, {"seconds": 0.0, "history": [], "losses": []})
        done = int(state.step) if state else 0
        if done < total:
            begin, made = time.perf_counter() - notes["seconds"], training.data()
            training = training._replace(data=lambda: made)  # a bar of its own is over by now
            with self.reporter.bar(name, total, done) as bar:
                chunks = bar.track(training.chunks(name, state, visits), config)
                for state, metrics in chunks:
                    notes["losses"] = [*notes["losses"], told(metrics)]
                    visited = int(state.step) in (*visits, total)
                    if visited:
                        seen = visit(training.trained(state)) if visit else []
                        point = [int(state.step) / per_epoch, float(np.mean(notes["losses"]))]
                        notes |= {"history": [*notes["history"], [*point, *seen]], "losses": []}
                    notes["seconds"] = time.perf_counter() - begin
                    self._checkpoint(name, state, notes, made_from, visited)
        self.seconds[name], self.history[name] = notes["seconds"], notes["history"]
        assert state is not None
        return state

    def _checkpoint(
        self,
        name: str,
        state: FitState,
        notes: dict[str, Any],
        made_from: Mapping[str, str],
        now: bool,
    ) -> None:
        """At a chunk's edge: saves `now`, when the last save is long ago, or to stop."""
        late = time.monotonic() - self.store.saved_at > SAVE_SECONDS
        if now or late or self.interruption.asked:
            if not finite(state):
                raise FloatingPointError(f"{name}, step {state.step}: weights are not finite")
            self.store.save(name, int(state.step), state, notes, made_from)
        self.interruption.check()


def finite(tree: Any) -> bool:
    """Whether all numbers of a pytree are finite."""
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))
