"""Demonstrations: what they hold, and that each wrong array is refused by its name."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.demos import Demos

N, T, S, A = 3, 4, 2, 1
IMAGES = np.zeros((N, T, 16, 24, 3), np.uint8)
ACTIONS, STATES = np.zeros((N, T, A)), np.zeros((N, S))
RAGGED = np.arange(T) < np.array([4, 1, 3])[:, None]
HOLE = np.arange(N * T).reshape(N, T) != 2 * T + 1  # False in episode 2 at step 1
PADDED = np.where(RAGGED[..., None], 0.5, np.nan)


def demos(**changed):
    return Demos(**{"images": IMAGES, "actions": ACTIONS, "initial_states": STATES, **changed})


def test_lengths_are_those_of_the_valid_steps():
    np.testing.assert_array_equal(demos().lengths, [4, 4, 4])
    np.testing.assert_array_equal(demos(valid=RAGGED).lengths, [4, 1, 3])
    np.testing.assert_array_equal(demos(valid=jnp.asarray(RAGGED)).lengths, [4, 1, 3])


def test_what_is_padded_may_be_anything():
    held = demos(valid=RAGGED, actions=PADDED, previous_actions=PADDED)
    np.testing.assert_array_equal(held.actions, PADDED)


def test_lists_become_arrays_and_arrays_stay_what_they_are():
    held = demos(actions=ACTIONS.tolist(), initial_states=jnp.asarray(STATES))
    assert held.actions.shape == (N, T, A)
    assert isinstance(held.initial_states, jnp.ndarray)
    assert held.images is IMAGES


def nan_at(shape, place):
    values = np.zeros(shape)
    values[place] = np.nan
    return values


WRONG = [
    ("images", "float64", {"images": IMAGES / 255}),
    ("images", "shape (3, 4, 16, 24)", {"images": IMAGES[..., 0]}),
    ("images", "shape (3, 4, 16, 24, 1)", {"images": IMAGES[..., :1]}),
    ("images", "shape (0, 4, 16, 24, 3)", {"images": IMAGES[:0]}),
    ("images", "object", {"images": None}),
    ("actions", "shape (3, 4)", {"actions": ACTIONS[..., 0]}),
    ("actions", "shape (2, 4, 1)", {"actions": ACTIONS[:2]}),
    ("actions", "shape (3, 3, 1)", {"actions": ACTIONS[:, :3]}),
    ("actions", "shape (3, 4, 0)", {"actions": ACTIONS[..., :0]}),
    ("actions", "object", {"actions": None}),
    ("actions", "nan at [1, 2, 0]", {"actions": nan_at((N, T, A), (1, 2, 0))}),
    ("actions", "inf at [0, 0, 0]", {"actions": ACTIONS + np.inf, "valid": RAGGED}),
    ("initial_states", "shape (3,)", {"initial_states": STATES[:, 0]}),
    ("initial_states", "shape (2, 2)", {"initial_states": STATES[:2]}),
    ("initial_states", "<U1", {"initial_states": [["a", "b"]] * 3}),
    ("initial_states", "nan at [2, 1]", {"initial_states": nan_at((N, S), (2, 1))}),
    ("valid", "shape (3, 3)", {"valid": RAGGED[:, :3]}),
    ("valid", "float64", {"valid": RAGGED.astype(float)}),
    ("valid", "otherwise in episode 1", {"valid": RAGGED & (np.arange(N) != 1)[:, None]}),
    ("valid", "otherwise in episode 2", {"valid": RAGGED & HOLE}),
    ("previous_actions", "shape (3, 4, 2)", {"previous_actions": np.zeros((N, T, 2))}),
    ("previous_actions", "nan at [2, 0, 0]", {"previous_actions": nan_at((N, T, A), (2, 0, 0))}),
    ("state_names", "1", {"state_names": ("x",)}),
    ("action_names", "2", {"action_names": ["left", "right"]}),
]


@pytest.mark.parametrize(
    ("name", "shown", "changed"), WRONG, ids=[f"{name}-{shown}" for name, shown, _ in WRONG]
)
def test_a_wrong_array_is_named_in_one_line(name, shown, changed):
    with pytest.raises(ValueError, match=rf"^{name}: expected .*got ") as error:
        demos(**changed)
    assert shown in str(error.value)
    assert "\n" not in str(error.value)
