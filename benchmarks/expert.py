"""How fast the expert is, with its error against IPOPT beside it: `python -m benchmarks.expert`.

Closed loop from states of the CartPole box: compile time, median run, time a step and trajectory,
device, peak memory; then the cost against the optima of casadi 3.8.2 / IPOPT (tests/golden).
"""

import argparse
import json
import resource
import time
from pathlib import Path

import jax
import numpy as np

from jaxdeconf import systems
from jaxdeconf.expert import expert_trajectories, plan

GOLDEN = Path(__file__).parents[1] / "tests" / "golden" / "control.json"


def seconds(call) -> np.ndarray:
    """Seconds of a call, until its arrays are there: by the clock, and of processor time."""
    start = np.array([time.perf_counter(), time.process_time()])
    jax.block_until_ready(call())
    return np.array([time.perf_counter(), time.process_time()]) - start


def speed(count: int, repeats: int) -> None:
    """Closed loop from `count` states."""
    system = systems.get("cartpole")
    states = jax.vmap(system.sample_initial)(jax.random.split(jax.random.key(0), count))
    keys = jax.random.split(jax.random.key(1), repeats + 1)
    first = seconds(lambda: expert_trajectories(system, states, keys[0]))
    runs = [seconds(lambda key=key: expert_trajectories(system, states, key)) for key in keys[1:]]
    median, processor = np.median(runs, axis=0)
    trajectories, unconverged = expert_trajectories(system, states, keys[0])
    outside = np.abs(trajectories.states) > np.array([5, 10, np.pi / 2, np.pi / 2])
    device = jax.devices()[0]
    print(f"device              {device.platform} {device.device_kind}")
    print(f"trajectories        {count} of {system.steps} steps")
    print(f"compile             {first[0] - median:.1f} s (first call less the median)")
    print(f"run                 {median:.2f} s median of {repeats}")
    print(f"processor time      {processor:.2f} s median, over all cores")
    print(f"step and trajectory {1e6 * median / count / system.steps:.1f} us")
    print(
        f"peak memory         {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB"
    )
    print(f"out of bounds       {int((~trajectories.valid).any(axis=1).sum())} trajectories")
    print(f"soft limits broken  {outside.any(axis=(1, 2)).mean():.1%} of trajectories")
    print(f"unconverged         {int((unconverged > 0).sum())} trajectories")


def error() -> None:
    """Costs against the golden optima."""
    system, golden = systems.get("cartpole"), json.loads(GOLDEN.read_text())
    optima = golden["cartpole_soft_N30"]
    states = np.array([case["x0"] for case in optima])
    plans = plan(system, states)
    excess = np.asarray(plans.cost) / [case["cost"] for case in optima] - 1
    print(f"open loop           {np.abs(excess).max():.1e} worst relative error of ten optima")
    trajectories, _ = expert_trajectories(system, states, jax.random.key(0))
    costs = jax.vmap(jax.vmap(system.stage_cost))(trajectories.states, trajectories.actions)
    expected = golden["cartpole_closed_loop_soft_N30"]["stage_cost_sum"]
    excess = np.asarray(costs.sum(axis=1)) / expected - 1
    print(f"closed loop         {np.abs(excess).max():.1e} worst relative error of ten MPC runs")


def main() -> None:
    """Reads the sizes and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000, help="trajectories")
    parser.add_argument("--repeats", type=int, default=5, help="timed runs")
    arguments = parser.parse_args()
    speed(arguments.count, arguments.repeats)
    error()


if __name__ == "__main__":
    main()
