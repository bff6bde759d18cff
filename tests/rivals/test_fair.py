"""Every row of the fair rivals and controls goes through `clone_policy`, and is not plain cloning.

What the first gradient is, is read off Adam's first moment: a tenth of it.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.deconfound import clone_policy
from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.learn.fit import FitState
from jaxdeconf.methods import METHODS, usual
from jaxdeconf.nets.vq import VQConfig
from jaxdeconf.rivals import codes
from jaxdeconf.rivals.codes import CodesConfig
from jaxdeconf.rivals.fair import ROWS
from tests.rivals import toy

TRACES = []
COUNTED = {}  # by objective: the same function whenever the same program is meant


def counted(objective):
    """The objective, which says so whenever it is traced."""

    def make(config):
        loss = objective(config)

        def count(*arguments):
            TRACES.append(objective)
            return loss(*arguments)

        return count

    return COUNTED.setdefault(objective, make)


class Cloned(NamedTuple):
    start: FitState
    state: FitState
    loss: float
    config: CloneConfig
    traces: int

    @property
    def gradient(self):
        return jax.tree.map(lambda a: 10 * np.asarray(a), self.state.moments.mu)


@pytest.fixture(scope="module")
def given():
    return toy.demos(), toy.evidence()


@pytest.fixture
def cloned(given, monkeypatch):
    """(name, config) -> what the policy's training came to."""
    network = VQConfig(codes=8, dimension=3, channels=(2, 2, 2))
    monkeypatch.setattr(codes, "CONFIG", CodesConfig(steps=1, batch_size=16, network=network))

    def clone(name, config=toy.CLONE):
        found, traces = [], len(TRACES)

        def watch(stage, training):
            begin = jax.tree.map(jnp.copy, training.start(training.data()))
            *_, (state, metrics) = training.chunks(stage)
            if stage == f"clone {name}":
                loss, count = metrics["loss"], len(TRACES) - traces
                found.append(Cloned(begin, state, loss, training.config, count))
            return state

        row = METHODS[name]
        monkeypatch.setitem(METHODS, name, row._replace(objective=counted(row.objective)))
        clone_policy(name, *given, toy.KEY, config, watch)
        monkeypatch.setitem(METHODS, name, row)
        return found[0]

    return clone


def same(a, b):
    return jax.tree.all(jax.tree.map(lambda a, b: np.allclose(a, b, rtol=1e-3, atol=1e-7), a, b))


# Rows whose first gradient differs from plain cloning's with the same config, and whether at the
# last layer, too: a penalty on the features does not reach it.
DIFFER = {
    "Palr": False,
    "Fca": False,
    "Keyframes": True,
    "Oreo": True,
    "LatentDropout": True,
    "Cutout": True,
    "Dropout": True,
}
PLAIN = {"LatentDropout": "Reconstructed"}  # what to compare with


@pytest.mark.parametrize("name", ROWS)
def test_a_row_trains_and_its_gradient_is_its_own(name, cloned):
    found = cloned(name)
    assert np.isfinite(found.loss)
    moved = jax.tree.map(lambda a, b: bool((a != b).any()), found.start, found.state)
    assert moved.variables["params"]["head"]["kernel"]
    plain = cloned(PLAIN.get(name, "BcVanilla"), replace(found.config, strength=None))
    gradient, expected = found.gradient, plain.gradient
    gradient.pop("adversary", None)
    same_head = same(gradient.pop("head"), expected.pop("head"))
    assert same(gradient, expected) == (name not in DIFFER)
    assert same_head == (not DIFFER.get(name, False))


@pytest.mark.parametrize("name", [name for name, row in ROWS.items() if row.strength is not None])
def test_two_strengths_are_one_program(name, cloned):
    first = cloned(name, replace(toy.CLONE, strength=0.3))
    second = cloned(name, replace(toy.CLONE, strength=0.6))
    assert second.traces == 0
    assert not same(first.gradient, second.gradient)


def test_no_row_is_cloned_unasked():
    assert ROWS.keys() <= METHODS.keys()
    assert not ROWS.keys() & {*usual()}
    assert all(row.rival and row.note.endswith(".") for row in ROWS.values())


@pytest.mark.parametrize("name", ["LatentDropout", "Dropout"])
def test_not_all_can_be_dropped(name, cloned):
    with pytest.raises(ValueError, match=r"^strength: expected a share in \[0, 1\), got 1.0$"):
        cloned(name, replace(toy.CLONE, strength=1.0))
