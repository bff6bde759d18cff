"""Views: what each policy is shown."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import systems
from jaxdeconf.learn import views
from jaxdeconf.nets import vae
from jaxdeconf.nets.vae import VAEConfig

SYSTEM = systems.get("cartpole")
CONFIG = VAEConfig(channels=(4, 4, 4, 4, 4), latents=3)


@pytest.fixture
def images():
    states = jax.vmap(SYSTEM.sample_initial)(jax.random.split(jax.random.key(0), 5))
    return jax.vmap(SYSTEM.frame)(states, jnp.linspace(-25, 25, 5)[:, None])


def test_identity(images):
    np.testing.assert_array_equal(views.identity({}, images), images)


def test_the_cover_hides_the_nuisance_and_nothing_else(images):
    seen = np.asarray(views.covered(SYSTEM.nuisance)({}, images))
    assert (seen[:, :15, :15] == 255).all()
    changed = (seen != np.asarray(images)).any(axis=(0, 3))
    assert not changed[16:].any()
    assert not changed[:, 16:].any()


def test_a_masked_reconstruction_does_not_depend_on_a_masked_latent(images):
    variables = vae.init(CONFIG, jax.random.key(1))
    view = views.reconstructed(CONFIG)
    mean, _, _ = vae.encode(CONFIG, variables, images.astype(jnp.float32) / 255, train=False)
    keep = jnp.array([True, False, True])
    expected = vae.decode(CONFIG, variables, mean.at[:, 1].set(0.0), train=False)[0]
    seen = view({"variables": variables, "keep": keep}, images)
    np.testing.assert_allclose(seen.astype(float), expected * 255, atol=0.51)
    nothing = view({"variables": variables, "keep": jnp.zeros(3, bool)}, images)
    assert (nothing == nothing[0]).all()


def test_the_same_view_is_the_same_static_argument():
    assert views.reconstructed(CONFIG) is views.reconstructed(VAEConfig((4, 4, 4, 4, 4), 3))
    assert views.covered(SYSTEM.nuisance) is views.covered(SYSTEM.nuisance)
