"""Random-latent dropout: which latents the frames are drawn of, in each of a sample's frames."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.learn import clone, disentangle
from jaxdeconf.learn.fit import Loss
from jaxdeconf.method import Ask, unmasked
from jaxdeconf.nets import network
from jaxdeconf.rivals import latent_dropout
from jaxdeconf.views import shown
from tests.rivals import toy

INDICES = jnp.arange(40)


@pytest.fixture(scope="module")
def data():
    demos, evidence = toy.demos(), toy.evidence()
    latents = latent_dropout.latents(demos, evidence, Ask(toy.CLONE, toy.KEY))
    assert latents.shape == (toy.N, toy.T, 3)
    return shown(demos, *unmasked(evidence), None, latents)


@pytest.fixture(scope="module")
def variables():
    first = network.init(toy.NETWORK, toy.KEY, (*toy.SIZE, 6), toy.A)
    return latent_dropout.begin(first, toy.evidence(), toy.KEY)


def test_the_latents_are_the_encoders_and_0_where_they_carry_nothing(data):
    demos, encoder = toy.demos(), toy.evidence().encoder
    valid = demos.images[demos.valid]
    expected, _ = disentangle.encode(encoder.network, encoder.variables, jnp.asarray(valid))
    np.testing.assert_allclose(data.extra[:, :2], expected[:, :2], atol=1e-5)
    assert not data.extra[:, 2].any()


def test_the_encoder_is_not_given_away():
    evidence = toy.evidence()
    first = network.init(toy.NETWORK, toy.KEY, (*toy.SIZE, 6), toy.A)
    frozen = latent_dropout.begin(first, evidence, toy.KEY)["frozen"]
    leaves = zip(*map(jax.tree.leaves, (frozen, evidence.encoder.variables)), strict=True)
    assert all(a is not b and (a == b).all() for a, b in leaves)


def images_of(loss: Loss, variables, data, monkeypatch):
    """What the network is given."""

    def look(config, variables, images, train, gate):
        return jnp.zeros((len(images), toy.A)), None, {"given": images}

    monkeypatch.setattr(network, "look", look)
    _, (stats, _) = jax.jit(loss)(variables, data, INDICES, toy.KEY, jnp.int32(0))
    return np.asarray(stats["given"])


def test_nothing_dropped_is_the_reconstruction(data, variables, monkeypatch):
    config = replace(toy.CLONE, strength=0.0)
    loss = latent_dropout.objective(config)
    found = images_of(loss, variables, data, monkeypatch)
    np.testing.assert_allclose(found, clone.stacked(config, data, INDICES), atol=1.01 / 255)


def test_a_sample_loses_the_same_latents_in_all_its_frames(data, variables, monkeypatch):
    config = replace(toy.CLONE, strength=0.5, frames=3)
    found = images_of(latent_dropout.objective(config), variables, data, monkeypatch)
    encoder = toy.evidence().encoder
    ways = np.array([[a, b, 0] for a in (0, 1) for b in (0, 1)])
    drawn = [  # [ways, n, H, W, 3]
        np.asarray(
            disentangle.decode(encoder.network, encoder.variables, data.extra * way, toy.SIZE)
        )
        / 255
        for way in ways
    ]
    step, lost = np.asarray(data.step), set()
    for i, image in zip(np.asarray(INDICES), found, strict=True):
        fits = [
            all(
                np.allclose(
                    image[..., 3 * place : 3 * place + 3],
                    frames[i - ago] if ago <= step[i] else 0.0,
                    atol=1.01 / 255,
                )
                for place, ago in enumerate((2, 1, 0))
            )
            for frames in drawn
        ]
        assert any(fits)
        lost.add(fits.index(True))
    assert lost == {0, 1, 2, 3}
