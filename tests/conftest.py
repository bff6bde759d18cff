"""One uninterrupted run of every stage, which several tests look at, and its compiled programs."""

import json
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import pytest

# As the command does: beside another process, the threads of linear algebra wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A command called within a test's process would turn the cache of compiled programs on for all
# later tests there, in the user's home: XLA crashed so, once as it wrote and once as it read.
os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"

# Compiling is most of the time of a test, so it takes LLVM's shortest way. Whole programs are
# compiled as for users: see `Experiments`.
os.environ["XLA_FLAGS"] = "--xla_backend_optimization_level=0"
if version("jaxlib").startswith("0.10."):  # a flag that XLA does not know ends the process
    os.environ["XLA_FLAGS"] += " --xla_cpu_use_fusion_emitters=false"

# The smoke preset, smaller yet: that stages fit together, in less time. Small chunks, so that there
# are edges to stop at.
SMOKE = (
    *("--preset", "smoke", "--collect.size", "32", "32"),
    *("--collect.random-trajectories", "60", "--collect.expert-trajectories", "48"),
    *("--collect.held-out-trajectories", "60"),
    *("--expert.horizon", "15", "--expert.initial-iterations", "20"),
    *("--disentangle.network.channels", "4", "4", "--disentangle.chunk", "4"),
    *("--clone.network.stages", "1", "--clone.chunk", "4"),
)
# Reconstructed and Inpainted take Masked's way.
METHODS = ("--methods", "BcVanilla", "BcManual", "Masked")


# XLA starts a thread a core, or a device if those are more (or as many as NPROC says), and splits
# long sums by their number: four threads, so that four devices change nothing on two cores.
THREADS = "4"


# Files whose tests look at the run that is `done`, or start with its programs.
SHARE_A_RUN = {"test_smoke.py", "test_interruption.py", "test_determinism.py", "test_damage.py"}


def pytest_xdist_make_scheduler(config, log):
    """A file a process; those that share a run in one."""
    from xdist.scheduler import LoadScopeScheduling

    class Files(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            file = nodeid.partition("::")[0]
            return "shared" if Path(file).name in SHARE_A_RUN else file

    return Files(config, log)


def pytest_collection_modifyitems(items):
    """Whole programs first: two processes then end at about the same time."""
    items.sort(key=lambda item: "experiment" not in getattr(item, "fixturenames", ()))


class Experiments:
    """Runs experiments as a user does, with one cache of compiled programs."""

    def __init__(self, cache: Path):
        as_users = {"JAX_ENABLE_COMPILATION_CACHE": "true", "XLA_FLAGS": ""}
        of_ours = {"XDG_CACHE_HOME": str(cache), "NPROC": THREADS}
        self.environment = {**os.environ, **as_users, **of_ours}

    def __call__(self, *arguments, start=("-m", "experiments.cartpole"), **environment):
        return subprocess.run(
            [sys.executable, "-W", "error", *start, *map(str, arguments)],
            capture_output=True,
            text=True,
            env={**self.environment, **environment},
        )


class Done(NamedTuple):
    directory: Path
    process: subprocess.CompletedProcess


@pytest.fixture(scope="session")
def experiment(tmp_path_factory):
    return Experiments(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="session")
def done(tmp_path_factory, experiment):
    directory = tmp_path_factory.mktemp("runs") / "smoke"
    process = experiment(*SMOKE, *METHODS, "--out", directory)
    assert process.returncode == 0, process.stderr
    return Done(directory, process)


@pytest.fixture(scope="session")
def smoke():
    """The arguments of the run that is `done`."""
    return (*SMOKE, *METHODS)


@pytest.fixture(scope="session")
def small():
    """Its sizes alone."""
    return SMOKE


@pytest.fixture(scope="session")
def grains():
    """Images of grains: the cover and the β-VAE take whatever there is."""
    import jax.numpy as jnp  # late: this file is read by processes that run no test
    import numpy as np

    return jnp.asarray(np.random.default_rng(0).integers(0, 255, (5, 64, 64, 3), np.uint8))


@pytest.fixture(scope="module", autouse=True)
def forget_programs():
    """A process ends without a word at 65,530 memory maps, and XLA keeps three or more a program.

    Two processes with half of all tests each came to more than 50,000.
    """
    yield
    if jax := sys.modules.get("jax"):
        jax.clear_caches()


@pytest.fixture
def numbers():
    """What a run's results.json holds, but for times and memory."""

    def read(directory):
        results = json.loads((directory / "results.json").read_text())
        return {k: v for k, v in results.items() if k not in ("seconds", "peak_memory_mb")}

    return read
