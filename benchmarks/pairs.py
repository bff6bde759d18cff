"""What testing two states together costs, sees and gets wrong: `python -m benchmarks.pairs`.

First the time of all pairs of 10 states with 12 columns. Then the share of data sets rejected at
1 % by `interaction_r`, which tests what two columns tell of a third beyond what each tells alone,
and by two joint tests of both columns: distance correlation (of their ranks in the plane, by its
chi-square law) and Blum, Kiefer & Rosenblatt's statistic (by a gamma law of its moments). Then the
family-wise error of Algorithm 1 with pairs, asked to be at most 5 %. Then the masks of Reacher with
its arm and target from half a circle and from the whole, of what their coordinates would show and
of a nuisance. Shapes: B data sets in a batch, N samples.
"""

import argparse
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks.levels import COLUMNS
from jaxdeconf.expert import plan
from jaxdeconf.independence import p_value
from jaxdeconf.independence.interaction import interaction_r
from jaxdeconf.mask import find_mask
from jaxdeconf.presets.reacher import EXPERT, PRESETS
from jaxdeconf.systems import System
from jaxdeconf.systems.reacher import REACHER, elbow_and_end

BATCH = 250
TURN = 2 * np.pi
# The third column, of two that are uniform on (0, 1), u and v, and of normal noise.
KINDS: dict[str, Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]] = {
    "nothing": lambda u, v, noise: noise,
    "sine of an angle between": lambda u, v, noise: np.sin(TURN * (u - v)) + noise,
    "and of u, too": lambda u, v, noise: np.sin(TURN * (u - v)) + 2 * u + noise,
    "sine of twice the angle": lambda u, v, noise: np.sin(2 * TURN * (u - v)) + noise,
    "product": lambda u, v, noise: 8 * (u - 0.5) * (v - 0.5) + noise,
    "exclusive or": lambda u, v, noise: np.sign((u - 0.5) * (v - 0.5)) / 2 + noise,
    "variance": lambda u, v, noise: noise * np.exp(0.7 * np.sign((u - 0.5) * (v - 0.5))),
    "saturated sine": lambda u, v, noise: np.clip(2 * np.sin(TURN * (u - v)) + 2 * noise, -1, 1),
    "button in a fifth": lambda u, v, noise: np.sin(TURN * (u - v)) + noise > 1,
    "u alone": lambda u, v, noise: np.sin(3 * u) + noise / 4,
    "variance by u alone": lambda u, v, noise: noise * np.exp(3 * u),
}

# Three states, an observation and an action each.
FAMILIES = (
    ("normal",) * 5,
    ("three levels", "saturated", "one in a fifth", "three levels", "saturated"),
    ("normal", "saturated", "rare (3 %)", "normal", "three levels"),
)


def _ranks(v: Array) -> Array:
    return (v[:, None] > v).mean(axis=1) + (v[:, None] == v).mean(axis=1) / 2


def _distance_correlation(x: Array, z: Array) -> Array:
    n = len(z)

    def centred(a: Array) -> Array:
        row, whole = a.sum(axis=1) / (n - 2), a.sum() / ((n - 1) * (n - 2))
        return jnp.where(jnp.eye(n, dtype=bool), 0, a - row[:, None] - row[None, :] + whole)

    apart = [jnp.abs(u[:, None] - u) for u in (*map(_ranks, x.T), _ranks(z))]
    a, b = centred(jnp.hypot(*apart[:2])), centred(apart[2])
    correlation = (a * b).sum() / jnp.sqrt((a**2).sum() * (b**2).sum())
    return jax.scipy.stats.chi2.sf(n * correlation + 1, 1)


def _joint_distribution(x: Array, z: Array) -> Array:
    n = len(z)
    below_x, below_z = (x[:, None] <= x).all(axis=2), z[:, None] <= z
    f, g = (v.T - v.mean(axis=0)[:, None] for v in (below_x * 1.0, below_z * 1.0))
    t = ((f @ g.T / n) ** 2).mean() * n
    own = [v.T @ v / n for v in (f, g)]
    mean = jnp.trace(own[0]) * jnp.trace(own[1]) / n**2
    variance = 2 * (own[0] ** 2).mean() * (own[1] ** 2).mean()
    return jax.scipy.special.gammaincc(mean**2 / variance, t * mean / variance)


TESTS: dict[str, Callable[[Array, Array], Array]] = {
    "interaction": lambda x, z: p_value(interaction_r(x, z[:, None])[0, 0], len(z)),
    "joint distance correlation": _distance_correlation,
    "joint distribution": _joint_distribution,
}


@jax.jit
def _p_values(x: Array, z: Array) -> list[Array]:
    return [jax.lax.map(lambda of, t=test: t(*of), (x, z)) for test in TESTS.values()]


def rejected(kind: str, count: int, n: int, seed: int) -> list[float]:
    """The share of data sets with p <= 0.01, for each test."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(count // BATCH):
        x, noise = rng.random((BATCH, n, 2)), rng.normal(size=(BATCH, n))
        z = KINDS[kind](x[..., 0], x[..., 1], noise)
        found.append(_p_values(x.astype(np.float32), z.astype(np.float32)))
    return np.mean(np.concatenate(found, axis=1) <= 0.01, axis=1).tolist()


def family_wise_error(names: tuple[str, ...], count: int, n: int, seed: int) -> float:
    """The share of data sets with any test above the threshold, three states among five columns."""
    rng, wrong = np.random.default_rng(seed), 0
    find = jax.jit(partial(find_mask, states_together=2))
    for _ in range(count):
        columns = np.array([COLUMNS[name](rng, n) for name in names], np.float32).T
        found = find(columns[:, :3], columns[:, 3:4], columns[:, 4:, None])
        largest = max(found.state_observation.max(), found.state_action.max())
        wrong += bool(largest > found.threshold)
    return wrong / count


def whole_circle(key: Array) -> Array:
    """[6] an initial state of Reacher, target and upper link each turned by any angle."""
    first, second = jax.random.split(key)
    x, y, theta, *others = REACHER.sample_initial(first)
    turn, other = jax.random.uniform(second, (2,), maxval=TURN)
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    return jnp.stack([cos * x - sin * y, sin * x + cos * y, (theta + other) % TURN, *others])


class Starts(NamedTuple):
    """Of Reacher, N initial states and what belongs to them."""

    states: Array  # [N, 6]
    shown: Array  # [N, 8] places in a frame, and a nuisance
    actions: Array  # [N, 1, 2] the expert's first


NAMES = [f"{of} {i}" for of in ("target", "elbow", "end", "nuisance") for i in (1, 2)]


def starts(system: System, n: int, seed: int) -> Starts:
    """The places of target, elbow and end, turned by an angle as latents may be; its torques."""
    state_key, nuisance_key = jax.random.split(jax.random.key(seed))
    states = jax.vmap(system.sample_initial)(jax.random.split(state_key, n))
    nuisance = jax.random.uniform(nuisance_key, (n, 2), minval=-1.0)
    places = [states[:, :2], *jax.vmap(elbow_and_end)(states), nuisance]
    turn = jnp.array([[0.8, -0.6], [0.6, 0.8]])
    actions = plan(system, states, EXPERT).actions[:, :1] / system.limits
    return Starts(states, jnp.concatenate([v @ turn for v in places], axis=1), actions)


def masked(given: Sequence[Starts], threshold: float, together: int) -> str:
    """How many of the data sets mask what is shown."""
    masks = [find_mask(*one, threshold, states_together=together).mask for one in given]
    counts = np.sum(masks, axis=0).tolist()
    return ", ".join(f"{name} {count}" for name, count in zip(NAMES, counts, strict=True))


def main() -> None:
    """Prints a line a measurement."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000, help="data sets of a family")
    parser.add_argument("--samples", type=int, default=150)
    parser.add_argument("--seeds", type=int, default=5, help="data sets of Reacher")
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    x, y = rng.random((2000, 10)), rng.random((2000, 12))
    for what in ("with compilation", "again"):
        begin = time.perf_counter()
        jax.block_until_ready(interaction_r(x, y))
        print(f"45 pairs x 12, N = 2000: {time.perf_counter() - begin:.2f} s {what}")
    circle, gamma = replace(REACHER, sample_initial=whole_circle), PRESETS["laptop"].mask.threshold
    for name, system in {"half circle": REACHER, "whole circle": circle}.items():
        given = [starts(system, 1000, 100 + seed) for seed in range(options.seeds)]
        for together, threshold in itertools.product((1, 2), (1e-3, gamma)):
            shares = masked(given, threshold, together)
            print(f"{name}, {together} together, gamma {threshold:g}: {shares}", flush=True)
    print("| third column | " + " | ".join(TESTS) + " |", flush=True)
    for seed, kind in enumerate(KINDS):
        shares = rejected(kind, options.count // 5, options.samples, seed)
        print(f"| {kind} | " + " | ".join(f"{share:.3f}" for share in shares) + " |", flush=True)
    for seed, names in enumerate(FAMILIES):
        error = family_wise_error(names, options.count, 400, seed)
        print(f"family-wise error of {', '.join(names)}: {error:.4f}", flush=True)


if __name__ == "__main__":
    main()
