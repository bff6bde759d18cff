"""What a sweep is going to do, before it starts: programs, models and memory, about."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxdeconf.learn import clone, disentangle
from jaxdeconf.learn.clone import Demonstrations
from jaxdeconf.learn.fit import Training
from jaxdeconf.method import configured, imitated
from jaxdeconf.methods import METHODS
from jaxdeconf.pipeline.config import Config, fitting
from jaxdeconf.pipeline.machine import free_memory
from jaxdeconf.sweep import batch, grid, shared
from jaxdeconf.sweep.grid import Point
from jaxdeconf.sweep.log import Sweep
from jaxdeconf.sweep.sweep import part
from jaxdeconf.systems import System
from jaxdeconf.views import identity


def describe(sweep: Sweep, system: System, shard: tuple[int, int], budget: float) -> str:
    """The plan in a few lines; `budget` as in `sweep.sweep`.

    Raises:
      ValueError: if a point does not fit the system.
    """
    base, points = sweep.base, part(sweep.points, shard)
    configs = [point.config for point in points]
    for config in configs:
        fitting(config, system)
    of = "" if shard == (1, 1) else f", part {shard[0]} of {shard[1]} of {len(sweep.points)}"
    preset = f", {base.preset}" if base.preset else ""
    lines = [f"{base.system}{preset}: {len(points)} points{of}; seeds: {sweep.seeds}"]
    for axis in sweep.axes:
        kind = "traced" if grid.is_traced(axis, base) else "static"
        values = ", ".join(map(grid.shown, axis.values))
        lines.append(f"  {axis.name} = {values}   ({kind})")
    if not points:
        return "\n".join([*lines, "  nothing to do"])
    data = shared.distinct(configs, shared.data_name)
    encoders = shared.distinct(configs, shared.encoder_name)
    expert = base.collect.expert_trajectories
    lines.append(f"  collect    {len(data)} × {expert} expert trajectories")
    learn = [_disentangling(config, fitting(config, system)) for config in encoders]
    programs = len({batch.Job(training, "").shape for training in learn})
    lines.append(_stage("β-VAE     ", learn, len(learn), budget, programs))
    lines.append(f"  mask       {len(points)}, in one pass a β-VAE")
    if base.methods:
        each = shared.distinct(configs, lambda config: repr((config.clone, config.methods)))
        policies = [_cloning(one, fitting(one, system)) for one in each]
        programs = {
            (row.objective, row.kind_of_data, jax.tree.structure(configured(row, one.clone)))
            for one in each
            for row in [METHODS[name] for name in one.methods]
        }
        lines.append(_stage("policies  ", policies, _most_policies(points), budget, len(programs)))
    return "\n".join(lines)


def _most_policies(points: Sequence[Point]) -> int:
    """If every mask differs, which thresholds seldom do."""
    names = set()
    for config in [point.config for point in points]:
        for method in config.methods:
            needs = METHODS[method].needs
            of = shared.encoder_name(config) if "encoder" in needs else shared.data_name(config)
            mask = repr(config.mask) if "mask" in needs else ""
            names.add((method, of, mask, repr(config.clone)))
    return len(names)


def _stage(
    name: str, trainings: Sequence[Training], models: int, budget: float, programs: int
) -> str:
    """One training stage's line, from one training of each kind."""
    bytes_ = batch.model_bytes(trainings[0])
    room = batch.room(models, bytes_, budget)
    # At most: trajectories may end early, and masks agree.
    return (
        f"  {name} at most {models} models, {programs} program{'s' * (programs > 1)}, "
        f"{room.models} at a time on {len(room.devices)} {jax.default_backend()} "
        f"device{'s' * (len(room.devices) > 1)}; {room.models * bytes_ / 1e9:.1f} GB"
    )


def _disentangling(config: Config, system: System) -> Training:
    """A β-VAE's training on as many frames as there may be, of which only shapes are made."""
    collect = config.collect
    count = collect.random_trajectories * (collect.random_steps or system.steps)

    def images() -> jax.Array:
        return jnp.zeros((count, *system.frame_shape), jnp.uint8)

    return disentangle.training(config.disentangle, images, count, images, jax.random.key(0))


def _cloning(config: Config, system: System) -> Training:
    """A plain policy's training, of which only shapes are made."""
    lengths = np.full(config.collect.expert_trajectories, system.steps)
    count = imitated(lengths, config.clone)

    def data() -> Demonstrations:
        frames = jnp.zeros((count, *system.frame_shape), jnp.uint8)
        actions = jnp.zeros((count, len(system.action_limit)))
        return Demonstrations(frames, jnp.zeros(count, jnp.int32), actions, actions)

    return clone.training(config.clone, data, count, identity, {}, jax.random.key(0))


def half_of_free_memory() -> float:
    """Bytes: of a device, or of the machine if its devices are a CPU's."""
    stats = jax.local_devices()[0].memory_stats() or {}
    if "bytes_limit" in stats:
        return 0.5 * (stats["bytes_limit"] - stats.get("bytes_in_use", 0))
    return 0.5 * free_memory()
