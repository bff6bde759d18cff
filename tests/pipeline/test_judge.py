"""The numbers of the report against what can be counted by hand."""

import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import systems, threads
from jaxdeconf.collect import Collected, Exploration
from jaxdeconf.independence.hscic import hscic
from jaxdeconf.learn.clone import Policy
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.nets import network
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.pipeline import judge
from jaxdeconf.systems import Trajectories
from jaxdeconf.systems.rollout import random_trajectories
from jaxdeconf.views import identity


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


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_what_is_left_of_the_past_is_hscic_at_the_same_steps(frames, monkeypatch):
    """A policy that answers with the action before, which the nuisance of a frame shows."""
    system = replace(systems.get("cartpole"), size=(16, 16), steps=9)
    trajectories = random_trajectories(system, jax.random.key(0), 40)
    expert = trajectories._replace(actions=trajectories.actions - trajectories.previous_actions)
    monkeypatch.setattr(
        network, "apply", lambda *a, train: (2.0 * a[2][:, 1, 1, -3:-2].astype(jnp.float32) - 1, {})
    )
    copy = Policy(identity, NetworkConfig(width=17), frames, {}, {})
    collected = Collected(*[expert] * 4, jnp.zeros(40, int))
    trial = judge.Trial(system, jax.random.key(1), collected, None)
    first = max(1, frames - 1)
    before, acted = (v[:, first:].reshape(-1, 1) for v in (expert.previous_actions, expert.actions))
    want = float(hscic(before, before, acted))
    assert judge.past_leakage(trial, copy) == pytest.approx(want, rel=1e-2)
    assert want > 1e-3


def test_leakage_is_regressed_from_frames_apart(monkeypatch):
    """Each shows its place in one pixel: what is asked for is a regression of every fifth."""
    monkeypatch.setattr(judge, "_JUDGE_FRAMES", 5)
    places = jnp.arange(42)
    images = jnp.zeros((42, 4, 4, 3), jnp.uint8).at[:, 0, 0, 0].set(places.astype(jnp.uint8))
    held_out = Exploration(images, places[:, None] / 42, places[:, None] / 42)
    trial = judge.Trial(systems.get("cartpole"), jax.random.key(0), None, held_out)  # type: ignore
    asked = []
    monkeypatch.setattr(judge.leakage, "leaked", lambda *given: asked.append(given) or 0.0)
    judge.leaked(trial, identity, {})
    images, signal, _ = asked[0]
    seen = images[:, 0, 0, 0]
    np.testing.assert_array_equal(seen, range(0, 42, 5))
    np.testing.assert_allclose(signal[:, 0], seen / 42, rtol=1e-6)


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


def test_programs_are_forgotten_where_they_are_many():
    from jaxdeconf.pipeline import machine

    double = jax.jit(lambda x: 2 * x)
    double(1.0)
    machine.forget_programs()
    assert double._cache_size() == 1
    machine.forget_programs(most=1)
    assert double._cache_size() == 0
    assert double(1.0) == 2.0


@pytest.mark.parametrize(("data", "many"), [(1e6, 3), (0.5e9, 3), (1e9, 2), (2.5e9, 1), (1e12, 1)])
def test_as_many_networks_train_at_once_as_cores_and_memory_allow(data, many, monkeypatch):
    from jaxdeconf.pipeline import machine

    monkeypatch.setattr(threads, "cores", lambda: 3)
    monkeypatch.setattr(machine, "free_memory", lambda: 10e9)
    assert machine.trainings(data) == many
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert machine.trainings(data) == 1


def test_a_machine_that_does_not_say_is_no_fault(monkeypatch):
    """Reference: what macOS and Windows lack."""
    import os

    from jaxdeconf.pipeline import machine

    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert threads.cores() >= 1
    monkeypatch.setattr(os, "sysconf", lambda _: (_ for _ in ()).throw(ValueError()))
    assert machine.free_memory() > 0
    monkeypatch.setattr(machine.Path, "exists", lambda _: False)
    assert machine.peak_memory_mb() > 50
    monkeypatch.setitem(sys.modules, "resource", None)
    assert np.isnan(machine.peak_memory_mb())
