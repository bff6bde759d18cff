"""Many models of one shape trained by one program: the loop of `fit`, with an axis M of models.

Models may differ in their weights, keys and samples, and in the `Traced` fields of their configs.
They are spread over the devices of a mesh; on each, `at_once` of them step together (`vmap`) and
the rest follow. A model's numbers do not depend on who it is trained with.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxdeconf.learn.fit import FitConfig, FitState, Objective, lengths, train

AXIS = "models"  # of the mesh


class Models(NamedTuple):
    """What tells models apart; each leaf has a leading axis M."""

    state: FitState
    config: FitConfig  # its leaves, the Traced fields, are [M]
    key: Array  # [M] shuffles and noise
    first_sample: Array  # [M] int32: where, in its device's data, each one's samples begin


def fit_many(
    objective: Objective,
    models: Models,
    data: Any,
    samples: int,
    mesh: Mesh,
    at_once: int = 1,
) -> Iterator[tuple[FitState, dict[str, Array]]]:
    """Trains M models from their first step; yields as `fit` does, each leaf with an axis M.

    Args:
      objective: config -> loss.
      models: M of them, a multiple of the mesh's devices, which get M over D each, in order. The
        buffers of their states are donated.
      data: any pytree of arrays whose leading axis is split among the devices in the same way.
      samples: of each model.
      mesh: one axis, AXIS.
      at_once: models that step together on a device; a divisor of M over D. On a CPU, 1.
    Raises:
      ValueError: if M is no multiple of that; when the first chunk is asked for.
    """
    count, devices = len(models.first_sample), mesh.devices.size
    if count % (devices * at_once):
        raise ValueError(
            f"models: expected a multiple of {devices} devices × {at_once} at once, got {count}"
        )
    split = NamedSharding(mesh, PartitionSpec(AXIS))
    models, data = jax.device_put((models, data), split)
    state, rest = models.state, models._replace(state=None)  # type: ignore
    for length in lengths(models.config, samples, 0, ()):
        state, metrics = _chunk(
            objective, samples, mesh, at_once, state, rest, data, jnp.int32(length)
        )
        # On one device XLA calls the same placement another name, which would compile again.
        state = jax.device_put(state, split)
        yield state, metrics


@partial(
    jax.jit,
    static_argnames=("objective", "samples", "mesh", "at_once"),
    donate_argnames="state",
)
def _chunk(
    objective: Objective,
    samples: int,
    mesh: Mesh,
    at_once: int,
    state: FitState,
    rest: Models,
    data: Any,
    length: Array,
) -> tuple[FitState, dict[str, Array]]:
    split, whole = PartitionSpec(AXIS), PartitionSpec()

    # Without the check of which values vary over devices, which no loss of ours says of its zeros.
    @partial(
        jax.shard_map,
        mesh=mesh,
        in_specs=(split, split, whole),
        out_specs=split,
        check_vma=False,
    )
    def on_device(models: Models, data: Any, length: Array) -> tuple[FitState, dict[str, Array]]:
        def one(model: Models) -> tuple[FitState, dict[str, Array]]:
            start = model.first_sample
            return train(
                objective, model.config, samples, model.state, data, start, model.key, length
            )

        return jax.lax.map(one, models, batch_size=at_once if at_once > 1 else None)

    return on_device(rest._replace(state=state), data, length)
