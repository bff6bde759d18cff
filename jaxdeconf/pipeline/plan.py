"""What a sweep is going to do, before it starts: programs, models, memory and time, about."""

import os
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxdeconf import systems
from jaxdeconf.learn import clone, disentangle
from jaxdeconf.learn.fit import FitConfig, FitState, Objective
from jaxdeconf.pipeline import batch, grid, sweep, sweep_stages
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.grid import Axis, Point
from jaxdeconf.pipeline.sweep_log import Sweep

# Of a matrix product's rate, what a training step of the laptop presets reaches on a CPU.
_SHARE_OF_ROOF = 0.4


def describe(asked: Sweep, shard: tuple[int, int], budget: float) -> str:
    """The plan in a few lines; `budget` as in `sweep.sweep`."""
    base, mine = asked.base, sweep.part(asked.points, shard)
    configs = [point.config for point in mine]
    of = "" if shard == (1, 1) else f", part {shard[0]} of {shard[1]} of {len(asked.points)}"
    axes = [_axis(axis, base) for axis in asked.axes]
    lines = [f"{base.system}, {base.preset}: {len(mine)} points{of}; seeds: {asked.seeds}", *axes]
    data = len(sweep_stages.distinct(configs, sweep_stages.data_name))
    encoders = sweep_stages.distinct(configs, sweep_stages.encoder_name)
    lines.append(f"  collect    {data} × {base.collect.expert_trajectories} expert trajectories")
    frames = base.collect.random_trajectories * (base.collect.random_steps or _steps(base))
    lines.append(_stage(asked, mine, "vae", len(encoders), frames, budget))
    lines.append(f"  mask       {len(mine)}, in one pass a β-VAE")
    if asked.policies:
        frames = base.collect.expert_trajectories * (base.bc.trajectory_steps or _steps(base))
        most = _most_policies(asked, mine)
        lines.append(_stage(asked, mine, "bc", most, frames, budget))
    return "\n".join(lines)


def _axis(axis: Axis, base: Config) -> str:
    kind = "traced" if grid.is_traced(axis, base) else "static"
    return f"  {axis.name} = {', '.join(map(grid.shown, axis.values))}   ({kind})"


def _steps(base: Config) -> int:
    return systems.get(base.system).steps


def _most_policies(asked: Sweep, mine: Sequence[Point]) -> int:
    """If every mask differs, which thresholds seldom do."""
    own = {(sweep_stages.data_name(p.config), repr(p.config.bc)) for p in mine}
    masked = {
        (sweep_stages.encoder_name(p.config), repr(p.config.bc), repr(p.config.mask)) for p in mine
    }
    count = {"Masked": len(masked), "BcVanilla": len(own), "BcManual": len(own)}
    count["Reconstructed"] = len({(e, b) for e, b, _ in masked})
    return sum(count[policy] for policy in asked.policies)


def _stage(
    asked: Sweep, mine: Sequence[Point], stage: str, models: int, frames: int, budget: float
) -> str:
    """One training stage's line."""
    base = asked.base
    config: FitConfig = getattr(base, stage)
    static = [axis for axis in asked.axes if not grid.is_traced(axis, base)]
    programs = len(
        {tuple(p.values[a.name] for a in static if a.name.startswith(stage)) for p in mine}
    )
    objective, job = _job(base, stage, frames)
    bytes_ = batch.model_bytes(objective, config, job)
    room = batch.room(models, bytes_, budget)
    seconds = models * config.steps(frames) * _flops(objective, config, job) / _flops_a_second()
    name = {"vae": "β-VAE     ", "bc": "policies  "}[stage]
    # Trajectories may end early, and masks agree.
    return (
        f"  {name} at most {models} models, {programs} program{'s' * (programs > 1)}, "
        f"{room.models} at a time on {len(room.devices)} {jax.default_backend()} "
        f"device{'s' * (len(room.devices) > 1)}; {room.models * bytes_ / 1e9:.1f} GB, "
        f"at most about {_time(seconds)}"
    )


def _job(base: Config, stage: str, frames: int) -> tuple[Objective, batch.Job]:
    """A model and data of a stage; only shapes are ever made of them."""
    system, key = systems.get(base.system), jax.random.key(0)
    side, actions = base.vae.network.image_size, len(system.action_limit)

    def images() -> jax.Array:
        return jnp.zeros((frames, side, side, 3), jnp.uint8)

    def demonstrations() -> Any:
        first, action = jnp.zeros(frames, bool), jnp.zeros((frames, actions))
        return clone.Demonstrations(images(), first, action)

    def first_policy(_: clone.Demonstrations) -> FitState:
        return clone.initial_state(base.bc, (side, side, 3), actions, key)

    def first_vae(images: jax.Array) -> FitState:
        return disentangle.initial_state(base.vae, images, key)

    if stage == "vae":
        return disentangle.objective, batch.Job(first_vae, {}, key, "", images)
    return clone.objective, batch.Job(first_policy, {}, key, "", demonstrations)


def _flops(objective: Objective, config: FitConfig, job: batch.Job) -> float:
    """Of a training step."""
    state, data = batch.shapes(job)

    def gradient(variables: Any, data: Any) -> Any:
        return jax.grad(batch.step_loss(objective, config, variables, data))(variables["params"])

    analysis = jax.jit(gradient).lower(state.variables, data).cost_analysis()
    return float(analysis["flops"]) if analysis else 0.0


def _flops_a_second() -> float:
    """What training makes of this device, from the time of a matrix product."""
    square = jnp.ones((1024, 1024))
    product = jax.jit(jnp.matmul)
    times = []
    for _ in range(30):
        begin = time.perf_counter()
        product(square, square).block_until_ready()
        times.append(time.perf_counter() - begin)
    devices = 1 if jax.default_backend() == "cpu" else jax.device_count()
    return devices * _SHARE_OF_ROOF * 2.0 * 1024**3 / min(times)


def _time(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"


def half_of_free_memory() -> float:
    """Bytes: of a device, or of the machine if its devices are a CPU's."""
    stats = jax.local_devices()[0].memory_stats() or {}
    if "bytes_limit" in stats:
        return 0.5 * (stats["bytes_limit"] - stats.get("bytes_in_use", 0))
    return 0.5 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES")
