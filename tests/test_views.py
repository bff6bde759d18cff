"""Views: what each makes of a frame."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import systems, views
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.method import Evidence, inpainted, masked
from jaxdeconf.nets import vae
from jaxdeconf.nets.vae import VAEConfig

SYSTEM = systems.get("cartpole")
CONFIG = VAEConfig(channels=(2,), latents=3, norm="none")


@pytest.fixture(scope="module")
def variables():
    return vae.init(CONFIG, jax.random.key(1), (64, 64))


def test_identity(grains):
    np.testing.assert_array_equal(views.identity({}, grains), grains)


def test_the_cover_hides_the_nuisance_and_nothing_else(grains):
    seen = np.asarray(views.see(views.covered(SYSTEM.nuisance.cover), {}, grains))
    assert (seen[:, :15, :15] == 255).all()
    changed = (seen != np.asarray(grains)).any(axis=(0, 3))
    assert not changed[16:].any()
    assert not changed[:, 16:].any()


def reconstruction(variables, grains, keep):
    """By the networks: the latents that are not kept are 0."""
    return _reconstruction(variables, grains, tuple(keep))


@partial(jax.jit, static_argnums=2)
def _reconstruction(variables, grains, keep):
    mean, _, _ = vae.encode(CONFIG, variables, grains.astype(jnp.float32) / 255, train=False)
    latents = jnp.stack([mean[:, i] if kept else 0 * mean[:, i] for i, kept in enumerate(keep)], 1)
    return vae.decode(CONFIG, variables, latents, (64, 64), train=False)[0]


def test_a_masked_reconstruction_does_not_depend_on_a_masked_latent(grains, variables):
    view = partial(views.see, views.reconstructed(CONFIG))
    seen = view({"variables": variables, "keep": jnp.array([True, False, True])}, grains)
    expected = reconstruction(variables, grains, [True, False, True])
    assert seen.dtype == jnp.uint8
    np.testing.assert_allclose(seen.astype(float), expected * 255, atol=0.51)
    nothing = view({"variables": variables, "keep": jnp.zeros(3, bool)}, grains)
    assert (nothing == nothing[0]).all()


def learnt(variables):
    return Encoder(CONFIG, variables, jnp.ones(3), jnp.ones(3, bool))


def test_a_region_stands_still_and_all_else_is_as_it_was(grains, variables):
    region = np.zeros((64, 64), bool)
    region[10:20, 5:40] = True
    mask = jnp.array([False, True, False])
    view, parameters = inpainted(Evidence(learnt(variables), mask, jnp.asarray(region)))
    seen = views.see(view, parameters, grains)
    still = np.asarray(reconstruction(variables, grains, [False] * 3))
    np.testing.assert_array_equal(seen[:, ~region], grains[:, ~region])
    np.testing.assert_allclose(seen[:, region].astype(float), still[:, region] * 255, atol=0.51)


def test_a_region_that_is_the_whole_image_is_reconstructed(grains, variables):
    whole = Evidence(learnt(variables), jnp.array([False, True, False]), jnp.ones((64, 64), bool))
    seen, drawn = (views.see(*by(whole), grains) for by in (inpainted, masked))
    np.testing.assert_array_equal(seen, drawn)
    assert (seen != seen[0]).any()


def test_a_view_that_makes_bytes_is_refused(grains):
    """What an earlier version's views made."""
    with pytest.raises(ValueError, match=r"^view: expected floats of shape .*, got uint8 of shape"):
        views.see(lambda _, images: (255 * images).astype(jnp.uint8), {}, grains)


def test_the_same_view_is_the_same_static_argument():
    assert views.reconstructed(CONFIG) is views.reconstructed(VAEConfig((2,), 3, norm="none"))
    assert views.covered(SYSTEM.nuisance.cover) is views.covered(SYSTEM.nuisance.cover)
