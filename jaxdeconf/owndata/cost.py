"""What a masking will take, before it begins: minutes of processor time, and memory."""

import time
from typing import NamedTuple

import numpy as np

from jaxdeconf.formats.source import Source
from jaxdeconf.learn import clone
from jaxdeconf.learn.fit import FitConfig
from jaxdeconf.owndata.config import Masking

# Fitted to maskings in docs/own-data.md, which they meet within a tenth; one whose programs are in
# the cache takes a sixth less of both. Time, in products of matrices of 1024 × 1024: whatever the
# data are, and for an image of 64 × 64 that is trained on. Memory: MB of the program, and copies
# that are held of all frames at the size that is learnt, of the demonstrations where policies are
# cloned, and of the longest episode as recorded.
_ALWAYS, _IMAGE = 2000.0, 0.045
_PROGRAM, _HELD, _CLONED, _EPISODE = 1500.0, 1.6, 3.0, 3.0


class Cost(NamedTuple):
    """About what is to come."""

    minutes: float  # of processor time, on this machine
    memory_mb: float


def expected(config: Masking, demos: Source, exploration: Source) -> Cost:
    """What a masking with the default networks will take."""
    pixels, both = config.size**2, (demos, exploration)
    steps = [int(one.lengths.sum()) for one in both]
    images, held = _images(config.disentangle, steps[1]), _HELD * sum(steps)
    if config.clone:
        images += 2 * _images(clone.CPU, steps[0])
        held += _CLONED * steps[0]
    seconds = _product() * (_ALWAYS + _IMAGE * images * pixels / 64**2)
    episode = _EPISODE * max(int(one.lengths.max()) * one.size[0] * one.size[1] for one in both)
    return Cost(seconds / 60.0, _PROGRAM + 3 * (held * pixels + episode) / 2**20)


def _images(config: FitConfig, samples: int) -> int:
    """How many a training looks at."""
    return config.total_steps(max(samples, config.batch_size)) * config.batch_size


def _product() -> float:
    """Seconds that a product of two matrices of 1024 × 1024 takes a processor here."""
    matrix = np.ones((1024, 1024), np.float32)
    taken = []
    for _ in range(5):
        begin = time.process_time()
        np.matmul(matrix, matrix)
        taken.append(time.process_time() - begin)
    return min(taken)
