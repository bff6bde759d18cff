"""Many models in one program against `fit`, one model at a time."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh

from jaxdeconf.learn import clone, disentangle, many
from jaxdeconf.learn.clone import CloneConfig, Demonstrations
from jaxdeconf.learn.disentangle import DisentangleConfig
from jaxdeconf.learn.fit import FitConfig, FitState, fit, start
from jaxdeconf.learn.many import AXIS, Models, fit_many
from jaxdeconf.nets.resnet import ResNetConfig
from jaxdeconf.nets.vae import VAEConfig

MESH = Mesh(np.array(jax.devices()[:1]), (AXIS,))
SAMPLES = 40


def stacked(trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def least_squares(config):
    def loss(variables, data, indices, key, step):
        x, y = data
        error = x[indices] @ variables["params"]["w"] - y[indices]
        return jnp.mean(error**2), (variables["batch_stats"], {"noise": jax.random.uniform(key)})

    return loss


def regressions(count):
    """That many models, the second half of them on other data than the first; and both data."""
    x = jax.random.normal(jax.random.key(0), (2 * SAMPLES, 3))
    y = jnp.where(jnp.arange(2 * SAMPLES) < SAMPLES, x @ jnp.array([1.0, -2.0, 0.5]), x[:, 0])
    begin = [
        start({"params": {"w": jnp.zeros(3) + i}, "batch_stats": jnp.int32(0)})
        for i in range(count)
    ]
    numbers = {
        "learning_rate": jnp.linspace(0.01, 0.1, count),
        "decay": jnp.linspace(0.9, 0.5, count),
        "weight_decay": jnp.linspace(0.0, 0.2, count),
    }
    keys = jax.random.split(jax.random.key(1), count)
    first = SAMPLES * (jnp.arange(count) >= count // 2)
    return Models(stacked(begin), numbers, keys, first), (x, y)


def alone(objective, models, data, config, model):
    """What `fit` makes of one of the models."""
    own = dataclasses.replace(config, **{k: float(v[model]) for k, v in models.numbers.items()})
    first = int(models.first_sample[model])
    data = jax.tree.map(lambda a: a[first : first + SAMPLES], data)
    state = jax.tree.map(lambda a: jnp.copy(a[model]), models.state)
    *_, last = fit(objective, state, data, SAMPLES, models.key[model], own)
    return last


@pytest.mark.parametrize("at_once", [1, 2, 4])
def test_each_model_is_the_one_that_fit_makes_of_it(at_once):
    config = FitConfig(epochs=2.5, batch_size=8, chunk=3)
    models, data = regressions(4)
    expected = [alone(least_squares, models, data, config, model) for model in range(4)]
    *_, found = fit_many(least_squares, models, data, SAMPLES, config, MESH, at_once)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(stacked(expected)), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-6)


def test_weight_decay_shrinks_weights_by_its_share_of_the_learning_rate():
    config = FitConfig(epochs=1, batch_size=SAMPLES, learning_rate=0.1, weight_decay=0.5)
    begin = start({"params": {"w": jnp.array([2.0, -4.0])}, "batch_stats": jnp.int32(0)})

    def flat(_):
        return lambda variables, *_: (0.0 * variables["params"]["w"].sum(), (0, {}))

    *_, (state, _) = fit(flat, begin, jnp.zeros(SAMPLES), SAMPLES, jax.random.key(0), config)
    np.testing.assert_allclose(state.variables["params"]["w"], [1.9, -3.8], rtol=1e-6)


def test_one_that_diverges_leaves_the_others_alone():
    config = FitConfig(epochs=2, batch_size=8)
    models, data = regressions(4)
    weights = models.state.variables["params"]["w"].at[1].set(jnp.nan)
    state = models.state._replace(
        variables={"params": {"w": weights}, "batch_stats": jnp.zeros(4, jnp.int32)}
    )
    expected = [alone(least_squares, models, data, config, model) for model in (0, 2, 3)]
    *_, (found, _) = fit_many(
        least_squares, models._replace(state=state), data, SAMPLES, config, MESH
    )
    trained = found.variables["params"]["w"]
    assert jnp.isnan(trained[1]).all()
    for model, (state, _) in zip((0, 2, 3), expected, strict=True):
        np.testing.assert_allclose(trained[model], state.variables["params"]["w"], rtol=2e-6)


def policies(count):
    config = CloneConfig(
        epochs=1, batch_size=8, huber=0.1, network=ResNetConfig(width=4, stem="imagenet")
    )
    frames = jax.random.randint(jax.random.key(0), (SAMPLES, 64, 64, 3), 0, 256, jnp.uint8)
    actions = jax.random.uniform(jax.random.key(1), (SAMPLES, 1), minval=-1)
    data = Demonstrations(frames, jnp.arange(SAMPLES) % 8 == 0, actions)
    keys = jax.random.split(jax.random.key(2), count)
    begin = [clone.initial_state(config, (64, 64, 3), 1, key) for key in keys]
    numbers = {
        "learning_rate": jnp.linspace(1e-3, 3e-3, count),
        "huber": jnp.linspace(0.1, 0.4, count),
    }
    return clone.objective, config, begin, keys, numbers, data


def encoders(count):
    network = VAEConfig(channels=(4, 4, 8, 8, 8), latents=3)
    config = DisentangleConfig(epochs=1, batch_size=8, objective="H", network=network)
    images = jax.random.randint(jax.random.key(0), (SAMPLES, 64, 64, 3), 0, 256, jnp.uint8)
    keys = jax.random.split(jax.random.key(2), count)
    begin = [disentangle.initial_state(config, images, key) for key in keys]
    return (
        disentangle.objective,
        config,
        begin,
        keys,
        {"beta": jnp.linspace(1.0, 9.0, count)},
        images,
    )


@pytest.mark.slow
@pytest.mark.parametrize("networks", [policies, encoders])
def test_the_networks_train_together_as_alone(networks):
    objective, config, begin, keys, numbers, data = networks(2)
    models = Models(stacked(begin), numbers, keys, jnp.zeros(2, jnp.int32))
    expected = [alone(objective, models, data, config, model) for model in range(2)]
    *_, (_, metrics) = fit_many(objective, models, data, SAMPLES, config, MESH, at_once=2)
    # Not weights: Adam's first steps are the signs of gradients, also of those that are rounding.
    loss = [float(one["loss"]) for _, one in expected]
    np.testing.assert_allclose(metrics["loss"], loss, rtol=1e-4)


def test_it_compiles_once():
    models, data = regressions(4)
    config = FitConfig(epochs=2.6, batch_size=8, chunk=2, learning_rate=0.013)
    before = many._chunk._cache_size()
    run = partial(fit_many, least_squares, data=data, samples=SAMPLES, config=config, mesh=MESH)
    for learning_rate in (0.1, 0.2):
        own = models._replace(
            state=jax.tree.map(jnp.copy, models.state),
            numbers=models.numbers | {"learning_rate": jnp.full(4, learning_rate)},
        )
        *_, last = run(models=own)
        jax.block_until_ready(last)
    assert many._chunk._cache_size() == before + 1


@pytest.mark.parametrize(
    ("words", "change"),
    [
        ("models: expected a multiple of 1 devices × 3 at once, got 4", {"at_once": 3}),
        ("at_once: expected a positive integer, got 0", {"at_once": 0}),
        ("models: expected a Models, got None", {"models": None}),
        (
            "numbers: expected one of learning_rate, decay, weight_decay, got 'beta'",
            {"name": "beta"},
        ),
    ],
)
def test_bad_arguments_say_what_was_expected(words, change):
    models, data = regressions(4)
    if name := change.pop("name", None):
        models = models._replace(numbers={name: jnp.ones(4)})
    arguments = {"models": models, "config": FitConfig(batch_size=8), "at_once": 1} | change
    with pytest.raises(ValueError, match=words):
        next(fit_many(least_squares, data=data, samples=SAMPLES, mesh=MESH, **arguments))


def test_no_buffer_of_the_caller_is_lost_but_the_states():
    models, data = regressions(2)
    list(fit_many(least_squares, models, data, SAMPLES, FitConfig(batch_size=8), MESH))
    assert not models.key.is_deleted()
    assert isinstance(models.state, FitState)
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves(models.state.moments))
