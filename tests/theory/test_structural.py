"""Systems whose causes are known. Reference: the equations again, a trajectory and a step at a time
in NumPy; and what an intervention moves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.theory.structural import (
    BUTTON,
    BYSTANDER,
    CAUSE,
    FORK,
    HORIZON,
    MARK,
    OBSERVATIONS,
    STATES,
    broken,
    draw_noise,
    draw_structure,
    moving,
    simulate,
)

COUNT, STEPS = 20, HORIZON + 1
draw = jax.jit(draw_structure)
run = jax.jit(simulate)
NOISE = draw_noise(jax.random.key(1), COUNT, STEPS)
FIRST = draw_noise(jax.random.key(2), 2000, 1)
KEYS = jax.random.split(jax.random.key(3), 60)


@pytest.fixture(scope="module", params=range(2))
def structure(request):
    return draw(jax.random.key(request.param), 0.7)


def stack(one):
    return jax.tree.map(lambda part: jnp.asarray(part)[None], one)


def without(structure):
    """Each broken system by its first word."""
    found = broken(stack(structure))
    return {name.split(":")[0]: jax.tree.map(lambda a: a[0], one) for name, one in found.items()}


def wave(waves, which, x):
    """One function at one number."""
    a, f, p = (part[which] for part in waves[:3])
    return float(np.sum(a * np.sin(f * x + p)) - waves.mean[which])


def twin(s, noise, coupling):
    """[N, T, ...] states, observations and actions, written out."""
    s, noise = (jax.tree.map(np.asarray, part) for part in (s, noise))
    found = []
    for i in range(COUNT):
        w, states, seen, actions = noise.seed[i], [], [], []
        natural = [
            s.seed_state[k] * wave(s.waves, k, w)
            + np.sqrt(1 - s.seed_state[k] ** 2) * noise.state[i, 0, k]
            for k in range(STATES)
        ]
        drawn = s.spread * noise.intervention[i]
        x = np.array(natural) if noise.natural[i] < 3**0.5 * (2 * coupling - 1) else drawn
        for t in range(STEPS):
            if t:
                x = np.array(
                    [
                        0.5 * x[k]
                        + s.drift[k] * wave(s.waves, STATES + k, x[k - 1])
                        + s.push[k] * actions[-1]
                        + 0.3 * noise.state[i, t, k]
                        for k in range(STATES)
                    ]
                )
            o = []
            for j in range(OBSERVATIONS):
                state = sum(x[k] for k in range(STATES) if s.parent[k, j])
                shown = wave(s.waves, 10 + j, state)
                if j == CAUSE and s.pair:
                    k = int(s.parent[:, j].argmax())
                    shown = 2**0.5 * np.sin(np.pi / 3**0.5 * (x[k] - x[(k + 1) % STATES]))
                value = s.shown[j] * shown
                if t == 0:
                    value = s.first * value + s.seed_observation[j] * wave(s.waves, 6 + j, w)
                rest = np.sqrt(1 - s.shown[j] ** 2 - s.seed_observation[j] ** 2)
                o.append(value + rest * noise.observation[i, t, j])
            if t:
                o[MARK] = actions[-1]
            seen.append(o)
            at = t - int(s.lag)
            a = s.attention * wave(s.waves, 14, seen[at][CAUSE]) if at >= 0 else 0.0
            a += np.sqrt(1 - s.attention**2) * noise.action[i, t]
            actions.append(a if np.isinf(s.button) else float(a > s.button))
            states.append(x)
        found.append((states, seen, actions))
    return [np.array(part) for part in zip(*found, strict=True)]


@pytest.mark.parametrize("coupling", [0.0, 0.5, 1.0])
def test_the_equations_are_the_twin_s(structure, coupling):
    for one, slow in zip(
        run(structure, NOISE, coupling), twin(structure, NOISE, coupling), strict=True
    ):
        np.testing.assert_allclose(one, slow, atol=2e-5)


def test_so_are_those_of_systems_that_break_an_assumption():
    for one in broken(stack(draw(jax.random.key(0), 0.7))).values():
        one = jax.tree.map(lambda part: part[0], one)
        for fast, slow in zip(run(one, NOISE, 0.0), twin(one, NOISE, 0.0), strict=True):
            np.testing.assert_allclose(fast, slow, atol=2e-5)


@jax.jit
def run_set(structure, first):
    """Actions where all first observations [N, O] are set."""
    return simulate(structure, NOISE, 0.0, {o: first[:, o] for o in range(OBSERVATIONS)}).actions


def moved(structure, which):
    """[T] bool: whether setting a first observation to something else moves an action."""
    first = run(structure, NOISE, 0.0).observations[:, 0]
    before, after = (run_set(structure, first.at[:, which].add(by)) for by in (0.0, 1.0))
    return np.any(np.asarray(before) != np.asarray(after), axis=0)


def test_only_the_cause_moves_an_action_and_only_after_its_lag(structure):
    for which in (BYSTANDER, FORK, MARK):
        assert not moved(structure, which).any()
    lag = int(structure.lag)
    assert lag < HORIZON
    assert not moved(structure, CAUSE)[:lag].any()
    assert moved(structure, CAUSE)[lag]


def test_only_the_natural_start_follows_the_seed(structure):
    other = NOISE._replace(seed=-NOISE.seed + 0.1)
    for coupling, follows in ((0.0, np.zeros(STATES, bool)), (1.0, structure.seed_state > 0)):
        one, two = (run(structure, noise, coupling).states[:, 0] for noise in (NOISE, other))
        np.testing.assert_array_equal(np.any(one != two, axis=0), follows)
    one, two = (run(structure, noise, 0.0).observations[:, 0] for noise in (NOISE, other))
    np.testing.assert_array_equal(np.any(one != two, axis=0), structure.seed_observation > 0)


def test_an_intervention_on_a_state_moves_what_shows_it(structure):
    shift = NOISE._replace(intervention=NOISE.intervention.at[:, 0].add(0.3))
    one, two = (run(structure, noise, 0.0).observations[:, 0] for noise in (NOISE, shift))
    np.testing.assert_array_equal(np.any(one != two, axis=0), structure.parent[0] > 0)


def test_what_is_broken_is_broken(structure):
    cases = without(structure)
    first = {name: run(one, NOISE, 0.0) for name, one in cases.items()}
    shift = NOISE._replace(intervention=-NOISE.intervention)
    for name in ("A1", "A2"):  # no state shows in the first cause
        other = run(cases[name], shift, 0.0).observations[:, 0, CAUSE]
        np.testing.assert_array_equal(first[name].observations[:, 0, CAUSE], other)
    assert moved(cases["A2"], CAUSE).any()  # and yet it is one
    assert not moved(cases["A3"], CAUSE)[:HORIZON].any()
    assert moved(cases["A3"], CAUSE)[HORIZON]
    assert set(np.unique(first["A4"].actions)) == {0.0, 1.0}
    assert not first["no density"].states[:, 0].any()
    assert BUTTON.startswith("A4")


def test_the_states_that_move_an_action_are_those_from_which_a_path_leads(structure):
    """By an intervention on each, without noise that could hide it."""
    for state in range(STATES):
        shift = NOISE._replace(intervention=NOISE.intervention.at[:, state].add(0.3))
        one, two = (run(structure, noise, 0.0).actions for noise in (NOISE, shift))
        for horizon in (1, 2, HORIZON):
            moves = bool(np.any(one[:, :horizon] != two[:, :horizon]))
            assert moves == bool(moving(structure, horizon)[state])


@pytest.fixture(scope="module")
def many():
    """60 systems with edges of 0.6, and what they make of 2,000 first steps."""
    systems = jax.jit(jax.vmap(draw_structure, (0, None)))(KEYS, 0.6)
    return systems, jax.jit(jax.vmap(simulate, (0, None, None)))


def test_edges_have_the_strength_that_is_said(many):
    """The share of an observation's variance that its state explains, over systems."""
    systems, run_many = many
    noiseless = FIRST._replace(observation=0.0 * FIRST.observation, seed=0.0 * FIRST.seed)
    shown = run_many(systems, noiseless, 0.0).observations[:, :, 0, CAUSE]
    assert float(shown.var(axis=1).mean()) == pytest.approx(0.36, abs=0.02)


def test_a_pair_shows_what_no_state_does(many):
    """By the observation's mean, given one of the two states: 0; given their angle, not."""
    systems, run_many = many
    alone = systems._replace(
        pair=1.0 + systems.pair, seed_observation=0.0 * systems.seed_observation
    )
    found = run_many(alone, FIRST, 0.0)
    own = np.asarray(alone.parent[:, :, CAUSE].argmax(axis=1))
    states, seen = np.asarray(found.states[:, :, 0]), np.asarray(found.observations[:, :, 0, CAUSE])
    place = np.arange(len(own))
    pair = states[place, :, own], states[place, :, (own + 1) % STATES]
    for state in pair:
        bins = np.digitize(state, np.linspace(-(3**0.5), 3**0.5, 9)[1:-1])
        assert max(abs(seen[bins == b].mean()) for b in range(8)) < 0.15
    angle = np.sin(np.pi / 3**0.5 * (pair[0] - pair[1]))
    assert np.corrcoef(angle.ravel(), seen.ravel())[0, 1] == pytest.approx(0.6, abs=0.03)


def test_a_batch_is_its_systems(many):
    systems, run_many = many
    found = run_many(systems, FIRST, 0.0)
    one = run(draw(KEYS[7], 0.6), FIRST, 0.0)
    for part, alone in zip(found, one, strict=True):
        np.testing.assert_allclose(part[7], alone, atol=1e-5)


def test_one_program_serves_all_systems():
    """Those that break an assumption among them."""
    before = run._cache_size()
    for one in without(draw(jax.random.key(6), 0.4)).values():
        run(one, NOISE, 0.3)
    assert run._cache_size() == max(before, 1)
