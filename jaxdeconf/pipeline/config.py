"""Everything that decides a run: the configs of the stages, nested. Defaults are the paper's."""

from dataclasses import dataclass, field
from typing import Literal

from jaxdeconf import checks, systems
from jaxdeconf.evaluate import EvaluateConfig
from jaxdeconf.expert import ExpertConfig
from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.learn.disentangle import DisentangleConfig


@dataclass(frozen=True)
class CollectConfig:
    """How many trajectories are collected."""

    random_trajectories: int = 5000  # random-policy ones, for the β-VAE; the paper's, for CartPole
    expert_trajectories: int = 1000  # for the mask and for cloning; the paper's, for CartPole
    held_out_trajectories: int = 500  # ours: random-policy ones that judge latents and leakage
    # Steps of each random-policy trajectory that are used, from the first; None is all, the
    # paper's. More trajectories of fewer steps show more initial states.
    random_steps: int | None = None

    def __post_init__(self):
        for name in ("random_trajectories", "held_out_trajectories"):
            checks.integer(name, getattr(self, name))
        # Hoeffding's D is a mean over quintuples.
        checks.integer("expert_trajectories", self.expert_trajectories, least=5)
        if self.random_steps is not None:
            checks.integer("random_steps", self.random_steps)


@dataclass(frozen=True)
class MaskConfig:
    """Algorithm 1's hyperparameters."""

    reaction_horizon: int = 3  # H, steps in which the expert reacts; the paper's, for CartPole
    threshold: float = 1e-3  # gamma, on 30 x Hoeffding's D; the paper's
    # Family-wise error of the independence tests; raises the threshold where it must. None is the
    # paper's bare gamma, which a disentangled nuisance exceeds by chance in one dataset in six.
    alpha: float | None = None

    def __post_init__(self):
        checks.integer("reaction_horizon", self.reaction_horizon)
        checks.not_negative("threshold", self.threshold)
        if self.alpha is not None:
            checks.number("alpha", self.alpha, "a number in (0, 1)", 0.0, 1.0)


@dataclass(frozen=True)
class Config:
    """One run."""

    system: str = "cartpole"
    preset: Literal["smoke", "laptop", "paper"] = "paper"
    seed: int = 0  # every random choice of the run derives from it
    collect: CollectConfig = field(default_factory=CollectConfig)
    expert: ExpertConfig = field(default_factory=ExpertConfig)
    vae: DisentangleConfig = field(default_factory=DisentangleConfig)
    mask: MaskConfig = field(default_factory=MaskConfig)
    bc: CloneConfig = field(default_factory=CloneConfig)
    eval: EvaluateConfig = field(default_factory=EvaluateConfig)

    def __post_init__(self):
        checks.one_of("system", self.system, systems.names())
        checks.integer("seed", self.seed, least=0, most=2**32 - 1)
        steps = systems.get(self.system).steps
        checks.integer("reaction_horizon", self.mask.reaction_horizon, most=steps)
        # Here rather than when cloning begins, minutes later.
        imitated = min(self.bc.trajectory_steps or steps, steps)
        self.bc.steps(self.collect.expert_trajectories * imitated)
