"""Random systems whose causes are known: the paper's structural causal model, as equations.

    W -> S_1, O_1      S_t -> O_t, S_t+1      O_t-l -> A_t      A_t -> S_t+1, O_t+1

W is the seed, common to the first state and the first observations (the paper's Figure 1). The
intervention draws S_1 from a distribution of its own, which cuts W -> S_1. Every edge is a random
smooth function of one variable; one of strength c makes c^2 of the effect's variance, and noise the
rest. Each of a system's four observations has a role, so that what is right is known:

    CAUSE      shows a state, and the expert acts on it, l steps later
    BYSTANDER  shows a state, and the expert does not look
    FORK       shows the seed alone
    MARK       shows the previous action; at t=1 a random one

A system is a pytree of numbers, those that break an assumption among them, so one compiled program
serves all. The paper's t=1 is index 0. Shapes: S = 3 states, O = 4 observations, T steps, K waves
of a function, F functions of a system.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

STATES, OBSERVATIONS = 3, 4
CAUSE, BYSTANDER, FORK, MARK = range(OBSERVATIONS)
HORIZON = 3  # steps within which a system that breaks nothing reacts
BUTTON = "A4: an action of two values"
PAIR = "only a pair of states shows the cause"
_WAVES = 3
_EDGE = 3**0.5  # uniform on [-_EDGE, _EDGE] has variance 1
# Where the functions of each kind of edge are among a system's.
_SEED_STATE, _DRIFT = slice(0, 3), slice(3, 6)
_SEED_OBSERVATION, _SHOWN, _ATTENTION = slice(6, 10), slice(10, 14), slice(14, 15)


class Waves(NamedTuple):
    """Smooth functions, sums of sines; mean 0 and variance 1 under the intervention."""

    amplitude: Array  # [F, K]
    frequency: Array  # [F, K]
    phase: Array  # [F, K]
    mean: Array  # [F]

    def of(self, some: slice, x: Array) -> Array:
        """Some of the functions, each of its column of x [N, ...]."""
        amplitude, frequency, phase, mean = (part[some] for part in self)
        waves = jnp.sin(frequency * x[:, :, None] + phase)
        return (amplitude * waves).sum(axis=-1) - mean


class Structure(NamedTuple):
    """A system's equations."""

    parent: Array  # [S, O] 1 where the observation shows the state, else 0
    shown: Array  # [O] strength of S_t -> O_t
    seed_state: Array  # [S] of W -> S_1
    seed_observation: Array  # [O] of W -> O_1
    attention: Array  # [] of CAUSE -> A
    lag: Array  # [] int, l steps later
    drift: Array  # [S] what the next state before it adds to each
    push: Array  # [S] what an action adds to the next state
    waves: Waves
    # What breaks an assumption; as they are, none does.
    spread: Array  # [] of the intervention's S_1: 0 is a constant
    first: Array  # [] 0: the first observations do not show the state
    pair: Array  # [] 1: CAUSE shows the angle between two states, each on the full circle
    button: Array  # [] an action is whether it exceeds this; infinite: the action itself


class Noise(NamedTuple):
    """What is random in N trajectories: the exogenous variables."""

    seed: Array  # [N] W, uniform with variance 1
    natural: Array  # [N] uniform, of variance 1: the lowest are not intervened on
    intervention: Array  # [N, S] uniform with variance 1
    state: Array  # [N, T, S] normal
    observation: Array  # [N, T, O]
    action: Array  # [N, T]


class Trajectories(NamedTuple):
    """What Algorithm 1 may look at, and what follows."""

    states: Array  # [N, T, S]
    observations: Array  # [N, T, O]
    actions: Array  # [N, T]


def draw_structure(key: Array, strength: Array | float) -> Structure:
    """A random system that meets the paper's Assumptions 1 to 4.

    Args:
      key: of the graph and the functions.
      strength: [] of the edges S -> CAUSE and CAUSE -> A, in (0, 1).
    """
    of_parents, of_lag, of_edges, of_moves, of_waves = jax.random.split(key, 5)
    parents = jax.random.randint(of_parents, (2,), 0, STATES)
    linked = jax.random.bernoulli(of_edges, 0.5, (STATES + 2,))
    moves = jax.random.uniform(of_moves, (2, STATES), minval=-0.7, maxval=0.7)
    rest = jnp.sqrt(1 - jnp.asarray(strength) ** 2)
    return Structure(
        parent=jnp.zeros((STATES, OBSERVATIONS))
        .at[parents, jnp.array([CAUSE, BYSTANDER])]
        .set(1.0),
        shown=jnp.stack([jnp.asarray(strength, float), *jnp.array([0.8, 0.0, 0.0])]),
        seed_state=0.8 * linked[:STATES],
        seed_observation=jnp.stack([0.5 * rest * linked[-1], 0.4 * linked[-2], 0.8, 0.0]),
        attention=jnp.asarray(strength, float),
        lag=jax.random.randint(of_lag, (), 0, HORIZON),
        drift=moves[0],
        push=moves[1],
        waves=_draw_waves(of_waves),
        spread=jnp.array(1.0),
        first=jnp.array(1.0),
        pair=jnp.array(0.0),
        button=jnp.array(jnp.inf),
    )


def _draw_waves(key: Array) -> Waves:
    shape = (_ATTENTION.stop, _WAVES)
    amplitude, frequency, phase = jax.random.uniform(key, (3, *shape))
    waves = Waves(2 * amplitude - 1, 0.3 + 1.2 * frequency, 2 * jnp.pi * phase, jnp.zeros(shape[0]))
    x = _EDGE * (2 * (jnp.arange(101) + 0.5) / 101 - 1)
    values = waves.of(slice(None), jnp.broadcast_to(x[:, None], (101, shape[0])))
    mean, deviation = values.mean(axis=0), values.std(axis=0)
    return waves._replace(amplitude=waves.amplitude / deviation[:, None], mean=mean / deviation)


def moving(structure: Structure, horizon: int) -> Array:
    """[S] bool: the first states from which a path leads to an action within so many steps.

    A state adds to itself and to the one after it, so it reaches CAUSE's in some steps.
    """
    steps = (structure.parent[:, CAUSE].argmax() - jnp.arange(STATES)) % STATES
    return steps < horizon - structure.lag


def broken(structures: Structure) -> dict[str, Structure]:
    """Systems [B], and in each entry the same with one assumption broken."""
    zeros = jnp.zeros_like(structures.spread)
    return {
        "A1: the first frames do not show the state": structures._replace(first=zeros),
        "A2: the expert attends to no state": structures._replace(
            shown=structures.shown.at[:, CAUSE].set(0.0)
        ),
        "A3: the reaction is later than H": structures._replace(
            lag=jnp.full_like(structures.lag, HORIZON)
        ),
        BUTTON: structures._replace(button=zeros + 1.5),
        "no density: a constant initial state": structures._replace(spread=zeros),
        PAIR: structures._replace(pair=zeros + 1.0),
    }


def draw_noise(key: Array, trajectories: int, steps: int) -> Noise:
    """The exogenous variables of N trajectories of T steps."""
    of_start, of_steps = jax.random.split(key)
    start = jax.random.uniform(of_start, (trajectories, STATES + 2), minval=-_EDGE, maxval=_EDGE)
    normal = jax.random.normal(of_steps, (trajectories, steps, STATES + OBSERVATIONS + 1))
    parts = jnp.split(normal, [STATES, STATES + OBSERVATIONS], axis=2)
    return Noise(start[:, 0], start[:, 1], start[:, 2:], parts[0], parts[1], parts[2][:, :, 0])


def simulate(
    structure: Structure,
    noise: Noise,
    coupling: Array | float = 0.0,
    do: Mapping[int, Array] | None = None,
) -> Trajectories:
    """Trajectories of a system; nothing in it is random but the noise.

    Args:
      structure: the system.
      noise: of N trajectories of T steps.
      coupling: [] the share of trajectories whose first state is the natural one: 0 is the paper's
        intervention on S_1, 1 none.
      do: further interventions: {observation: what its first value is set to, [N]}.
    """
    from_seed = structure.waves.of(_SEED_STATE, jnp.repeat(noise.seed[:, None], STATES, axis=1))
    natural = structure.seed_state * from_seed + _rest(structure.seed_state) * noise.state[:, 0]
    untouched = noise.natural < _EDGE * (2 * jnp.asarray(coupling) - 1)
    state = jnp.where(untouched[:, None], natural, structure.spread * noise.intervention)
    steps: list[tuple[Array, Array, Array]] = []
    for step in range(noise.action.shape[1]):
        if step:
            before, _, action = steps[-1]
            moved = structure.waves.of(_DRIFT, jnp.roll(before, 1, axis=1))
            state = 0.5 * before + structure.drift * moved + structure.push * action[:, None]
            state = state + 0.3 * noise.state[:, step]
        seen = _observe(structure, noise, step, state, steps[-1][2] if step else None)
        for which, value in (do or {}).items() if step == 0 else ():
            seen = seen.at[:, which].set(value)
        looked = [*(one[1][:, CAUSE] for one in steps), seen[:, CAUSE]]
        steps.append((state, seen, _act(structure, looked, noise.action[:, step])))
    return Trajectories(*(jnp.stack(parts, axis=1) for parts in zip(*steps, strict=True)))


def _rest(strength: Array) -> Array:
    """The noise's share, beside an edge of a strength."""
    return jnp.sqrt(1 - strength**2)


def _observe(
    structure: Structure, noise: Noise, step: int, state: Array, previous: Array | None
) -> Array:
    """[N, O] what is seen: of the state; of the seed, at first; and then of the last action."""
    seen = structure.waves.of(_SHOWN, state @ structure.parent)
    own = structure.parent[:, CAUSE]
    angle = jnp.pi / _EDGE * (state @ (own - jnp.roll(own, 1)))
    cause = jnp.where(structure.pair > 0, jnp.sqrt(2.0) * jnp.sin(angle), seen[:, CAUSE])
    seen = structure.shown * seen.at[:, CAUSE].set(cause)
    if previous is None:
        seeds = jnp.repeat(noise.seed[:, None], OBSERVATIONS, axis=1)
        of_seed = structure.waves.of(_SEED_OBSERVATION, seeds)
        seen = structure.first * seen + structure.seed_observation * of_seed
    share = structure.shown**2 + structure.seed_observation**2
    seen = seen + jnp.sqrt(1 - share) * noise.observation[:, step]
    return seen if previous is None else seen.at[:, MARK].set(previous)


def _act(structure: Structure, looked: list[Array], noise: Array) -> Array:
    """[N] the action on what CAUSE has shown [T][N], lag steps ago; before that, on nothing."""
    count = len(looked)
    then = sum(jnp.where(structure.lag == count - 1 - t, one, 0.0) for t, one in enumerate(looked))
    moved = structure.waves.of(_ATTENTION, jnp.asarray(then)[:, None])[:, 0]
    moved = jnp.where(structure.lag < count, moved, 0.0)
    action = structure.attention * moved + _rest(structure.attention) * noise
    return jnp.where(jnp.isinf(structure.button), action, 1.0 * (action > structure.button))
