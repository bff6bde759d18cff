"""The numbers of the report against what can be counted by hand."""

import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import systems
from jaxdeconf.collect import Collected
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.pipeline import judge
from jaxdeconf.systems import Trajectories


def test_the_experts_faults_are_counted():
    # 2 trajectories of 5 steps. Outside the soft limits (5 m, 10 m/s, pi/2, pi/2): 3 of the 8
    # states after the first ones, where limits do not hold yet.
    states = np.zeros((2, 5, 4), np.float32)
    states[0, 0] = [9, 0, 0, 0]
    states[0, 2] = [5.1, 0, 0, 0]
    states[1, 3] = [0, -10.1, 0, 0]
    states[1, 4] = [0, 9.9, 0, 2.0]
    still = jnp.zeros((2, 5, 1))
    expert = Trajectories(jnp.asarray(states), still, still, jnp.ones((2, 5), bool), still)
    collected = Collected(expert, expert, expert, expert, jnp.array([1, 3]))
    judged = judge.judge_expert(systems.get("cartpole"), collected)
    assert judged.violation_rate == pytest.approx(3 / 8)
    assert judged.unconverged == pytest.approx(4 / 10)
    assert judged.outcome == 1.0


@pytest.mark.parametrize(
    ("mask", "precision", "recall"),
    [
        ([1, 0, 0, 0], 1.0, 0.5),
        ([1, 1, 0, 0], 1.0, 1.0),
        ([0, 1, 1, 0], 0.5, 0.5),
        ([0, 0, 0, 1], None, 0.0),  # an inactive latent is at its mean whether masked or not
        ([0, 0, 0, 0], None, 0.0),
    ],
)
def test_precision_and_recall_of_a_mask(mask, precision, recall):
    """The nuisance's latents are the first two; the last is inactive."""
    active, share = jnp.array([True, True, True, False]), np.array([0.95, 0.91, 0.2, 0.99])
    encoder = Encoder(VAEConfig(), {}, jnp.zeros(4), active)
    found = judge.precision_recall(jnp.array(mask, bool), encoder, share)
    assert found == (precision, recall)


def test_peak_memory_is_the_processs_own():
    # 200 MB more of it show as 200 MB more, whatever the process that started it holds.
    code = (
        "from jaxdeconf.pipeline.machine import peak_memory_mb\n"
        "before = peak_memory_mb()\nblock = b'x' * (200 << 20)\ndel block\n"
        "print(before, peak_memory_mb())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    before, after = map(float, done.stdout.split())
    assert 50 < before < 1000
    assert after - before == pytest.approx(200, abs=10)


def test_a_machine_that_does_not_say_is_no_fault(monkeypatch):
    """Reference: what macOS and Windows lack."""
    import os

    from jaxdeconf.pipeline import machine

    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert machine.cores() >= 1
    monkeypatch.setattr(os, "sysconf", lambda _: (_ for _ in ()).throw(ValueError()))
    assert machine.free_memory() > 0
    monkeypatch.setattr(machine.Path, "exists", lambda _: False)
    assert machine.peak_memory_mb() > 50
    monkeypatch.setitem(sys.modules, "resource", None)
    assert np.isnan(machine.peak_memory_mb())
