"""The paper's theorems on random systems: a function a claim, which counts what would refute it.

`measure` makes Algorithm 1's statistics once; the claims compare them with thresholds. Each returns
rows, a `Rate` for each case and number of trajectories. The family-wise error is that of the tests
of one system. Shapes: B systems, S state, O observation, H reaction horizon, P columns.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxdeconf import checks, threads
from jaxdeconf.independence import hoeffding_d, least_strength, p_value
from jaxdeconf.independence.interaction import interaction_r, strongest
from jaxdeconf.keys import named
from jaxdeconf.mask import MaskConfig, effective_threshold, family, find_mask, potential_causes
from jaxdeconf.theory import structural
from jaxdeconf.theory.structural import (
    BUTTON,
    BYSTANDER,
    CAUSE,
    FORK,
    HORIZON,
    MARK,
    OBSERVATIONS,
    PAIR,
    STATES,
    Structure,
)

# (name, what makes a pytree of arrays) -> the pytree: where a caller may keep it, see `pipeline`.
Stage = Callable[[str, Callable[[], Any]], Any]
_CHUNK = 10  # systems of one compiled call
_TIED = (300, 1000)  # N of systems with ties, which take R, too
_BROKEN = 2500  # the most trajectories of systems that break an assumption
_MOST, _COLUMNS = 1000, 64  # N, and columns, of the largest family of tests
_POWER = 0.9
_TOGETHER = {"states one at a time": 1, "two states together": 2}
ALONE = ", family-wise alone"  # of a case: the threshold of the tests, without a fixed gamma


def at_once(_: str, compute: Callable[[], Any]) -> Any:
    """A stage that is kept nowhere."""
    return compute()


@dataclass(frozen=True)
class ClaimsConfig:
    """How many systems, and how they are tested. The numbers are ours but for gamma's 10^-3."""

    trajectories: tuple[int, ...] = (100, 300, 1000, 2500, 10_000, 30_000)  # N of a data set
    systems: int = 999  # for each N; a third of each strength
    broken_systems: int = 200  # of each assumption
    # No more systems for an N than have so many trajectories together.
    budget: int = 1_200_000
    strengths: tuple[float, ...] = (0.3, 0.5, 0.8)  # of S -> O and O -> A: noise is the rest
    reaction_horizon: int = HORIZON
    threshold: float = MaskConfig.threshold
    alpha: float = 0.05
    thresholds: tuple[float, ...] = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2)  # bare ones to compare
    null_systems: int = 500  # data sets of columns that depend on nothing

    def __post_init__(self):
        checks.integer("reaction_horizon", self.reaction_horizon, most=HORIZON)
        for n in self.trajectories:
            checks.integer("trajectories", n, least=5)
        for strength in self.strengths:
            checks.number("strengths", strength, "numbers in (0, 1)", 0.0, 1.0)
        for name in ("systems", "broken_systems", "null_systems", "budget"):
            checks.integer(name, getattr(self, name))
        for gamma in (self.threshold, *self.thresholds):
            checks.not_negative("thresholds", gamma)
        checks.number("alpha", self.alpha, "a number in (0, 1)", 0.0, 1.0)

    def count(self, trajectories: int, systems: int) -> int:
        """How many systems of so many trajectories the budget has."""
        return min(systems, max(1, self.budget // trajectories))

    @property
    def tests(self) -> int:
        """In the family of one system."""
        return family(STATES, OBSERVATIONS + self.reaction_horizon, 1)

    def held(self, trajectories: int, tests: int) -> float:
        """The threshold that holds the family-wise error of so many tests."""
        return float(effective_threshold(0.0, self.alpha, trajectories, tests))

    def gamma(self, trajectories: int, together: int = 1) -> float:
        """What Algorithm 1 calls dependent above, of states alone or two together."""
        tests = family(STATES, OBSERVATIONS + self.reaction_horizon, together)
        return max(self.threshold, self.held(trajectories, tests))

    def gammas(self, trajectories: int) -> dict[str, float]:
        """That, and where a fixed gamma is above the tests' own threshold, that one, too."""
        gamma, held = self.gamma(trajectories), self.held(trajectories, self.tests)
        return {"": gamma} | ({ALONE: held} if held < gamma else {})


class Rate(NamedTuple):
    """How often something happened; Wilson's interval of 95 % (J. Am. Stat. Assoc. 22, 1927)."""

    case: str
    trajectories: int  # N of each data set
    threshold: float  # gamma as it was used
    events: int
    n: int  # of so many
    rate: float  # NaN of none
    interval: tuple[float, float]
    tests: int = 0  # in the family, where that is what is asked
    predicted: float | None = None  # by theory, where there is one


def rate(case: str, trajectories: int, threshold: float, happened: Any, **more: Any) -> Rate:
    """The rate of an array of booleans."""
    events, n = int(np.sum(happened)), int(np.size(happened))
    if not n:
        return Rate(case, trajectories, threshold, 0, 0, math.nan, (0.0, 1.0), **more)
    z = 1.959964
    p, q = events / n, z**2 / n
    middle, half = (p + q / 2) / (1 + q), math.sqrt(p * (1 - p) * q + q**2 / 4) / (1 + q)
    interval = (max(middle - half, 0.0), min(middle + half, 1.0))
    return Rate(case, trajectories, threshold, events, n, p, interval, **more)


class Statistics(NamedTuple):
    """The statistics of Algorithm 1 for B systems."""

    state_observation: Array  # [B, S, O]
    state_action: Array  # [B, S, H]

    def masked(self, gamma: float) -> np.ndarray:
        """[B, O] bool: what Algorithm 1 masks."""
        acted = self.state_action[..., None]  # [B, S, H, A]
        causes = jax.vmap(potential_causes, (0, 0, None))(self.state_observation, acted, gamma)
        return ~np.asarray(causes.any(axis=(-2, -1)))


class Measured(NamedTuple):
    """The statistics of the same systems with the intervention on S_1 and without."""

    intervened: Statistics
    natural: Statistics


def draw_systems(config: ClaimsConfig, count: int, key: Array) -> tuple[Structure, np.ndarray]:
    """B = count systems, and the strength [B] of each: they take turns."""
    most = max(count, config.systems)  # of any number, the first: one program draws all
    strengths = np.resize(np.array(config.strengths), most)
    keys = jax.random.split(named(key, "structures"), most)
    drawn = _draw(keys, jnp.asarray(strengths))
    return jax.tree.map(lambda a: a[:count], drawn), strengths[:count]


_draw = jax.jit(jax.vmap(structural.draw_structure))


@partial(jax.jit, static_argnames=("trajectories", "horizon", "tied", "together"))
def _tests(
    structures: Structure,
    keys: Array,
    coupling: float,
    trajectories: int,
    horizon: int,
    tied: bool,
    together: int,
) -> Statistics:
    def one(of: tuple[Structure, Array]) -> Statistics:
        structure, key = of
        noise = structural.draw_noise(key, trajectories, horizon)
        states, seen, actions = structural.simulate(structure, noise, coupling)
        if tied:
            mask = find_mask(states[:, 0], seen[:, 0], actions[:, :, None])
            return Statistics(mask.state_observation, mask.state_action[..., 0])
        columns = jnp.concatenate([seen[:, 0], actions], axis=1)
        d = hoeffding_d(states[:, 0], columns)
        if together == 2:
            d = strongest(d, interaction_r(states[:, 0], columns))
        return Statistics(d[:, :OBSERVATIONS], d[:, OBSERVATIONS:])

    return jax.lax.map(one, (structures, keys))


def run_tests(
    structures: Structure,
    key: Array,
    trajectories: int,
    horizon: int,
    coupling: float = 0.0,
    tied: bool = False,
    together: int = 1,
) -> Statistics:
    """Draws a data set of each system and tests it.

    Args:
      structures: B systems.
      key: of the data.
      trajectories: N.
      horizon: H.
      coupling: as of `structural.simulate`.
      tied: whether columns are tied: `find_mask` then takes R for them.
      together: states, as `find_mask` takes them.
    """
    count = len(structures.spread)
    keys = jax.random.split(named(key, "structural data"), count)

    def some(chunk: np.ndarray) -> Statistics:
        part = jax.tree.map(lambda a: a[chunk], structures)
        return _tests(part, keys[chunk], coupling, trajectories, horizon, tied, together)

    return _in_chunks(some, count)


def _in_chunks(compute: Callable[[np.ndarray], Any], count: int) -> Any:
    """A pytree of arrays [count, ...] of what is computed for numbers [_CHUNK] below count.

    The first is computed alone, and compiles for all.
    """
    chunks = [np.arange(begin, begin + _CHUNK) % count for begin in range(0, count, _CHUNK)]
    found = [compute(chunks[0]), *_side_by_side(compute, chunks[1:])]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[:count], *found)


def _side_by_side(compute: Callable[[Any], Any], of: Sequence[Any]) -> list[Any]:
    """What is computed of each: a program runs its systems one after another, on one core."""
    if isinstance(jnp.zeros(()), Tracer):  # shapes are asked for, of which other threads know not
        return [*map(compute, of)]
    return [*threads.each(lambda one: jax.block_until_ready(compute(one)), of)]


def _by_number(compute: Callable[[int], Any], trajectories: Sequence[int]) -> dict[int, Any]:
    """What is computed for each number of trajectories, whose program is its own."""
    return dict(zip(trajectories, _side_by_side(compute, trajectories), strict=True))


def measure(config: ClaimsConfig, key: Array, stage: Stage = at_once) -> dict[int, Measured]:
    """The statistics that the three theorems' claims compare, by N."""

    def one(n: int) -> Measured:
        structures, _ = draw_systems(config, config.count(n, config.systems), key)
        test = partial(run_tests, structures, trajectories=n, horizon=config.reaction_horizon)
        intervened, natural = jax.random.split(jax.random.fold_in(key, n))
        return Measured(test(intervened), test(natural, coupling=1.0))

    return stage("systems", lambda: _by_number(one, config.trajectories))


def conservative(
    config: ClaimsConfig, measured: dict[int, Measured], key: Array, stage: Stage = at_once
) -> list[Rate]:
    """Theorem 1: with the intervention, a true cause is not masked. How often it is."""
    rows = []
    for n, (intervened, _) in measured.items():
        strengths = np.resize(config.strengths, len(intervened.state_action))
        for kind, gamma in config.gammas(n).items():
            masked = intervened.masked(gamma)[:, CAUSE]
            for strength in config.strengths:
                name = f"edges of {strength:g}{kind}"
                rows.append(rate(name, n, gamma, masked[strengths == strength]))
    return [*rows, *_broken(config, key, stage)]


def _broken(config: ClaimsConfig, key: Array, stage: Stage) -> Iterator[Rate]:
    """The same of strong edges, with an assumption broken."""
    strong = replace(config, strengths=config.strengths[-1:])

    def tests(n: int) -> dict[str, Statistics]:
        structures, _ = draw_systems(strong, config.count(n, config.broken_systems), key)
        data, horizon = jax.random.fold_in(key, n), config.reaction_horizon
        systems = structural.broken(structures)
        found = {name: run_tests(one, data, n, horizon) for name, one in systems.items()}
        if n in _TIED:
            tied = run_tests(systems[BUTTON], data, n, horizon, tied=True)
            found[f"{BUTTON}, tested by R"] = tied
        return found

    found = stage("assumptions broken", lambda: _by_number(tests, _few(config, _BROKEN)))
    for n in _few(config, _BROKEN):
        gamma = config.gamma(n)
        for name, one in found[n].items():
            yield rate(name, n, gamma, one.masked(gamma)[:, CAUSE])


def _few(config: ClaimsConfig, most: int) -> list[int]:
    """The numbers of trajectories up to one."""
    return [n for n in config.trajectories if n <= most]


def pairs(config: ClaimsConfig, key: Array, stage: Stage = at_once) -> list[Rate]:
    """A cause that only two states show is kept where states are tested together, too.

    How often it is masked, and how often the mark is, of strong edges; and the same where single
    states show the cause.
    """
    rows, strong = [], replace(config, strengths=config.strengths[-1:])

    def tests(n: int) -> dict[str, dict[str, Statistics]]:
        structures, _ = draw_systems(strong, config.count(n, config.broken_systems), key)
        systems = {"shown alone": structures, PAIR: structural.broken(structures)[PAIR]}
        test = partial(run_tests, trajectories=n, horizon=config.reaction_horizon)
        data = named(jax.random.fold_in(key, n), "pairs")
        return {
            name: {word: test(of, data, together=count) for word, count in _TOGETHER.items()}
            for name, of in systems.items()
        }

    found = stage("pairs", lambda: _by_number(tests, _few(config, _BROKEN)))
    for n in _few(config, _BROKEN):
        for name, one in found[n].items():
            for word, count in _TOGETHER.items():
                gamma = config.gamma(n, count)
                masked = one[word].masked(gamma)
                case = f"is masked: {name}, {word}"
                rows.append(rate(f"the cause {case}", n, gamma, masked[:, CAUSE]))
                rows.append(rate(f"the mark {case}", n, gamma, masked[:, MARK]))
    return rows


def _moving(config: ClaimsConfig, structures: Structure) -> np.ndarray:
    """[B, S] bool: the states that move an action within H."""
    return np.asarray(jax.vmap(structural.moving, (0, None))(structures, config.reaction_horizon))


def no_more_conservative(
    config: ClaimsConfig, measured: dict[int, Measured], key: Array
) -> list[Rate]:
    """Theorem 2: what is rightly masked without the intervention is masked with it, too.

    How often it is, of observations that cause nothing, in the same system. One that shows a state
    is apart if that state moves an action: its mask is then for want of trajectories.
    """
    rows = []
    for n, tests in measured.items():
        structures, _ = draw_systems(config, len(tests.natural.state_action), key)
        shown = np.asarray(structures.parent[:, :, BYSTANDER] > 0)
        moves = (shown & _moving(config, structures)).any(axis=1)
        cases = {
            "the mark": (MARK, moves | True),
            "shows the seed": (FORK, moves | True),
            "shows a state that moves no action": (BYSTANDER, ~moves),
            "shows a state that moves one": (BYSTANDER, moves),
        }
        for kind, gamma in config.gammas(n).items():
            intervened, natural = (one.masked(gamma) for one in tests)
            for name, (which, among) in cases.items():
                of = natural[:, which] & among
                rows.append(rate(f"{name}{kind}", n, gamma, intervened[of, which]))
    return rows


def strictly_less(config: ClaimsConfig, measured: dict[int, Measured], key: Array) -> list[Rate]:
    """The proposition: in the fork W -> S_1, W -> O_1 only the intervention lets O be masked.

    How often it is, where the seed moves a state that moves an action within H; and, to compare,
    where it moves no state.
    """
    rows = []
    for n, tests in measured.items():
        structures, _ = draw_systems(config, len(tests.natural.state_action), key)
        seeded = np.asarray(structures.seed_state > 0)
        cases = {
            "a fork": (seeded & _moving(config, structures)).any(axis=1),
            "no fork": ~seeded.any(axis=1),
        }
        for kind, gamma in config.gammas(n).items():
            for name, one in tests._asdict().items():
                masked = one.masked(gamma)[:, FORK]
                for case, which in cases.items():
                    rows.append(rate(f"{name}, {case}{kind}", n, gamma, masked[which]))
    return rows


def threshold(
    config: ClaimsConfig, measured: dict[int, Measured], key: Array, stage: Stage = at_once
) -> list[Rate]:
    """What gamma trades: causes masked against nuisances kept, and what decides it."""
    rows = []
    for n, (intervened, _) in measured.items():
        held = config.held(n, config.tests)
        for kind, gamma in [*(("", one) for one in config.thresholds), (", family-wise", held)]:
            masked = intervened.masked(gamma)
            rows.append(rate(f"a cause is masked{kind}", n, gamma, masked[:, CAUSE]))
            rows.append(rate(f"the mark is kept{kind}", n, gamma, ~masked[:, MARK]))
    return [*rows, *_of_tests(config, key, stage)]


def _of_tests(config: ClaimsConfig, key: Array, stage: Stage) -> Iterator[Rate]:
    """How often any of m tests of independent columns is above a threshold; and how often that
    dependence is seen that `required_trajectories` says is, in `_POWER` of the data sets.
    """
    columns = (1, config.tests // STATES, _COLUMNS)
    few = _few(config, _MOST)
    least = {
        n: least_strength(n, config.tests, _POWER, config.alpha, config.threshold) for n in few
    }

    def pairs(n: int) -> Array:
        of = named(jax.random.fold_in(key, n), "normal columns")
        keys = jax.random.split(of, config.null_systems)
        some = partial(_normal_columns, strength=least[n], trajectories=n)
        return _in_chunks(lambda chunk: some(keys[chunk]), len(keys))

    found = stage("normal columns", lambda: _by_number(pairs, few))
    for n in few:
        d, strength = np.asarray(found[n]), least[n]
        for some in columns:
            tests, largest = STATES * some, d[:, :, 1 : 1 + some].max(axis=(1, 2))
            chance = 1 - (1 - float(p_value(config.threshold, n))) ** tests
            for name, gamma, predicted in (
                ("any independent pair, bare", config.threshold, chance),
                ("any independent pair, family-wise", config.held(n, tests), config.alpha),
            ):
                more = {"tests": tests, "predicted": predicted}
                yield rate(name, n, gamma, largest > gamma, **more)
        seen, gamma = d[:, 0, 0] > config.gamma(n), config.gamma(n)
        name = f"a correlation of {strength:.3f} is seen"
        yield rate(name, n, gamma, seen, tests=config.tests, predicted=_POWER)


@partial(jax.jit, static_argnames="trajectories")
def _normal_columns(keys: Array, strength: float, trajectories: int) -> Array:
    """[B, S, 1 + columns] D; the first column depends on the first state, no other on any."""

    def one(key: Array) -> Array:
        drawn = jax.random.normal(key, (trajectories, STATES + 1 + _COLUMNS))
        states, other = drawn[:, :STATES], drawn[:, STATES:]
        first = strength * states[:, 0] + jnp.sqrt(1 - strength**2) * other[:, 0]
        return hoeffding_d(states, other.at[:, 0].set(first))

    return jax.lax.map(one, keys)
