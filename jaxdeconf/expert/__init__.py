"""The expert that the cloned policy imitates: constrained receding-horizon control."""

from jaxdeconf.expert.mpc import (
    ExpertConfig,
    Plans,
    expert_trajectories,
    plan,
    receding_horizon,
    relabel,
)

__all__ = ["ExpertConfig", "Plans", "expert_trajectories", "plan", "receding_horizon", "relabel"]
