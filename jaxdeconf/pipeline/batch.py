"""Models of one shape, trained in batches that fill the devices: what a sweep does with `fit_many`.

The batch is an array over a mesh of devices, also of those of other processes: each process places
what its own devices need, all run the same program, and all get every trained model back.
"""

import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxdeconf.learn.fit import FitConfig, FitState, Objective
from jaxdeconf.learn.many import AXIS, Models, fit_many

# Steps at once on an accelerator beyond which nothing is gained.
_MOST_AT_ONCE = 16


class Job(NamedTuple):
    """One model to train."""

    state: Callable[[Any], FitState]  # its first, for its data
    numbers: dict[str, float]  # of the config's traced fields; all jobs name the same
    key: Array
    data_name: Hashable  # equal for equal data
    data: Callable[[], Any]  # a pytree of arrays [samples, ...]


class Room(NamedTuple):
    """The devices of a batch, and how many models each steps at once."""

    devices: tuple[Any, ...]
    at_once: int

    @property
    def models(self) -> int:
        """Models in a batch."""
        return len(self.devices) * self.at_once


def room(jobs: int, bytes_a_model: float, budget: float) -> Room:
    """How many models to train at once: as memory and devices allow.

    A CPU's cores are devices that share one memory, and step one model at a time.

    Args:
      jobs: models to train.
      bytes_a_model: what one takes.
      budget: bytes, of a device; of all together on a CPU.
    """
    devices, alone = jax.devices(), jax.process_count() == 1
    fit = max(1, int(budget // max(1.0, bytes_a_model)))
    if jax.default_backend() == "cpu":
        count = max(1, min(len(devices), jobs, fit)) if alone else len(devices)
        return Room(tuple(devices[:count]), 1)
    count = min(len(devices), jobs) if alone else len(devices)
    return Room(tuple(devices[:count]), max(1, min(_MOST_AT_ONCE, fit, -(-jobs // count))))


class Trained(NamedTuple):
    """What became of a job."""

    job: int  # its place
    state: FitState  # on the host
    loss: float  # of the last chunk
    seconds: float  # of its batch


def train_all(
    objective: Objective,
    config: FitConfig,
    samples: int,
    jobs: Sequence[Job],
    budget: float,
    progress: Callable[[int], None],
) -> Iterator[list[Trained]]:
    """Trains jobs, a batch after the other.

    Args:
      objective: config -> loss.
      config: of all jobs, but for their numbers.
      samples: of each job's data.
      jobs: what to train.
      budget: bytes, see `room`.
      progress: told the steps so far, of all models, after every chunk; may raise to stop.
    Yields:
      A batch that is done. Models whose numbers are not finite are among it.
    """
    # Neighbours share their data, which a device then holds once.
    names = [job.data_name for job in jobs]
    order = sorted(range(len(jobs)), key=lambda i: names.index(names[i]))
    space = room(len(jobs), model_bytes(objective, config, jobs[0]), budget)
    total = config.steps(samples)
    for start in range(0, len(jobs), space.models):
        chosen = order[start : start + space.models]
        begin = time.perf_counter()
        for steps, metrics, states in train(
            objective, config, samples, [jobs[i] for i in chosen], space
        ):
            progress(total * start + steps * len(chosen))
            if states is not None:
                seconds = time.perf_counter() - begin
                loss = metrics["loss"]
                yield [
                    Trained(i, _model(states, k), float(loss[k]), seconds)
                    for k, i in enumerate(chosen)
                ]


def _model(states: FitState, index: int) -> FitState:
    return jax.tree.map(lambda a: a[index], states)


def model_bytes(objective: Objective, config: FitConfig, job: Job) -> float:
    """About what training a model takes: its data, its weights, and what a gradient keeps."""
    state, data = shapes(job)

    def kept(variables: Any, data: Any) -> Any:
        return jax.vjp(step_loss(objective, config, variables, data), variables["params"])[1]

    activations = jax.eval_shape(kept, state.variables, data)
    # Twice: gradients of what is kept live beside it.
    return size(data) + 2.0 * size(activations) + 2.0 * size(state)


def shapes(job: Job) -> tuple[FitState, Any]:
    """A model's first state and its data, as shapes: nothing is made."""
    data = jax.eval_shape(job.data)
    return jax.eval_shape(job.state, data), data


def step_loss(
    objective: Objective, config: FitConfig, variables: Any, data: Any
) -> Callable[[Any], Array]:
    """The loss of a step, as a function of the weights: to be measured, not trained."""
    indices, key = jnp.zeros(config.batch_size, int), jax.random.key(0)

    def loss(params: Any) -> Array:
        own = {**variables, "params": params}
        return objective(config)(own, data, indices, key, jnp.int32(0))[0]

    return loss


def size(tree: Any) -> float:
    """Bytes of a pytree of arrays or of their shapes."""
    leaves = jax.tree.leaves(tree)
    return float(sum(leaf.size * leaf.dtype.itemsize for leaf in leaves if hasattr(leaf, "size")))


def train(
    objective: Objective,
    config: FitConfig,
    samples: int,
    jobs: Sequence[Job],
    room: Room,
) -> Iterator[tuple[int, dict[str, np.ndarray], FitState | None]]:
    """Trains up to `room.models` jobs together; the last one fills what is left of the room.

    Yields:
      After every chunk: its steps so far, its metrics [M], and at the end the states, on the host,
      with an axis M over the jobs; None before.
    """
    padded = [*jobs, *[jobs[-1]] * (room.models - len(jobs))]
    mesh = Mesh(np.array(room.devices), (AXIS,))
    models, data = _place(padded, samples, mesh)
    total = config.steps(samples)
    for state, metrics in fit_many(objective, models, data, samples, config, mesh, room.at_once):
        gathered = {name: _gather(value)[: len(jobs)] for name, value in metrics.items()}
        done = int(np.asarray(state.step.addressable_shards[0].data)[0])
        if done < total:
            yield done, gathered, None
        else:
            yield done, gathered, jax.tree.map(lambda a: _gather(a)[: len(jobs)], state)


def _gather(array: Array) -> np.ndarray:
    return np.asarray(multihost_utils.process_allgather(array, tiled=True))


def _place(jobs: Sequence[Job], samples: int, mesh: Mesh) -> tuple[Models, Any]:
    """Models and data on the devices; each device holds what its own models need, once."""
    devices = mesh.devices.tolist()
    each = len(jobs) // len(devices)
    shares = [jobs[i * each : (i + 1) * each] for i in range(len(devices))]
    named = [list(dict.fromkeys(job.data_name for job in share)) for share in shares]
    most = max(map(len, named))  # every device's data must have the same shape
    models, data = [], []
    for device, share, names in zip(devices, shares, named, strict=True):
        if device.process_index != jax.process_index():
            continue
        first = jnp.array([names.index(job.data_name) * samples for job in share], jnp.int32)
        numbers = {k: jnp.array([job.numbers[k] for job in share]) for k in share[0].numbers}
        of = {job.data_name: job.data for job in share}
        made = {name: of[name]() for name in names}
        states = [job.state(made[job.data_name]) for job in share]
        state = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
        keys = jnp.stack([job.key for job in share])
        models.append(jax.device_put(Models(state, numbers, keys, first), device))
        sets = list(made.values())
        sets += [sets[0]] * (most - len(sets))
        joined = jax.tree.map(lambda *a: a[0] if len(a) == 1 else jnp.concatenate(a), *sets)
        data.append(jax.device_put(joined, device))
    return _one_array(models, mesh), _one_array(data, mesh)


def _one_array(parts: Sequence[Any], mesh: Mesh) -> Any:
    """Pytrees, one a device of this process, as one whose leading axis is split over the mesh."""
    sharding = NamedSharding(mesh, PartitionSpec(AXIS))

    def join(*leaves: Array) -> Array:
        shape = (leaves[0].shape[0] * mesh.devices.size, *leaves[0].shape[1:])
        return jax.make_array_from_single_device_arrays(shape, sharding, list(leaves))

    return jax.tree.map(join, *parts)
