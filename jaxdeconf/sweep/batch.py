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

from jaxdeconf.learn.fit import FitState, Training, told
from jaxdeconf.learn.many import AXIS, Models, fit_many

# Steps at once on an accelerator beyond which nothing is gained.
_MOST_AT_ONCE = 16
# Models of groups side by side that are trained and judged before any program is forgotten.
_LOT = 16


class Job(NamedTuple):
    """One model to train."""

    training: Training
    data_name: Hashable  # equal for equal data
    kind: Hashable = None  # equal for data and variables of the same fields

    @property
    def shape(self) -> Hashable:
        """Equal for models that one program trains."""
        training = self.training
        return training.objective, training.samples, jax.tree.structure(training.config), self.kind


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


class Lot(NamedTuple):
    """Groups of jobs, of one shape each, to train before compiled programs are forgotten."""

    groups: list[int]  # their places
    at_once: int  # how many side by side, each by its own program


def lots(groups: Sequence[Sequence[Job]], budget: float) -> Iterator[Lot]:
    """Groups in the order to train them: first those that fill the devices, one after the other.

    Groups of fewer models would leave cores idle alone, and are trained side by side: on a CPU, in
    one process.

    Args:
      groups: jobs of one shape each.
      budget: bytes, of all together.
    """
    on_cores = jax.default_backend() == "cpu" and jax.process_count() == 1
    devices = len(jax.devices()) if on_cores else 1
    small = [i for i, group in enumerate(groups) if len(group) < devices]
    yield from (Lot([i], 1) for i in range(len(groups)) if i not in small)
    most = max((len(groups[i]) for i in small), default=1)
    count = max(1, _LOT // most)
    for some in (small[i : i + count] for i in range(0, len(small), count)):
        taken = max(len(groups[i]) * model_bytes(groups[i][0].training) for i in some)
        yield Lot(some, max(1, min(devices // most, int(budget // taken))))


class Trained(NamedTuple):
    """What became of a job."""

    job: int  # its place
    state: FitState  # on the host
    loss: float  # of the last chunk
    seconds: float  # of its batch


def train_all(
    jobs: Sequence[Job], budget: float, progress: Callable[[int, float], None]
) -> Iterator[list[Trained]]:
    """Trains jobs of one shape, a batch after the other.

    Args:
      jobs: what to train.
      budget: bytes, see `room`.
      progress: told the steps so far, of all models, and the mean loss; may raise to stop.
    Yields:
      A batch that is done. Models whose numbers are not finite are among it.
    """
    # Neighbours share their data, which a device then holds once.
    names = [job.data_name for job in jobs]
    order = sorted(range(len(jobs)), key=lambda i: names.index(names[i]))
    first = jobs[0].training
    space, total = room(len(jobs), model_bytes(first), budget), total_steps(first)
    for start in range(0, len(jobs), space.models):
        chosen = order[start : start + space.models]
        begin = time.perf_counter()
        for steps, metrics, states in _train([jobs[i] for i in chosen], space):
            progress(total * start + steps * len(chosen), float(metrics["loss"].mean()))
            if states is not None:
                seconds, loss = time.perf_counter() - begin, told(metrics)
                yield [
                    Trained(i, jax.tree.map(lambda a, k=k: a[k], states), float(loss[k]), seconds)
                    for k, i in enumerate(chosen)
                ]


def total_steps(training: Training) -> int:
    """Of a training."""
    return training.config.total_steps(training.samples)


def model_bytes(training: Training) -> float:
    """What a model takes in training, about: its data, its weights and Adam's moments, and what the
    gradient keeps."""
    state, data = shapes(training)

    def kept(variables: Any, data: Any) -> Any:
        return jax.vjp(step_loss(training, variables, data), variables["params"])[1]

    activations = jax.eval_shape(kept, state.variables, data)
    # Twice: gradients of what is kept live beside it.
    return _size(data) + 2.0 * _size(activations) + 2.0 * _size(state)


def shapes(training: Training) -> tuple[FitState, Any]:
    """A model's first state and its data, as shapes: nothing is made."""
    data = jax.eval_shape(training.like or training.data)
    return jax.eval_shape(training.start, data), data


def step_loss(training: Training, variables: Any, data: Any) -> Callable[[Any], Array]:
    """The loss of a step, as a function of the weights: to be measured, not trained."""
    indices, key = jnp.zeros(training.config.batch_size, int), jax.random.key(0)

    def loss(params: Any) -> Array:
        own, objective = {**variables, "params": params}, training.objective(training.config)
        return objective(own, data, indices, key, jnp.int32(0))[0]

    return loss


def _size(tree: Any) -> float:
    """Bytes of a pytree of arrays or of their shapes."""
    leaves = jax.tree.leaves(tree)
    return float(sum(leaf.size * leaf.dtype.itemsize for leaf in leaves if hasattr(leaf, "size")))


def _train(
    jobs: Sequence[Job], room: Room
) -> Iterator[tuple[int, dict[str, np.ndarray], FitState | None]]:
    """Trains up to `room.models` jobs together; the last one fills what is left of the room.

    Yields:
      After every chunk: its steps so far, its metrics [M], and at the end the states, on the host,
      with an axis M over the jobs; None before.
    """
    padded = [*jobs, *[jobs[-1]] * (room.models - len(jobs))]
    mesh = Mesh(np.array(room.devices), (AXIS,))
    models, data = _place(padded, mesh)
    first = jobs[0].training
    for state, metrics in fit_many(
        first.objective, models, data, first.samples, mesh, room.at_once
    ):
        gathered = {name: _gather(value)[: len(jobs)] for name, value in metrics.items()}
        done = int(np.asarray(state.step.addressable_shards[0].data)[0])
        if done < total_steps(first):
            yield done, gathered, None
        else:
            yield done, gathered, jax.tree.map(lambda a: _gather(a)[: len(jobs)], state)


def _gather(array: Array) -> np.ndarray:
    return np.asarray(multihost_utils.process_allgather(array, tiled=True))


def _place(jobs: Sequence[Job], mesh: Mesh) -> tuple[Models, Any]:
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
        samples = share[0].training.samples
        first = jnp.array([names.index(job.data_name) * samples for job in share], jnp.int32)
        configs = [job.training.config for job in share]
        config = jax.tree.map(lambda *leaves: jnp.array(leaves, jnp.float32), *configs)
        of = {job.data_name: job.training.data for job in share}
        made = {name: of[name]() for name in names}
        states = [job.training.start(made[job.data_name]) for job in share]
        state = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
        keys = jnp.stack([job.training.key for job in share])
        models.append(jax.device_put(Models(state, config, keys, first), device))
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
