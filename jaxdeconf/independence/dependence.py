"""Every column of one table against every column of another: what depends on what.

Source of q: Benjamini & Hochberg, "Controlling the false discovery rate", J. R. Stat. Soc. B 57
(1995). Shapes: N samples, S columns of x, P columns of y.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdeconf.independence.hoeffding import HOEFFDING
from jaxdeconf.independence.null import p_value
from jaxdeconf.independence.ranks import both_ranked
from jaxdeconf.independence.refined import REFINED
from jaxdeconf.independence.table import both_columns, counted
from jaxdeconf.independence.ties import of_ranks


class Dependence(NamedTuple):
    """NumPy arrays, or pandas tables if x or y is one."""

    D: Any  # [S, P] Hoeffding's D, as `hoeffding_d`
    R: Any  # [S, P] the refined R, as `refined_d`
    p: Any  # [S, P] p-value of R, which holds its level with ties, too
    q: Any  # [S, P] the least false discovery rate at which the pair counts as dependent


def dependence(x: Any, y: Any) -> Dependence:
    """Tests every column of x against every column of y.

    Args:
      x: [N] or [N, S] real numbers, N >= 5: an array, or a pandas table, whose names are kept.
      y: [N] or [N, P] real numbers, the same.
    Returns:
      [], [P], [S] or [S, P] each, 64-bit only where jax_enable_x64 is on. Of the pairs with
      q <= 0.05, on average at most one in twenty is independent.
    Raises:
      ValueError: as `hoeffding_d`.
    """
    tables = [given for given in (x, y) if hasattr(given, "iloc") and hasattr(given, "columns")]
    # Columns of several types, as of buttons and positions, come as objects unless one is named.
    values_x, values_y = (v.to_numpy(float) if any(v is t for t in tables) else v for v in (x, y))
    shape, dtype = np.shape(values_x)[1:] + np.shape(values_y)[1:], jnp.result_type(float)
    with jax.enable_x64(True):
        xs, ys = both_ranked(*map(np.asarray, both_columns(values_x, values_y)))
        found = counted(xs, ys, HOEFFDING), of_ranks(xs, ys, REFINED)[0]
    d, r = (np.asarray(part, dtype).reshape(shape) for part in found)
    p = np.asarray(p_value(r, len(values_x)))
    parts = [d, r, p, false_discovery_rate(p)]
    if tables:  # made by pandas' own class, which need not be imported for it
        names = [getattr(v, "columns", None) for v in (x, y)]
        shape = [np.atleast_2d(np.transpose(v)).shape[0] for v in (values_x, values_y)]
        parts = [type(tables[0])(part.reshape(shape), *names) for part in parts]
    return Dependence(*parts)


def false_discovery_rate(p: np.ndarray) -> np.ndarray:
    """q-values of any number of p-values, by Benjamini & Hochberg's step-up procedure."""
    order = p.ravel().argsort()[::-1]
    rank = np.arange(p.size, 0, -1)
    q = np.empty(p.size, p.dtype)
    q[order] = np.minimum.accumulate(p.ravel()[order] * (p.size / rank))
    return q.reshape(p.shape)
