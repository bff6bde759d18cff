"""What holds of every System: it pickles, is a static argument, and has frames of any size."""

import dataclasses
import pickle

import jax
import jax.numpy as jnp
import pytest

from jaxdeconf import systems


@pytest.fixture(params=systems.names())
def system(request):
    return systems.get(request.param)


def test_a_system_pickles(system):
    again = pickle.loads(pickle.dumps(system))
    assert again == system
    assert hash(again) == hash(system)


def test_frames_have_the_systems_size(system):
    system = dataclasses.replace(system, size=(24, 40))
    state = system.sample_initial(jax.random.key(0))
    frame = jax.jit(system.frame)(state, system.limits)
    assert frame.shape == system.frame_shape == (24, 40, 3)
    assert frame.dtype == jnp.uint8
