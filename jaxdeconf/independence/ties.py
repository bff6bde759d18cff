"""The refined R of tied columns, on the scale on which it has D's law under independence.

Midranks push Hoeffding's D of tied columns far below 0, where p-values and thresholds for
continuous margins see nothing: a column may be equal to another one and have p = 1. Blum, Kiefer &
Rosenblatt's R has no such bias. With U, V the midranks of x and y in (0, 1),

    R = sum over i, j >= 1 of 4 / (pi^4 i^2 j^2) Cov(cos pi i U, cos pi j V)^2,

summed here to the 16th harmonic: the squared covariance of the features sqrt(2) / (pi i) cos pi i U
of x with those of y. (N - 1) R then tends, under independence, to the sum of lambda_i mu_j Z_ij^2,
Z standard normal, lambda and mu the eigenvalues of the features' covariances, which the ties of
each column fix. Its survival is the integral of exp(K(t) - t q) / t along a parabola past the
saddle point, K the cumulant generating function: exact far into the tail. Where both columns are
rare events, whose coincidences are too few for a normal law, the p-value is at least that of their
number, which is hypergeometric (Fisher's exact test, two-sided by doubling).

The result is the R of continuous columns that has this p-value. So one table of p-values and one
threshold serve all pairs.
Sources: Blum, Kiefer & Rosenblatt, Ann. Math. Stat. 32 (1961); Székely, Rizzo & Bakirov, Ann. Stat.
35 (2007), theorem 5, for the law with any margins; Rice, SIAM J. Sci. Stat. Comput. 1 (1980), for
the contour. Shapes: V columns, S of x, P of y, N samples.
"""

from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import gammaln
from jax.typing import ArrayLike

from jaxdeconf.independence.eigen import eigenvalues
from jaxdeconf.independence.null import quantile
from jaxdeconf.independence.ranks import Ranks, rank_on_device, rank_on_host
from jaxdeconf.independence.statistic import Statistic
from jaxdeconf.independence.table import all_pairs, both_columns, chosen, counted, formed, is_traced

# A column counts as tied where the chance that two samples share their value is above that of 333
# equally frequent values: one of bytes is. Below, ties move D by less than a tenth of its standard
# deviation.
TIED = 0.003
FEW = 10.0  # expected coincidences of two rare events below which no normal law holds
FEWEST = 5  # events of a column, to tell anything from
HARMONICS = 16
EIGENVALUES, WEIGHTS = 8, 24  # the largest, of a column and of a pair; the rest count by their mean
NODES = 32  # of the contour: the survival is then good to 1e-3, and to 1e-6 below 0.1


def with_ties(x: ArrayLike, y: ArrayLike, statistic: Statistic) -> tuple[Array, Array]:
    """The statistic, or R on its scale where a column of the pair is tied, and where that is.

    Args:
      x: [N] or [N, S] real numbers.
      y: [N] or [N, P] real numbers.
      statistic: D's or R's; keeps its bits where nothing is tied.
    Returns:
      [], [P], [S] or [S, P] each; the second bool.
    """
    xs, ys = both_columns(x, y)
    shape, dtype = np.shape(x)[1:] + np.shape(y)[1:], jnp.result_type(float)
    if is_traced(xs, ys):
        d = all_pairs(x, y, statistic)
        with jax.enable_x64(True):
            ranks = (rank_on_device(jnp.asarray(v))[0] for v in (xs, ys))
            r, tied = (part.reshape(shape) for part in _scaled(*ranks))
            return jnp.where(tied & ~jnp.isnan(d), r.astype(dtype), d), tied
    with jax.enable_x64(True):
        ranks = rank_on_host(np.asarray(xs)), rank_on_host(np.asarray(ys))
        d, tied = of_ranks(*ranks, statistic)
        return formed(d, dtype, shape), jnp.asarray(tied.reshape(shape))


def of_ranks(x: Ranks, y: Ranks, statistic: Statistic) -> tuple[Array | np.ndarray, np.ndarray]:
    """[S, P] as `with_ties`, of variables ranked on the host; under 64-bit types."""
    tied_x, tied_y = (np.asarray(_are_tied(_sharing(ranks, np))) for ranks in (x, y))
    tied = tied_x[:, None] | tied_y
    if not tied.any():
        return counted(x, y, statistic), tied
    values = np.array(_scaled(_with_ends(x), _with_ends(y))[0])
    if not tied.all():
        untied = counted(chosen(x, ~tied_x), chosen(y, ~tied_y), statistic)
        values[np.ix_(~tied_x, ~tied_y)] = untied
    return values, tied


def _sharing(ranks: Ranks, xp: ModuleType) -> Any:
    """[V, N] at each rank, how many others have the value there."""
    if ranks.first is None:
        return xp.zeros(ranks.rank.shape)
    return xp.asarray(ranks.last) - xp.asarray(ranks.first)


def _are_tied(sharing: Any) -> Any:
    """[V] bool, of `_sharing`; see `TIED`."""
    return sharing.mean(axis=1) > TIED * (sharing.shape[1] - 1)


def _with_ends(ranks: Ranks) -> Ranks:
    """With the tie group of each rank also where it is known that there are no ties."""
    if ranks.first is not None:
        return ranks
    own = np.broadcast_to(np.arange(ranks.rank.shape[1], dtype=np.int32), ranks.rank.shape)
    return ranks._replace(first=own, last=own)


def few_events(values: ArrayLike) -> dict[int, int]:
    """Of tied columns that are not constant, those with few samples of another value than the most.

    Args:
      values: [N, ...] real numbers.
    Returns:
      {column, counted over the other axes: samples of another value, 1 to 4}.
    """
    table = np.asarray(values)
    table = table.reshape(len(table), -1)
    events = {}
    for column, value in enumerate(table.T):
        counts = np.unique(value, return_counts=True)[1]
        if len(counts) < len(value):
            events[column] = len(value) - int(counts.max())
    return {column: count for column, count in events.items() if 0 < count < FEWEST}


class _Columns(NamedTuple):
    """What the ties of each column make of its law."""

    features: Array  # [V, HARMONICS, N] with mean 0
    eigenvalues: Array  # [V, EIGENVALUES] the largest of their covariance
    trace: Array  # [V] the sum of all of them
    rare: Array  # [V, N] 1 where the sample has not the most frequent value, else 0
    tied: Array  # [V] bool


def _columns(ranks: Ranks) -> _Columns:
    n = ranks.rank.shape[1]
    rank, first, last = map(jnp.asarray, (ranks.rank, ranks.first, ranks.last))
    sharing = _sharing(ranks, jnp)
    tied = _are_tied(sharing)
    first, last, sharing = (jnp.take_along_axis(v, rank, axis=1) for v in (first, last, sharing))
    cosine = jnp.cos(jnp.pi * (first + last + 1) / (2.0 * n))
    cosines = [jnp.ones_like(cosine), cosine]
    for _ in range(HARMONICS - 1):
        cosines.append(2 * cosine * cosines[-1] - cosines[-2])
    harmonic = jnp.arange(1, HARMONICS + 1)[:, None]
    features = jnp.sqrt(2.0) / (jnp.pi * harmonic) * jnp.stack(cosines[1:], axis=1)
    features = features - features.mean(axis=-1, keepdims=True)
    largest = eigenvalues(features @ features.swapaxes(1, 2) / n)[:, -EIGENVALUES:]
    most = jnp.take_along_axis(first, jax.lax.argmax(sharing, 1, jnp.int32)[:, None], axis=1)
    return _Columns(
        features=features,
        eigenvalues=jnp.where(largest > 1e-15, largest, 0.0),  # the others are rounding
        trace=(features**2).mean(axis=-1).sum(axis=-1),
        rare=(first != most).astype(float),
        tied=tied,
    )


@jax.jit
def _scaled(ranks_x: Ranks, ranks_y: Ranks) -> tuple[Array, Array]:
    """[S, P] R on its scale, and whether a column of the pair is tied."""
    rows, n = ranks_x.rank.shape
    both = _columns(jax.tree.map(lambda *parts: jnp.concatenate(parts), ranks_x, ranks_y))
    x, y = (_Columns(*(part[at] for part in both)) for at in np.s_[:rows, rows:])
    flat = x.features.reshape(-1, n) @ y.features.reshape(-1, n).T / n
    r = (flat.reshape(len(x.tied), HARMONICS, len(y.tied), HARMONICS) ** 2).sum(axis=(1, 3))

    def row(r: Array, eigenvalues: Array, trace: Array) -> Array:
        weights = (eigenvalues[:, None] * y.eigenvalues[:, None, :]).reshape(len(r), -1)
        weights = jax.lax.top_k(weights, WEIGHTS)[0]
        rest = trace * y.trace - weights.sum(axis=1)  # of the small ones: as good as constant
        return jax.vmap(log_survival)((n - 1) * r - rest, weights)

    log_p = jax.lax.map(lambda of: row(*of), (r, x.eigenvalues, x.trace))
    events_x, events_y = x.rare.sum(axis=1)[:, None], y.rare.sum(axis=1)[None, :]
    few = (events_x * events_y < FEW * n) & (jnp.maximum(events_x, events_y) <= n / 2)
    exact = _log_coincidences(x.rare @ y.rare.T, events_x, events_y, n)
    log_p = jnp.where(few, jnp.maximum(log_p, exact), log_p)
    return quantile(log_p) / (1.2 * (n - 1)), x.tied[:, None] | y.tied[None, :]


def log_survival(q: Array, weights: Array) -> Array:
    """log P(sum of weights Z^2 > q), Z standard normal, for weights [k] >= 0; 0 if all are 0."""
    # All is in units of the largest weight, so that the branch cut begins at t = 1/2.
    largest = weights.max()
    some = (largest > 0) & (q > 0)
    w = weights / jnp.where(some, largest, 1.0)
    q = jnp.where(some, q / jnp.where(some, largest, 1.0), 1.0)

    # The saddle point t = (1 - u) / 2 of K(t) - log t - t q, by halving.
    def halve(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        u = (low + high) / 2
        below = jnp.sum(w / (1 - w + w * u)) - 2 / (1 - u) > q
        return jnp.where(below, u, low), jnp.where(below, high, u)

    low, high = jax.lax.fori_loop(0, 60, halve, (jnp.zeros_like(q), jnp.ones_like(q)))
    saddle = (1 - (low + high) / 2) / 2
    curvature = jnp.sum(2 * (w / (1 - 2 * w * saddle)) ** 2) + 1 / saddle**2
    step = 5.0 / NODES
    theta = jnp.sinh(step * (jnp.arange(NODES) + 0.5))
    bend = 1 / (2 * jnp.maximum(q, w.sum()))
    t = saddle + bend * theta**2 + 1j * theta / jnp.sqrt(curvature)
    slope = (2 * bend * theta + 1j / jnp.sqrt(curvature)) * jnp.sqrt(1 + theta**2)

    def exponent(t: Array) -> Array:
        return -jnp.log(1 - 2 * w * t[..., None]).sum(axis=-1) / 2 - t * q

    at_saddle = exponent(saddle)
    integral = jnp.sum((jnp.exp(exponent(t) - at_saddle) / t * slope).imag) * step / jnp.pi
    return jnp.where(some, jnp.minimum(at_saddle + jnp.log(integral), 0.0), 0.0)


def _log_coincidences(both: Array, in_x: Array, in_y: Array, n: int) -> Array:
    """Log of the two-sided p-value of as many coincidences of few events; see `FEW`."""

    def log_choose(total: Array, chosen: Array) -> Array:
        return gammaln(total + 1.0) - gammaln(chosen + 1.0) - gammaln(total - chosen + 1.0)

    log_here = log_choose(in_x, both) + log_choose(n - in_x, in_y - both)
    log_here = log_here - log_choose(jnp.asarray(float(n)), in_y)
    more = both[..., None] + jnp.arange(64.0)
    ratio = (in_x[..., None] - more) * (in_y[..., None] - more) / (more + 1)
    ratio = ratio / (n - in_x[..., None] - in_y[..., None] + more + 1)
    above = jnp.cumprod(jnp.maximum(ratio, 0.0), axis=-1).sum(axis=-1)
    at_least, at_most = log_here + jnp.log1p(above), jnp.log1p(-jnp.exp(log_here) * above)
    return jnp.minimum(jnp.log(2.0) + jnp.minimum(at_least, at_most), 0.0)
