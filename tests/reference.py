"""Slow, obvious NumPy twins of what the package computes fast."""

from fractions import Fraction
from itertools import permutations

import numpy as np


def quintuple_d(x: np.ndarray, y: np.ndarray) -> float:
    """30 D_n without ties, as Hoeffding (1948) defines it: a mean over all quintuples."""

    def psi(a: float, b: float, c: float) -> int:
        return int(a >= b) - int(a >= c)

    def kernel(v: np.ndarray, i: tuple[int, ...]) -> int:
        a, b, c, d, e = (v[j] for j in i)
        return psi(a, b, c) * psi(a, d, e)

    terms = [kernel(x, i) * kernel(y, i) / 4 for i in permutations(range(len(x)), 5)]
    return 30 * float(np.mean(terms))


def quintuple_r(x: np.ndarray, y: np.ndarray) -> float:
    """30 R_n without ties: (F - G H)^2 over dG dH, each point used once (Blum et al. 1961)."""
    tuples = list(permutations(range(len(x)), 5))
    joint = [
        x[k] < x[i] and y[k] < y[j] and x[m] < x[i] and y[m] < y[j] for i, j, k, m, _ in tuples
    ]
    cross = [
        x[k] < x[i] and y[k] < y[j] and x[m] < x[i] and y[o] < y[j] for i, j, k, m, o in tuples
    ]
    return 30 * float(np.mean(joint) - 2 * np.mean(cross) + 1 / 9)


def below(x: np.ndarray) -> np.ndarray:
    """[N, N]: 1 where sample j (column) is below sample i, 1/2 where tied with it, else 0."""
    less = (x[None, :] < x[:, None]) + 0.5 * (x[None, :] == x[:, None])
    return less - 0.5 * np.eye(len(x))


def midrank_d(x: np.ndarray, y: np.ndarray) -> float:
    """30 D_n with midranks (Hollander, Wolfe & Chicken 2014, eq. 8.92), in rational arithmetic."""
    n, in_x, in_y = len(x), below(x), below(y)
    r, s, q = (1 + v.sum(axis=1) for v in (in_x, in_y, in_x * in_y))
    d1 = d2 = d3 = Fraction(0)
    for ri, si, qi in zip(*(map(Fraction, v.tolist()) for v in (r, s, q)), strict=True):
        d1 += (qi - 1) * (qi - 2)
        d2 += (ri - 1) * (ri - 2) * (si - 1) * (si - 2)
        d3 += (ri - 2) * (si - 2) * (qi - 1)
    total = (n - 2) * (n - 3) * d1 + d2 - 2 * (n - 2) * d3
    return float(30 * total / (n * (n - 1) * (n - 2) * (n - 3) * (n - 4)))


def rank_distance_covariance(x: np.ndarray, y: np.ndarray) -> float:
    """30/4 of the squared distance covariance of the midranks over N, to which 30 R_n tends."""
    n = len(x)
    rank_x, rank_y = below(x).sum(axis=1) / n, below(y).sum(axis=1) / n
    a, b = (np.abs(v[:, None] - v[None, :]) for v in (rank_x, rank_y))
    square = (a * b).mean() + a.mean() * b.mean() - 2 * (a.mean(axis=1) * b.mean(axis=1)).mean()
    return float(30 / 4 * square)


def interaction(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[float, np.ndarray]:
    """N - 1 times the interaction of x and y with z, and the weights of chi-squares of its law."""

    def cosines(v: np.ndarray, count: int) -> list[np.ndarray]:
        u = (below(v).sum(axis=1) + 0.5) / len(v)
        return [np.sqrt(2 / i) * np.cos(np.pi * i * u) for i in range(1, count + 1)]

    alone = np.column_stack([np.ones(len(x)), *cosines(x, 8), *cosines(y, 8)])
    left = []
    for of_x in cosines(x, 4):
        for of_y in cosines(y, 4):
            told = alone @ np.linalg.lstsq(alone, of_x * of_y, rcond=1e-7)[0]
            left.append(of_x * of_y - told)
    of_z = [f - f.mean() for f in cosines(z, 4)]
    t = sum(np.mean(g * f) ** 2 for g in left for f in of_z)
    first, second = (np.linalg.eigvalsh(np.cov(v, bias=True)) for v in (left, of_z))
    return (len(x) - 1) * float(t), np.outer(first, second).ravel().clip(0)


def mask_by_loops(
    states: np.ndarray, observations: np.ndarray, actions: np.ndarray, threshold: float
) -> np.ndarray:
    """Algorithm 1 of the paper as it is printed: procedures Mask and Check."""

    def check(o: int, t: int, a: int) -> bool:
        for s in range(states.shape[1]):
            state = states[:, s]
            first = midrank_d(state, observations[:, o]) > threshold
            second = midrank_d(state, actions[:, t, a]) > threshold
            if first and second:
                return True
        return False

    _, horizon, controls = actions.shape
    return np.array(
        [
            all(not check(o, t, a) for a in range(controls) for t in range(horizon))
            for o in range(observations.shape[1])
        ]
    )
