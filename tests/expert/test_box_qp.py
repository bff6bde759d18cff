"""The box-QP against an enumeration of every active set in NumPy."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.expert import box_qp
from jaxdeconf.expert.box_qp import fill


def by_enumeration(hessian, gradient, low, high):
    """Best feasible point over every choice of which controls sit at which bound."""
    best, best_value = None, np.inf
    for held in itertools.product((None, 0, 1), repeat=len(gradient)):
        k = np.array([0.0 if h is None else (low, high)[h][i] for i, h in enumerate(held)])
        free = [i for i, h in enumerate(held) if h is None]
        if free:
            right = -(gradient + hessian @ k)[free]
            k[free] = np.linalg.solve(hessian[np.ix_(free, free)], right)
        value = gradient @ k + 0.5 * k @ hessian @ k
        if (k >= low - 1e-12).all() and (k <= high + 1e-12).all() and value < best_value:
            best, best_value = k, value
    return best


def solve(hessian, gradient, low, high):
    """`box_qp.solve` on arrays."""
    objects = [fill(a.shape, lambda *i, a=a: a[i]) for a in (hessian, gradient, low, high)]
    k, inverse = box_qp.solve(*objects)
    return jnp.stack(k.tolist()), jnp.stack([jnp.stack(row) for row in inverse.tolist()])


def problems(actions, count=300):
    rng = np.random.default_rng(actions)
    root = rng.normal(size=(count, actions, actions))
    hessian = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(actions)
    gradient = rng.normal(size=(count, actions)) * 2
    low, high = -rng.uniform(0, 2, (count, actions)), rng.uniform(0, 2, (count, actions))
    return hessian, gradient, low, high


@pytest.mark.parametrize("actions", [1, 2])
def test_minimiser_matches_enumeration(actions):
    cases = problems(actions)
    expected = np.array([by_enumeration(*case) for case in zip(*cases, strict=True)])
    with jax.enable_x64(True):
        k, inverse = jax.jit(jax.vmap(solve))(*map(jnp.asarray, cases))
        np.testing.assert_allclose(k, expected, rtol=0, atol=1e-9)
    at_bound = (expected == cases[2]) | (expected == cases[3])
    held = at_bound.sum(axis=1)
    assert all((held == n).sum() > 10 for n in range(actions + 1))  # every kind of case occurred
    np.testing.assert_array_equal(np.asarray(inverse)[at_bound], 0)


@pytest.mark.parametrize("actions", [1, 2])
def test_inverse_is_the_derivative_of_the_minimiser(actions):
    hessian, gradient, low, high = problems(actions, 100)
    h = 1e-7
    with jax.enable_x64(True):
        run = jax.jit(jax.vmap(solve))
        _, inverse = run(*map(jnp.asarray, (hessian, gradient, low, high)))
        for j in range(actions):
            up, down = (
                run(hessian, gradient + d * np.eye(actions)[j], low, high)[0] for d in (h, -h)
            )
            np.testing.assert_allclose(-inverse[:, :, j], (up - down) / (2 * h), atol=1e-5)


def test_more_than_two_controls_are_refused():
    with pytest.raises(ValueError, match="1 or 2 actions, got 3"):
        solve(np.eye(3), np.ones(3), -np.ones(3), np.ones(3))
