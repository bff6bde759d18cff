"""The coloured square: its size, its colour, its white cover, its gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import systems
from jaxdeconf.vision.nuisance import ColorSquare, JoystickDot

SYSTEM = systems.get("cartpole")
GREY = jnp.full((64, 64, 3), 0.5)


@pytest.mark.parametrize(
    ("signal", "color"),
    [(-1, (0, 1, 0)), (1, (1, 0, 0)), (0, (0.5, 0.5, 0)), (0.5, (0.75, 0.25, 0))],
)
def test_square_is_fifteen_pixels_from_green_to_red(signal, color):
    image = ColorSquare().draw(GREY, jnp.array([signal]))
    np.testing.assert_allclose(image[:15, :15], np.broadcast_to(color, (15, 15, 3)), atol=1e-6)
    np.testing.assert_array_equal(image.at[:15, :15].set(0.5), GREY)


def test_color_follows_the_previous_action_linearly():
    actions = jnp.linspace(-25, 25, 11)[:, None]
    images = jax.vmap(SYSTEM.render, (None, 0))(jnp.zeros(4), actions)
    steps = jnp.diff(images[:, 7, 7], axis=0)
    np.testing.assert_allclose(steps, np.tile([0.1, -0.1, 0.0], (10, 1)), atol=1e-6)
    # Nothing but the square shows the action.
    outside = images.at[:, :15, :15].set(0)
    np.testing.assert_array_equal(outside, jnp.broadcast_to(outside[:1], outside.shape))


def test_cover_removes_the_previous_action_exactly():
    state = jnp.array([1.0, 0.0, 0.3, 0.0])
    left, right = (SYSTEM.render(state, jnp.array([action])) for action in (-25.0, 13.0))
    assert (left != right).any()
    covered = SYSTEM.nuisance.cover(left)
    np.testing.assert_array_equal(covered, SYSTEM.nuisance.cover(right))
    # The square hides nothing of the state: under it the frame is white anyway.
    np.testing.assert_array_equal(covered, SYSTEM.draw(state))


def test_gradients_match_finite_differences():
    """In corner and colour, the two ways in which a nuisance could move."""
    with jax.enable_x64(True):
        weights = jnp.asarray(np.random.default_rng(0).normal(size=(64, 64, 3)))
        image = jnp.asarray(GREY, float)
        at, h = jnp.array([3.3, 5.8, 0.2, 0.9, 0.4]), 1e-5
        loss = jax.jit(lambda p: jnp.sum(weights * ColorSquare().paint(image, p[:2], p[2:])))
        numeric = jnp.array([(loss(at + d) - loss(at - d)) / (2 * h) for d in h * jnp.eye(5)])
        gradient = jax.grad(loss)(at)
        np.testing.assert_allclose(gradient, numeric, rtol=1e-6, atol=1e-6)
        assert jnp.abs(gradient).min() > 1e-2
        # The default corner lies on pixel edges: there too nothing is NaN.
        assert jnp.isfinite(jax.grad(loss)(jnp.array([0.0, 0.0, 0.2, 0.9, 0.4]))).all()


@pytest.mark.parametrize(
    ("signal", "place"), [((0, 0), (7.5, 7.5)), ((1, 0), (11.5, 7.5)), ((-1, 0.5), (3.5, 5.5))]
)
def test_joystick_dot_is_where_the_actions_point(signal, place):
    image = JoystickDot().draw(jnp.ones((64, 64, 3)), jnp.array(signal, float))
    np.testing.assert_array_equal(image[..., 0], 1.0)  # red on white
    np.testing.assert_array_equal(image[..., 1], image[..., 2])
    weight, centers = 1.0 - image[..., 1], np.arange(64) + 0.5
    found = np.stack([weight.sum(0) @ centers, weight.sum(1) @ centers]) / weight.sum()
    np.testing.assert_allclose(found, place, atol=0.02)
    np.testing.assert_allclose(weight.sum(), np.pi * 9, rtol=0.02)


def test_joystick_dot_stays_in_its_corner_and_is_covered():
    signals = jnp.array([[a, b] for a in (-1.0, 1.0) for b in (-1.0, 1.0)])
    for signal in signals:
        image = JoystickDot().draw(GREY, signal)
        np.testing.assert_array_equal(image.at[:15, :15].set(0.5), GREY)
        np.testing.assert_array_equal(JoystickDot().cover(image)[:15, :15], 1.0)


def test_joystick_dot_has_gradients_in_its_position():
    with jax.enable_x64(True):
        weights = jnp.asarray(np.random.default_rng(0).normal(size=(64, 64, 3)))
        loss = jax.jit(lambda s: jnp.sum(weights * JoystickDot().draw(jnp.asarray(GREY, float), s)))
        at, h = jnp.array([0.3, -0.8]), 1e-6
        numeric = jnp.array([(loss(at + d) - loss(at - d)) / (2 * h) for d in h * jnp.eye(2)])
        np.testing.assert_allclose(jax.grad(loss)(at), numeric, rtol=1e-5)
        assert jnp.abs(numeric).min() > 1e-2
