"""What can be said of a dataset before anything is trained: whether Algorithm 1 can work on it.

Shapes: N episodes, S state, A action, H steps looked at, O components, m frames.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf import checks
from jaxdeconf.independence import least_strength
from jaxdeconf.independence.interaction import pairs_of
from jaxdeconf.keys import named
from jaxdeconf.leakage import explained
from jaxdeconf.learn.linear_start import linear_start
from jaxdeconf.mask import all_tests, effective_threshold, family
from jaxdeconf.owndata.config import Masking
from jaxdeconf.owndata.dataset import Dataset
from jaxdeconf.vision import raster

_STEPS = 10  # in which an expert is expected to react
# A dependence below twice the threshold may be gone in another draw of as many episodes.
_MARGIN = 2.0
_HIDDEN = 0.1  # R² that states show together and none of them alone
_FEW = 100  # episodes, of which half predict the other half; below, R² is noise
_SATURATED = 0.5  # share of actions at their limit
# Of a latent's spread over exploration frames, the least that first frames must show. What resets
# do not vary has 0.04 to 0.06, all of it mixed in from other latents; what they do, 0.5 and more.
UNVARIED = 0.2
_TESTS = 36  # among which a correlation is to be seen: a usual number


class Check(NamedTuple):
    """The dependences, and what is to be said of them."""

    episodes: int  # N
    state_names: list[str]  # [S] that vary
    constant: list[str]  # columns that do not, and are left out
    threshold: float  # gamma, of all tests that a mask would make
    state_action: np.ndarray  # [S, H, A] the statistic, as a mask's, H up to 10
    horizon: int  # that Algorithm 1 is to take
    visible: float  # the least correlation that N episodes show
    spread: np.ndarray  # [O] of the linear start's components; see `spread`
    notes: list[str]  # sentences
    refused: str | None  # why it makes no sense to go on; None: it does


def visible(episodes: int) -> float:
    """The least Gaussian correlation that so many episodes show in nine datasets of ten."""
    return least_strength(episodes, _TESTS)


def spread(first: Array, exploration: Array) -> np.ndarray:
    """[O] the standard deviation of latents in first frames [N, O] over that in others [m, O]."""
    over = jnp.maximum(exploration.std(axis=0), 1e-6)
    return np.asarray(first.std(axis=0) / over)


def varying(demos: Dataset, config: Masking) -> np.ndarray:
    """[S] bool: the initial states that are asked for, and are not the same in all episodes.

    Raises:
      ValueError: if one that is asked for is not there, or none varies.
    """
    for name in config.states:
        checks.one_of("states", name, demos.state_names)
    asked = [name in config.states or not config.states for name in demos.state_names]
    found = np.array(asked) & (np.ptp(demos.initial_states, axis=0) > 0)
    if not found.any():
        raise ValueError(f"states: expected one that varies, of {' '.join(demos.state_names)}")
    return found


def check(demos: Dataset, exploration: np.ndarray, config: Masking, key: Array) -> Check:
    """Looks at a dataset for some seconds.

    Args:
      demos: the demonstrations.
      exploration: uint8 [m, Z, Z, 3], those frames that the β-VAE is to learn.
      config: how it is to be masked.
      key: of the linear start, and of regressions.
    Raises:
      ValueError: if there are too few episodes, or one is shorter than the horizon.
    """
    episodes, shortest = len(demos.lengths), int(demos.lengths.min())
    checks.integer("episodes", episodes, least=5)
    if config.horizon is not None and config.horizon > shortest:
        where = int(demos.lengths.argmin())
        raise ValueError(
            f"horizon: expected at most {shortest}, the steps of episode {where}; "
            f"--drop-short {config.horizon} makes nothing of shorter ones"
        )
    chosen, steps = varying(demos, config), min(_STEPS, shortest)
    begin = demos.begin(steps, chosen)
    states, names = np.asarray(begin.initial_states), list(begin.state_names)
    actions = np.asarray(begin.actions).reshape(episodes, -1)
    latents = config.disentangle.network.latents
    tests = family(len(names), latents + actions.shape[1], config.states_together)
    gamma = float(effective_threshold(config.threshold, config.alpha, episodes, tests))
    order = np.arange(episodes)[:, None]
    columns = np.concatenate([actions, states, order], axis=1)
    found = all_tests(states, columns, states_together=config.states_together)  # compiled once
    mutual = np.asarray(found.alone)[:, actions.shape[1] :]
    pairs, d = (np.asarray(v)[:, : actions.shape[1]] for v in (found.pairs, found.largest))
    d = d.reshape(len(names), steps, -1)
    moves = d.max(axis=(1, 2)) > gamma
    known = linear_spread(demos, exploration, config, key)
    together = _together(states, actions, moves, key) if episodes >= _FEW else None
    constant = [name for name, v in zip(demos.state_names, chosen, strict=True) if not v]
    return Check(
        episodes=episodes,
        state_names=names,
        constant=constant,
        threshold=gamma,
        state_action=d,
        horizon=config.horizon or _horizon(d, gamma),
        visible=visible(episodes),
        spread=known,
        notes=[
            *_of_states(mutual, episodes, names, moves, constant),
            *_of_pairs(names, pairs.max(axis=1, initial=0.0) > gamma),
            *_of_actions(demos),
        ],
        refused=_refused(names, moves, together, known, config),
    )


def _horizon(d: np.ndarray, gamma: float) -> int:
    """The least H within which every state that ever moves an action has clearly done so."""
    best = d.max(axis=2)  # [S, H]
    enough = np.minimum(_MARGIN * gamma, best.max(axis=1))
    firsts = (best >= enough[:, None]).argmax(axis=1) + 1
    return int(firsts[best.max(axis=1) > gamma].max(initial=1))


def _together(
    states: np.ndarray, actions: np.ndarray, moves: np.ndarray, key: Array
) -> tuple[float, float] | None:
    """R² of an action from all states, and from those alone that move one; None: all do.

    Of the action and the step that all states explain best.
    """
    if moves.all():
        return None
    scaled = jnp.asarray((states - states.mean(axis=0)) / states.std(axis=0))
    of = named(key, "check")
    every = explained(scaled, jnp.asarray(actions), of)
    best = int(every.argmax())
    alone = explained(scaled[:, moves], jnp.asarray(actions), of) if moves.any() else 0.0 * every
    return float(every[best]), max(float(alone[best]), 0.0)


def linear_spread(
    demos: Dataset, exploration: np.ndarray, config: Masking, key: Array
) -> np.ndarray:
    """[O] the spread of independent components of the frames: a look ahead, in seconds."""

    def flat(images: np.ndarray) -> Array:
        return raster.dequantize(jnp.asarray(images)).reshape(len(images), -1)

    network, frames = config.disentangle.network, flat(exploration[:: -(-len(exploration) // 4096)])
    count = min(network.latents, len(frames))
    among = min(config.disentangle.start_components or count, len(frames))
    found = linear_start(frames, count, named(key, "linear start"), among)
    return spread(flat(demos.starts) @ found.encoder, frames @ found.encoder)


def unvaried_words(latents: list[str]) -> str:
    """Why nothing can be found, and what to do about it."""
    what = " and ".join(filter(None, [", ".join(latents[:-1]), latents[-1]]))
    return (
        f"first frames do not vary what {what} shows: its spread there is below {UNVARIED:g} of "
        "that under random actions, so no test on first frames can tell whether it causes an "
        "action. Record first frames with the mark at random, as if a random action had come "
        "before, or say --unvaried mask or --unvaried keep"
    )


def _refused(
    names: list[str],
    moves: np.ndarray,
    together: tuple[float, float] | None,
    known: np.ndarray,
    config: Masking,
) -> str | None:
    if together is not None and together[0] - together[1] > _HIDDEN:
        hidden = ", ".join(name for name, moved in zip(names, moves, strict=True) if not moved)
        return (
            f"{hidden} move the actions only together with other states: all states explain R² "
            f"{together[0]:.2f} of an action, those that the tests show "
            f"{together[1]:.2f}. What the frames show of {hidden} would be masked. "
            + ("Say --states-together 2, draw " if config.states_together == 1 else "Draw ")
            + "initial states from a smaller range, or give a column that moves the actions by "
            "itself (an angle between two of them, say) with --initial-states FILE.npy"
        )
    if not moves.any():
        return (
            f"no initial state moves an action within {_STEPS} steps, so every latent would be "
            "masked: are the initial states those of these episodes, drawn at random?"
        )
    low = np.flatnonzero(known < UNVARIED)
    if len(low) and config.unvaried == "refuse":
        return unvaried_words([f"component {place + 1}" for place in low.tolist()])
    return None


def _of_states(
    d: np.ndarray, episodes: int, names: list[str], moves: np.ndarray, constant: list[str]
) -> list[str]:
    """Sentences on columns that are constant, and by D [S, S + 1] dependent or drifting."""
    count, said = len(names), []
    gamma = float(effective_threshold(0.0, 0.05, episodes, count * (count + 1) // 2))
    if constant:
        said.append(
            f"Left out, since they never vary or were not asked for: {', '.join(constant)}."
        )
    still = [name for name, moved in zip(names, moves, strict=True) if not moved]
    if still:
        said.append(f"No test shows an action that depends on {', '.join(still)}.")
    tied = [f"{names[i]} and {names[j]}" for i, j in np.argwhere(np.triu(d[:, :count] > gamma, 1))]
    if tied:
        said.append(
            f"Not drawn independently: {', '.join(tied)}. If episodes were chosen, by success say, "
            "what the frames show of one may be taken for a cause by the other."
        )
    drift = [name for name, high in zip(names, d[:, count] > gamma, strict=True) if high]
    if drift:
        said.append(f"Drifts from episode to episode: {', '.join(drift)}.")
    return said


def _of_pairs(names: list[str], shown: np.ndarray) -> list[str]:
    """A sentence on the states that move an action together, beyond what they do alone."""
    pairs = [f"{names[i]} with {names[j]}" for i, j in pairs_of(len(names))[np.flatnonzero(shown)]]
    return [f"Moving an action together: {', '.join(pairs)}."] if pairs else []


def _of_actions(demos: Dataset) -> list[str]:
    """Sentences on actions that look shifted, saturated or discrete; on few or short episodes."""
    said, actions, episodes = [], demos.actions, len(demos.lengths)
    if (shortest := demos.lengths.min()) < min(_STEPS, np.median(demos.lengths)):
        said.append(
            f"Only the first {shortest} steps are looked at, which the shortest episode has: "
            "--drop-short N makes nothing of those shorter than N."
        )
    if not actions[demos.first].any() and actions.any():
        said.append(
            "The first action of every episode is 0: action t may be the one that led to frame t. "
            "Shift it by a step, so that frame t is what was seen when action t was chosen."
        )
    saturated = float((np.abs(actions) >= 0.999).mean())
    if saturated > _SATURATED:
        said.append(f"{100 * saturated:.0f} % of the actions are at their limit.")
    values = min(len(np.unique(column)) for column in actions.T)
    if values <= 20:
        said.append(f"An action takes {values} values only: tests lose power where values repeat.")
    said.append(
        f"{episodes} episodes show a correlation from about {visible(episodes):.2g} on"
        + ("; a hundred or more are needed to trust a mask." if episodes < _FEW else ".")
    )
    return said
