"""Box-constrained quadratic programs of one or two controls, exact and without branches.

    minimise  g·k + k·H k / 2   subject to   low <= k <= high

With so few controls the active sets can be listed, so nothing iterates and every lane of a vmap
does the same work. Shapes: A action, 1 or 2.

Matrices here and in `ilqr` are NumPy object arrays of JAX scalars: `@` then unrolls into scalar
arithmetic, which XLA fuses and vectorises across the lanes of a vmap. As [lanes, 4, 4] arrays the
same products take four times as long on a CPU.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

Scalars = np.ndarray[Any, np.dtype[np.object_]]  # of JAX scalars


def fill(shape: tuple[int, ...], entry: Callable[..., Any]) -> Scalars:
    """Object array of that shape with entry(i, j, ...) at [i, j, ...].

    `np.array(nested, dtype=object)` would try to convert the JAX scalars themselves.
    """
    scalars = np.empty(shape, dtype=object)
    for index in np.ndindex(shape):
        scalars[index] = entry(*index)
    return scalars


def solve(hessian: Scalars, gradient: Scalars, low: Scalars, high: Scalars) -> tuple:
    """The minimiser, and the inverse of the Hessian on the controls that no bound holds.

    Args:
      hessian: [A, A] positive definite.
      gradient: [A].
      low: [A] lower bounds.
      high: [A] upper bounds, above the lower ones.
    Returns:
      k [A]; inverse [A, A], zero in the rows and columns of the controls at a bound: if the
      gradient moves by d and the same bounds stay active, k moves by -inverse @ d.
    Raises:
      ValueError: if there are more than two controls.
    """
    if len(gradient) == 1:
        point = -gradient[0] / hessian[0, 0]
        free = (low[0] < point) & (point < high[0])
        k = jnp.clip(point, low[0], high[0])
        inverse = jnp.where(free, 1.0 / hessian[0, 0], 0.0)
        return fill((1,), lambda i: k), fill((1, 1), lambda i, j: inverse)
    if len(gradient) == 2:
        return _solve_two(hessian, gradient, low, high)
    raise ValueError(f"system: the expert's box-QP takes 1 or 2 actions, got {len(gradient)}")


def _solve_two(hessian: Scalars, gradient: Scalars, low: Scalars, high: Scalars) -> tuple:
    """The unconstrained point if it is inside the box, else the best of the four clipped edges."""
    (a, b), (_, c) = hessian
    determinant = a * c - b * b
    point = ((b * gradient[1] - c * gradient[0]) / determinant,)
    point += ((b * gradient[0] - a * gradient[1]) / determinant,)
    inside = _within(point[0], low[0], high[0]) & _within(point[1], low[1], high[1])
    best = (point[0], point[1], jnp.where(inside, -jnp.inf, jnp.inf), inside, inside)
    for held in (0, 1):
        for bound in (low[held], high[held]):
            best = _better(best, _edge(hessian, gradient, low, high, held, bound))
    free = best[3:]
    both = free[0] & free[1]

    def inverse(i: int, j: int) -> Array:
        joint = hessian[1 - i, 1 - j] / determinant * (1.0 if i == j else -1.0)
        alone = jnp.where(free[i], 1.0 / hessian[i, i], 0.0) if i == j else 0.0
        return jnp.where(both, joint, alone)

    return fill((2,), lambda i: best[i]), fill((2, 2), inverse)


def _edge(hessian, gradient, low, high, held: int, bound: Array) -> tuple:
    """(k_0, k_1, value, free_0, free_1) with control `held` at a bound and the other one best."""
    other = 1 - held
    point = -(gradient[other] + hessian[0, 1] * bound) / hessian[other, other]
    k = fill((2,), lambda i: bound if i == held else jnp.clip(point, low[other], high[other]))
    free = fill((2,), lambda i: (i != held) & _within(point, low[other], high[other]))
    return k[0], k[1], gradient @ k + 0.5 * (k @ (hessian @ k)), free[0], free[1]


def _better(one: tuple, two: tuple) -> tuple:
    return tuple(jnp.where(two[2] < one[2], new, old) for old, new in zip(one, two, strict=True))


def _within(point: Array, low: Array, high: Array) -> Array:
    return (low < point) & (point < high)
