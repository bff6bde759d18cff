"""The only training loop: Adam on mini-batches, in jitted chunks that a host loop drives.

A chunk is the unit of everything else: where metrics appear, where a caller saves, evaluates or
stops. `fit` yields at every chunk's edge and keeps no state of its own: what it yields is enough to
go on from, to the last bit.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxdeconf import checks
from jaxdeconf.nets.layers import Variables
from jaxdeconf.traced import Traced, traceable

# (variables, data, indices [B], key, step []) -> (loss [], (new batch_stats, metrics))
Loss = Callable[[Variables, Any, Array, Array, Array], tuple[Array, tuple[Any, dict[str, Array]]]]
# A config -> its loss. The config's `Traced` fields are traced: it must neither hash nor branch on
# them. The same function whenever the same program is meant.
Objective = Callable[[Any], Loss]

_MOST_STEPS = 2**31 - 1  # the step is int32
_AVERAGED = "params", "batch_stats"


@traceable
@dataclass(frozen=True)
class FitConfig:
    """How a network is trained: Adam (Kingma & Ba 2015), exponential decay of its learning rate."""

    epochs: float = 1.0  # passes over the samples; a fraction stops within a pass
    # Steps in all, whatever the number of samples, in place of `epochs`. Ours: a budget that fits
    # data of any size.
    steps: int | None = None
    batch_size: int = 64  # samples a step
    learning_rate: Traced = 1e-3  # Adam's, at the start
    # The learning rate's factor an epoch, or with `steps` over all of them: to train for longer
    # give more steps, since more epochs alone end in ever smaller ones.
    decay: Traced = 0.96
    chunk: int = 64  # steps a jitted call; ours: seconds on a CPU, the bar's and a stop's grain
    weight_decay: Traced = 0.0  # decoupled from the gradient (Loshchilov & Hutter 2019); ours: none
    # What is good for anything is not the last weights but their running average, of which so much
    # is kept each step (Polyak & Juditsky 1992); with the statistics of normalisation. None: none.
    average: Traced | None = None

    def __post_init__(self):
        for name in ("epochs", "learning_rate", "decay"):
            checks.positive(name, getattr(self, name))
        checks.not_negative("weight_decay", self.weight_decay)
        if self.average is not None:
            checks.number("average", self.average, "a number in (0, 1)", 0.0, 1.0)
        for name in ("batch_size", "chunk"):
            checks.integer(name, getattr(self, name))
        if self.steps is not None:
            checks.integer("steps", self.steps)

    def steps_per_epoch(self, samples: int) -> int:
        """Whole batches in one pass; the samples left over differ from pass to pass."""
        if checks.integer("samples", samples) < self.batch_size:
            raise ValueError(
                f"batch_size: expected at most {samples} samples, got {self.batch_size}"
            )
        return samples // self.batch_size

    def total_steps(self, samples: int) -> int:
        """Steps of the whole training on so many samples."""
        per_epoch = self.steps_per_epoch(samples)
        if self.steps is not None:
            return self.steps
        steps = max(1, round(self.epochs * per_epoch))
        if steps > _MOST_STEPS:
            raise ValueError(
                f"epochs: expected at most {_MOST_STEPS} steps in all, got {self.epochs} epochs"
            )
        return steps


class FitState(NamedTuple):
    """Everything that training changes."""

    variables: Variables
    moments: Any  # Adam's
    step: Array  # [] int32
    average: Variables | None = None  # of weights and statistics, where the config asks for one

    @property
    def best(self) -> Variables:
        """The weights and statistics that are good for something: averaged ones where there are."""
        held = self.variables if self.average is None else self.average
        return {name: held[name] for name in _AVERAGED}


def start(variables: Variables, averaged: bool = False) -> FitState:
    """The state before the first step, from {"params": ..., "batch_stats": ...}."""
    moments = optax.scale_by_adam().init(variables["params"])
    average = None
    if averaged:  # in buffers of its own: those of a state are donated
        average = jax.tree.map(jnp.array, {name: variables[name] for name in _AVERAGED})
    return FitState(variables, moments, jnp.int32(0), average)


def learning_rate(config: FitConfig, samples: int, step: Array) -> Array:
    """[] the learning rate of a step; it decays smoothly, so that short trainings have it too."""
    over = config.steps or config.steps_per_epoch(samples)
    return config.learning_rate * config.decay ** (step / over)


def train(
    objective: Objective,
    config: FitConfig,
    samples: int,
    state: FitState,
    data: Any,
    first_sample: Array | int,
    key: Array,
    length: Array,
) -> tuple[FitState, dict[str, Array]]:
    """`length` steps within one epoch, and the mean of their metrics; config may be traced."""
    loss, steps_per_epoch = objective(config), config.steps_per_epoch(samples)
    shuffle_key, noise_key = jax.random.split(key)
    epoch = state.step // steps_per_epoch
    order = jax.random.permutation(jax.random.fold_in(shuffle_key, epoch), samples) + first_sample
    adam = optax.scale_by_adam()

    def advance(state: FitState) -> tuple[FitState, dict[str, Array]]:
        first = (state.step % steps_per_epoch) * config.batch_size
        indices = jax.lax.dynamic_slice_in_dim(order, first, config.batch_size)

        def objective(params: Any):
            variables = {**state.variables, "params": params}
            return loss(
                variables, data, indices, jax.random.fold_in(noise_key, state.step), state.step
            )

        params = state.variables["params"]
        (value, (batch_stats, metrics)), gradient = jax.value_and_grad(objective, has_aux=True)(
            params
        )
        updates, moments = adam.update(gradient, state.moments)
        updates = jax.tree.map(lambda u, p: u + config.weight_decay * p, updates, params)
        rate = learning_rate(config, samples, state.step)
        params = jax.tree.map(lambda p, u: p - rate * u, params, updates)
        variables = {**state.variables, "params": params, "batch_stats": batch_stats}
        average = _averaged(config, state, variables)
        return FitState(variables, moments, state.step + 1, average), {"loss": value, **metrics}

    def body(_: Array, carry: tuple) -> tuple:
        state, total = carry
        state, metrics = advance(state)
        return state, jax.tree.map(jnp.add, total, metrics)

    zeros = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(advance, state)[1])
    # A trip count that is data: one compilation serves the shorter chunk at an epoch's end.
    state, total = jax.lax.fori_loop(0, length, body, (state, zeros))
    return state, jax.tree.map(lambda a: a / length, total)


def _averaged(config: FitConfig, state: FitState, variables: Variables) -> Variables | None:
    """The average after a step; its first steps forget faster, or it would begin at random."""
    if state.average is None or config.average is None:
        return None
    kept = jnp.minimum(config.average, (1.0 + state.step) / (10.0 + state.step))
    new = {name: variables[name] for name in state.average}
    return jax.tree.map(lambda old, now: now + kept * (old - now), state.average, new)


@partial(jax.jit, static_argnames=("objective", "samples"), donate_argnames="state")
def _chunk(
    objective: Objective,
    samples: int,
    state: FitState,
    data: Any,
    config: FitConfig,
    key: Array,
    length: Array,
) -> tuple[FitState, dict[str, Array]]:
    return train(objective, config, samples, state, data, 0, key, length)


def lengths(config: FitConfig, samples: int, step: int, stops: Sequence[int]) -> Iterator[int]:
    """The lengths of the chunks from a step on."""
    per_epoch, last = config.steps_per_epoch(samples), config.total_steps(samples)
    while step < last:
        length = min(config.chunk, per_epoch - step % per_epoch, last - step)
        length = min([length, *(stop - step for stop in stops if stop > step)])
        step += length
        yield length


def fit(
    objective: Objective,
    state: FitState,
    data: Any,
    samples: int,
    key: Array,
    config: FitConfig,
    stops: Sequence[int] = (),
) -> Iterator[tuple[FitState, dict[str, Array]]]:
    """Trains, yielding at every chunk's edge; chunks end where an epoch ends.

    Args:
      objective: config -> loss; the same function whenever the same program is meant.
      state: from `start`, or one that was yielded before: training goes on from its step as if it
        had never stopped. Its buffers are donated.
      data: any pytree of arrays on the device; the loss picks what `indices` name.
      samples: how many there are to index.
      key: shuffles and whatever noise the loss draws.
      config: how long and how fast. One program serves all values of its `Traced` fields.
      stops: steps, ascending, at which a chunk also ends.
    Yields:
      The state, and the chunk's mean of every metric.
    """
    for length in lengths(config, samples, int(state.step), stops):
        state, metrics = _chunk(objective, samples, state, data, config, key, jnp.int32(length))
        yield state, metrics


def told(metrics: Mapping[str, Any]) -> Any:
    """The metric that is told of a training: the error, where the loss holds more than that."""
    return metrics.get("error", metrics["loss"])


class Training(NamedTuple):
    """A training before it begins: all that `fit` needs, and nothing of it made yet."""

    objective: Objective
    config: FitConfig
    samples: int
    key: Array  # shuffles and noise
    data: Callable[[], Any]
    start: Callable[[Any], FitState]  # from the data: its first state
    trained: Callable[[FitState], Any]  # what a state of it is good for: an encoder, a policy
    made_from: Any = None  # a pytree that the data depend on beside the demonstrations
    # Makes data of the same shapes by nothing that JAX cannot trace; None: `data` does.
    like: Callable[[], Any] | None = None

    def chunks(
        self, name: str, state: FitState | None = None, stops: Sequence[int] = ()
    ) -> Iterator[tuple[FitState, dict[str, float]]]:
        """Trains, from its first state or a later one.

        Yields:
          As `fit` does, with the metrics as Python floats.
        Raises:
          FloatingPointError: with its name, the step at the chunk's end and the value, at a loss
            that is not finite.
        """
        data = self.data()
        begin = self.start(data) if state is None else state
        chunks = fit(self.objective, begin, data, self.samples, self.key, self.config, stops)
        for reached, metrics in chunks:
            values = {metric: float(value) for metric, value in metrics.items()}
            if not math.isfinite(values["loss"]):
                raise FloatingPointError(f"{name}, step {reached.step}: loss is {values['loss']}")
            yield reached, values


# How a training is gone through: (its name, the training) -> its last state.
Watch = Callable[[str, Training], FitState]


def finish(name: str, training: Training) -> FitState:
    """The plain watch: from the first step to the last, and nothing beside."""
    *_, (state, _) = training.chunks(name)
    return state
