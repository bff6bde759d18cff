"""Leakage: how much of a signal is still to be had from latents or from frames.

By rank correlation (Spearman 1904) for single latents, and by kernel ridge regression (Saunders,
Gammerman & Vovk 1998) for frames. What no correlation with a single latent sees, a signal spread
over several of them or shown in a non-monotone way, a nonlinear regression from the frames does.
Closed form: the same frames give the same number.
Shapes: n training frames, m test frames, P pixels, C components, O latents, A signals.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf import checks
from jaxdeconf.learn.linear_start import principal_components

# Enough for all that CartPole's frames hold; every one is scaled alike, so that a faint trace of
# the signal counts as much as the pose does.
_COMPONENTS = 32
# Of the first component's standard deviation: what is smaller is the rounding of uint8.
_FLOOR = 3e-3
# Below 0.1 the kernel's smallest eigenvalues are rounding in float32: leave-one-out then may choose
# a ridge whose predictions blow up (R² of -8.7 on one run of Reacher), and gains nothing elsewhere.
_RIDGES = (0.1, 1.0, 10.0, 100.0)


@jax.jit
def spearman(latents: Array, signal: Array) -> Array:
    """[O, A] Spearman rank correlations of latents [n, O] with signals [n, A], both continuous.

    A constant latent has rank correlation 0 with everything.
    """

    def ranks(values: Array) -> Array:
        order = jnp.argsort(jnp.argsort(values, axis=0), axis=0) - (len(values) - 1) / 2
        return jnp.where(values.max(axis=0) > values.min(axis=0), order, 0.0)

    a, b = ranks(latents), ranks(signal)
    scale = jnp.sqrt((a**2).sum(0)[:, None] * (b**2).sum(0)[None])
    return a.T @ b / jnp.maximum(scale, 1.0)


def _kernel(a: Array, b: Array) -> Array:
    """[n, m] linear plus Gaussian kernel of features [n, C], [m, C]; its width is sqrt(C)."""
    inner = a @ b.T
    squared = (a * a).sum(1)[:, None] + (b * b).sum(1)[None] - 2.0 * inner
    size = a.shape[1]
    return inner / size + jnp.exp(-jnp.maximum(squared, 0.0) / (2.0 * size))


def regression(
    train: Array, signal: Array, key: Array, components: int
) -> Callable[[Array], Array]:
    """Kernel ridge regression on principal components; each ridge the best by leave-one-out.

    Args:
      train: [n, P] what a signal is told from.
      signal: [n, A].
      key: starts the search for principal components.
      components: C, at most n and P.
    Returns:
      [m, P] others -> [m, A] what the signal is predicted to be.
    """
    mean = train.mean(axis=0)
    vectors, variances = principal_components(train - mean, components, key)
    scale = jnp.sqrt(jnp.maximum(variances, variances[0] * _FLOOR**2) + 1e-12)
    features = (train - mean) @ vectors / scale
    offset = signal.mean(axis=0)
    values, basis = jnp.linalg.eigh(_kernel(features, features))
    rotated = basis.T @ (signal - offset)

    def solve(ridge: Array) -> tuple[Array, Array]:
        inverse = 1.0 / (jnp.maximum(values, 0.0) + ridge)
        weights = basis @ (inverse[:, None] * rotated)
        # Leave-one-out residuals: alpha_i / (K + ridge I)^-1_ii.
        residual = weights / ((basis * basis) @ inverse)[:, None]
        return (residual**2).mean(axis=0), weights

    errors, weights = jax.lax.map(solve, jnp.asarray(_RIDGES))  # [ridges, A], [ridges, n, A]
    best = jnp.argmin(errors, axis=0)
    chosen = jnp.take_along_axis(weights, best[None, None], axis=0)[0]
    return lambda test: offset + _kernel((test - mean) @ vectors / scale, features) @ chosen


def leaked(images: Array, signal: Array, key: Array) -> Array:
    """How much of a signal, or of its size, a regression tells from frames it has not seen.

    Of its size: by its squared distance from its mean. A mark may show how large a signal is and
    not its sign; then no function of the frame tells the signal, but some tell its square.

    Args:
      images: [n, ...], float or uint8.
      signal: [n, A].
      key: starts the search for principal components.
    Returns:
      [] R², at most 1, the mean over A, of the signal or of its square, whichever is told better;
      about 0, or a little below, where nothing leaks.
    Raises:
      ValueError: if frames and signals differ in number, or there are too few.
    """
    checks.key("key", key)
    images = checks.plain("images", images)  # lists too; no masked values
    count = checks.integer("frames in images", len(images), least=4)
    form = f"[{count}, A], one row a frame"
    signal = jnp.asarray(checks.array("signal", signal, form, (count, None), finite=True))
    squared = (signal - signal[: count // 2].mean(axis=0)) ** 2
    found = explained(images, jnp.concatenate([signal, squared], axis=1), key)
    return found.reshape(2, -1).mean(axis=1).max()


def explained(seen: Array, signal: Array, key: Array) -> Array:
    """The share of each signal's variance that what is seen explains, in whatever nonlinear way.

    The regression is fitted to the first half and judged on the second: 1 for a signal that is a
    function of what is seen alone, about 0, or a little below, for one that is independent of it.

    Args:
      seen: [n, P] columns; or images [n, ...], of which the first principal components are taken.
      signal: [n, A].
      key: starts the search for principal components.
    Returns:
      [A] R²; 0 for a signal that is constant.
    """
    half, flat = len(seen) // 2, jnp.asarray(seen, jnp.float32).reshape(len(seen), -1)
    columns = flat.shape[1]
    components = columns if seen.ndim == 2 else min(_COMPONENTS, half - 1, columns)
    return _shares(flat[:half], signal[:half], flat[half:], signal[half:], key, components)


@partial(jax.jit, static_argnames="components")
def _shares(
    train: Array, train_signal: Array, test: Array, test_signal: Array, key: Array, components: int
) -> Array:
    """[A] R² of each signal on test frames [m, P]; 0 for one that is constant."""
    predicted = regression(train, train_signal, key, components)(test)
    error, variance = ((predicted - test_signal) ** 2).mean(axis=0), test_signal.var(axis=0)
    varies = variance > 0.0
    return jnp.where(varies, 1.0 - error / jnp.where(varies, variance, 1.0), 0.0)
