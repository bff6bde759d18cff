"""How fast the expert is, with its error against IPOPT beside it.

    python -m benchmarks.expert
    python -m benchmarks.expert --system reacher

Closed loop from random initial states: compile time, median run, time a step and trajectory,
device, peak memory, and how the trajectories went; then the cost against the optima of casadi
3.8.2 / IPOPT (tests/golden), for Reacher the best of its eight starts.
"""

import argparse
import json
import resource
import time
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jax import Array

from jaxdeconf import evaluate, systems
from jaxdeconf.expert import ExpertConfig, expert_trajectories, plan
from jaxdeconf.systems import System, Trajectories

GOLDEN = Path(__file__).parents[1] / "tests" / "golden" / "control.json"


class Case(NamedTuple):
    """A system's expert, and where its golden values stand."""

    config: ExpertConfig
    optima: str  # open-loop plans of K = 30
    closed_loop: str
    soft_limits: bool  # whether the system has any that a trajectory could break


CASES = {
    "cartpole": Case(
        ExpertConfig(), "cartpole_soft_N30", "cartpole_closed_loop_soft_N30", soft_limits=True
    ),
    "reacher": Case(
        # That of the presets.
        ExpertConfig(initial_iterations=15, step_iterations=1),
        "reacher_rk4_N30",
        "reacher_closed_loop_rk4_N30",
        soft_limits=False,
    ),
}


def seconds(call) -> np.ndarray:
    """Seconds of a call, until its arrays are there: by the clock, and of processor time."""
    start = np.array([time.perf_counter(), time.process_time()])
    jax.block_until_ready(call())
    return np.array([time.perf_counter(), time.process_time()]) - start


def speed(system: System, case: Case, count: int, repeats: int) -> None:
    """Closed loop from `count` states."""
    states = jax.vmap(system.sample_initial)(jax.random.split(jax.random.key(0), count))

    def run(key: Array) -> tuple[Trajectories, Array]:
        return expert_trajectories(system, states, key, case.config)

    keys = jax.random.split(jax.random.key(1), repeats + 1)
    first = seconds(lambda: run(keys[0]))
    runs = [seconds(lambda key=key: run(key)) for key in keys[1:]]
    median, processor = np.median(runs, axis=0)
    device = jax.devices()[0]
    print(f"device              {device.platform} {device.device_kind}")
    print(f"trajectories        {count} of {system.steps} steps of {system.name}")
    print(f"compile             {first[0] - median:.1f} s (first call less the median)")
    print(f"run                 {median:.2f} s median of {repeats}")
    print(f"processor time      {processor:.2f} s median, over all cores")
    print(f"step and trajectory {1e6 * median / count / system.steps:.1f} us")
    print(
        f"peak memory         {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB"
    )
    conduct(system, case, *run(keys[0]))


def conduct(system: System, case: Case, trajectories: Trajectories, unconverged: Array) -> None:
    """How the trajectories went: what they came to, and their faults."""
    outcomes, form = evaluate.outcome(system, trajectories), system.outcome.form
    spread = f"{outcomes.min():{form}} to {outcomes.max():{form}}"
    print(f"{system.outcome.name:20}{outcomes.mean():{form}} mean, {spread}")
    print(f"out of bounds       {int((~trajectories.valid).any(axis=1).sum())} trajectories")
    if case.soft_limits:
        outside = jax.vmap(jax.vmap(system.state_penalty))(trajectories.states) > 0
        print(f"soft limits broken  {outside.any(axis=1).mean():.1%} of trajectories")
    share = unconverged.sum() / trajectories.valid.size
    print(f"unconverged         {int((unconverged > 0).sum())} trajectories, {share:.1%} of steps")


def error(system: System, case: Case) -> None:
    """Costs against the golden optima, which for Reacher hold target and arm apart."""
    golden = json.loads(GOLDEN.read_text())
    optima, closed_loop = golden[case.optima], golden[case.closed_loop]
    states = np.array([optimum.get("target", []) + optimum["x0"] for optimum in optima])
    plans = plan(system, states, case.config)
    excess = np.asarray(plans.cost) / [optimum["cost"] for optimum in optima] - 1
    print(f"open loop           {np.abs(excess).max():.1e} worst relative error of ten optima")
    trajectories, _ = expert_trajectories(system, states, jax.random.key(0), case.config)
    costs = jax.vmap(jax.vmap(system.stage_cost))(trajectories.states, trajectories.actions)
    total = costs[:, : closed_loop["T"]].sum(axis=1)
    excess = np.asarray(total) / closed_loop["stage_cost_sum"] - 1
    print(f"closed loop         {np.abs(excess).max():.1e} worst relative error of ten MPC runs")


def main() -> None:
    """Reads the system and the sizes and prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--system", choices=CASES, default="cartpole", help="what moves")
    parser.add_argument("--count", type=int, default=1000, help="trajectories")
    parser.add_argument("--repeats", type=int, default=5, help="timed runs")
    arguments = parser.parse_args()
    system, case = systems.get(arguments.system), CASES[arguments.system]
    speed(system, case, arguments.count, arguments.repeats)
    error(system, case)


if __name__ == "__main__":
    main()
