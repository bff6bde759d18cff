"""Many models in one program against `fit`, one model at a time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh

from jaxdeconf.learn import clone, disentangle
from jaxdeconf.learn.clone import CloneConfig, Demonstrations
from jaxdeconf.learn.disentangle import DisentangleConfig
from jaxdeconf.learn.fit import FitConfig, FitState, fit, start
from jaxdeconf.learn.many import AXIS, Models, fit_many
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.views import identity

MESH = Mesh(np.array(jax.devices()[:1]), (AXIS,))
SAMPLES = 40


def stacked(trees):
    return jax.tree.map(lambda *leaves: jnp.stack(jnp.asarray(leaves)), *trees)


def least_squares(config):
    def loss(variables, data, indices, key, step):
        x, y = data
        error = x[indices] @ variables["params"]["w"] - y[indices]
        return jnp.mean(error**2), (variables["batch_stats"], {"noise": jax.random.uniform(key)})

    return loss


def regressions(count, **structure):
    """That many models, the second half of them on other data than the first; and both data.

    Also the config of each, alone.
    """
    x = jax.random.normal(jax.random.key(0), (2 * SAMPLES, 3))
    y = jnp.where(jnp.arange(2 * SAMPLES) < SAMPLES, x @ jnp.array([1.0, -2.0, 0.5]), x[:, 0])
    begin = [
        start({"params": {"w": jnp.zeros(3) + i}, "batch_stats": jnp.int32(0)})
        for i in range(count)
    ]
    numbers = np.linspace((0.01, 0.9, 0.0), (0.1, 0.5, 0.2), count).tolist()
    configs = [
        FitConfig(learning_rate=rate, decay=decay, weight_decay=weight_decay, **structure)
        for rate, decay, weight_decay in numbers
    ]
    keys = jax.random.split(jax.random.key(1), count)
    first = SAMPLES * (jnp.arange(count) >= count // 2)
    return Models(stacked(begin), stacked(configs), keys, first), (x, y), configs


def alone(objective, models, data, configs, model):
    """What `fit` makes of one of the models."""
    first = int(models.first_sample[model])
    data = jax.tree.map(lambda a: a[first : first + SAMPLES], data)
    state = jax.tree.map(lambda a: jnp.copy(a[model]), models.state)
    *_, last = fit(objective, state, data, SAMPLES, models.key[model], configs[model])
    return last


@pytest.mark.parametrize("at_once", [1, 2, 4])
def test_each_model_is_the_one_that_fit_makes_of_it(at_once):
    models, data, configs = regressions(4, epochs=2.5, batch_size=8, chunk=3)
    expected = [alone(least_squares, models, data, configs, model) for model in range(4)]
    *_, found = fit_many(least_squares, models, data, SAMPLES, MESH, at_once)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(stacked(expected)), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-6)


def test_a_budget_in_steps_is_that_of_fit():
    models, data, configs = regressions(2, steps=7, batch_size=8, chunk=3)
    expected = [alone(least_squares, models, data, configs, model) for model in range(2)]
    *_, (found, _) = fit_many(least_squares, models, data, SAMPLES, MESH)
    np.testing.assert_array_equal(found.step, [7, 7])
    weights = stacked([state.variables["params"]["w"] for state, _ in expected])
    np.testing.assert_allclose(found.variables["params"]["w"], weights, rtol=2e-6)


def test_weight_decay_shrinks_weights_by_its_share_of_the_learning_rate():
    config = FitConfig(epochs=1, batch_size=SAMPLES, learning_rate=0.1, weight_decay=0.5)
    begin = start({"params": {"w": jnp.array([2.0, -4.0])}, "batch_stats": jnp.int32(0)})

    def flat(_):
        return lambda variables, *_: (0.0 * variables["params"]["w"].sum(), (0, {}))

    *_, (state, _) = fit(flat, begin, jnp.zeros(SAMPLES), SAMPLES, jax.random.key(0), config)
    np.testing.assert_allclose(state.variables["params"]["w"], [1.9, -3.8], rtol=1e-6)


def test_one_that_diverges_leaves_the_others_alone():
    models, data, configs = regressions(4, epochs=2.5, batch_size=8, chunk=3)
    weights = models.state.variables["params"]["w"].at[1].set(jnp.nan)
    state = models.state._replace(
        variables={"params": {"w": weights}, "batch_stats": jnp.zeros(4, jnp.int32)}
    )
    expected = [alone(least_squares, models, data, configs, model) for model in (0, 2, 3)]
    *_, (found, _) = fit_many(least_squares, models._replace(state=state), data, SAMPLES, MESH)
    trained = found.variables["params"]["w"]
    assert jnp.isnan(trained[1]).all()
    for model, (state, _) in zip((0, 2, 3), expected, strict=True):
        np.testing.assert_allclose(trained[model], state.variables["params"]["w"], rtol=2e-6)


def policies():
    frames = jax.random.randint(jax.random.key(0), (SAMPLES, 16, 16, 3), 0, 256, jnp.uint8)
    actions = jax.random.uniform(jax.random.key(1), (SAMPLES, 1), minval=-1)
    data = Demonstrations(frames, jnp.arange(SAMPLES) % 8, actions)
    network = NetworkConfig(width=4, stem="imagenet", stages=1, norm="none")
    configs = [
        CloneConfig(epochs=1, batch_size=8, huber=huber, learning_rate=rate, network=network)
        for huber, rate in ((0.1, 1e-3), (0.4, 3e-3))
    ]
    keys = jax.random.split(jax.random.key(2), 2)
    each = zip(configs, keys, strict=True)
    trainings = [clone.training(c, lambda: data, SAMPLES, identity, {}, key) for c, key in each]
    return trainings, data


def encoders():
    network = VAEConfig(channels=(4,), latents=3)
    images = jax.random.randint(jax.random.key(0), (SAMPLES, 16, 16, 3), 0, 256, jnp.uint8)
    configs = [
        DisentangleConfig(epochs=1, batch_size=8, objective="H", beta=beta, network=network)
        for beta in (1.0, 9.0)
    ]
    keys = jax.random.split(jax.random.key(2), 2)
    each = zip(configs, keys, strict=True)
    trainings = [
        disentangle.training(c, lambda: images, SAMPLES, lambda: images, key) for c, key in each
    ]
    return trainings, images


@pytest.mark.slow
@pytest.mark.parametrize("networks", [policies, encoders])
def test_the_networks_train_together_as_alone(networks):
    trainings, data = networks()
    first = trainings[0]
    configs = [training.config for training in trainings]
    models = Models(
        stacked([training.start(data) for training in trainings]),
        stacked(configs),
        jnp.stack([training.key for training in trainings]),
        jnp.zeros(2, jnp.int32),
    )
    expected = [alone(first.objective, models, data, configs, model) for model in range(2)]
    *_, (_, metrics) = fit_many(first.objective, models, data, SAMPLES, MESH, at_once=2)
    # Not weights: Adam's first steps are the signs of gradients, also of those that are rounding.
    loss = [float(one["loss"]) for _, one in expected]
    np.testing.assert_allclose(metrics["loss"], loss, rtol=1e-4)


def test_one_program_serves_all_chunks_and_all_traced_numbers():
    traces = []

    def counted(config):
        loss = least_squares(config)

        def count(*arguments):
            traces.append(config)
            return loss(*arguments)

        return count

    models, data, _ = regressions(4, epochs=2.6, batch_size=8, chunk=2)
    seen = []
    for learning_rate in (0.1, 0.2):
        config = jax.tree.map(lambda leaf, r=learning_rate: jnp.full(4, r), models.config)
        own = models._replace(state=jax.tree.map(jnp.copy, models.state), config=config)
        *_, last = fit_many(counted, own, data, SAMPLES, MESH)
        jax.block_until_ready(last)
        seen.append(len(traces))
    assert 0 < seen[0] == seen[1]


def test_as_many_models_as_fill_the_devices():
    models, data, _ = regressions(4, batch_size=8)
    words = "models: expected a multiple of 1 devices × 3 at once, got 4"
    with pytest.raises(ValueError, match=words):
        next(fit_many(least_squares, models, data, SAMPLES, MESH, at_once=3))


def test_no_buffer_of_the_caller_is_lost_but_the_states():
    models, data, _ = regressions(2, batch_size=8)
    list(fit_many(least_squares, models, data, SAMPLES, MESH))
    assert not models.key.is_deleted()
    assert isinstance(models.state, FitState)
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves(models.state.moments))
