"""Eigenvalues of many covariances, also where several threads ask for some at a time.

On a CPU, jaxlib's LAPACK calls with a batch axis run in the threads that they wait for: as many of
them at a time as there are threads never end (jaxlib 0.10). Without a batch axis they do not wait.
"""

import jax
import jax.numpy as jnp
from jax import Array


def eigenvalues(covariances: Array) -> Array:
    """[..., K] ascending, of symmetric matrices [..., K, K]; traceable."""
    if jax.default_backend() != "cpu":
        return jnp.linalg.eigvalsh(covariances)
    return jnp.vectorize(_alone, signature="(k,k)->(k)")(covariances)


@jax.custom_batching.sequential_vmap
def _alone(covariance: Array) -> Array:
    return jnp.linalg.eigvalsh(covariance)
