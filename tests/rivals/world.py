"""CartPole of a few steps and pixels, its expert, a β-VAE of chance: what rivals are tried on."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from jaxdeconf import collect, systems
from jaxdeconf.expert import ExpertConfig, expert_trajectories
from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.nets import vae
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.rivals.simulator import Simulator
from jaxdeconf.systems.rollout import random_trajectories

KEY = jax.random.key(0)
COUNT, STEPS, SIZE = 16, 6, (16, 16)
SYSTEM = replace(systems.get("cartpole"), steps=STEPS, size=SIZE)
EXPERT = ExpertConfig(horizon=8, initial_iterations=10)
CLONE = CloneConfig(
    steps=4,
    batch_size=16,
    network=NetworkConfig(width=2, stem="imagenet", stages=1, norm="none"),
)
VAE = vae.VAEConfig(channels=(2,), latents=3, norm="none")


def simulator(count=COUNT):
    """The expert from random starts."""
    starts = jax.vmap(SYSTEM.sample_initial)(jax.random.split(KEY, count))
    trajectories, _ = expert_trajectories(SYSTEM, starts, jax.random.key(1), EXPERT)
    return Simulator(SYSTEM, EXPERT, trajectories)


def demos(simulator):
    """What is cloned of it."""
    return collect.demonstrations(SYSTEM, simulator.trajectories)


def encoder():
    """Untrained; its second latent is not active."""
    active = jnp.array([True, False, True])
    return Encoder(VAE, vae.init(VAE, KEY, SIZE), jnp.ones(3), active)


def exploration():
    """Frames under random actions."""
    return collect.exploration(SYSTEM, random_trajectories(SYSTEM, jax.random.key(2), 12))
