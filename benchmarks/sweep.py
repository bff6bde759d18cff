"""What batching buys a sweep: `python -m benchmarks.sweep`.

Clones of the laptop preset's size, differing in their seed, on frames of random states: trained as
a sweep trains them, one after another in one process, and each in a fresh process with a warm
compilation cache, as a script that starts an experiment a point would. Wall time with compilation,
start and data of each. Then the error: the largest difference of a weight between the first two
ways. Then Algorithm 1 for 1000 points of γ × H × seeds.
"""

import argparse
import dataclasses
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxdeconf import mask, systems
from jaxdeconf.commands.guard import cache_compilations
from jaxdeconf.learn import clone
from jaxdeconf.learn.fit import FitState, Training
from jaxdeconf.presets import PRESETS
from jaxdeconf.sweep import batch, plan
from jaxdeconf.threads import cores
from jaxdeconf.views import identity

BASE = PRESETS["cartpole"]["laptop"]
CARTPOLE = systems.get("cartpole")


def demonstrations() -> clone.Demonstrations:
    """As many as the preset clones."""
    count = BASE.collect.expert_trajectories * (BASE.clone.trajectory_steps or CARTPOLE.steps)
    keys = jax.random.split(jax.random.key(0), count)

    @jax.jit
    def draw(keys: jax.Array) -> jax.Array:
        def one(key: jax.Array) -> jax.Array:
            return CARTPOLE.frame(CARTPOLE.sample_initial(key), jnp.ones(1))

        return jax.lax.map(one, keys, batch_size=256)

    actions = jax.random.uniform(jax.random.key(1), (count, 1), minval=-1.0)
    return clone.Demonstrations(draw(keys), jnp.arange(count) % 40, actions)


def training(
    config: clone.CloneConfig, point: int, data: Callable[[], clone.Demonstrations]
) -> Training:
    """A point's clone: its key is its own."""
    count = BASE.collect.expert_trajectories * (BASE.clone.trajectory_steps or CARTPOLE.steps)
    return clone.training(config, data, count, identity, {}, jax.random.key(point))


def batched(config: clone.CloneConfig, points: int) -> list[FitState]:
    """As a sweep does."""
    data, found = demonstrations(), {}
    jobs = [batch.Job(training(config, point, lambda: data), "") for point in range(points)]
    for trained in batch.train_all(jobs, plan.half_of_free_memory(), lambda *_: None):
        found |= {one.job: one.state for one in trained}
    return [found[point] for point in range(points)]


def in_one_process(config: clone.CloneConfig, points: int) -> list[FitState]:
    """One after another; one compilation."""
    data, found = demonstrations(), []
    for point in range(points):
        *_, (state, _) = training(config, point, lambda: data).chunks(str(point))
        found.append(jax.block_until_ready(state))
    return found


def in_fresh_processes(config: clone.CloneConfig, points: int) -> None:
    """One after another, a process each."""
    for point in range(points):
        command = ["-m", "benchmarks.sweep", "--one", str(point), "--epochs", str(config.epochs)]
        subprocess.run([sys.executable, *command], check=True)


def timed(work: Callable[[], object]) -> tuple[float, object]:
    """Seconds, and what came of it; compiled programs of before are forgotten."""
    jax.clear_caches()
    begin = time.perf_counter()
    value = work()
    return time.perf_counter() - begin, value


def error(mine: list[FitState], other: list[FitState]) -> float:
    """The largest difference of a weight."""
    pairs = zip(jax.tree.leaves(mine), jax.tree.leaves(other), strict=True)
    return max(float(np.abs(np.asarray(a) - np.asarray(b)).max()) for a, b in pairs)


def masking(points: int) -> None:
    """Seconds of Algorithm 1 for γ × H × seeds, statistics and compilation included."""
    keys = jax.random.split(jax.random.key(0), 3)
    states, latents, actions = (
        jax.random.normal(key, (1000, size)) for key, size in zip(keys, (4, 6, 10), strict=True)
    )
    gammas = np.geomspace(1e-4, 0.3, points // 40)
    jax.clear_caches()
    begin, found = time.perf_counter(), 0
    for _ in range(4):
        masks = mask.find_mask(states, latents, actions[..., None], gammas, alpha=None)
        found += sum(len(masks.within(horizon)) for horizon in range(1, 11))
    print(f"masks of {found} points: {time.perf_counter() - begin:.2f} s")


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--points", type=int, nargs="*", default=[1, 4, 16])
    parser.add_argument("--epochs", type=float, default=BASE.clone.epochs)
    parser.add_argument("--one", type=int, help="train this point alone (a fresh process does)")
    options = parser.parse_args()
    config = dataclasses.replace(BASE.clone, epochs=options.epochs)
    cache_compilations()
    if options.one is not None:
        list(training(config, options.one, demonstrations).chunks("one"))
        return
    jax.config.update("jax_num_cpu_devices", cores())
    print(f"{jax.device_count()} {jax.devices()[0].device_kind} devices, jax {jax.__version__}")
    for points in options.points:
        together, mine = timed(partial(batched, config, points))
        alone, other = timed(partial(in_one_process, config, points))
        fresh, _ = timed(partial(in_fresh_processes, config, points))
        print(
            f"{points:3d} points, points an hour: {3600 * points / together:.0f} batched, "
            f"{3600 * points / alone:.0f} in one process ({alone / together:.2f} ×), "
            f"{3600 * points / fresh:.0f} in fresh ones ({fresh / together:.2f} ×); "
            f"largest difference {error(mine, other):.1e}",  # type: ignore
            flush=True,
        )
    masking(1000)


if __name__ == "__main__":
    main()
