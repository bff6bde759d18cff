"""HSCIC: how much two things depend on one another, given a third, by kernels in closed form.

The Hilbert–Schmidt conditional independence criterion (Park & Muandet 2020, "A measure-theoretic
approach to kernel conditional mean embeddings"), as Seo et al. (2023) estimate it: the squared
distance, at each z, of the joint conditional mean embedding from the product of the two marginal
ones. 0 where x and y are independent given z; N samples tell little below 128 of them.
Shapes: N samples, F features, A and C components.
"""

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import cho_factor, cho_solve

# λ; N·λ is .01 for 128 samples, as it is for the authors' 1024 (their λ is 1e-5).
RIDGE = 1e-4
_TINY = 1e-12  # a variance below counts as none: what is constant then has distance 0 to itself


def hscic(
    x: Array, y: Array, z: Array, ridge: float | Array = RIDGE, weight: Array | None = None
) -> Array:
    """How much x depends on y given z, averaged over the samples of z.

    Each is centred and scaled first: y and z by component, to variance 1; x as a whole, to a total
    variance of 1, so that a network does not get out of it by shrinking its features, or by adding
    a constant. The kernels are then exp(-‖·-·‖²), the authors'.

    A weight is that of a sample in the regressions on z which the conditional embeddings are, in
    the mean over z, and in the centring and scaling: with weights of 0 and 1 the statistic is the
    one of the samples of weight 1 alone, and N their number.

    Args:
      x: [N, F], y: [N, A], z: [N, C].
      ridge: λ; the regressions on z have the ridge N·λ.
      weight: [N] ≥ 0; None: all alike.
    Returns:
      [] ≥ 0 but for rounding, float32.
    """
    weight = jnp.ones(len(x)) if weight is None else jnp.asarray(weight, jnp.float32)
    total = jnp.maximum(weight.sum(), 1.0)
    # A GPU's usual products of float32 have three digits; the solve needs more.
    with jax.default_matmul_precision("float32"):
        scaled = [_scaled(a, weight / total, whole) for a, whole in ((x, True), (y, False))]
        k_x, k_y, k_z = (_kernel(a) for a in (*scaled, _scaled(z, weight / total, False)))
        # W [N, N]: in column j the weights of the samples for conditioning on z_j. With S the root
        # of the weights, S (S K S + N λ)⁻¹ S K is what weighted least squares comes to.
        root = jnp.sqrt(weight)
        gram = root[:, None] * k_z * root + total * ridge * jnp.eye(len(x))
        w = root[:, None] * cho_solve(cho_factor(gram), root[:, None] * k_z)
        x_w, y_w = k_x @ w, k_y @ w
        joint = (w * ((k_x * k_y) @ w)).sum(axis=0)
        cross = (w * x_w * y_w).sum(axis=0)
        product = (w * x_w).sum(axis=0) * (w * y_w).sum(axis=0)
    return ((joint - 2.0 * cross + product) * weight).sum() / total


def _scaled(values: Array, share: Array, whole: bool) -> Array:
    """[N, F] values less their mean, over their standard deviation, or over that of the whole."""
    values = jnp.asarray(values, jnp.float32)
    centred = values - share @ values
    variance = share @ centred**2
    return centred / jnp.sqrt((variance.sum() if whole else variance) + _TINY)


def _kernel(a: Array) -> Array:
    """[N, N] exp(-‖·-·‖²) of rows [N, F]."""
    squared = (a * a).sum(axis=1)
    return jnp.exp(-jnp.maximum(squared[:, None] + squared - 2.0 * a @ a.T, 0.0))
