"""Closed-loop scores against what they are by definition."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import evaluate, systems
from jaxdeconf.evaluate import EvaluateConfig
from jaxdeconf.learn.clone import Policy
from jaxdeconf.nets import network
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.systems.signal import SIGNALS
from jaxdeconf.views import covered, identity

SIZE = (16, 16)
SYSTEM = replace(systems.get("cartpole"), size=SIZE)
# With a nuisance that does not show the previous action.
SHORT = replace(SYSTEM, steps=6, signal=SIGNALS["two_steps_ago"])
NETWORK = NetworkConfig(width=4, stem="imagenet", stages=1, norm="none")
# Not a network: the tests that put a function of their own in its place name it, so that nothing
# compiled before is taken for it.
FUNCTION = NetworkConfig(width=17)


@pytest.fixture(scope="module")
def policy():
    variables = network.init(NETWORK, jax.random.key(0), (*SIZE, 6), 1)
    return Policy(identity, NETWORK, 2, {}, variables)


@pytest.fixture(scope="module")
def initial_states():
    return jax.vmap(SYSTEM.sample_initial)(jax.random.split(jax.random.key(1), 3))


@pytest.fixture(scope="module")
def driven(policy, initial_states):
    return evaluate.drive(SYSTEM, policy, initial_states, jax.random.key(2))


def test_a_policy_drives_as_a_plain_loop_does(policy, initial_states, driven):
    apply = jax.jit(lambda images: network.apply(NETWORK, policy.variables, images, train=False)[0])
    state = initial_states[0]
    previous_action = driven.signals[0, 0]
    previous = jnp.zeros((1, *SIZE, 3), jnp.uint8)
    for t in range(6):
        current = SYSTEM.frame(state, previous_action)[None]
        images = jnp.concatenate([previous, current], axis=-1) / 255
        previous_action = jnp.clip(apply(images)[0] * 25.0, -25.0, 25.0)
        np.testing.assert_allclose(driven.states[0, t], state, atol=1e-3)
        np.testing.assert_allclose(driven.actions[0, t], previous_action, atol=1e-2)
        state, previous = SYSTEM.step(state, previous_action), current


@pytest.mark.parametrize("frames", [1, 3])
def test_a_policy_sees_the_last_frames_in_order_and_blank_ones_before(
    frames, initial_states, monkeypatch
):
    """The red of each frame's nuisance moves the action by a weight of its own."""

    def apply(network, weights, images, train):
        return jnp.tanh(images[:, 1, 1, ::3] @ weights)[:, None], {}

    monkeypatch.setattr(network, "apply", apply)
    weights = np.array([3.0, -0.7, -1.1], np.float32)[-frames:]

    def upside_down(_, images):
        return 1.0 - images

    policy = Policy(upside_down, FUNCTION, frames, {}, jnp.asarray(weights))
    found = evaluate.drive(SHORT, policy, initial_states, jax.random.key(2))
    for r in range(3):
        reds = [0.0] * (frames - 1)  # blank, and not what the view would make of it
        for t in range(SHORT.steps):
            image = SHORT.frame(found.states[r, t], found.signals[r, t])
            reds.append((255 - int(image[1, 1, 0])) / 255)
            action = 25.0 * np.tanh(np.dot(reds[-frames:], weights))
            np.testing.assert_allclose(found.actions[r, t, 0], action, atol=1e-3)
    assert np.asarray(found.actions).std() > 1.0


def test_the_initial_states_and_the_nuisance_there_are_shared(initial_states, driven, monkeypatch):
    monkeypatch.setattr(network, "apply", lambda *a, train: (jnp.ones((1, 1)), {}))
    other = Policy(covered(SYSTEM.nuisance.cover), FUNCTION, 2, {}, {})
    second = evaluate.drive(SYSTEM, other, initial_states, jax.random.key(2))
    np.testing.assert_array_equal(driven.states[:, 0], initial_states)
    np.testing.assert_array_equal(driven.states[:, 0], second.states[:, 0])
    np.testing.assert_array_equal(driven.signals[:, 0], second.signals[:, 0])


def test_rollouts_of_many_programs_are_those_of_one(policy):
    states = 0.1 * jax.random.normal(jax.random.key(4), (27, 4))
    many, fewer = (
        evaluate.drive(SHORT, policy, some, jax.random.key(2)) for some in (states, states[:25])
    )
    for found, first in zip(many, fewer, strict=True):
        assert len(found) == 27
        np.testing.assert_array_equal(found[:25], first)
    keys = jax.random.split(jax.random.key(2), 27)
    at_once = evaluate._drive(SHORT, policy, states, keys)
    np.testing.assert_allclose(many.states, at_once.states, atol=1e-4)


def test_rollout_loss_charges_the_cost_of_the_exit_for_the_rest(driven):
    losses, ended = evaluate.rollout_loss(SYSTEM, driven), 0
    for r in range(3):
        costs, states, actions = [], np.asarray(driven.states[r]), np.asarray(driven.actions[r])
        for t in range(100):
            x, x_dot, theta, theta_dot = states[t]
            cost = x**2 + 0.1 * x_dot**2 + 10 * theta**2 + 0.1 * theta_dot**2
            costs.append(cost + 0.01 * actions[t, 0] ** 2)
            if abs(x) > 10 or abs(theta) > np.pi / 2:
                costs += [costs[-1]] * (99 - t)
                ended += 1
                break
        assert len(costs) == 100
        assert losses[r] == pytest.approx(np.mean(costs), rel=1e-4)
        assert evaluate.outcome(SYSTEM, driven)[r] == (abs(states[-1, 2]) <= np.pi / 2)
    assert ended  # an untrained policy drops the pole


def test_all_starts_and_times_come_in_turn(driven):
    many = jax.tree.map(lambda a: jnp.tile(a, (20, *[1] * (a.ndim - 1))), driven)
    many = many._replace(signals=jnp.broadcast_to(jnp.arange(100.0)[:, None], many.signals.shape))
    found = evaluate.in_turns(many, 25)
    assert found.valid.shape == (60, 25)
    times = np.asarray(found.signals[..., 0])
    np.testing.assert_array_equal(np.diff(times), 1.0)
    assert np.bincount(times.astype(int).ravel(), minlength=100).min() > 0
    for r in range(60):
        own = many.states[r, int(times[r, 0]) : int(times[r, -1]) + 1]
        np.testing.assert_array_equal(found.states[r], own)
    assert evaluate.in_turns(many, 500).valid.shape == (60, 100)


def redness(images):
    """[B] what the nuisance of the present frame shows, read off its middle: -1 green, +1 red."""
    return (images[:, 1, 1, -3] - 0.5) * 2.0


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_copycat_compares_all_successive_frames_with_the_same_under_another_nuisance(
    frames, driven, monkeypatch
):
    seen = []

    def apply(network, scale, images, train):
        jax.debug.callback(lambda images: seen.append(np.asarray(images)), images, ordered=True)
        return scale * redness(images)[:, None], {}

    monkeypatch.setattr(network, "apply", apply)
    trajectories = jax.tree.map(lambda a: a[:, :5], driven)
    policy = Policy(identity, FUNCTION, frames, {}, 0.5)
    score = evaluate.copycat(SYSTEM, policy, trajectories, jax.random.key(3))
    jax.effects_barrier()
    assert len(seen) == 6  # the frames of each trajectory, and then the same redrawn
    changes = []
    for r, (shown, redrawn) in enumerate(zip(seen[:3], seen[3:], strict=True)):
        assert shown.shape == redrawn.shape == (5 - frames + 1, *SIZE, 3 * frames)
        for begin in range(5 - frames + 1):
            for i in range(frames):
                t, channels = begin + i, slice(3 * i, 3 * i + 3)
                image = SYSTEM.frame(trajectories.states[r, t], trajectories.signals[r, t])
                np.testing.assert_allclose(shown[begin, ..., channels], image / 255, atol=1e-6)
                different = shown[begin, ..., channels] != redrawn[begin, ..., channels]
                assert different[:4, :4].any()
                assert not different[4:].any()
                assert not different[:, 4:].any()
        # What is redrawn is the nuisance of a frame, whatever frames it is seen with.
        np.testing.assert_array_equal(redrawn[1:, ..., :-3], redrawn[:-1, ..., 3:])
        changes.append(np.abs(redness(shown) - redness(redrawn)) * 0.5)
    assert score == pytest.approx(np.mean(changes), rel=1e-4)


def test_copycat_is_zero_for_a_covered_nuisance_and_that_of_chance_for_a_pure_copy(
    driven, monkeypatch
):
    monkeypatch.setattr(network, "apply", lambda *a, train: (redness(a[2])[:, None], {}))
    blind = Policy(covered(SYSTEM.nuisance.cover), FUNCTION, 2, {}, {})
    assert evaluate.copycat(SYSTEM, blind, driven, jax.random.key(3)) == 0.0
    copy = Policy(identity, FUNCTION, 2, {}, {})
    score = evaluate.copycat(SYSTEM, copy, driven, jax.random.key(3))
    shown = np.asarray(driven.signals[:, 1:]) / 25.0
    # E|a - u| for u uniform on [-1, 1] is (1 + a²) / 2.
    assert score == pytest.approx(np.mean((1 + shown**2) / 2), rel=0.15)


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_the_slope_of_a_copy_is_what_it_copies_with(frames, driven, monkeypatch):
    monkeypatch.setattr(network, "apply", lambda *a, train: (a[1] * redness(a[2])[:, None], {}))
    copy = Policy(identity, FUNCTION, frames, {}, -0.3)
    assert evaluate.saliency(SHORT, copy, driven).slope == pytest.approx(-0.3, rel=1e-5)
    blind = Policy(covered(SYSTEM.nuisance.cover), FUNCTION, frames, {}, -0.3)
    assert evaluate.saliency(SHORT, blind, driven).slope == 0.0


def test_the_slope_is_that_of_finite_differences(policy, driven):
    """Of every step at once: the nuisance of the present frame alone shows a little more."""
    images = jax.vmap(jax.vmap(SYSTEM.render))(driven.states, driven.signals)

    def acted(more):
        present = jax.vmap(jax.vmap(SYSTEM.render))(driven.states, driven.signals + more * 25.0)
        both = jnp.concatenate([images[:, :-1], present[:, 1:]], axis=-1)
        return jax.vmap(policy.decide)(both).mean()

    slope = (acted(1e-2) - acted(-1e-2)) / 2e-2
    assert abs(slope) > 1e-3
    found = evaluate.saliency(SYSTEM, policy, driven).slope
    assert found == pytest.approx(float(slope), rel=1e-2)


def test_pixels_are_salient_by_finite_differences(policy, driven):
    """Of one rollout's one pixel, a colour at a time; where nobody looks, nothing is."""
    images = jax.vmap(SYSTEM.render)(driven.states[0], driven.signals[0])

    def acted(more):
        return policy.decide(jnp.concatenate([images[:1], images[1:2] + more], axis=-1))[0, 0]

    found = evaluate.saliency(SYSTEM, policy, driven).pixels
    assert found.shape == (3, SYSTEM.steps - 1, *SIZE)
    row, column = np.unravel_index(np.argmax(found[0, 0]), SIZE)
    nudges = 1e-2 * jnp.zeros((3, *SIZE, 3)).at[np.arange(3), row, column, np.arange(3)].set(1.0)
    slopes = [(acted(nudge) - acted(-nudge)) / 2e-2 for nudge in nudges]
    assert np.abs(slopes).sum() == pytest.approx(float(found[0, 0, row, column]), rel=1e-2)
    blind = replace(policy, view=covered(SYSTEM.nuisance.cover))
    unseen = evaluate.saliency(SYSTEM, blind, driven).pixels
    square = np.asarray(SYSTEM.nuisance.cover(jnp.ones((*SIZE, 3))) != 1.0).any(axis=-1)
    assert np.all(unseen[..., square] == 0.0)
    assert np.any(unseen[..., ~square] > 0.0)


@pytest.mark.parametrize(
    ("every", "per_epoch", "total", "steps"),
    [
        (0.25, 1250, 1562, (312, 625, 938, 1250, 1562)),
        (10.0, 100, 2500, (1000, 2000, 2500)),
        (10.0, 100, 1, (1,)),
        (0.001, 10, 3, (1, 2, 3)),
    ],
)
def test_evaluations_are_even_and_end_with_the_training(every, per_epoch, total, steps):
    assert EvaluateConfig(every=every).steps(per_epoch, total) == steps
