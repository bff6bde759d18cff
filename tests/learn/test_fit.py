"""The training loop against Adam in NumPy, and its promise that chunks do not matter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.learn import fit as fitting
from jaxdeconf.learn.fit import FitConfig, fit, start

SAMPLES, SIZE = 40, 3


def least_squares(config):
    def loss(variables, data, indices, key, step):
        x, y = data
        error = x[indices] @ variables["params"]["w"] - y[indices]
        return jnp.mean(error**2), (
            variables["batch_stats"] + 1,
            {"noise": jax.random.uniform(key)},
        )

    return loss


@pytest.fixture
def data():
    x = jax.random.normal(jax.random.key(0), (SAMPLES, SIZE))
    return x, x @ jnp.array([1.0, -2.0, 0.5])


def begin():
    return start({"params": {"w": jnp.zeros(SIZE)}, "batch_stats": jnp.int32(0)})


def last(config, data, state=None, stops=()):
    *_, final = fit(
        least_squares, state or begin(), data, SAMPLES, jax.random.key(1), config, stops
    )
    return final


def test_a_step_is_adam_with_exponential_decay(data):
    config = FitConfig(epochs=2, batch_size=SAMPLES, learning_rate=0.1, decay=0.5)
    state, _ = last(config, data)
    x, y = (np.asarray(a, np.float64) for a in data)
    w, m, v = np.zeros(SIZE), np.zeros(SIZE), np.zeros(SIZE)
    for step in range(2):  # one step an epoch, every sample in it: the order does not matter
        gradient = 2 * x.T @ (x @ w - y) / SAMPLES
        m, v = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient**2
        corrected = m / (1 - 0.9 ** (step + 1)), v / (1 - 0.999 ** (step + 1))
        w = w - 0.1 * 0.5**step * corrected[0] / (np.sqrt(corrected[1]) + 1e-8)
    np.testing.assert_allclose(state.variables["params"]["w"], w, rtol=1e-5)
    assert state.variables["batch_stats"] == 2


def test_it_learns(data):
    state, metrics = last(FitConfig(epochs=100, batch_size=8, learning_rate=0.05), data)
    np.testing.assert_allclose(state.variables["params"]["w"], [1.0, -2.0, 0.5], atol=1e-2)
    assert metrics["loss"] < 1e-3


@pytest.mark.parametrize(("chunk", "stops"), [(1, ()), (3, ()), (64, (2, 4, 12)), (64, (7,))])
def test_neither_chunks_nor_stops_change_a_bit(data, chunk, stops):
    whole, _ = last(FitConfig(epochs=2.5, batch_size=8, chunk=64), data)
    split, _ = last(FitConfig(epochs=2.5, batch_size=8, chunk=chunk), data, stops=stops)
    assert int(split.step) == 12
    assert jax.tree.all(jax.tree.map(lambda a, b: (a == b).all(), whole, split))


def test_it_resumes_where_it_stopped_to_the_last_bit(data):
    config = FitConfig(epochs=2, batch_size=8, chunk=2)
    chunks = fit(least_squares, begin(), data, SAMPLES, jax.random.key(1), config)
    for _ in range(2):
        state, _ = next(chunks)
    resumed, _ = last(config, data, jax.tree.map(jnp.copy, state))
    whole, _ = last(config, data)
    assert jax.tree.all(jax.tree.map(lambda a, b: (a == b).all(), whole, resumed))


def test_an_epoch_shows_every_sample_once():
    seen = []

    def loss(variables, data, indices, key, step):
        jax.debug.callback(lambda i: seen.extend(i.tolist()), indices)
        return jnp.sum(variables["params"]["w"] ** 2), (0, {})

    state = start({"params": {"w": jnp.zeros(1)}, "batch_stats": 0})
    config = FitConfig(epochs=2, batch_size=10)
    for chunk in fit(lambda _: loss, state, None, SAMPLES, jax.random.key(0), config):
        jax.block_until_ready(chunk)
    jax.effects_barrier()
    first, second = seen[:SAMPLES], seen[SAMPLES:]
    assert sorted(first) == sorted(second) == list(range(SAMPLES))
    assert first != second


def test_it_compiles_once(data):
    before = fitting._chunk._cache_size()
    last(FitConfig(epochs=2.6, batch_size=8, chunk=2, learning_rate=0.011), data, stops=(3, 9))
    assert fitting._chunk._cache_size() == before + 1


@pytest.mark.parametrize(
    ("field", "value"),
    [("epochs", 0), ("batch_size", 0), ("learning_rate", -1.0), ("decay", 0.0), ("chunk", -1)],
)
def test_a_bad_config_names_the_field_and_the_value(field, value):
    with pytest.raises(ValueError, match=rf"{field}: expected .*{value}"):
        FitConfig(**{field: value})


def test_too_few_samples_for_a_batch():
    with pytest.raises(ValueError, match="batch_size: expected at most 40 samples, got 64"):
        FitConfig(batch_size=64).steps_per_epoch(SAMPLES)
