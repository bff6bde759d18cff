"""Configs as pytrees: what is a leaf, what is structure, and what compiles again."""

from dataclasses import dataclass, fields, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.evaluate import EvaluateConfig
from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.learn.disentangle import DisentangleConfig
from jaxdeconf.learn.fit import FitConfig
from jaxdeconf.mask import MaskConfig
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.pipeline.config import Config
from jaxdeconf.traced import Traced, traceable

MADE = []


@traceable
@dataclass(frozen=True)
class Line:
    """A made-up config; says when it is made the ordinary way."""

    slope: Traced = 2.0
    order: int = 1
    offset: Traced | None = None
    name: str = "line"

    def __post_init__(self):
        MADE.append(self)

    def at(self, x):
        """Its value."""
        return self.slope * x**self.order + (0.0 if self.offset is None else self.offset)


@pytest.mark.parametrize(
    ("config", "leaves"),
    [
        (Line(3.0), [3.0]),
        (Line(3.0, offset=4.0), [3.0, 4.0]),
        (FitConfig(learning_rate=0.1, decay=0.2, weight_decay=0.3), [0.1, 0.2, 0.3]),
        (CloneConfig(), [1e-3, 0.96, 0.0]),
        (CloneConfig(huber=0.1), [1e-3, 0.96, 0.0, 0.1]),
        (DisentangleConfig(beta=7.0), [1e-3, 0.95, 0.0, 7.0, 25.0]),
        (MaskConfig(threshold=0.02), [0.02]),
        (VAEConfig(), []),
        (EvaluateConfig(), []),
        (Config(), []),
    ],
    ids=lambda value: type(value).__name__,
)
def test_traced_fields_are_the_leaves_in_their_order(config, leaves):
    assert jax.tree.leaves(config) == leaves
    again = jax.tree.map(lambda leaf: leaf, config)
    assert again == config
    assert type(again) is type(config)


def test_structure_is_equal_if_and_only_if_all_but_the_leaves_is():
    structure = jax.tree.structure
    assert structure(Line(1.0)) == structure(Line(2.0))
    assert structure(Line(offset=1.0)) == structure(Line(offset=2.0))
    assert structure(Line(offset=1.0)) != structure(Line())  # None is no number
    assert structure(Line(order=1)) != structure(Line(order=2))
    assert structure(CloneConfig(huber=0.1)) != structure(CloneConfig())
    assert structure(CloneConfig()) != structure(FitConfig())
    first, second = VAEConfig(latents=3), VAEConfig(latents=4)
    assert structure(DisentangleConfig(network=first)) != structure(
        DisentangleConfig(network=second)
    )


def test_jit_compiles_once_for_all_leaves_and_again_for_another_structure():
    traces = []

    @jax.jit
    def value(line, x):
        traces.append(line.order)
        return line.at(x)

    assert [float(value(Line(slope), 3.0)) for slope in (1.0, 2.0, 5.0)] == [3.0, 6.0, 15.0]
    assert traces == [1]
    assert float(value(Line(2.0, order=2), 3.0)) == 18.0
    assert float(value(Line(2.0, offset=1.0), 3.0)) == 7.0
    assert traces == [1, 2, 1]


def test_vmap_over_a_config_whose_leaves_have_an_axis():
    lines = [Line(slope, offset=offset) for slope, offset in ((1.0, 0.5), (2.0, -1.0), (4.0, 0.0))]
    together = jax.tree.map(lambda *leaves: jnp.stack(jnp.asarray(leaves)), *lines)
    assert together.slope.shape == (3,)
    found = jax.vmap(lambda line: line.at(3.0))(together)
    np.testing.assert_allclose(found, [line.at(3.0) for line in lines])


def test_it_is_checked_when_made_and_not_when_unflattened():
    line = Line()
    MADE.clear()
    leaves, structure = jax.tree.flatten(line)
    assert structure.unflatten([object()]).slope is not leaves[0]  # whatever a transformation puts
    jax.eval_shape(lambda line: line, line)
    assert MADE == []
    replace(line, slope=3.0)
    assert len(MADE) == 1
    with pytest.raises(ValueError, match=r"learning_rate: expected a positive number, got -1.0"):
        FitConfig(learning_rate=-1.0)


def test_a_traced_leaf_may_stand_in_a_config_that_is_made_inside_of_jit():
    @jax.jit
    def decayed(rate):
        return FitConfig(learning_rate=rate).learning_rate * 0.5

    assert float(decayed(0.5)) == 0.25


def test_an_unflattened_config_is_the_dataclass_it_was():
    config = jax.tree.map(lambda leaf: 2 * leaf, CloneConfig(huber=0.1, frames=3))
    assert (config.huber, config.frames, config.learning_rate) == (0.2, 3, 2e-3)
    assert {field.name for field in fields(config)} == set(vars(config))
    assert config == CloneConfig(huber=0.2, frames=3, learning_rate=2e-3, decay=1.92)
    assert hash(config) == hash(replace(config))
