"""The training loop against Adam in NumPy, and its promise that chunks do not matter."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.learn.fit import FitConfig, Training, finish, fit, start

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


def test_the_average_forgets_as_it_is_told_but_its_first_steps_faster(data):
    config = FitConfig(epochs=30, batch_size=SAMPLES, learning_rate=0.1, chunk=1, average=0.8)
    weights = {"params": {"w": jnp.zeros(SIZE)}, "batch_stats": jnp.float32(0)}
    state = start({**weights, "frozen": jnp.ones(1)}, averaged=True)
    expected, statistics = np.zeros(SIZE), 0.0
    for reached, _ in fit(least_squares, state, data, SAMPLES, jax.random.key(1), config):
        step = int(reached.step) - 1
        kept = min(0.8, (1 + step) / (10 + step))
        expected = kept * expected + (1 - kept) * np.asarray(reached.variables["params"]["w"])
        statistics = kept * statistics + (1 - kept) * (step + 1)
        assert reached.best.keys() == {"params", "batch_stats"}
        np.testing.assert_allclose(reached.best["params"]["w"], expected, rtol=1e-5)
        np.testing.assert_allclose(reached.best["batch_stats"], statistics, rtol=1e-5)
    plain, _ = last(replace(config, average=None), data)
    assert plain.average is None
    assert plain.best["params"]["w"] is plain.variables["params"]["w"]
    np.testing.assert_array_equal(reached.variables["params"]["w"], plain.best["params"]["w"])


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


def test_one_program_serves_all_chunks_and_all_traced_numbers(data):
    traces = []

    def counted(config):
        loss = least_squares(config)

        def count(*arguments):
            traces.append(config)
            return loss(*arguments)

        return count

    def weights(rate, decay=0.9, weight_decay=0.0, **structure):
        numbers = {"learning_rate": rate, "decay": decay, "weight_decay": weight_decay}
        config = FitConfig(**{"epochs": 2.6, "batch_size": 8, "chunk": 2, **numbers, **structure})
        *_, (state, _) = fit(counted, begin(), data, SAMPLES, jax.random.key(1), config, (3, 9))
        return state.variables["params"]["w"]

    first, after_one = weights(0.011), len(traces)
    assert after_one > 0
    for numbers in ((0.022,), (0.011, 0.5), (0.011, 0.9, 0.1)):
        assert (weights(*numbers) != first).all()
    assert len(traces) == after_one
    weights(0.011, batch_size=10)
    assert len(traces) > after_one


def rates(samples, **config):
    """The learning rate of every step: under a constant gradient, Adam moves by it."""

    def slope(_):
        return lambda variables, *_: (variables["params"]["w"].sum(), (0, {}))

    config, key = FitConfig(batch_size=8, chunk=1, **config), jax.random.key(0)
    begin = start({"params": {"w": jnp.zeros(1)}, "batch_stats": 0})
    chunks = fit(slope, begin, None, samples, key, config)
    moved = [float(state.variables["params"]["w"][0]) for state, _ in chunks]
    return -np.diff([0.0, *moved])


@pytest.mark.parametrize("samples", [8, 40, 4000])
def test_a_budget_in_steps_is_one_whatever_the_number_of_samples(samples):
    found = rates(samples, steps=12, epochs=3.0, learning_rate=0.1, decay=0.05)
    np.testing.assert_allclose(found, 0.1 * 0.05 ** (np.arange(12) / 12), rtol=1e-4)
    assert FitConfig(steps=12, batch_size=8).total_steps(samples) == 12


def test_without_one_the_learning_rate_decays_by_the_epoch():
    found = rates(40, epochs=2.4, learning_rate=0.1, decay=0.5)  # five steps an epoch
    np.testing.assert_allclose(found, 0.1 * 0.5 ** (np.arange(12) / 5), rtol=1e-4)
    assert FitConfig(epochs=2.4, batch_size=8).total_steps(47) == 12
    assert FitConfig(epochs=1e-9, batch_size=8).total_steps(47) == 1


def training(data, made, **config):
    def make(name, value):
        made.append(name)
        return value

    return Training(
        least_squares,
        FitConfig(batch_size=8, **config),
        SAMPLES,
        jax.random.key(1),
        lambda: make("data", data),
        lambda given: make("start", begin()) if given is data else None,
        lambda state: state.variables["params"]["w"],
    )


def test_a_training_makes_nothing_before_it_begins_and_no_start_when_it_resumes(data):
    made = []
    asked = training(data, made, epochs=2, chunk=3)
    chunks = asked.chunks("it")
    assert made == []
    state, metrics = next(chunks)
    assert made == ["data", "start"]
    assert {name: type(value) for name, value in metrics.items()} == {"loss": float, "noise": float}
    *_, (resumed, _) = asked.chunks("it", jax.tree.map(jnp.copy, state))
    assert made == ["data", "start", "data"]
    whole, _ = last(FitConfig(batch_size=8, epochs=2, chunk=3), data)
    for found in (resumed, finish("it", asked)):
        assert jax.tree.all(jax.tree.map(lambda a, b: (a == b).all(), whole, found))
    np.testing.assert_array_equal(asked.trained(resumed), whole.variables["params"]["w"])


def test_a_training_stops_where_it_is_asked_to(data):
    chunks = training(data, [], epochs=2, chunk=4).chunks("it", stops=(1, 6, 7))
    assert [int(state.step) for state, _ in chunks] == [1, 5, 6, 7, 10]


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_is_told_with_its_name_and_step(data, value):
    x, y = data
    chunks = training((x, y + value), [], chunk=2).chunks("clone Masked")
    with pytest.raises(FloatingPointError, match=r"^clone Masked, step 2: loss is (nan|inf)$"):
        next(chunks)


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
