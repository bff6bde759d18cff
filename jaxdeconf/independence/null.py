"""The asymptotic law of Hoeffding's D and the refined R under independence.

Source: Hoeffding (1948), section 9; Blum, Kiefer & Rosenblatt (1961), which tabulate it. With
continuous margins, W = 1.2 (N - 1) D tends to the sum over i, j >= 1 of
36 / (pi^4 i^2 j^2) (Z_ij^2 - 1), Z standard normal, and so does W of the refined R.
`null_survival.csv` is P(W > w) by numerical inversion of that law's characteristic function.
Ties push D down: the p-values then err on the safe side and lose power; see `permutation_p_value`.
"""

import math
from importlib import resources

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from jaxdeconf import checks

_TEXT = resources.files("jaxdeconf.independence").joinpath("null_survival.csv").read_text()
_TABLE = np.loadtxt(_TEXT.splitlines(), delimiter=",", skiprows=1)
_W, _LOG_SURVIVAL = _TABLE[:, 0], np.log(_TABLE[:, 1])


def _log_tail(w: Array) -> Array:
    """log P(W > w) for large w: the term of the largest eigenvalue, 36 / pi^4."""
    z = jnp.pi**4 * (w + 1.0) / 72.0
    return math.log(2.46666) - z - 0.5 * jnp.log(jnp.pi * z)


def p_value(d: ArrayLike, n: ArrayLike) -> Array:
    """P(D > d | independence), asymptotic in the number of samples.

    Args:
      d: any shape, D (or refined R) on the scale of `hoeffding_d`.
      n: number of samples, at least 5; broadcasts with `d`.
    Returns:
      `d`'s shape, in [0, 1]. Continuous margins assumed; within 1e-5 of the asymptotic law.
    """
    if not isinstance(n, Tracer) and not np.all(np.asarray(n) >= 5):
        raise ValueError(f"n: expected at least 5 samples, got {n}")
    if not jnp.issubdtype(jnp.result_type(d), np.floating):
        raise ValueError(f"d: expected floats, got {jnp.result_type(d)}")
    w = 1.2 * (jnp.asarray(n) - 1) * jnp.asarray(d)
    body = jnp.interp(w, jnp.asarray(_W), jnp.asarray(_LOG_SURVIVAL), left=0.0)
    tail = _log_tail(jnp.maximum(w, _W[-1]))
    return jnp.exp(jnp.where(w > _W[-1], tail, body))


def threshold(n: int, tests: int = 1, alpha: float = 0.05) -> float:
    """The D that independent pairs exceed with family-wise probability at most `alpha`.

    Bonferroni: each of the `tests` tests is held to alpha / tests, so it needs no assumption
    on how the tests depend on each other.

    Args:
      n: number of samples, at least 5.
      tests: number of tests in the family, at least 1.
      alpha: family-wise error rate, in (0, 1).
    Returns:
      The threshold on the scale of `hoeffding_d`; `p_value(threshold, n) == alpha / tests`.
    """
    checks.integer("n", n, least=5)
    checks.integer("tests", tests)
    checks.number("alpha", alpha, "a probability in (0, 1)", 0.0, 1.0)
    target = math.log(alpha / tests)
    if target >= _LOG_SURVIVAL[-1]:
        w = float(np.interp(-target, -_LOG_SURVIVAL, _W))
    else:
        w = _invert_tail(target)
    return w / (1.2 * (n - 1))


def _invert_tail(target: float) -> float:
    z = -target
    for _ in range(50):  # z = log(2.46666) - target - log(pi z) / 2: a contraction for z > 1
        z = math.log(2.46666) - target - 0.5 * math.log(math.pi * z)
    return 72.0 * z / math.pi**4 - 1.0
