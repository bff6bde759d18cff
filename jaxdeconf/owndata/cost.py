"""What a masking will take, before it begins: minutes of processor time, and memory."""

import time
from typing import NamedTuple

import numpy as np

from jaxdeconf.formats.source import Source
from jaxdeconf.owndata.config import Masking

# Of four maskings that were measured (docs/own-data.md): what does not depend on the data, and what
# a step on one image of 64 × 64 takes, in products of matrices of 1024 × 1024; and megabytes of the
# program, and for each of frames at the size that is learnt.
_ALWAYS, _IMAGE = 2400.0, 0.036
_PROGRAM, _HELD = 1500.0, 1.5


class Cost(NamedTuple):
    """About what is to come."""

    minutes: float  # of processor time, on this machine
    memory_mb: float


def expected(config: Masking, demos: Source, exploration: Source) -> Cost:
    """What a masking with the default networks will take."""
    both, pixels = (demos, exploration), config.size**2
    counts = [int(one.lengths.sum()) for one in both]
    training = config.disentangle
    batch = training.batch_size
    images = training.total_steps(max(counts[1], batch)) * batch * pixels / 64**2
    seconds = _product() * (_ALWAYS + _IMAGE * images)
    # An episode as it is stored is read at once, and held as it is, decoded and drawn.
    episode = max(int(one.lengths.max()) * 3 * one.size[0] * one.size[1] for one in both)
    return Cost(seconds / 60.0, _PROGRAM + (_HELD * 3 * pixels * sum(counts) + 3 * episode) / 2**20)


def _product() -> float:
    """Seconds that a product of two matrices of 1024 × 1024 takes a processor here."""
    matrix = np.ones((1024, 1024), np.float32)
    taken = []
    for _ in range(5):
        begin = time.process_time()
        np.matmul(matrix, matrix)
        taken.append(time.process_time() - begin)
    return min(taken)
