"""The paper's networks, objective and batch order take a step on a CPU, stage by stage."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from experiments.cartpole import PRESETS
from jaxdeconf.pipeline import results, stages
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.store import Store

PAPER = PRESETS["paper"]


def test_the_preset_has_the_papers_sizes():
    assert (PAPER.collect.random_trajectories, PAPER.collect.expert_trajectories) == (5000, 1000)
    assert (PAPER.vae.epochs, PAPER.vae.learning_rate, PAPER.vae.decay) == (100, 0.005, 0.95)
    assert (PAPER.vae.beta, PAPER.vae.network.latents, PAPER.vae.batch_size) == (100, 3, 64)
    assert PAPER.vae.network.channels == (32, 64, 128, 256, 512)
    assert not PAPER.vae.network.linear_path
    assert (PAPER.mask.reaction_horizon, PAPER.mask.threshold, PAPER.mask.alpha) == (3, 1e-3, None)
    assert (PAPER.bc.learning_rate, PAPER.bc.decay, PAPER.bc.batch_size) == (0.001, 0.96, 256)
    assert (PAPER.bc.network.width, PAPER.bc.network.stem) == (64, "cifar")
    assert (PAPER.eval.rollouts, PAPER.eval.every) == (25, 10)


@pytest.mark.slow
def test_every_stage_takes_a_step(tmp_path):
    # The paper's networks on a handful of trajectories: one step of each training.
    config = replace(
        PAPER,
        collect=replace(
            PAPER.collect, random_trajectories=40, held_out_trajectories=20, expert_trajectories=8
        ),
        vae=replace(PAPER.vae, epochs=1e-6),
        bc=replace(PAPER.bc, epochs=1e-6, batch_size=8),
        eval=replace(PAPER.eval, rollouts=1),
    )
    store = Store(tmp_path, config, resume=False)
    run = stages.Run(config, store, Reporter(Console(quiet=True)), seconds={})
    collected = stages.collect(run)
    vae = stages.train_disentangler(run, collected)
    found = stages.find_mask(run, collected, vae)
    found = found._replace(mask=jnp.array([True, False, False]))
    cloned = stages.train_policy(
        run, "Masked", collected, *stages.view_of(run, "Masked", vae, found.mask)
    )
    scores, driven = results.judge_policy(run, "Masked", collected, vae, found, cloned)
    assert np.isfinite(cloned.train_loss)
    assert np.isfinite(float(scores["rollout_loss"]["mean"]))
    assert driven.states.shape == (1, 100, 4)
