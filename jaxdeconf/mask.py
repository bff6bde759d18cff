"""Algorithm 1 of the paper: which observations to mask, from N expert trajectories.

An observation may cause an action if some initial state is dependent on both. An observation
that may cause no action within the reaction horizon is masked. Everything is read at the first
time step, where the intervention on the initial state has cut every other common cause.
Shapes: N trajectories, S state, O latent observation, H reaction horizon, A action.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from jaxdeconf import checks
from jaxdeconf.independence import hoeffding_d, p_value
from jaxdeconf.independence import threshold as null_threshold


class Mask(NamedTuple):
    """The mask and the evidence for it."""

    mask: Array  # [O] bool: True where the observation is to be masked
    state_observation: Array  # [S, O] Hoeffding's D
    state_action: Array  # [S, H, A] Hoeffding's D
    potential_cause: Array  # [O, H, A] bool: the observation may cause the action
    threshold: float  # dependence means D above it
    p_state_observation: Array  # [S, O] asymptotic p-values of one test each
    p_state_action: Array  # [S, H, A]


def find_mask(
    initial_states: ArrayLike,
    observations: ArrayLike,
    actions: ArrayLike,
    threshold: float = 1e-3,
    alpha: float | None = None,
) -> Mask:
    """Masks the observations that, by Algorithm 1, cause no action.

    Args:
      initial_states: [N, S] state at the first time step, N >= 5.
      observations: [N, O] latent observation at the first time step.
      actions: [N, H, A] expert actions over the reaction horizon.
      threshold: dependence means D above it; the paper's gamma.
      alpha: if given, dependence means D above the larger of `threshold` and the one that
        independent pairs exceed with family-wise probability alpha. The family is every test
        that Algorithm 1 makes, m = S (O + H A): any of them can leave a nuisance unmasked.
    Returns:
      The mask and the statistics it follows from.
    Raises:
      ValueError: if shapes do not fit, values are not finite, or there are too few trajectories.
    """
    named = {"initial_states": initial_states, "observations": observations, "actions": actions}
    forms = "[N, S]", "[N, O]", "[N, H, A]"
    shapes = []
    for (name, value), form in zip(named.items(), forms, strict=True):
        given = checks.array(name, value, form, (None,) * (form.count(",") + 1), finite=True)
        shapes.append(given.shape)
        checks.same_length(name, len(given), shapes[0][0], "trajectories")
    (n, states), (_, latents), (_, horizon, controls) = shapes
    checks.integer("trajectories in initial_states", n, least=5)
    gamma = effective_threshold(threshold, alpha, n, states * (latents + horizon * controls))
    d = hoeffding_d(initial_states, _side_by_side(observations, actions))
    state_observation = d[:, :latents]
    state_action = d[:, latents:].reshape(states, horizon, controls)
    potential_cause = potential_causes(state_observation, state_action, gamma)
    return Mask(
        mask=~potential_cause.any(axis=(1, 2)),
        state_observation=state_observation,
        state_action=state_action,
        potential_cause=potential_cause,
        threshold=gamma,
        p_state_observation=p_value(state_observation, n),
        p_state_action=p_value(state_action, n),
    )


def effective_threshold(
    threshold: float, alpha: float | None, trajectories: int, tests: int
) -> float:
    """The D above which Algorithm 1 calls a pair dependent, as `find_mask` says.

    Args:
      threshold: the paper's gamma.
      alpha: family-wise error, or None for the bare gamma.
      trajectories: N.
      tests: in the family.
    """
    checks.not_negative("threshold", threshold)
    if alpha is None:
        return threshold
    return max(threshold, null_threshold(trajectories, tests, alpha))


def potential_causes(
    state_observation: ArrayLike, state_action: ArrayLike, threshold: ArrayLike
) -> Array:
    """Which observation may cause which action: some state is dependent on both.

    Args:
      state_observation: [S, O] Hoeffding's D.
      state_action: [S, H, A] Hoeffding's D.
      threshold: [...], any shape.
    Returns:
      [..., O, H, A] bool; what may cause nothing is masked.
    """
    gamma = jnp.asarray(threshold)[..., None, None]
    observed = jnp.asarray(state_observation) > gamma
    acted = jnp.asarray(state_action) > gamma[..., None]
    return jnp.einsum("...so,...sha->...oha", observed, acted)


def _side_by_side(observations: ArrayLike, actions: ArrayLike) -> Array | np.ndarray:
    """[N, O + H A]; on the host unless traced, where float64 stays float64."""
    traced = any(isinstance(v, Tracer) for v in (observations, actions))
    xp = jnp if traced else np
    first, second = xp.asarray(observations), xp.asarray(actions)
    return xp.concatenate([first, second.reshape(second.shape[0], -1)], axis=1)
