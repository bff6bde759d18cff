"""OREO: the same codes are dropped in all of a sample's frames, and what is kept grows as much."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.nets import network
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.rivals import oreo
from jaxdeconf.views import identity, shown
from tests.rivals import toy

RNG = np.random.default_rng(0)


def test_a_place_is_kept_if_its_codes_are_kept_in_every_frame():
    codes, kept = RNG.integers(0, 8, (3, 5, 2, 4)), RNG.uniform(size=(5, 8)) < 0.7
    none = np.array([[False] * 5, [True, False, False, False, True], [True] + [False] * 4])
    found = oreo.places_kept(jnp.asarray(codes, jnp.uint8), jnp.asarray(none), jnp.asarray(kept))
    for b in range(5):
        for u in range(2):
            for v in range(4):
                each = [none[frame, b] or kept[b, codes[frame, b, u, v]] for frame in range(3)]
                assert found[b, u, v] == all(each)
    assert 0 < np.mean(found) < 1


def test_the_map_is_gated_by_codes_and_keeps_its_mean(monkeypatch):
    """Frames of three codes, a row of places each: a row is dropped or kept as a whole."""
    extra = np.zeros((toy.N, toy.T, 3, 2), np.uint8) + np.array([[3], [200], [7]], np.uint8)
    data = shown(toy.demos(), identity, {}, None, extra)
    indices = jnp.arange(150)

    def look(config, variables, images, train, gate):
        return jnp.zeros((150, toy.A)), None, {"gated": gate(jnp.ones((150, 3, 2, 4)))}

    monkeypatch.setattr(network, "look", look)
    loss = jax.jit(oreo.objective(replace(toy.CLONE, strength=0.4)))
    _, (stats, metrics) = loss({}, data, indices, toy.KEY, jnp.int32(0))
    gated = np.asarray(stats["gated"])
    assert (gated == gated[:, :, :1, :1]).all()
    rows = gated[:, :, 0, 0] > 0
    assert len(np.unique(rows, axis=0)) == 8  # each code on its own
    # Of both frames alike: kept as often as one code is, and not as two are.
    assert rows.mean() == pytest.approx(0.6, abs=0.06)
    assert metrics["places kept"] == pytest.approx(rows.mean(), rel=1e-5)
    np.testing.assert_allclose(gated[gated > 0], 1 / rows.mean(), rtol=1e-5)


@pytest.mark.parametrize("stem", ["imagenet", "cifar"])
@pytest.mark.parametrize("stages", [1, 4])
def test_the_networks_last_map_has_the_codes_size(stem, stages):
    asked = NetworkConfig(width=2, stem=stem, norm="none", stages=stages)
    config = oreo.on_a_map(CloneConfig(network=asked)).network
    variables = network.init(config, toy.KEY, (32, 48, 6), 1)
    shapes = []
    jax.eval_shape(
        lambda x: network.look(config, variables, x, True, lambda x: shapes.append(x.shape) or x),
        jnp.zeros((1, 32, 48, 6)),
    )
    assert [shape[1:3] for shape in shapes] == [(4, 6)]


def test_of_a_finer_map_a_code_drops_a_block(monkeypatch):
    extra = RNG.integers(0, 200, (toy.N, toy.T, 3, 2)).astype(np.uint8)
    data = shown(toy.demos(), identity, {}, None, extra)
    sizes = (3, 2), (12, 8)

    def look(config, variables, images, train, gate):
        return jnp.zeros((50, toy.A)), None, [gate(jnp.ones((50, *size, 2))) for size in sizes]

    monkeypatch.setattr(network, "look", look)
    loss = jax.jit(oreo.objective(replace(toy.CLONE, strength=0.4)))
    _, ((coarse, fine), _) = loss({}, data, jnp.arange(50), toy.KEY, jnp.int32(0))
    assert 0 < (np.asarray(coarse) == 0).mean() < 1
    np.testing.assert_array_equal(fine, np.kron(coarse, np.ones((1, 4, 4, 1))))
