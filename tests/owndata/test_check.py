"""What is said of a made-up dataset before anything is trained, and of one that is wrong."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxdeconf.independence import hoeffding_d
from jaxdeconf.owndata.check import check, visible
from tests.owndata.scene import CONFIG, opened, scene

KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return opened(scene(400, 4, True, 0), tmp_path_factory.mktemp("data") / "demos.npz")


@pytest.fixture(scope="module")
def random_frames():
    return scene(150, 6, False, 1)["frames"]


def test_a_mark_that_first_frames_do_not_vary_is_refused(demos, random_frames, tmp_path):
    """The silent failure: no test on first frames can find it."""
    still = opened(scene(400, 4, True, 0, mark=0.0), tmp_path / "still.npz")
    words = "first frames do not vary what component . shows"
    refused = check(still, random_frames, CONFIG, KEY)
    assert refused.refused is not None
    assert words.replace(".", refused.refused.split("component ")[1][0]) in refused.refused
    assert check(still, random_frames, replace(CONFIG, unvaried="keep"), KEY).refused is None
    assert check(demos, random_frames, CONFIG, KEY).refused is None


def test_causes_that_no_single_state_shows_are_refused(demos, random_frames):
    """An action that is the product of two states: each alone is independent of it."""
    states = np.sign(demos.initial_states[:, :1] * demos.initial_states[:, 1:])
    states = states + np.random.default_rng(2).normal(0, 0.1, states.shape)
    product = np.repeat(states, demos.lengths, axis=0).astype(np.float32)
    found = check(demos._replace(actions=product / 2), random_frames, CONFIG, KEY)
    assert found.refused is not None
    assert "left, right move the actions only together" in found.refused
    assert "Say --states-together 2, draw initial states" in found.refused
    both = replace(CONFIG, states_together=2)
    found = check(demos._replace(actions=product / 2), random_frames, both, KEY)
    assert found.refused is None
    assert (found.state_action.max(axis=(1, 2)) > found.threshold).all()
    assert "Moving an action together: left with right." in found.notes


def test_states_that_move_nothing_are_refused(demos, random_frames):
    noise = np.random.default_rng(3).normal(size=demos.actions.shape).astype(np.float32)
    found = check(demos._replace(actions=noise), random_frames, CONFIG, KEY)
    assert found.refused is not None
    assert "no initial state moves an action" in found.refused


def test_a_button_that_is_seldom_pressed_is_seen_to_be_moved(demos, random_frames):
    """By D, whose value is held down by ties, nothing would seem to move it."""
    left = demos.initial_states[:, 0]
    pressed = (left > np.quantile(left, 0.98)).astype(np.float32)
    assert hoeffding_d(left, pressed) < check(demos, random_frames, CONFIG, KEY).threshold
    button = np.repeat(pressed, demos.lengths)[:, None]
    found = check(demos._replace(actions=button), random_frames, CONFIG, KEY)
    assert (found.state_action[0] > found.threshold).all()
    assert "No test shows an action that depends on right." in found.notes


def test_what_looks_wrong_is_said(demos, random_frames):
    """Constant, dependent and drifting states; actions that are shifted, at their limit, few."""
    states, count = demos.initial_states, len(demos.lengths)
    drift = np.arange(count)[:, None] + 0.0 * states[:, :1]
    wrong = np.concatenate([states, states[:, :1] ** 3, drift, 0 * drift], axis=1)
    actions = np.sign(demos.actions)
    actions[demos.first] = 0.0
    names = ["left", "right", "cubed", "drift", "still"]
    odd = demos._replace(initial_states=wrong, state_names=names, actions=actions)
    said = " ".join(check(odd, random_frames, CONFIG, KEY).notes)
    for words in (
        "not asked for: still",
        "left and cubed",
        "Drifts from episode to episode: drift",
    ):
        assert words in said
    for words in ("The first action of every episode is 0", "are at their limit", "3 values only"):
        assert words in said


def test_the_least_horizon_in_which_every_state_shows_is_taken(demos, random_frames):
    """An expert that reacts to the second state only in its third step."""
    actions = demos.actions.copy()
    for state, step in ((0, 0), (0, 1), (1, 2)):
        at = demos.first + step
        actions[at, 0] = demos.initial_states[:, state]
    assert check(demos._replace(actions=actions), random_frames, CONFIG, KEY).horizon == 3


def test_short_episodes_are_named_and_left_out_if_asked(demos, random_frames):
    lengths = demos.lengths.copy()
    lengths[:2] = demos.lengths[0] + demos.lengths[1] - 1, 1  # the second episode is of one step
    short = demos._replace(lengths=lengths)
    said = " ".join(check(short, random_frames, CONFIG, KEY).notes)
    assert "Only the first 1 steps are looked at" in said
    longer = short.longer(2)
    assert len(longer.lengths) == len(lengths) - 1
    assert np.array_equal(longer.frames[: lengths[0]], demos.frames[: lengths[0]])
    assert np.array_equal(longer.frames[lengths[0] :], demos.frames[lengths[0] + 1 :])
    assert np.array_equal(longer.initial_states[1:], demos.initial_states[2:])
    assert longer.longer(2) is longer


def test_more_episodes_show_more():
    assert visible(50) == pytest.approx(0.61, abs=0.01)
    assert visible(600) == pytest.approx(0.20, abs=0.01)
    assert visible(10**6) == pytest.approx(0.064, abs=0.001)  # gamma hides what is weaker
