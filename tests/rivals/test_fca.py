"""FCA: one gradient that improves the adversary and worsens its features."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxdeconf.learn import clone
from jaxdeconf.method import Evidence
from jaxdeconf.nets import network
from jaxdeconf.rivals import fca
from jaxdeconf.views import identity, shown
from tests.rivals import toy


def test_the_reversal_is_the_identity_whose_gradient_is_turned():
    x = jnp.array([0.3, -1.7, 1e-20])

    def f(x):
        return jnp.sin(x).sum()

    np.testing.assert_array_equal(fca.reverse(x, 2.5), x)
    found = jax.grad(lambda x: f(fca.reverse(x, 2.5)))(x)
    each = 1e-2 * np.eye(3)
    by_differences = [(f(x + e) - f(x - e)) / 2e-2 for e in each]
    np.testing.assert_allclose(found, -2.5 * np.array(by_differences), rtol=1e-3)


def test_the_adversary_learns_by_its_error_and_the_features_by_the_opposite():
    data, strength = shown(toy.demos(), identity, {}, None), 0.7
    config = replace(toy.CLONE, strength=strength)
    first = network.init(config.network, toy.KEY, (*toy.SIZE, 6), toy.A)
    variables = fca.begin(first, Evidence(), toy.KEY)
    assert variables["params"]["adversary"]["hidden"]["kernel"].shape == (2 + toy.A, 300)
    indices, at = jnp.arange(40), (toy.KEY, jnp.int32(0))
    later = np.flatnonzero(np.asarray(data.step[indices]) > 0)

    @jax.jit
    @jax.value_and_grad
    def of_the_loss(params):
        return fca.objective(config)({**variables, "params": params}, data, indices, *at)[0]

    @jax.jit
    def errors(params):
        """The two errors of which the gradient is made, written out: [], []."""
        images = clone.stacked(config, data, indices)
        own = {**variables, "params": params}
        error, x, _ = clone.imitate(config, own, data, indices, images)
        x = jnp.concatenate([x, data.actions[indices]], axis=1)
        layers = params["adversary"]
        x = x @ layers["hidden"]["kernel"] + layers["hidden"]["bias"]
        guess = jnp.where(x > 0, x, 0.2 * x) @ layers["head"]["kernel"] + layers["head"]["bias"]
        return error, jnp.mean((guess - data.previous_actions[indices])[later] ** 2)

    params = variables["params"]
    value, found = of_the_loss(params)
    own, against = (jax.grad(lambda p, i=i: errors(p)[i])(params) for i in (0, 1))
    np.testing.assert_allclose(value, sum(errors(params)), rtol=1e-5)
    for name in params:
        sign = 1.0 if name == "adversary" else -strength
        expected = jax.tree.map(lambda a, b, sign=sign: a + sign * b, own[name], against[name])
        for a, b in zip(jax.tree.leaves(found[name]), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6)
    assert max(jnp.abs(leaf).max() for leaf in jax.tree.leaves(against["stem"])) > 1e-4


def test_with_first_steps_alone_there_is_nothing_to_tell():
    data = shown(toy.demos(), identity, {}, 1)
    config = replace(toy.CLONE, strength=1.0)
    first = network.init(config.network, toy.KEY, (*toy.SIZE, 6), toy.A)
    loss = jax.jit(fca.objective(config))
    variables = fca.begin(first, Evidence(), toy.KEY)
    _, (_, metrics) = loss(variables, data, jnp.arange(40), toy.KEY, jnp.int32(0))
    assert metrics["adversary"] == 0.0
