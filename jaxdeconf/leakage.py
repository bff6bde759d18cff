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


def leaked(train: Array, train_signal: Array, test: Array, test_signal: Array, key: Array) -> Array:
    """How much of a signal, or of its size, a regression tells from frames it has not seen.

    Of its size: by its squared distance from its mean. A mark may show how large a signal is and
    not its sign; then no function of the frame tells the signal, but some tell its square.

    Args:
      train: [n, ...] images, float or uint8.
      train_signal: [n, A].
      test: [m, ...] images.
      test_signal: [m, A].
      key: starts the search for principal components.
    Returns:
      [] R², at most 1, the mean over A, of the signal or of its square, whichever is told better;
      about 0, or a little below, where nothing leaks.
    Raises:
      ValueError: if frames and signals differ in number, frames in size, or there are too few.
    """
    _check(train, train_signal, test, test_signal, key)
    mean = train_signal.mean(axis=0)
    train_both, test_both = (
        jnp.concatenate([signal, (signal - mean) ** 2], axis=1)
        for signal in (train_signal, test_signal)
    )
    found = _told(train, train_both, test, test_both, key)
    return found.reshape(2, -1).mean(axis=1).max()


def r_squared_each(
    train: Array, train_signal: Array, test: Array, test_signal: Array, key: Array
) -> Array:
    """[A] the share of each signal's variance that is told of the test frames; else as `leaked`."""
    _check(train, train_signal, test, test_signal, key)
    return _told(train, train_signal, test, test_signal, key)


def _told(train: Array, train_signal: Array, test: Array, test_signal: Array, key: Array) -> Array:
    flat = [jnp.asarray(x, jnp.float32).reshape(len(x), -1) for x in (train, test)]
    components = min(_COMPONENTS, len(train) - 1, flat[0].shape[1])
    return _shares(flat[0], train_signal, flat[1], test_signal, key, components)


def _check(train: Array, train_signal: Array, test: Array, test_signal: Array, key: Array) -> None:
    checks.key("key", key)
    shape = jnp.shape(train)[1:]
    for name, images, signal in (("train", train, train_signal), ("test", test, test_signal)):
        count = checks.integer(f"frames in {name}", len(images), least=2)
        checks.array(name, images, f"[n, {str(shape)[1:-1]}]", (None, *shape))
        form = f"[{count}, A], one row a frame"
        checks.array(f"{name}_signal", signal, form, (count, None), finite=True)


@partial(jax.jit, static_argnames="components")
def _shares(
    train: Array, train_signal: Array, test: Array, test_signal: Array, key: Array, components: int
) -> Array:
    """[A] R² of each signal on test frames [m, P]; 0 for one that is constant."""
    predicted = regression(train, train_signal, key, components)(test)
    error, variance = ((predicted - test_signal) ** 2).mean(axis=0), test_signal.var(axis=0)
    varies = variance > 0.0
    return jnp.where(varies, 1.0 - error / jnp.where(varies, variance, 1.0), 0.0)


def explained(signal: Array, latents: Array, key: Array) -> Array:
    """The share of each latent's variance that a signal explains, in whatever nonlinear way.

    The regression is fitted to the first half and judged on the second: 1 for a latent that is a
    function of the signal alone, about 0, or a little below, for one that is independent of it.

    Args:
      signal: [n, A].
      latents: [n, O].
      key: starts the search for principal components.
    Returns:
      [O] R².
    """
    half, components = len(signal) // 2, signal.shape[1]
    return _shares(signal[:half], latents[:half], signal[half:], latents[half:], key, components)
