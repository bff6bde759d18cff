"""Rivals that ask, shake and redraw: what of the demonstrations each one replaces, and by what."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.deconfound import clone_policy
from jaxdeconf.keys import named
from jaxdeconf.learn.fit import finish
from jaxdeconf.method import Ask, Evidence, Price, cloning, configured, imitated
from jaxdeconf.rivals import oracles
from jaxdeconf.rivals.oracles import ROWS, replaced
from jaxdeconf.views import identity, shown
from tests.rivals import world
from tests.rivals.world import CLONE, COUNT, KEY, STEPS

ROUNDS = ("clone Dagger, round 1", "clone Dagger, round 2")


@pytest.fixture(scope="module")
def evidence():
    simulator = world.simulator()
    return Evidence(world.encoder(), exploration=world.exploration(), simulator=simulator)


@pytest.fixture(scope="module")
def demos(evidence):
    return world.demos(evidence.simulator)


def begin(name, training):
    """A watch that trains nothing."""
    return training.start(training.data())


def test_dart_gives_half_of_the_demonstrations_anew(demos, evidence):
    row = ROWS["Dart"]
    config = configured(row, CLONE)
    assert config.strength == 0.1
    found = row.data(demos, evidence, Ask(config, KEY))
    half = COUNT // 2
    for field in ("images", "actions", "previous_actions"):
        own, before = (np.asarray(getattr(one, field)) for one in (found, demos))
        np.testing.assert_allclose(own[half:], before[half:], atol=1e-7)
        assert (own[:half, 1:] != before[:half, 1:]).any(axis=tuple(range(1, own.ndim))).all()
    np.testing.assert_array_equal(found.initial_states, demos.initial_states)
    executed, intended = found.previous_actions[:half, 1:], found.actions[:half, :-1]
    noise = np.asarray(executed - intended)[np.abs(executed) < 1]
    assert noise.std() == pytest.approx(0.1, rel=0.4)
    stronger = row.data(demos, evidence, Ask(replace(config, strength=0.4), KEY))
    noise = stronger.previous_actions[:half, 1:] - stronger.actions[:half, :-1]
    assert np.abs(noise).mean() > 0.2
    assert row.price(COUNT, STEPS) == Price(half * STEPS, half)


def test_dagger_replaces_a_quarter_a_round_by_what_its_clone_did(demos, evidence):
    """Reference: the rounds one by one, each clone trained on what there was by then."""
    seen = {}

    def watch(name, training):
        state = finish(name, training)
        data = jax.tree.map(jnp.array, training.data())
        seen[name] = data, training.trained(state), training.config
        return state

    found = ROWS["Dagger"].data(demos, evidence, Ask(replace(CLONE, steps=5), KEY, watch))
    assert tuple(seen) == ROUNDS
    quarter, wanted = COUNT // 4, demos
    keys = jax.random.split(named(KEY, "clone drives"), 2)
    for turn, name in enumerate(ROUNDS):
        data, policy, config = seen[name]
        assert config == replace(CLONE, steps=2)
        before = shown(wanted, identity, {}, None)
        np.testing.assert_array_equal(data.frames, before.frames)
        np.testing.assert_array_equal(data.actions, before.actions)
        rows = slice(turn * quarter, (turn + 1) * quarter)
        driven = evidence.simulator.driven(policy, keys[turn], STEPS, rows)
        wanted = replaced(wanted, rows, evidence.simulator.labelled(driven))
        executed, labels = wanted.previous_actions[rows, 1:], wanted.actions[rows, :-1]
        assert np.abs(executed - labels).mean() > 0.1  # so short a training makes no expert
    for field in ("images", "actions", "initial_states", "previous_actions", "weights"):
        np.testing.assert_array_equal(getattr(found, field), getattr(wanted, field))
    np.testing.assert_array_equal(found.initial_states, demos.initial_states)
    half = slice(2 * quarter, None)
    np.testing.assert_array_equal(found.images[half], demos.images[half])
    np.testing.assert_array_equal(found.actions[half], demos.actions[half])
    assert ROWS["Dagger"].price(COUNT, STEPS) == Price(2 * quarter * STEPS, 2 * quarter)


def test_half_of_the_budget_is_half_of_the_epochs_where_these_count(demos, evidence):
    configs = []

    def watch(name, training):
        configs.append(training.config)
        return begin(name, training)

    config = replace(CLONE, steps=None, epochs=3.0)
    ROWS["Dagger"].data(demos, evidence, Ask(config, KEY, watch))
    assert [one.epochs for one in configs] == [1.5, 1.5]


def test_redrawn_changes_the_frames_alone(demos, evidence):
    found = ROWS["Redrawn"].data(demos, evidence, Ask(CLONE, KEY))
    for field in ("actions", "previous_actions", "initial_states"):
        np.testing.assert_array_equal(getattr(found, field), getattr(demos, field))
    assert (found.images[:, :, :4, :4] != demos.images[:, :, :4, :4]).any()
    np.testing.assert_array_equal(found.images[:, :, 4:], demos.images[:, :, 4:])


def test_episodes_that_end_early_are_replaced_up_to_there(demos, evidence):
    """So that there are as many steps as before; what falls within them has no weight."""
    valid = np.arange(STEPS) < np.where(np.arange(COUNT) == 1, 3, STEPS)[:, None]
    ragged = replace(demos, valid=valid)
    data = ROWS["Dart"].data(ragged, evidence, Ask(configured(ROWS["Dart"], CLONE), KEY))
    cloned = shown(data, identity, {}, None)
    assert len(cloned.actions) == valid.sum() == imitated(ragged.lengths, CLONE)
    assert cloned.weight.shape == (valid.sum(),)


def short(name, training):
    """A watch that trains for four steps, whatever is asked for."""
    return finish(name, training._replace(config=replace(training.config, steps=4)))


@pytest.mark.parametrize("name", ROWS)
def test_every_row_is_cloned(name, demos, evidence):
    policy = clone_policy(name, demos, evidence, KEY, CLONE, short)
    assert np.isfinite(jax.tree.leaves(policy.variables)[0]).all()
    if ROWS[name].select is not None:
        keep = np.asarray(policy.parameters["keep"])
        assert keep.shape == (3,)
        assert not keep[1]  # it is not active


@pytest.mark.parametrize("name", [name for name, row in ROWS.items() if row.select is None])
def test_its_data_can_be_traced_for_their_shapes(name, demos, evidence):
    samples = imitated(demos.lengths, CLONE)
    training = cloning(ROWS[name], lambda: demos, samples, evidence, Ask(CLONE, KEY, short))
    assert training.like is not None
    shapes = jax.eval_shape(training.like)
    made = training.data()
    assert jax.tree.map(jnp.shape, shapes) == jax.tree.map(jnp.shape, made)
    assert jax.tree.structure(shapes) == jax.tree.structure(made)


def test_the_rows_need_what_a_file_does_not_have():
    for name, row in oracles.ROWS.items():
        assert row.rival
        assert ("simulator" in row.needs) == (row.kind == "oracle"), name
