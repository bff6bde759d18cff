"""The VQ-VAE's loss by hand, and the codes of every frame of demonstrations."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.demos import Demos
from jaxdeconf.learn.fit import finish
from jaxdeconf.method import Ask, Evidence
from jaxdeconf.nets import vq
from jaxdeconf.nets.vq import VQConfig
from jaxdeconf.rivals import codes
from jaxdeconf.rivals.codes import CodesConfig
from jaxdeconf.vision import raster
from tests.rivals import toy

NETWORK = VQConfig(codes=8, dimension=3, channels=(4, 4, 4))
CONFIG = CodesConfig(steps=150, batch_size=16, learning_rate=3e-3, network=NETWORK)


@pytest.fixture(scope="module")
def frames():
    given = toy.demos()
    return jnp.asarray(given.images)[given.valid]


@pytest.fixture(scope="module")
def trained(frames):
    training = codes.training(CONFIG, lambda: frames, len(frames), toy.KEY)
    *_, (state, metrics) = training.chunks("codes")
    return training.trained(state), metrics


def test_the_loss_is_its_definition_and_reaches_all_of_the_network(trained, frames):
    variables, indices = trained[0], jnp.arange(20)
    loss = codes.objective(CONFIG)

    @jax.jit
    @jax.value_and_grad
    def of_the_loss(params):
        return loss({**variables, "params": params}, frames, indices, toy.KEY, jnp.int32(0))[0]

    value, gradient = of_the_loss(variables["params"])
    images = raster.dequantize(frames[:20])
    maps = np.asarray(vq.encode(NETWORK, variables, images))
    table = np.asarray(variables["params"]["codes"])
    taken = table[np.linalg.norm(maps[..., None, :] - table, axis=-1).argmin(-1)]
    drawn = vq.decode(NETWORK, variables, jnp.asarray(taken))
    error = np.mean((np.asarray(drawn) - np.asarray(images)) ** 2) / np.var(np.asarray(images))
    np.testing.assert_allclose(value, error + 1.25 * np.mean((maps - taken) ** 2), rtol=1e-4)
    # The codes are drawn to what takes them, and by nothing else.
    expected = np.zeros_like(table)
    codes_of = np.linalg.norm(maps[..., None, :] - table, axis=-1).argmin(-1)
    np.add.at(expected, codes_of.ravel(), (2 * (taken - maps) / maps.size).reshape(-1, 3))
    np.testing.assert_allclose(gradient["codes"], expected, atol=1e-6)
    for part in ("encoder", "decoder"):
        assert all(jnp.abs(leaf).max() > 0 for leaf in jax.tree.leaves(gradient[part]))


def test_it_learns_the_frames_with_codes_in_use(trained):
    metrics = trained[1]
    assert metrics["reconstruction"] < 0.8  # of the variance, in so few steps
    assert metrics["perplexity"] > 3.0


def test_the_codes_of_every_frame(frames, trained, monkeypatch):
    monkeypatch.setattr(codes, "CONFIG", CONFIG)
    seen = []

    def watch(name, training):
        seen.append((name, training.samples))
        return finish(name, training)

    demos = toy.demos()
    found = codes.codes(demos, Evidence(), Ask(toy.CLONE, toy.KEY, watch))
    assert seen == [("codes", len(frames))]  # padding is not learnt
    assert (found.shape, found.dtype) == ((toy.N, toy.T, 2, 3), jnp.uint8)
    variables = trained[0]
    maps = vq.encode(NETWORK, variables, raster.dequantize(frames[:10]))
    expected = vq.nearest(variables, maps)
    np.testing.assert_array_equal(np.asarray(found)[demos.valid][:10], expected)


def test_they_can_be_traced_for_their_shapes(monkeypatch):
    monkeypatch.setattr(codes, "CONFIG", CONFIG)

    def untrained(_, training):
        return training.start(training.data())

    ask = Ask(toy.CLONE, toy.KEY, untrained)
    found = jax.eval_shape(lambda: codes.codes(toy.demos(), Evidence(), ask))
    assert (found.shape, found.dtype) == ((toy.N, toy.T, 2, 3), jnp.uint8)


def test_a_size_that_has_no_whole_places_is_refused():
    demos = toy.demos()
    narrow = Demos(demos.images[..., :20, :], demos.previous_actions, demos.initial_states)
    with pytest.raises(ValueError, match=r"^size: expected multiples of 8 .*, got 16 × 20$"):
        codes.codes(narrow, Evidence(), Ask(replace(toy.CLONE, steps=1), toy.KEY))
