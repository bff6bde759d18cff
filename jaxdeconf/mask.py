"""Algorithm 1 of the paper: which observations to mask, from N expert trajectories.

An observation may cause an action if some initial state is dependent on both. An observation
that may cause no action within the reaction horizon is masked. Everything is read at the first
time step, where the intervention on the initial state has cut every other common cause.
With `states_together` = 2, something is dependent on a state also where it is so only together with
one other state: what the angle between an arm and its target moves depends on both (docs/pairs.md).
Columns of few values (buttons, grippers, saturated actions) are tested by the refined R, whatever
the statistic: a rare cause is not masked in silence.
Shapes: N trajectories, S state, O latent observation, H reaction horizon, A action.
"""

import warnings
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from jaxdeconf import checks
from jaxdeconf.independence import p_value
from jaxdeconf.independence import threshold as null_threshold
from jaxdeconf.independence.hoeffding import HOEFFDING
from jaxdeconf.independence.interaction import interaction_r, strongest
from jaxdeconf.independence.refined import REFINED
from jaxdeconf.independence.ties import few_events, with_ties
from jaxdeconf.traced import Traced, traceable

# By name; on one scale and with one null law.
STATISTICS = {"hoeffding": HOEFFDING, "refined": REFINED}


@traceable
@dataclass(frozen=True)
class MaskConfig:
    """Algorithm 1's hyperparameters."""

    # H, steps in which the expert reacts. Ours: the least, for one that acts on what it sees now.
    reaction_horizon: int = 1
    threshold: Traced = 1e-3  # gamma, on 30 x Hoeffding's D; the paper's
    # Family-wise error of the independence tests; raises the threshold where it must. Ours; None is
    # the paper's bare gamma, which a disentangled nuisance exceeds by chance in one dataset in six.
    alpha: float | None = 0.05
    statistic: Literal["hoeffding", "refined"] = "hoeffding"  # the paper's
    # 2: also what two states move only together. Ours; 1 is the paper's.
    states_together: Literal[1, 2] = 1

    def __post_init__(self):
        checks.integer("reaction_horizon", self.reaction_horizon)
        checks.not_negative("threshold", self.threshold)
        if self.alpha is not None:
            checks.number("alpha", self.alpha, "a number in (0, 1)", 0.0, 1.0)
        checks.one_of("statistic", self.statistic, tuple(STATISTICS))
        checks.integer("states_together", self.states_together, most=2)


class Tested(NamedTuple):
    """What each state was found to have to do with each column; C pairs of states, or none."""

    alone: Array  # [S, P] the statistic; R on its scale where the pair is tied
    largest: Array  # [S, P] that, or R of the state and another one, whichever is larger
    tied: Array  # [S, P] bool
    pairs: Array  # [C, P] R of what two states tell only together, as `pairs_of` orders them


def all_tests(
    states: ArrayLike, columns: ArrayLike, statistic: str = "hoeffding", states_together: int = 1
) -> Tested:
    """The tests that Algorithm 1 makes: states [N, S] against columns [N, P]; see `find_mask`."""
    d, tied = with_ties(states, columns, STATISTICS[statistic])
    if states_together == 1:
        return Tested(d, d, tied, jnp.zeros((0, d.shape[1])))
    pairs = interaction_r(states, columns)
    return Tested(d, strongest(d, pairs), tied, pairs)


class Mask(NamedTuple):
    """The mask and the evidence for it; with thresholds [...], the mask of each.

    Where states are tested together, too, the statistic of a state is the largest of its tests:
    alone, and with each other state. C of those pairs, in the order of `pairs_of`, or none.
    """

    mask: Array  # [..., O] bool: True where the observation is to be masked
    state_observation: Array  # [S, O] the statistic; where tied, R
    state_action: Array  # [S, H, A] the statistic
    potential_cause: Array  # [..., O, H, A] bool: the observation may cause the action
    threshold: Array  # [...] dependence means a statistic above it
    p_state_observation: Array  # [S, O] asymptotic p-values of one test each
    p_state_action: Array  # [S, H, A]
    tied_state_observation: Array  # [S, O] bool: for its ties the pair was tested by R
    tied_state_action: Array  # [S, H, A] bool
    pair_observation: Array  # [C, O] R of what two states tell only together
    pair_action: Array  # [C, H, A]

    def within(self, horizon: int) -> Array:
        """[..., O] the mask for a reaction horizon no longer than H, at the same thresholds.

        Raises:
          ValueError: if it is longer.
        """
        checks.integer("horizon", horizon, most=self.potential_cause.shape[-2])
        return ~self.potential_cause[..., :horizon, :].any(axis=(-2, -1))


def find_mask(
    initial_states: ArrayLike,
    observations: ArrayLike,
    actions: ArrayLike,
    threshold: ArrayLike = MaskConfig.threshold,
    alpha: float | None = MaskConfig.alpha,
    statistic: str = MaskConfig.statistic,
    states_together: int = MaskConfig.states_together,
) -> Mask:
    """Masks the observations that, by Algorithm 1, cause no action.

    Args:
      initial_states: [N, S] state at the first time step, N >= 5.
      observations: [N, O] latent observation at the first time step.
      actions: [N, H, A] expert actions over the reaction horizon.
      threshold: dependence means a statistic above it; the paper's gamma. Or several of them,
        [...], for a mask each from the same statistics. With ties, a pair's R is on the scale of
        its p-value: gamma then is what it is for continuous pairs, a level of significance.
      alpha: dependence means a statistic above the larger of `threshold` and the one that
        independent pairs exceed with family-wise probability alpha. The family is every test
        that Algorithm 1 makes, m = S (O + H A), or (S + 1) / 2 times as many with pairs of states:
        any of them can leave a nuisance unmasked. None leaves the bare thresholds.
      statistic: "hoeffding", the paper's D, or "refined", Blum, Kiefer & Rosenblatt's R. Pairs of
        which a column is tied are always tested by R: D of such columns sees next to nothing.
      states_together: 1, the paper's, or 2: every two states are tested together, too, by
        `interaction_r`.
    Returns:
      The mask and the statistics it follows from.
    Warns:
      UserWarning: if ties leave a column fewer than five samples to depend on anything with.
    Raises:
      ValueError: if shapes do not fit, values are not finite, or there are too few trajectories.
    """
    states = checks.array("initial_states", initial_states, "[N, S]", (None, None), finite=True)
    n, coordinates = states.shape
    checks.integer("trajectories in initial_states", n, least=5)
    latents = checks.array("observations", observations, f"[{n}, O]", (n, None), finite=True)
    controls = checks.array("actions", actions, f"[{n}, H, A]", (n, None, None), finite=True)
    checks.one_of("statistic", statistic, tuple(STATISTICS))
    checks.integer("states_together", states_together, most=2)
    columns = _side_by_side(latents, controls)
    count = family(coordinates, columns.shape[1], states_together)
    gamma = effective_threshold(threshold, alpha, n, count)
    _, d, tied, pairs = all_tests(states, columns, statistic, states_together)
    if not isinstance(tied, Tracer) and tied.any():
        _warn_of_few_events(initial_states=states, observations=latents, actions=controls)

    def split(pairs: Array) -> tuple[Array, Array]:
        observed, acted = jnp.split(pairs, [latents.shape[1]], axis=1)
        return observed, acted.reshape(-1, *controls.shape[1:])

    (state_observation, state_action), of_ties, together = split(d), split(tied), split(pairs)
    potential_cause = potential_causes(state_observation, state_action, gamma)
    return Mask(
        mask=~potential_cause.any(axis=(-2, -1)),
        state_observation=state_observation,
        state_action=state_action,
        potential_cause=potential_cause,
        threshold=gamma,
        p_state_observation=p_value(state_observation, n),
        p_state_action=p_value(state_action, n),
        tied_state_observation=of_ties[0],
        tied_state_action=of_ties[1],
        pair_observation=together[0],
        pair_action=together[1],
    )


def _warn_of_few_events(**named: ArrayLike) -> None:
    for name, values in named.items():
        for column, events in few_events(values).items():
            warnings.warn(
                f"{name}: column {column} has its most frequent value in all but {events} "
                "trajectories, too few to find what it depends on; it may be masked for that",
                stacklevel=3,
            )


def family(states: int, columns: int, states_together: int) -> int:
    """How many tests Algorithm 1 makes of S states against O + H A columns."""
    return states * columns if states_together == 1 else states * (states + 1) // 2 * columns


def effective_threshold(
    threshold: ArrayLike, alpha: float | None, trajectories: int, tests: int
) -> Array:
    """[...] what Algorithm 1 calls a pair dependent above, as `find_mask` says.

    Args:
      threshold: [...] the paper's gamma.
      alpha: family-wise error, or None for the bare gamma.
      trajectories: N.
      tests: in the family.
    """
    if not isinstance(threshold, Tracer):
        for one in np.ravel(threshold).tolist():
            checks.not_negative("threshold", one)
    gamma = jnp.asarray(threshold, float)
    return (
        gamma if alpha is None else jnp.maximum(gamma, null_threshold(trajectories, tests, alpha))
    )


def potential_causes(
    state_observation: ArrayLike, state_action: ArrayLike, threshold: ArrayLike
) -> Array:
    """Which observation may cause which action: some state is dependent on both.

    Args:
      state_observation: [S, O] the statistic.
      state_action: [S, H, A] the statistic.
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
