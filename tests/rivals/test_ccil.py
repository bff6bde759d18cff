"""CCIL on latents of which it is known what causes the action. References: loops in NumPy."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.learn.fit import finish
from jaxdeconf.rivals import ccil
from jaxdeconf.rivals.ccil import CcilConfig, Samples

KEY = jax.random.key(0)
CONFIG = CcilConfig(hidden=(32,), steps=600, batch_size=128)
CAUSE, COPY, NOISE = range(3)


def samples(seed, copied):
    """The action is 0.8 of the cause. Of an expert the copy shows it almost; else it is random."""
    rng = np.random.default_rng(seed)
    now, before = rng.uniform(-1, 1, (2, 1500, 3))
    action = 0.8 * now[:, CAUSE]
    if copied:
        now[:, COPY] = action + 0.1 * rng.normal(size=1500)
    return Samples(jnp.asarray(np.stack([before, now], axis=1)), jnp.asarray(action[:, None]))


@pytest.fixture(scope="module")
def layers():
    training = ccil.training(samples(0, copied=True), CONFIG, KEY)
    return training.trained(finish("CCIL policy", training))


@pytest.fixture(scope="module")
def found(layers):
    """Answers where the copy is another's."""
    states = samples(1, copied=False)
    return ccil.answered(layers, ccil.graphs(3, KEY), states, jnp.ones(1500))


def test_every_graph_is_listed_once():
    listed = np.asarray(ccil.graphs(4, KEY)).tolist()
    assert sorted(listed) == [list(one) for one in itertools.product([0.0, 1.0], repeat=4)]
    some = np.asarray(ccil.graphs(13, KEY))
    assert some.shape == (4096, 13)
    assert set(np.unique(some)) == {0.0, 1.0}
    np.testing.assert_allclose(some.mean(axis=0), 0.5, atol=0.04)


def test_what_a_graph_leaves_out_is_not_seen(layers):
    latents = samples(2, copied=False).latents[:50]
    graph = jnp.broadcast_to(jnp.array([1.0, 0.0, 1.0]), (50, 3))
    other = latents.at[:, :, COPY].add(1.0)
    same = ccil.predict(layers, latents, graph)
    np.testing.assert_array_equal(ccil.predict(layers, other, graph), same)
    everything = jnp.ones((50, 3))
    moved = ccil.predict(layers, other, everything) - ccil.predict(layers, latents, everything)
    assert np.abs(moved).mean() > 0.1


def test_the_graph_itself_is_given(layers):
    """Of latents that are all 0 the policy knows nothing but which of them it may use."""
    nothing = jnp.zeros((2, 2, 3))
    first, second = ccil.predict(layers, nothing, jnp.array([[1.0, 0, 0], [0, 1.0, 1.0]]))
    assert first != second


def test_the_best_graph_is_the_cause_without_the_copy(found):
    assert found.best[CAUSE]
    assert not found.best[COPY]


def test_the_linear_model_agrees(found):
    assert found.linear[CAUSE]
    assert not found.linear[COPY]
    assert found.weights[CAUSE] > 2 * abs(found.weights[NOISE])
    assert -found.weights[COPY] > 2 * abs(found.weights[NOISE])


def test_on_the_experts_own_states_the_copy_would_be_kept(layers):
    """So it is the intervention that tells."""
    own = ccil.answered(layers, ccil.graphs(3, KEY), samples(3, copied=True), jnp.ones(1500))
    assert own.linear[COPY]


def test_errors_are_those_of_a_loop_over_what_counts(layers, found):
    states = samples(1, copied=False)
    weight = jnp.asarray(np.random.default_rng(5).integers(0, 2, 1500), float)
    got = ccil.answered(layers, found.graphs, states, weight)
    for graph, error in zip(np.asarray(found.graphs), np.asarray(got.errors), strict=True):
        given = np.asarray(states.latents) * graph
        x = np.concatenate([given.reshape(1500, 6), np.tile(graph, (1500, 1))], axis=1)
        hidden = np.maximum(x @ np.asarray(layers[0]["kernel"]) + layers[0]["bias"], 0)
        out = hidden @ np.asarray(layers[1]["kernel"]) + layers[1]["bias"]
        squared = np.asarray((out - states.actions) ** 2)[:, 0]
        assert error == pytest.approx(squared[np.asarray(weight) > 0].mean(), rel=1e-4)
    columns = np.column_stack([np.ones(8), found.graphs])
    slopes = np.linalg.lstsq(columns, -np.asarray(got.errors), rcond=None)[0][1:]
    np.testing.assert_allclose(got.weights, slopes, atol=1e-5)


def test_the_expert_is_asked_where_the_graphs_disagree(layers):
    latents = samples(4, copied=False).latents
    some = ccil.graphs(3, KEY)
    found = np.asarray(ccil.disagreement(layers, some, latents))
    for i in (0, 7, 99):
        alike = jnp.broadcast_to(latents[i], (8, 2, 3))
        wanted = np.var(ccil.predict(layers, alike, some))
        assert found[i] == pytest.approx(float(wanted), rel=1e-3)


def test_ridge_is_that_of_the_augmented_system():
    rng = np.random.default_rng(6)
    every = rng.integers(0, 2, (9, 4)).astype(float)
    returns = rng.normal(size=9)
    rows = np.vstack([np.column_stack([np.ones(9), every]), np.eye(5)[1:]])
    wanted = np.linalg.lstsq(rows, np.append(returns, np.zeros(4)), rcond=None)[0][1:]
    np.testing.assert_allclose(
        ccil.ridge(jnp.asarray(every), jnp.asarray(returns)), wanted, atol=1e-5
    )


def test_a_single_round_says_nothing():
    weights = ccil.ridge(jnp.array([[1.0, 0.0]]), jnp.array([-30.0]))
    np.testing.assert_array_equal(weights, [0.0, 0.0])
