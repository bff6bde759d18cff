"""Everything that decides a run: the configs of its stages, nested. Presets hold the numbers."""

from dataclasses import dataclass, field, replace
from functools import cache
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np

from jaxdeconf import checks
from jaxdeconf.collect import CollectConfig
from jaxdeconf.evaluate import EvaluateConfig
from jaxdeconf.expert import ExpertConfig
from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.learn.disentangle import DisentangleConfig, check_size
from jaxdeconf.mask import MaskConfig
from jaxdeconf.method import Need, configured, imitated
from jaxdeconf.methods import METHODS, require, usual
from jaxdeconf.systems import System
from jaxdeconf.systems.signal import PREVIOUS_ACTION, SIGNALS
from jaxdeconf.traced import traceable


@traceable
@dataclass(frozen=True)
class Config:
    """One run. Sections are named after what is done."""

    system: str = "cartpole"
    preset: str = ""  # which it comes from
    seed: int = 0  # every random choice of the run derives from it
    methods: tuple[str, ...] = field(default_factory=usual)  # cloned and driven
    collect: CollectConfig = field(default_factory=CollectConfig)
    expert: ExpertConfig = field(default_factory=ExpertConfig)
    disentangle: DisentangleConfig = field(default_factory=DisentangleConfig)
    mask: MaskConfig = field(default_factory=MaskConfig)
    clone: CloneConfig = field(default_factory=CloneConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)

    def __post_init__(self):
        checks.integer("seed", self.seed, least=0, most=2**32 - 1)
        for name in self.methods:
            checks.one_of("methods", name, tuple(METHODS))
        if len(set(self.methods)) < len(self.methods):
            raise ValueError(f"methods: expected each once, got {' '.join(self.methods)}")


def fitting(config: Config, system: System) -> System:
    """The system as a config wants it, if the two fit: before anything is collected.

    Raises:
      ValueError: naming the field that does not fit the system, or the data that there will be.
    """
    checks.instance("system", system, System)
    if config.collect.size is not None:
        system = replace(system, size=config.collect.size)
    if config.collect.nuisance != PREVIOUS_ACTION.name:  # else a system of one's own may differ
        system = replace(system, signal=SIGNALS[config.collect.nuisance])
    drawn, wanted = _drawn(system), system.frame_shape
    if drawn != wanted:
        raise ValueError(f"draw: expected images of shape {list(wanted)}, got {list(drawn)}")
    check_size(config.disentangle, system.size)
    checks.integer("reaction_horizon", config.mask.reaction_horizon, most=system.steps)
    lengths = np.full(config.collect.expert_trajectories, system.steps)
    samples = imitated(lengths, config.clone)
    met = {*get_args(Need)} - (set() if hasattr(system.nuisance, "cover") else {"cover"})
    for name in config.methods:
        require(name, met)
        configured(METHODS[name], config.clone).total_steps(samples)
    return system


@cache
def _drawn(system: System) -> tuple[int, ...]:
    """The shape of what a system draws; drawing it would compile it."""
    state = jnp.zeros(len(system.state_names))
    return jax.eval_shape(lambda state: system.draw(state, system.size), state).shape
