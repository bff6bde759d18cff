"""A linear start for the β-VAE: principal components, turned until they are independent.

Why: the nuisance explains as much of the pixels' variance as the pose does, and any sane β pays for
it; yet from random weights its gradient is a product of two small numbers beside the pose's large
one, and within a CPU's budget Adam never finds it. From this start every latent carries something
from the first step. Why turned: two leading eigenvalues may be close, and PCA then mixes their
directions; ICA parts them, because sources that do not influence one another are independent.
Nothing here knows where the nuisance is, or that there is one.

FastICA: Hyvärinen (1999), symmetric, log-cosh contrast. Shapes: n frames, P pixels, O components.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf import checks

# Of the first component's variance, the least that a component is taken to have.
_FLOOR = 1e-6


class LinearStart(NamedTuple):
    """Unit-variance, uncorrelated components z = (x - mean) @ encoder, x ≈ mean + z @ decoder."""

    mean: Array  # [P]
    encoder: Array  # [P, O]
    decoder: Array  # [O, P]


def principal_components(centred: Array, count: int, key: Array) -> tuple[Array, Array]:
    """Leading eigenvectors and eigenvalues of the covariance, by subspace iteration.

    Args:
      centred: [n, P] with zero mean.
      count: O.
      key: draws the first subspace.
    Returns:
      vectors [P, O], orthonormal, and variances [O], descending.
    """
    samples, pixels = centred.shape
    # A wider subspace than asked for settles the last components (Halko et al. 2011).
    first = jax.random.normal(key, (pixels, min(2 * count + 8, samples, pixels)))

    def improve(_: Array, scores: Array) -> Array:  # of samples, which are fewer than pixels
        return jnp.linalg.qr(centred @ (centred.T @ scores))[0]

    scores = jax.lax.fori_loop(0, 5, improve, jnp.linalg.qr(centred @ first)[0])
    basis = jnp.linalg.qr(centred.T @ scores)[0]
    projected = centred @ basis
    variances, rotation = jnp.linalg.eigh(projected.T @ projected / samples)
    return (basis @ rotation)[:, ::-1][:, :count], variances[::-1][:count]


def independent_rotation(white: Array, key: Array, iterations: int = 200) -> Array:
    """The rotation [O, O] that makes whitened samples [n, O] most independent (FastICA)."""

    def orthogonalize(matrix: Array) -> Array:
        left, _, right = jnp.linalg.svd(matrix)
        return left @ right

    def improve(_: Array, rotation: Array) -> Array:
        sources = jnp.tanh(white @ rotation)
        slope = jnp.mean(1.0 - sources**2, axis=0)
        return orthogonalize(white.T @ sources / len(white) - rotation * slope)

    size = white.shape[1]
    first = orthogonalize(jax.random.normal(key, (size, size)))
    return jax.lax.fori_loop(0, iterations, improve, first)


@partial(jax.jit, static_argnames=("count", "among"))
def linear_start(images: Array, count: int, key: Array, among: int | None = None) -> LinearStart:
    """Fits the start to images.

    Args:
      images: [n, P] float; a few thousand are enough.
      count: O.
      key: random starts of both iterations.
      among: of how many components, made independent of one another, to keep the O that change the
        image most; None is O. More separate better: a source that the leading O principal
        components hold only a part of is mixed with what they hold of others.
    Raises:
      ValueError: if there are fewer images than components, or fewer of these than O.
    """
    among = count if among is None else among
    checks.integer("among", among, least=count, most=min(images.shape))
    subspace_key, rotation_key = jax.random.split(key)
    mean = images.mean(axis=0)
    centred = images - mean
    vectors, variances = principal_components(centred, among, subspace_key)
    # Components that are rounding of uint8 must not be blown up to unit variance.
    scale = jnp.sqrt(jnp.maximum(variances, _FLOOR * variances[0] + 1e-12))
    rotation = independent_rotation(centred @ (vectors / scale), rotation_key)
    if among > count:
        power = ((vectors * scale) ** 2).sum(axis=0) @ rotation**2  # of each, in the image
        rotation = rotation[:, jnp.argsort(-power)[:count]]
    return LinearStart(mean, (vectors / scale) @ rotation, rotation.T @ (vectors * scale).T)
