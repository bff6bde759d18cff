"""Policies cloned from frames as recorded and as written, on frames whose corner says it all."""

import jax
import numpy as np
import pytest

from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.learn.fit import finish
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.owndata.clones import compared
from jaxdeconf.owndata.dataset import Dataset

RANDOM = np.random.default_rng(0)
LENGTHS = np.array([5, 6] * 20)
ACTIONS = RANDOM.uniform(-1, 1, (LENGTHS.sum(), 1)).astype(np.float32)
CORNER = np.zeros((32, 32), bool)
CORNER[:8, :8] = True
NETWORK = NetworkConfig(width=4, stem="imagenet", stages=1, norm="none")
CONFIG = CloneConfig(steps=60, batch_size=16, learning_rate=1e-2, network=NETWORK)


class Grey:
    """A view that paints its region grey."""

    def __init__(self, region):
        self.region = region

    def __call__(self, frames):
        return np.where(self.region[..., None], np.uint8(128), frames)


@pytest.fixture(scope="module")
def demos():
    """The corner shows the action itself, all else is noise."""
    frames = RANDOM.integers(0, 256, (len(ACTIONS), 32, 32, 3), dtype=np.uint8)
    frames[:, CORNER] = (128 + 120 * ACTIONS[:, :, None]).astype(np.uint8)
    return Dataset(frames, ACTIONS, LENGTHS, np.zeros((len(LENGTHS), 0)), [])


@pytest.fixture(scope="module")
def held_out():
    return np.repeat(np.arange(len(LENGTHS)), LENGTHS) % 5 == 4


def clones(demos, out, region):
    seen = {}

    def watch(name, training, frames):
        seen[name] = np.asarray(frames)
        return finish(name, training)

    return compared(demos, out, Grey(region), jax.random.key(0), watch, CONFIG), seen


def test_who_sees_the_corner_follows_it_and_who_does_not_cannot(demos, held_out):
    found, seen = clones(demos, held_out, CORNER)
    assert np.array_equal(seen["clone recorded"], demos.frames[~held_out])
    assert np.array_equal(seen["clone written"], Grey(CORNER)(demos.frames[~held_out]))
    recorded, written = found["recorded"], found["written"]
    assert recorded.copycat > 0.3
    assert written.copycat == 0.0
    variance = np.mean(demos.actions[held_out] ** 2)
    assert recorded.error < 0.5 * variance < written.error


def test_where_all_is_redrawn_nothing_is_left_to_exchange(demos, held_out):
    found, _ = clones(demos, held_out, np.ones_like(CORNER))
    assert found["recorded"].copycat is None
