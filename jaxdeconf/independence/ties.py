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

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import gammaln
from jax.typing import ArrayLike

from jaxdeconf.independence.eigen import eigenvalues
from jaxdeconf.independence.null import quantile
from jaxdeconf.independence.ranks import Ranks, both_ranked, rank_on_device
from jaxdeconf.independence.statistic import Statistic
from jaxdeconf.independence.table import (
    all_pairs,
    both_columns,
    chosen,
    counted,
    formed,
    in_parts,
    is_traced,
)

X = TypeVar("X")

# A column counts as tied where the chance that two samples share their value is above that of 333
# equally frequent values: one of bytes is. Below, ties move D by less than a tenth of its standard
# deviation.
TIED = 0.003
FEW = 10.0  # expected coincidences of two rare events below which no normal law holds
FEWEST = 5  # events of a column, to tell anything from
HARMONICS = 16
EIGENVALUES, WEIGHTS = 8, 24  # the largest, of a column and of a pair; the rest count by their mean
AT_ONCE = 2**20  # samples of columns whose features are made at once; on a CPU they are one's
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
        ranks = both_ranked(np.asarray(xs), np.asarray(ys))
        d, tied = of_ranks(*ranks, statistic)
        return formed(d, dtype, shape), jnp.asarray(tied.reshape(shape))


def of_ranks(x: Ranks, y: Ranks, statistic: Statistic) -> tuple[Array | np.ndarray, np.ndarray]:
    """[S, P] as `with_ties`, of variables ranked on the host; under 64-bit types."""
    tied_x, tied_y = (np.asarray(_are_tied(_sharing(ranks, np))) for ranks in (x, y))
    tied = tied_x[:, None] | tied_y
    if not tied.any():
        return counted(x, y, statistic), tied
    values = np.array(in_parts(lambda x, y: _scaled(_with_ends(x), _with_ends(y))[0], x, y))
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


class _Column(NamedTuple):
    """What the ties of a column make of its law; [V, ...] of V columns."""

    features: Array  # [HARMONICS, N] with mean 0
    eigenvalues: Array  # [EIGENVALUES] the largest of their covariance
    trace: Array  # [] the sum of all of them
    rare: Array  # [N] 1 where the sample has not the most frequent value, else 0
    tied: Array  # [] bool


def _column(rank: Array, first: Array, last: Array) -> _Column:
    """Of one column's ranks, [N] each."""
    n = rank.shape[0]
    sharing = last - first
    midrank, most = (first + last)[rank], first[jax.lax.argmax(sharing, 0, jnp.int32)]
    cosine = jnp.cos(jnp.pi * (midrank + 1) / (2.0 * n))

    def double(two: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        before, now = two
        return (now, 2 * cosine * now - before), now

    cosines = jax.lax.scan(double, (jnp.ones_like(cosine), cosine), length=HARMONICS)[1]
    harmonic = jnp.arange(1, HARMONICS + 1)[:, None]
    features = jnp.sqrt(2.0) / (jnp.pi * harmonic) * cosines
    features = features - features.mean(axis=-1, keepdims=True)
    covariance = features @ features.T / n
    largest = eigenvalues(covariance)[-EIGENVALUES:]
    return _Column(
        features=features,
        eigenvalues=jnp.where(largest > 1e-15, largest, 0.0),  # the others are rounding
        trace=jnp.trace(covariance),
        rare=(first[rank] != most).astype(float),
        tied=_are_tied(sharing[None])[0],
    )


@jax.jit
def _scaled(x: Ranks, y: Ranks) -> tuple[Array, Array]:
    """[S, P] R on its scale, and whether a column of the pair is tied."""
    n = x.rank.shape[1]
    of_x = _each_column(_column, x)
    flat = of_x.features.reshape(-1, n)

    def against(*of: Array) -> tuple[Array, ...]:
        one = _column(*of)
        r = ((flat @ one.features.T / n).reshape(-1, HARMONICS**2) ** 2).sum(axis=1)
        return r, one.eigenvalues, one.trace, one.rare.sum(), of_x.rare @ one.rare, one.tied

    *of_y, events_y, both, tied_y = _each_column(against, y)

    def log_p(r: Array, eigenvalues: Array, trace: Array) -> Array:
        weights = (of_x.eigenvalues[:, :, None] * eigenvalues).reshape(len(r), -1)
        weights = jax.lax.top_k(weights, WEIGHTS)[0]
        rest = of_x.trace * trace - weights.sum(axis=1)  # of the small ones: as good as constant
        return jax.vmap(log_survival)((n - 1) * r - rest, weights)

    found = jax.lax.map(lambda of: log_p(*of), tuple(of_y)).T
    events_x = of_x.rare.sum(axis=1)[:, None]
    few = (events_x * events_y < FEW * n) & (jnp.maximum(events_x, events_y) <= n / 2)
    exact = _log_coincidences(both.T, events_x, events_y, n)
    found = jnp.where(few, jnp.maximum(found, exact), found)
    return quantile(found) / (1.2 * (n - 1)), of_x.tied[:, None] | tied_y


def _each_column(function: Callable[..., X], ranks: Ranks) -> X:
    """[V, ...] of `function` of each column's ranks, some at a time: its features are large."""
    parts = (ranks.rank, ranks.first, ranks.last)
    at_once = 1 if jax.default_backend() == "cpu" else max(1, AT_ONCE // ranks.rank.shape[1])
    return jax.lax.map(lambda of: function(*of), parts, batch_size=at_once)


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
        return -_log_product(1 - 2 * w * t[..., None]) / 2 - t * q

    at_saddle = -jnp.log(1 - 2 * w * saddle).sum() / 2 - saddle * q
    integral = jnp.sum((jnp.exp(exponent(t) - at_saddle) / t * slope).imag) * step / jnp.pi
    return jnp.where(some, jnp.minimum(at_saddle + jnp.log(integral), 0.0), 0.0)


def _log_product(factors: Array) -> Array:
    """The sum over the last axis of the logs of factors below the real axis, by one log.

    Each turns the product clockwise, by less than half a turn: where it comes from below the axis
    to above, it has passed the cut, and its log falls short of the sum by a turn.
    """
    product, turns = factors[..., 0], 0
    for k in range(1, factors.shape[-1]):
        before, product = product, product * factors[..., k]
        turns = turns + ((before.imag < 0) & (product.imag >= 0))
    return jnp.log(product) - 2j * jnp.pi * turns


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
