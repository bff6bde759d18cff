"""Frames as functions of the state, CartPole's above all, and at other sizes than the paper's."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import systems

SYSTEM = systems.get("cartpole")
JACOBIANS = jax.jit(jax.jacfwd(SYSTEM.render, (0, 1)))


def test_gradients_match_finite_differences():
    """In x and theta, at states of every kind; velocities do not show in one frame."""
    weights = np.random.default_rng(0).normal(size=(64, 64, 3))
    states = np.random.default_rng(1).uniform(-1, 1, (20, 4)) * [9, 5, 1.5, 5]
    with jax.enable_x64(True):
        loss = jax.jit(lambda s: jnp.sum(weights * SYSTEM.render(s, jnp.array([7.0]))))
        gradient, h = jax.jit(jax.grad(loss)), 1e-6
        for state in jnp.asarray(states):
            numeric = [(loss(state + d) - loss(state - d)) / (2 * h) for d in h * jnp.eye(4)]
            got = gradient(state)
            np.testing.assert_allclose(got, jnp.array(numeric), rtol=1e-4, atol=1e-4)
            assert jnp.abs(got[0]) > 1e-3
            assert jnp.abs(got[2]) > 1e-3
            assert (got[1], got[3]) == (0, 0)


@pytest.mark.parametrize("x", [-1e4, -10.0, -8.5, 0.0, 8.5, 10.0])
@pytest.mark.parametrize("theta", [-np.pi / 2, 0.0, 1e-9, np.pi / 2, 3.0])
def test_gradients_are_finite_everywhere(x, theta):
    for action in (-25.0, 0.0, 25.0):
        jacobians = JACOBIANS(jnp.array([x, 0, theta, 0]), jnp.array([action]))
        assert all(jnp.isfinite(jacobian).all() for jacobian in jacobians)


@pytest.mark.parametrize("side", [-1, 1])
def test_cart_at_eight_and_a_half_meters_is_visible(side):
    """The frame's edge cuts off at most a quarter of the cart."""

    def dark(x):
        return float((jnp.max(SYSTEM.draw(jnp.array([x, 0, 0, 0])), axis=-1) < 0.3).sum())

    assert dark(8.5 * side) >= 0.75 * dark(0.0) > 0


def test_pole_is_legible_and_never_under_the_nuisance():
    thetas = jnp.linspace(-np.pi / 2, np.pi / 2, 41)
    xs = jnp.linspace(-10, 10, 41)
    states = jnp.stack(jnp.meshgrid(xs, jnp.zeros(1), thetas, jnp.zeros(1)), -1).reshape(-1, 4)
    corners = jax.jit(jax.vmap(lambda s: SYSTEM.draw(s)[:15, :15]))(states)
    assert (corners == 1).all()
    # A tenth of a radian changes the picture by tens of pixels.
    upright, tilted = (SYSTEM.draw(jnp.array([0, 0, theta, 0])) for theta in (0.0, 0.1))
    assert jnp.abs(upright - tilted).max(axis=-1).sum() > 20


def test_pole_leans_the_way_of_its_angle():
    image = SYSTEM.draw(jnp.array([0.0, 0.0, 0.5, 0.0]))
    pole = (1 - image[:40]).sum(axis=(0, 2))  # above the cart only the pole is drawn
    assert pole[33:].sum() > 5 * pole[:31].sum()


def test_vmap_matches_loop():
    rng = np.random.default_rng(2)
    states = jnp.asarray(rng.uniform(-1, 1, (4, 4)), jnp.float32) * 3
    actions = jnp.asarray(rng.uniform(-25, 25, (4, 1)), jnp.float32)
    render = jax.jit(SYSTEM.render)
    together = jax.jit(jax.vmap(SYSTEM.render))(states, actions)
    single = jnp.stack([render(s, a) for s, a in zip(states, actions, strict=True)])
    np.testing.assert_allclose(together, single, atol=1e-5)
    frame = SYSTEM.frame(states[0], actions[0])
    assert frame.dtype == jnp.uint8
    assert np.abs(np.asarray(frame, float) / 255 - single[0]).max() < 0.51 / 255


@pytest.fixture(params=systems.names())
def shown(request):
    """A system, a state and a previous action."""
    system = systems.get(request.param)
    return system, system.sample_initial(jax.random.key(0)), 0.6 * system.limits


def resized(system, *size):
    return dataclasses.replace(system, size=size)


def test_twice_the_resolution_averages_to_the_papers_frame(shown):
    system, *moment = shown
    fine, coarse = resized(system, 128, 128).render(*moment), system.render(*moment)
    error = jnp.abs(fine.reshape(64, 2, 64, 2, 3).mean((1, 3)) - coarse)
    assert error.max() < 0.15  # at the edges, where the coarse frame smooths over its wider pixels
    assert error.mean() < 2e-3


@pytest.mark.parametrize(
    ("size", "middle"), [((48, 80), np.s_[:, 16:64]), ((80, 48), np.s_[16:64])]
)
def test_scene_is_in_the_middle_of_a_long_frame(shown, size, middle):
    """With the nuisance, and as it is in a square frame of the shorter side."""
    system, *moment = shown
    wide, square = (resized(system, *s) for s in (size, (48, 48)))
    assert wide.frame_shape == (*size, 3)
    image = wide.render(*moment)
    assert image.shape == wide.frame_shape
    np.testing.assert_allclose(image[middle], square.render(*moment), atol=1e-4)


@pytest.mark.parametrize("size", [(96, 96), (48, 80), (50, 34)])
def test_cover_hides_the_nuisance_at_any_size(shown, size):
    """Its edges too, which lie within pixels here."""
    system, state, action = shown
    system = resized(system, *size)
    one, two = system.render(state, action), system.render(state, -action)
    assert jnp.abs(one - two).max() > 0.1
    covered = system.nuisance.cover(one)
    np.testing.assert_array_equal(covered, system.nuisance.cover(two))
    np.testing.assert_array_equal(covered, system.draw(state, size))


def test_gradients_are_finite_at_another_size(shown):
    system, *moment = shown
    gradients = jax.grad(lambda *m: resized(system, 48, 80).render(*m).sum(), (0, 1))(*moment)
    assert all(jnp.isfinite(gradient).all() for gradient in gradients)
    assert jnp.abs(gradients[0]).max() > 0
