"""The probe's mask, on latents of which it is known what they show."""

import jax.numpy as jnp
import numpy as np

from jaxdeconf.demos import Exploration
from jaxdeconf.learn import disentangle
from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.method import Ask, Evidence
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.rivals.probe import explained
from tests.rivals.world import KEY


def test_it_masks_the_active_latents_that_the_previous_action_explains(monkeypatch):
    """In whatever way: by a monotone function, by one that is not; not what shows the signal."""
    rng = np.random.default_rng(0)
    previous, signal, pose = rng.uniform(-1, 1, (3, 600))
    columns = [previous**3, np.cos(3 * previous), pose, signal, pose + 0.3 * previous, previous]
    latents = jnp.asarray(np.stack(columns, axis=1))
    monkeypatch.setattr(disentangle, "encode", lambda network, variables, images: (latents, None))
    active = jnp.array([True, True, True, True, True, False])
    encoder = Encoder(VAEConfig(latents=6), {}, jnp.ones(6), active)
    images = np.zeros((600, 4, 4, 3), np.uint8)
    evidence = Evidence(
        encoder, exploration=Exploration(images, previous[:, None], signal[:, None])
    )
    mask = explained(lambda: None, evidence, Ask(CloneConfig(), KEY))
    np.testing.assert_array_equal(mask, [True, True, False, False, False, False])
