"""How often tests of independence are wrong, and how often they see: `python -m benchmarks.levels`.

For eight kinds of data, the share of data sets that each test rejects at 5 %: its level, where the
columns are drawn independently, and its power. The peers are distance correlation, with the
chi-square test of Shen, Panda & Vogelstein (J. Comput. Graph. Stat. 31, 2022), and Chatterjee's xi
(J. Am. Stat. Assoc. 116, 2021), with its asymptotic variance under ties. `--out PATH` draws the
powers. Then the family-wise error of Algorithm 1's tests, asked to be at most 5 %, on data in which
nothing depends on anything. Shapes: B data sets in a batch, N samples.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf.independence import hoeffding_d, p_value, refined_d
from jaxdeconf.mask import find_mask

BATCH = 250
Draw = Callable[[np.random.Generator, tuple[int, int]], tuple[np.ndarray, np.ndarray]]


def _linear(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    x = rng.normal(size=shape)
    return x, 0.2 * x + rng.normal(size=shape)


def _parabola(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    x = rng.normal(size=shape)
    return x, 0.3 * x**2 + rng.normal(size=shape)


def _circle(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    angle, noise = rng.uniform(0, 2 * np.pi, shape), rng.normal(size=(2, *shape))
    return np.cos(angle) + 0.2 * noise[0], np.sin(angle) + 0.2 * noise[1]


def _binary(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    x, kept = rng.random(shape) < 0.5, rng.random(shape) < 0.2
    return x, np.where(kept, x, rng.random(shape) < 0.5)


def _rare(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    x = rng.random(shape) < 0.03
    return x, np.where(x, rng.random(shape) < 0.4, rng.random(shape) < 0.03)


def _rare_cause(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    x = rng.random(shape) < 0.03
    return x, 1.0 * x + rng.normal(size=shape)


def _levels(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    x = rng.integers(0, 3, size=shape)
    return x, np.where(rng.random(shape) < 0.2, 2 * (x == 1), rng.integers(0, 3, size=shape))


def _saturated(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    x, y = _linear(rng, shape)
    return np.clip(x, -0.5, 0.5), np.clip(y, -0.5, 0.5)


KINDS: dict[str, Draw] = {
    "normal, correlation 0.2": _linear,
    "parabola in noise": _parabola,
    "circle in noise": _circle,
    "binary, correlation 0.2": _binary,
    "rare and rare (3 %)": _rare,
    "rare and normal": _rare_cause,
    "three levels, not monotone": _levels,
    "saturated in three of five": _saturated,
}


def _distance_correlation(x: Array, y: Array) -> Array:
    """p-value by the chi-square law of N times the bias-corrected distance correlation."""
    n = len(x)

    def centred(v: Array) -> Array:
        a = jnp.abs(v[:, None] - v[None, :])
        row, whole = a.sum(axis=1) / (n - 2), a.sum() / ((n - 1) * (n - 2))
        return jnp.where(jnp.eye(n, dtype=bool), 0, a - row[:, None] - row[None, :] + whole)

    a, b = centred(x), centred(y)
    correlation = (a * b).sum() / jnp.sqrt((a**2).sum() * (b**2).sum())
    return jax.scipy.stats.chi2.sf(n * correlation + 1, 1)


def _chatterjee(x: Array, y: Array) -> Array:
    """One-sided p-value of xi of y on x, whose ties the samples' random order breaks."""
    n = len(x)
    at_most = (y[None, :] <= y[:, None]).sum(axis=1) / n
    at_least = (y[None, :] >= y[:, None]).sum(axis=1) / n
    in_order = at_most[jnp.argsort(x)]
    scale = (at_least * (1 - at_least)).mean()
    xi = 1 - jnp.abs(jnp.diff(in_order)).sum() / (2 * n * scale)
    # Its theorem 2.2 and the estimate of tau^2 that follows it.
    u = jnp.sort(at_most)
    i = jnp.arange(1, n + 1)
    v = jnp.cumsum(u)
    a = ((2 * n - 2 * i + 1) * u**2).sum() / n**2
    b = ((v + (n - i) * u) ** 2).sum() / n**3
    c = ((2 * n - 2 * i + 1) * u).sum() / n**2
    return jax.scipy.stats.norm.sf(jnp.sqrt(n / (a - 2 * b + c**2)) * scale * xi)


TESTS: dict[str, Callable[[Array, Array], Array]] = {
    "D": lambda x, y: p_value(hoeffding_d(x, y), len(x)),
    "R": lambda x, y: p_value(refined_d(x, y), len(x)),
    "distance correlation": _distance_correlation,
    "Chatterjee's ξ": _chatterjee,
}


@jax.jit
def _p_values(x: Array, y: Array) -> list[Array]:
    return [jax.lax.map(lambda pair, t=test: t(*pair), (x, y)) for test in TESTS.values()]


def rejected(draw: Draw, independent: bool, count: int, n: int, seed: int) -> list[float]:
    """The share of data sets with p <= 0.05, for each test."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count // BATCH):
        x, y = draw(rng, (BATCH, n))
        if independent:
            y = draw(rng, (BATCH, n))[1]
        found.append(_p_values(x.astype(np.float32), y.astype(np.float32)))
    return np.mean(np.concatenate(found, axis=1) <= 0.05, axis=1).tolist()


COLUMNS: dict[str, Callable[[np.random.Generator, int], np.ndarray]] = {
    "rare (3 %)": lambda rng, n: rng.random(n) < 0.03,
    "one in a fifth": lambda rng, n: rng.random(n) < 0.2,
    "normal": lambda rng, n: rng.normal(size=n),
    "three levels": lambda rng, n: rng.integers(0, 3, n),
    "saturated": lambda rng, n: np.clip(rng.normal(size=n), -0.7, 0.7),
}
# Two states, two observations and an action each.
FAMILIES = (
    ("rare (3 %)",) * 5,
    ("one in a fifth",) * 5,
    ("rare (3 %)", "normal", "rare (3 %)", "three levels", "saturated"),
)


def family_wise_error(names: tuple[str, ...], count: int, n: int, seed: int) -> float:
    """The share of data sets with any pair above `find_mask`'s threshold, nothing dependent."""
    rng, find, wrong = np.random.default_rng(seed), jax.jit(find_mask), 0
    for _ in range(count):
        columns = np.array([COLUMNS[name](rng, n) for name in names], np.float32).T
        found = find(columns[:, :2], columns[:, 2:4], columns[:, 4:, None])
        largest = max(found.state_observation.max(), found.state_action.max())
        wrong += bool(largest > found.threshold)
    return wrong / count


def draw_powers(rows: dict[str, list[float]], path: Path) -> None:
    """Horizontal bars of each test's power, a group a kind."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 5), layout="constrained")
    place = np.arange(len(rows))
    for i, (test, powers) in enumerate(zip(TESTS, zip(*rows.values(), strict=True), strict=True)):
        axes.barh(place + 0.2 * (i - 1.5), powers, 0.18, label=test)
    axes.set_yticks(place, list(rows))
    axes.invert_yaxis()
    axes.set(xlim=(0, 1), xlabel="dependent data sets seen at 5 %")
    figure.legend(frameon=False, loc="outside lower center", ncols=len(TESTS))
    figure.savefig(path, dpi=100)


def main() -> None:
    """A row a kind: level and power of each test."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000, help="data sets of a kind")
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--out", type=Path, help="a PNG of the powers")
    arguments = parser.parse_args()
    print("| data | " + " | ".join(f"{test}: level | power" for test in TESTS) + " |")
    powers = {}
    for seed, (kind, draw) in enumerate(KINDS.items()):
        shares = [
            rejected(draw, independent, arguments.count, arguments.samples, 2 * seed + independent)
            for independent in (True, False)
        ]
        powers[kind] = shares[1]
        cells = (f"{level:.3f} | {power:.2f}" for level, power in zip(*shares, strict=True))
        print(f"| {kind} | " + " | ".join(cells) + " |", flush=True)
    for seed, names in enumerate(FAMILIES):
        error = family_wise_error(names, arguments.count, 2 * arguments.samples, seed)
        print(f"family-wise error of {', '.join(names)}: {error:.4f}", flush=True)
    if arguments.out:
        draw_powers(powers, arguments.out)


if __name__ == "__main__":
    main()
