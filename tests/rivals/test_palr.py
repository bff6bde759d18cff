"""PALR: its loss is the action's error and so much of HSCIC, and its batches are large enough."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.independence.hscic import hscic
from jaxdeconf.learn import clone
from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.nets import network
from jaxdeconf.rivals import palr
from jaxdeconf.views import identity, shown
from tests.rivals import toy


def test_the_loss_is_the_error_and_the_strength_times_hscic_without_first_steps():
    data, config = shown(toy.demos(), identity, {}, None), replace(toy.CLONE, strength=3.0)
    variables = network.init(config.network, toy.KEY, (*toy.SIZE, 6), toy.A)
    indices = jnp.arange(3, 133)
    loss = jax.jit(palr.objective(config))
    value, (_, metrics) = loss(variables, data, indices, toy.KEY, jnp.int32(0))
    plain, _ = jax.jit(clone.objective(config))(variables, data, indices, toy.KEY, jnp.int32(0))
    np.testing.assert_allclose(metrics["error"], plain, rtol=1e-5)
    images = clone.stacked(config, data, indices)
    look = jax.jit(network.look, static_argnums=(0, 3))
    _, features, _ = look(config.network, variables, images, True)
    later = np.asarray(data.step[indices]) > 0
    assert 0 < later.sum() < len(later)
    expected = hscic(
        features[later], data.previous_actions[indices][later], data.actions[indices][later]
    )
    np.testing.assert_allclose(metrics["hscic"], expected, rtol=1e-2)
    np.testing.assert_allclose(value, plain + 3.0 * metrics["hscic"], rtol=1e-5)


@pytest.mark.parametrize("steps", [None, 1250])
def test_small_batches_become_larger_on_as_many_samples(steps):
    config = CloneConfig(epochs=2, steps=steps, batch_size=32, learning_rate=1e-3)
    found = palr.in_larger_batches(config)
    assert (found.batch_size, found.learning_rate, found.epochs) == (128, 2e-3, 2)
    assert found.steps == (steps and 312)
    large = replace(config, batch_size=256)
    assert palr.in_larger_batches(large) == large
