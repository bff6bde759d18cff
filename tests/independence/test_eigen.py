"""Eigenvalues against NumPy's, and asked for by many threads at a time."""

import subprocess
import sys

import jax
import numpy as np
import pytest

from jaxdeconf.independence.eigen import eigenvalues

# More threads than cores, a batch each, again and again: with LAPACK's own batches it stands still
# within the first hundred.
MANY = """
import threading
import numpy as np
from jaxdeconf import threads
from jaxdeconf.independence.refined import REFINED
from jaxdeconf.independence.ties import with_ties

tied = np.random.default_rng(0).integers(0, 3, size=(100, 8))
def ask():
    for _ in range(200):
        with_ties(tied, tied, REFINED)[0].block_until_ready()

ask()
asking = [threading.Thread(target=ask) for _ in range(threads.cores() + 2)]
for one in asking:
    one.start()
for one in asking:
    one.join()
"""


@pytest.mark.parametrize("shape", [(), (7,), (3, 5)])
def test_they_are_numpys_whatever_is_mapped_over(shape):
    half = np.random.default_rng(1).normal(size=(*shape, 6, 9))
    covariances = half @ half.swapaxes(-1, -2)
    wanted = np.linalg.eigvalsh(covariances)
    with jax.enable_x64(True):
        np.testing.assert_allclose(eigenvalues(covariances), wanted, rtol=1e-10)
        if shape:
            mapped = jax.jit(jax.vmap(eigenvalues))(covariances)
            np.testing.assert_allclose(mapped, wanted, rtol=1e-10)


def test_threads_that_ask_at_a_time_do_not_wait_for_one_another():
    subprocess.run([sys.executable, "-W", "error", "-c", MANY], check=True, timeout=120)
