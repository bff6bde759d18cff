"""The asymptotic law of Hoeffding's D and the refined R under independence.

Source: Hoeffding (1948), section 9; Blum, Kiefer & Rosenblatt (1961), which tabulate it. With
continuous margins, W = 1.2 (N - 1) D tends to the sum over i, j >= 1 of
36 / (pi^4 i^2 j^2) (Z_ij^2 - 1), Z standard normal, and so does W of the refined R.
`null_survival.csv` is P(W > w) by numerical inversion of that law's characteristic function.
With ties, D lies below this law: its p-values err on the safe side and lose all power. R has it
with any margins, by its scale (see `ties`).
"""

import math
from importlib import resources
from types import ModuleType
from typing import Any

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

    It holds its level for R of any columns, tied ones too. For D of tied columns it is safe but
    sees next to nothing: take R's, or `permutation_p_value`.

    Args:
      d: any shape, D (or refined R) on the scale of `hoeffding_d`.
      n: number of samples, at least 5; broadcasts with `d`.
    Returns:
      `d`'s shape, in [0, 1]; within 1e-5 of the asymptotic law.
    """
    if not isinstance(n, Tracer) and not np.all(np.asarray(n) >= 5):
        raise ValueError(f"n: expected at least 5 samples, got {n}")
    values = checks.plain("d", d)
    if not jnp.issubdtype(values.dtype, np.floating):
        raise ValueError(f"d: expected floats, got {values.dtype}")
    w = 1.2 * (jnp.asarray(n, float) - 1) * jnp.asarray(values)
    body = jnp.interp(w, jnp.asarray(_W), jnp.asarray(_LOG_SURVIVAL), left=0.0)
    tail = _log_tail(jnp.maximum(w, _W[-1]))
    return jnp.exp(jnp.where(w > _W[-1], tail, body))


def threshold(n: int, tests: int = 1, alpha: float = 0.05) -> float:
    """The D that independent pairs exceed with family-wise probability at most `alpha`.

    Bonferroni: each of the `tests` tests is held to alpha / tests, so it needs no assumption
    on how the tests depend on each other. As for `p_value`, it is right for R of any columns.

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
    return float(quantile(math.log(alpha / tests), np) / (1.2 * (n - 1)))


def quantile(log_p: Any, xp: ModuleType = jnp) -> Any:
    """The W with P(W > w) = exp(log_p), by `xp`, NumPy or jax.numpy."""
    log_p = xp.asarray(log_p, float)
    w, log_survival = (xp.asarray(column, log_p.dtype) for column in (_W, _LOG_SURVIVAL))
    z = deep = xp.maximum(-log_p, -log_survival[-1])  # beyond the table
    for _ in range(15):  # z = log(2.46666) - log_p - log(pi z) / 2: a contraction for z > 1
        z = math.log(2.46666) + deep - 0.5 * xp.log(math.pi * z)
    body = xp.interp(-log_p, -log_survival, w)
    return xp.where(log_p >= log_survival[-1], body, 72.0 * z / math.pi**4 - 1.0)
