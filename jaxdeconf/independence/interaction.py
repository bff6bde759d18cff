"""What two columns tell of a third only together: the interaction term of the refined R.

With f_i = sqrt(2 / i) cos pi i U, i = 1 to 4, of the midranks U of a column in (0, 1), and g_ij the
product f_i(U) f_j(V) of two columns' less its regression on what either column tells alone,

    T = sum over i, j, k of Cov(g_ij, f_k)^2

of the f_k of the third. Products of cosines of U and V are cosines of U alone where U = V, of twice
the order: so regressions go up to the 8th, and two equal columns tell nothing together. For
independent columns and weights 1 / i^2, T is the term of all three in the decomposition of Blum,
Kiefer & Rosenblatt's statistic; 1 / i sees more of angles (docs/pairs.md).

Where the third column depends on neither, (N - 1) T tends to the sum of lambda_a mu_b Z_ab^2,
Z standard normal, lambda and mu the eigenvalues of the covariances of g and of f_k, whatever ties
there are; its mean is exact for any N. The result is the R of two continuous columns with the same
p-value, as in `ties`: one table of p-values and one threshold serve all tests.
Sources: Deheuvels, J. Multivar. Anal. 11 (1981); Genest & Rémillard, Test 13 (2004). Shapes: S
columns of x, P of y, I their harmonics, N samples.
"""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxdeconf.independence.eigen import eigenvalues
from jaxdeconf.independence.null import quantile
from jaxdeconf.independence.ranks import Ranks, rank_on_device
from jaxdeconf.independence.table import both_columns
from jaxdeconf.independence.ties import FEW, log_survival

HARMONICS = 4  # two turns of an angle that is uniform on the circle
_ROUNDING = 1e-10  # of an eigenvalue of cosines' covariances, which are of the order of 1


def pairs_of(count: int) -> np.ndarray:
    """[count (count - 1) / 2, 2] every two of so many columns, in the order (0, 1), (0, 2), ..."""
    return np.array(list(combinations(range(count), 2)), np.int32).reshape(-1, 2)


def interaction_r(x: ArrayLike, y: ArrayLike) -> Array:
    """R of what two columns of x tell of a column of y together, beyond what each tells alone.

    It is on the scale of `refined_d`: `p_value` and `threshold` hold for it where the column of y
    depends on neither. Where rare values leave fewer than ten coincidences of all three to be
    expected, nothing is told, and p is 1.

    Args:
      x: [N, S] real numbers, N >= 5.
      y: [N, P] real numbers.
    Returns:
      [S (S - 1) / 2, P], pairs of columns of x in the order of `pairs_of`; types and errors as
      `hoeffding_d`.
    """
    xs, ys = both_columns(x, y)
    dtype, pairs = jnp.result_type(float), pairs_of(len(xs))
    if not len(pairs):
        return jnp.zeros((0, len(ys)))
    with jax.enable_x64(True):
        found = _scaled(jnp.asarray(xs), jnp.asarray(ys), jnp.asarray(pairs))
        return jax.lax.convert_element_type(found, dtype)


def strongest(alone: ArrayLike, together: ArrayLike) -> Array:
    """[S, P] the largest statistic of a column's tests: alone [S, P], and `together` with others.

    Args:
      alone: [S, P].
      together: [S (S - 1) / 2, P], as of `interaction_r`.
    """
    found, together = jnp.asarray(alone), jnp.asarray(together)
    first, second = pairs_of(len(found)).T
    return found.at[first].max(together).at[second].max(together)


@jax.jit
def _scaled(x: Array, y: Array, pairs: Array) -> Array:
    """[pairs, P] R on its scale."""
    (_, n), count = x.shape, len(y)
    (of_x, events_x), (of_y, events_y) = (_features(rank_on_device(v)[0]) for v in (x, y))
    told = of_y[:, :HARMONICS]  # [P, I, N]
    mu = _eigenvalues(told @ told.swapaxes(1, 2) / n)

    def pair(which: Array) -> Array:
        alone, events = of_x[which], events_x[which]
        first, second = alone[:, :HARMONICS]
        together = (first[:, None] * second).reshape(-1, n)
        together = together - together.mean(axis=1, keepdims=True)
        alone = alone.reshape(-1, n)
        inverse = jnp.linalg.pinv(alone @ alone.T, rtol=_ROUNDING, hermitian=True)
        left = together - (together @ alone.T) @ inverse @ alone
        weights = _eigenvalues(left @ left.T / n)[:, None] * mu[:, None, :]
        covariance = (left @ told.reshape(-1, n).T / n).reshape(-1, count, HARMONICS)
        t = (n - 1) * (covariance**2).sum(axis=(0, 2))
        log_p = jax.vmap(_log_survival)(t, weights.reshape(count, -1))
        return jnp.where(events.prod() * events_y < FEW * (n - 1) ** 2, 0.0, log_p)

    return quantile(jax.lax.map(pair, pairs)) / (1.2 * (n - 1))


def _log_survival(q: Array, weights: Array) -> Array:
    """As `log_survival`, which is for the upper tail; below the mean, where p is above 0.3, by
    Wilson & Hilferty's cube root of a chi-square of the same mean and variance."""
    mean, spread = weights.sum(), 2 / 9 * (weights**2).sum() / weights.sum() ** 2
    z = (jnp.cbrt(q / mean) - 1 + spread) / jnp.sqrt(spread)
    return jnp.where(q < mean, jnp.log(jax.lax.erfc(z / 2**0.5) / 2), log_survival(q, weights))


def _features(ranks: Ranks) -> tuple[Array, Array]:
    """[V, 2 I, N] cosines with mean 0, and [V] the samples without the most frequent value."""
    n = ranks.rank.shape[1]
    assert ranks.first is not None
    assert ranks.last is not None
    first, last = (jnp.take_along_axis(v, ranks.rank, axis=1) for v in (ranks.first, ranks.last))
    i = jnp.arange(1.0, 2 * HARMONICS + 1)[:, None]
    cosines = jnp.sqrt(2 / i) * jnp.cos(jnp.pi * i * ((first + last + 1) / (2 * n))[:, None])
    events = n - 1.0 - (last - first).max(axis=1)
    return cosines - cosines.mean(axis=-1, keepdims=True), events


def _eigenvalues(covariance: Array) -> Array:
    """[..., K] of covariances of features [..., K, K], without what is rounding."""
    found = eigenvalues(covariance)
    return jnp.where(found > _ROUNDING, found, 0.0)
