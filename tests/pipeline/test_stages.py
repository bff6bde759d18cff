"""Trainings whose data take a training first: what is done again when such a one is resumed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from jaxdeconf.learn.fit import FitConfig, Training, start
from jaxdeconf.pipeline import checkpoint, stages
from jaxdeconf.pipeline.interruption import Interrupted, Interruption
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.store import Store
from jaxdeconf.presets import PRESETS

CONFIG = PRESETS["cartpole"]["smoke"]
FIT = FitConfig(steps=16, batch_size=4, chunk=4)


def towards(config):
    """A loss that pulls a weight to the data."""

    def loss(variables, data, indices, key, step):
        return jnp.mean((variables["params"]["w"] - data[indices]) ** 2), ({}, {})

    return loss


def begin(data):
    return start({"params": {"w": jnp.zeros(())}, "batch_stats": {}})


def opened(directory, resume=False, interruption=None):
    store = Store(directory, CONFIG, resume)
    reporter = Reporter(Console(quiet=True))
    return stages.Run(CONFIG, store, reporter, interruption or Interruption())


def outer(run, made):
    """Its data are what an inner training came to; `made` counts how often that was asked for."""

    def data(watch):
        inner = Training(towards, FIT, 8, jax.random.key(1), lambda: jnp.ones(8), begin, _as_it_is)
        made.append(watch == run.watch)
        weight = watch("inner", inner).variables["params"]["w"]
        return jnp.full(8, weight)

    def untrained(_, training):
        return training.start(training.data())

    key = jax.random.key(2)
    first = Training(towards, FIT, 8, key, lambda: data(run.watch), begin, _as_it_is)
    return first._replace(like=lambda: data(untrained))


def _as_it_is(state):
    return state


def test_one_that_is_done_is_loaded_and_the_one_before_is_not_asked_for(tmp_path):
    run, made = opened(tmp_path / "run"), []
    found = run.watch("outer", outer(run, made))
    assert made == [True]
    assert set(run.seconds) == {"inner", "outer"}
    again, made = opened(tmp_path / "run", resume=True), []
    loaded = again.watch("outer", outer(again, made))
    assert made == [False]  # for shapes, by the watch that trains nothing
    jax.tree.map(np.testing.assert_array_equal, found, loaded)


class After(Interruption):
    """Stops at a chunk's edge, the nth of all."""

    def __init__(self, edges):
        super().__init__()
        self.left = edges

    def check(self):
        self.left -= 1
        if self.left == 0:
            raise Interrupted(15)


@pytest.mark.parametrize(("edges", "inner", "own"), [(3, 6, None), (11, 16, 6)])
def test_one_that_was_stopped_goes_on_from_where_both_are(edges, inner, own, tmp_path, monkeypatch):
    """In the middle of the training before, and of its own."""
    whole = opened(tmp_path / "whole")
    wanted = whole.watch("outer", outer(whole, []))
    monkeypatch.setattr(stages, "SAVE_SECONDS", 0.0)
    run = opened(tmp_path / "run", interruption=After(edges))
    with pytest.raises(Interrupted):
        run.watch("outer", outer(run, []))
    checkpoints = tmp_path / "run" / "checkpoints"
    for name, step in (("inner", inner), ("outer", own)):
        last = checkpoint.latest(checkpoints / name)
        assert (None if last is None else int(last.name)) == step
    again = opened(tmp_path / "run", resume=True)
    found = again.watch("outer", outer(again, []))
    jax.tree.map(np.testing.assert_array_equal, found, wanted)
