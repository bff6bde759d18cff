"""Controls: the squares, the dropouts and the budgets are what they are said to be."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.learn.fit import learning_rate
from jaxdeconf.rivals import controls

KEY = jax.random.key(0)


def test_one_square_of_the_mean_grey_at_the_same_place_in_all_frames():
    images = jnp.linspace(0.0, 1.0, 200 * 32 * 48 * 6).reshape(200, 32, 48, 6)
    found, given = np.asarray(controls.cutout(images, KEY)), np.asarray(images)
    cut = (found != given).all(axis=-1)
    np.testing.assert_array_equal(cut, (found != given).any(axis=-1))
    np.testing.assert_allclose(found[cut], given.mean(), rtol=1e-4)
    rows, columns = cut.any(axis=2).sum(axis=1), cut.any(axis=1).sum(axis=1)
    np.testing.assert_array_equal(rows, columns)
    np.testing.assert_array_equal(cut.sum(axis=(1, 2)), rows * columns)  # a square
    assert (rows.min(), rows.max()) == (4, 11)  # of 32, 12 to 36 %
    top, left = cut.any(axis=2).argmax(axis=1), cut.any(axis=1).argmax(axis=1)
    assert top.min() == left.min() == 0  # anywhere
    assert (top + rows).max() == 32
    assert (left + columns).max() == 48


def test_dropout_keeps_a_share_and_the_mean():
    x = jnp.ones((100, 10, 10, 4))
    found = np.asarray(controls.dropout(x, 0.3, KEY))
    np.testing.assert_allclose(np.unique(found), [0.0, 1 / 0.7], rtol=1e-6)
    assert (found > 0).mean() == pytest.approx(0.7, abs=0.01)
    for axes in ((1, 2, 3), (0, 1, 2)):
        assert found.mean(axis=axes).std() > 0  # of each number on its own
    np.testing.assert_array_equal(controls.dropout(x, 0.0, KEY), x)


@pytest.mark.parametrize("steps", [None, 100])
def test_longer_is_so_many_samples_and_falls_as_far(steps):
    config = CloneConfig(epochs=2.0, steps=steps, batch_size=10, decay=0.3)
    found, samples = controls.longer(config), 500
    total = config.total_steps(samples)
    assert found.total_steps(samples) == 2.5 * total
    rates = [learning_rate(config, samples, jnp.int32(s)) for s in (0, total // 2, total)]
    slower = [learning_rate(found, samples, jnp.int32(2.5 * s)) for s in (0, total // 2, total)]
    np.testing.assert_allclose(slower, rates, rtol=1e-5)


def test_one_frame_is_the_present_one_alone():
    assert controls.of_one_frame(CloneConfig()) == replace(CloneConfig(), frames=1)
