"""A made-up scene that shows the action before, for methods to be cloned on in a few steps."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxdeconf.demos import Demos
from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.method import Evidence
from jaxdeconf.nets import vae
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.nets.vae import VAEConfig

KEY = jax.random.key(0)
N, T, SIZE, A = 60, 4, (16, 24), 2
LENGTHS = np.random.default_rng(1).integers(2, T + 1, N)
NETWORK = NetworkConfig(width=2, stem="imagenet", stages=1, norm="none")
CLONE = CloneConfig(steps=1, batch_size=32, network=NETWORK)
LATENTS = VAEConfig(channels=(2,), latents=3, norm="none")


def demos():
    """Episodes of 2 to 4 steps: a bar for each of two states, a corner for each action before."""
    rng = np.random.default_rng(0)
    state, previous = rng.uniform(-1, 1, (N, 2)), rng.uniform(-1, 1, (N, A))
    steps = []
    for _ in range(T):
        action = state @ np.array([[0.5, 0.3], [-0.4, 0.6]])
        steps.append((_drawn(np.concatenate([state, previous], axis=1)), action, previous))
        state, previous = 0.5 * state + 0.3 * rng.uniform(-1, 1, (N, 2)), action
    images, actions, previous = (np.stack(part, axis=1) for part in zip(*steps, strict=True))
    valid = np.arange(T) < LENGTHS[:, None]
    images[~valid], actions[~valid] = 7, np.nan
    return Demos(images, actions, rng.uniform(-1, 1, (N, 2)), valid, previous)


def _drawn(values):
    """uint8 [n, 16, 24, 3] of values [n, 4]."""
    images = np.full((len(values), *SIZE, 3), 128.0)
    for i, (top, left) in enumerate([(2, 8), (9, 16), (0, 0), (11, 0)]):
        images[:, top : top + 5, left : left + 5] += 100 * values[:, i, None, None, None]
    return np.round(images).astype(np.uint8)


def evidence():
    """A β-VAE of random weights, whose last latent carries nothing."""
    variables = vae.init(LATENTS, jax.random.key(1), SIZE)
    return Evidence(Encoder(LATENTS, variables, jnp.ones(3), jnp.array([True, True, False])))
