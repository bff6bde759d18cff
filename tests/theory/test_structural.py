"""Systems whose causes are known. Reference: the equations again, a trajectory and a step at a time
in NumPy; and what an intervention moves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.theory import structural
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
    simulate,
)

COUNT, STEPS = 40, 5
draw = jax.jit(draw_structure)
run = jax.jit(simulate)
NOISE = draw_noise(jax.random.key(1), COUNT, STEPS)


@pytest.fixture(scope="module", params=range(3))
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
    a, f, p = (np.asarray(part)[which] for part in waves[:3])
    return float(np.sum(a * np.sin(f * x + p)) - np.asarray(waves.mean)[which])


def twin(s, noise, coupling):
    """[N, T, ...] states, observations and actions, written out."""
    s = jax.tree.map(lambda part: np.asarray(part, float), s._replace(waves=()))._replace(
        waves=s.waves
    )
    found = []
    for i in range(COUNT):
        w, states, seen, actions = float(noise.seed[i]), [], [], []
        natural = [
            s.seed_state[k] * wave(s.waves, k, w)
            + np.sqrt(1 - s.seed_state[k] ** 2) * noise.state[i, 0, k]
            for k in range(STATES)
        ]
        drawn = s.spread * np.asarray(noise.intervention[i])
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
        for fast, slow in zip(run(one, NOISE), twin(one, NOISE, 0.0), strict=True):
            np.testing.assert_allclose(fast, slow, atol=2e-5)


def moved(structure, which, noise=NOISE):
    """[T] bool: whether setting a first observation moves an action."""
    before = run(structure, noise)
    value = before.observations[:, 0, which] + 1.0
    after = run(structure, noise, 0.0, {which: value})
    return np.any(np.asarray(before.actions) != np.asarray(after.actions), axis=0)


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
    one, two = (run(structure, noise).observations[:, 0] for noise in (NOISE, other))
    np.testing.assert_array_equal(np.any(one != two, axis=0), structure.seed_observation > 0)


def test_an_intervention_on_a_state_moves_what_shows_it(structure):
    shift = NOISE._replace(intervention=NOISE.intervention.at[:, 0].add(0.3))
    one, two = (run(structure, noise).observations[:, 0] for noise in (NOISE, shift))
    np.testing.assert_array_equal(np.any(one != two, axis=0), structure.parent[0] > 0)


def test_what_is_broken_is_broken(structure):
    cases = without(structure)
    first = {name: run(one, NOISE) for name, one in cases.items()}
    shift = NOISE._replace(intervention=-NOISE.intervention)
    for name in ("A1", "A2"):  # no state shows in the first cause
        other = run(cases[name], shift).observations[:, 0, CAUSE]
        np.testing.assert_array_equal(first[name].observations[:, 0, CAUSE], other)
    assert moved(cases["A2"], CAUSE).any()  # and yet it is one
    assert not moved(cases["A3"], CAUSE)[:HORIZON].any()
    assert moved(cases["A3"], CAUSE)[HORIZON]
    assert set(np.unique(first["A4"].actions)) == {0.0, 1.0}
    assert not first["no density"].states[:, 0].any()
    assert BUTTON.startswith("A4")


def test_a_pair_shows_what_no_state_does():
    """By the angle's expectation over the circle: 0, whatever one of the two states is."""
    system = without(draw(jax.random.key(0), 0.7))["only a pair of states shows the cause"]
    many = draw_noise(jax.random.key(2), 20_000, 1)
    found = run(system._replace(seed_observation=jnp.zeros(OBSERVATIONS)), many)
    state = int(system.parent[:, CAUSE].argmax())
    for other in (state, (state + 1) % STATES):
        bins = np.digitize(found.states[:, 0, other], np.linspace(-1.7, 1.7, 9)[1:-1])
        means = [found.observations[bins == b, 0, CAUSE].mean() for b in range(8)]
        assert np.abs(means).max() < 0.08
    angle = np.pi / 3**0.5 * (found.states[:, 0, state] - found.states[:, 0, (state + 1) % STATES])
    shown = np.corrcoef(np.sin(angle), found.observations[:, 0, CAUSE])[0, 1]
    assert shown == pytest.approx(0.7, abs=0.02)


def test_edges_have_the_strength_that_is_said():
    """The share of an observation's variance that its state explains, over many systems."""
    keys = jax.random.split(jax.random.key(3), 60)
    systems = jax.vmap(draw_structure, (0, None))(keys, 0.6)
    many = draw_noise(jax.random.key(4), 2000, 1)
    noiseless = many._replace(observation=0.0 * many.observation, seed=0.0 * many.seed)
    found = jax.vmap(simulate, (0, None))(systems, noiseless)
    share = found.observations[:, :, 0, CAUSE].var(axis=1)
    assert float(share.mean()) == pytest.approx(0.36, abs=0.02)


def test_a_batch_is_its_systems():
    keys = jax.random.split(jax.random.key(5), 3)
    batch = jax.vmap(draw_structure, (0, None))(keys, 0.5)
    found = jax.vmap(simulate, (0, None))(batch, NOISE)
    for place, key in enumerate(keys):
        alone = run(draw(key, 0.5), NOISE)
        for part, one in zip(found, alone, strict=True):
            np.testing.assert_allclose(part[place], one, atol=1e-5)


def test_one_program_serves_all_systems():
    run.clear_cache()
    for one in without(draw(jax.random.key(6), 0.4)).values():
        run(one, NOISE, 0.3)
    assert run._cache_size() <= 2  # a system's lag is an integer of the same type in all
    assert structural.STATES == 3
