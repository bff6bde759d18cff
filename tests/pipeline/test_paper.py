"""The paper's networks and objective take a step on a CPU, on a handful of short trajectories."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxdeconf import collect, systems
from jaxdeconf.deconfound import clone_policy, learn_latents, mask_latents
from jaxdeconf.method import Evidence
from jaxdeconf.presets import PRESETS

PAPER = PRESETS["cartpole"]["paper"]


@pytest.mark.slow
def test_every_network_takes_a_step():
    system, key = replace(systems.get("cartpole"), steps=5), jax.random.key(0)
    few = replace(
        PAPER.collect, random_trajectories=20, held_out_trajectories=2, expert_trajectories=8
    )
    collected = collect.collect(system, few, replace(PAPER.expert, horizon=5), 1, key)
    images = collect.exploration(system, collected.random).images
    learning, cloning = replace(PAPER.disentangle, steps=1), replace(PAPER.clone, steps=1)
    encoder = learn_latents(images, images[:10], key, learning)
    demos = collect.demonstrations(system, collected.expert)
    mask = mask_latents(encoder, demos, PAPER.mask)
    assert mask.mask.shape == (3,)
    evidence = Evidence(encoder, np.array([True, False, False]))
    policy = clone_policy("Masked", demos, evidence, key, replace(cloning, batch_size=8))
    seen = policy.see(demos.images[0])
    actions = policy.act([seen[:-1], seen[1:]])
    assert actions.shape == (4, 1)
    assert np.isfinite(actions).all()
