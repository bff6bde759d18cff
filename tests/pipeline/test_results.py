"""The numbers of the report against what can be counted by hand."""

import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from experiments.cartpole import PRESETS
from jaxdeconf.pipeline import results, stages
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.systems import Trajectories


def test_the_experts_faults_are_counted():
    # 2 trajectories of 5 steps. Outside the soft limits (5 m, 10 m/s, pi/2, pi/2): 3 of the 8
    # states after the first ones, where limits do not hold yet.
    states = np.zeros((2, 5, 4), np.float32)
    states[0, 0] = [9, 0, 0, 0]
    states[0, 2] = [5.1, 0, 0, 0]
    states[1, 3] = [0, -10.1, 0, 0]
    states[1, 4] = [0, 9.9, 0, 2.0]
    expert = Trajectories(
        jnp.asarray(states), jnp.zeros((2, 5, 1)), jnp.zeros((2, 5, 1)), jnp.ones((2, 5), bool)
    )
    collected = stages.Collected(expert, expert, expert, expert, jnp.array([1, 3]))
    run = stages.Run(PRESETS["smoke"], None, Reporter(Console(quiet=True)), {})
    judged = results.judge_expert(run, collected)
    assert float(judged["violation_rate"]) == pytest.approx(3 / 8)
    assert float(judged["unconverged"]) == pytest.approx(4 / 10)
    assert float(judged["outcome"]) == 1.0


def test_peak_memory_is_the_processs_own():
    # 200 MB more of it show as 200 MB more, whatever the process that started it holds.
    code = (
        "from jaxdeconf.pipeline.results import peak_memory_mb\n"
        "before = peak_memory_mb()\nblock = b'x' * (200 << 20)\ndel block\n"
        "print(before, peak_memory_mb())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    before, after = map(float, done.stdout.split())
    assert 50 < before < 1000
    assert after - before == pytest.approx(200, abs=10)
