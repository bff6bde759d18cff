"""The Brax adapter against the System itself, Brax's wrappers, networks and one of its trainers."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import brax.envs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ars import train as ars
from brax.training.agents.ppo import networks_vision

from jaxdeconf import systems
from jaxdeconf.evaluate import rollout_loss
from jaxdeconf.systems import brax_env
from jaxdeconf.systems.rollout import rollout
from jaxdeconf.systems.signal import SIGNALS

ROOT = Path(__file__).parents[2]
NAMES = systems.names()
KEY = jax.random.PRNGKey(5)  # raw: what Brax's wrappers need
CARTPOLE = systems.get("cartpole")


def make(name="cartpole", **options):
    return brax.envs.get_environment(f"deconf_{name}", **options)


def unroll(env, state, actions):
    """The states after each action [T, ...], stacked along a leading axis."""

    def advance(state, action):
        state = env.step(state, action)
        return state, state

    return jax.jit(lambda *start: jax.lax.scan(advance, *start)[1])(state, actions)


@pytest.mark.parametrize("name", NAMES)
def test_steps_are_the_systems_own(name):
    """Jitted and vmapped, along trajectories, against a Python loop over System.step."""
    system, env = systems.get(name), make(name)
    starts = jax.jit(jax.vmap(env.reset))(jax.random.split(KEY, 4))
    actions = jax.random.uniform(KEY, (12, 4, env.action_size), minval=-1.5, maxval=1.5)
    got = unroll(brax.envs.training.VmapWrapper(env), starts, actions)
    assert (jnp.abs(actions) > 1).any()  # the clip is seen
    step, cost = jax.jit(system.step), jax.jit(system.stage_cost)
    for i in range(4):
        state = starts.pipeline_state.state[i]
        previous = starts.pipeline_state.previous_action[i]
        for t in range(12):
            inside = bool(system.in_bounds(state))
            wanted = jnp.clip(actions[t, i], -1, 1) * system.limits
            action = wanted if inside else previous
            paid = cost(state, action)
            state = step(state, action) if inside else state
            after = jax.tree.map(lambda x, t=t, i=i: x[t, i], got)
            np.testing.assert_allclose(after.pipeline_state.state, state, rtol=1e-6, atol=1e-6)
            np.testing.assert_array_equal(after.pipeline_state.previous_action, action)
            np.testing.assert_array_equal(after.obs, after.pipeline_state.state)
            np.testing.assert_allclose(after.reward, -paid, rtol=1e-5, atol=1e-5)
            assert after.done == (not system.in_bounds(state))
            assert after.metrics["in_bounds"] == inside
            # From where the environment is: this measures steps, not how errors grow.
            state, previous = after.pipeline_state.state, action


def test_a_whole_episode_is_a_rollout():
    """With terminate=False the reward of an episode is minus steps times the rollout loss."""
    env = make(terminate=False)
    start = jax.jit(env.reset)(KEY)
    actions = jax.random.uniform(KEY, (env.episode_length, 1), minval=-1.0, maxval=1.0)
    got = unroll(env, start, actions)

    def policy(count, state, signal, key):
        return count + 1, actions[count] * CARTPOLE.limits

    want = rollout(CARTPOLE, policy, jnp.array(0), start.pipeline_state.state, KEY)
    assert 1 < want.valid.sum() < env.episode_length  # it falls on the way
    np.testing.assert_allclose(got.pipeline_state.state[:-1], want.states[1:], rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(got.metrics["in_bounds"], want.valid)
    assert not got.done.any()
    loss = rollout_loss(CARTPOLE, jax.tree.map(lambda x: x[None], want))[0]
    np.testing.assert_allclose(-got.reward.sum() / env.episode_length, loss, rtol=1e-5)
    np.testing.assert_array_equal(got.metrics["stage_cost_per_step"], -got.reward)


@pytest.mark.parametrize("name", NAMES)
def test_previous_action_at_reset_is_random(name):
    """Uniform within the limits, independent of the state: as in systems/rollout.py."""
    system = systems.get(name)
    moments = jax.vmap(make(name).reset)(jax.random.split(KEY, 2000)).pipeline_state
    shown = np.asarray(moments.previous_action / system.limits)
    assert np.abs(shown).max() <= 1
    np.testing.assert_allclose(shown.mean(axis=0), 0, atol=0.05)
    np.testing.assert_allclose(shown.std(axis=0), 1 / np.sqrt(3), atol=0.03)
    states = np.asarray(moments.state)
    varied = states[:, states.std(axis=0) > 0]
    both = np.corrcoef(np.concatenate([shown, varied], axis=1).T)
    assert np.abs(both[: shown.shape[1], shown.shape[1] :]).max() < 0.1


@pytest.mark.parametrize("observation", brax_env.OBSERVATIONS)
def test_raw_and_typed_keys_give_the_same_start(observation):
    env = make(observation=observation)
    raw, typed = env.reset(jax.random.PRNGKey(7)), env.reset(jax.random.key(7))
    jax.tree.map(np.testing.assert_array_equal, raw, typed)
    other = env.reset(jax.random.key(8))
    assert (raw.pipeline_state.state != other.pipeline_state.state).all()


@pytest.mark.parametrize("name", NAMES)
def test_pixels_are_the_systems_frames(name):
    """With the nuisance of the action just taken; `render` gives the same frames in uint8."""
    system = dataclasses.replace(systems.get(name), size=(32, 48), signal=SIGNALS["filtered"])
    env = brax_env.SystemEnv(system, observation="pixels_state")
    start = jax.jit(env.reset)(KEY)
    after = jax.jit(env.step)(start, 0.5 * jnp.ones(env.action_size))
    assert env.observation_size == {"state": len(system.state_names), brax_env.PIXELS: (32, 48, 3)}
    for state in (start, after):
        moment = state.pipeline_state
        frame = np.asarray(system.frame(moment.state, moment.past[0]))
        pixels = state.obs[brax_env.PIXELS]
        assert pixels.dtype == jnp.float32
        np.testing.assert_allclose(pixels * 255, frame, atol=1e-4)
        np.testing.assert_array_equal(env.render([moment])[0], frame)
        np.testing.assert_array_equal(state.obs["state"], moment.state)
    # Another signal, another frame: the nuisance is in it.
    np.testing.assert_allclose(after.pipeline_state.previous_action, 0.5 * system.limits)
    shown = 0.7 * start.pipeline_state.past[0] + 0.15 * system.limits
    np.testing.assert_allclose(after.pipeline_state.past[0], shown, rtol=1e-5)
    bare = np.asarray(system.draw(after.pipeline_state.state, system.size))
    assert np.abs(bare - after.obs[brax_env.PIXELS]).max() > 0.2


def test_brax_vision_network_reads_the_pixels():
    """And its action follows them: under any other key it would see no image at all."""
    env = make(observation="pixels")
    network = networks_vision.make_ppo_networks_vision(env.observation_size, env.action_size)
    shapes = jax.eval_shape(network.policy_network.init, KEY)  # its own init compiles for seconds
    random = np.random.default_rng(0)
    params = jax.tree.map(lambda leaf: random.normal(0, 0.1, leaf.shape), shapes)
    obs = jax.jit(jax.vmap(env.reset))(jax.random.split(KEY, 3)).obs
    logits = jax.jit(network.policy_network.apply)(None, params, obs)
    assert logits.shape == (3, 2 * env.action_size)
    assert np.std(logits, axis=0).min() > 1e-5


@pytest.mark.parametrize("observation", ["state", "pixels_state"])
def test_brax_training_wrappers(observation):
    """Falls end episodes and go back to their own start; the time limit truncates."""
    env = make(observation=observation)
    wrapped = brax.envs.training.wrap(env, episode_length=env.episode_length)
    wrapped = brax.envs.training.EvalWrapper(wrapped)
    assert wrapped.unwrapped is env
    assert wrapped.dt == CARTPOLE.dt
    start = jax.jit(wrapped.reset)(jax.random.split(KEY, 8))
    after = unroll(wrapped, start, jnp.ones((40, 8, 1)))  # full force: every pole falls
    ends = np.asarray(after.done, bool)
    assert ends.any(axis=0).all()
    assert not np.asarray(after.info["truncation"]).any()
    first = np.broadcast_to(start.pipeline_state.state, (40, 8, 4))
    np.testing.assert_array_equal(after.pipeline_state.state[ends], first[ends])
    assert jax.tree.structure(jax.tree.map(lambda x: x[0], after)) == jax.tree.structure(start)
    counted = after.info["eval_metrics"].episode_metrics["in_bounds"][-1]
    np.testing.assert_array_equal(counted, ends.argmax(axis=0) + 1)


def test_time_limit_truncates():
    env = make(terminate=False)
    wrapped = brax.envs.training.wrap(env, episode_length=env.episode_length)
    start = jax.jit(wrapped.reset)(jax.random.split(KEY, 2))
    after = unroll(wrapped, start, jnp.zeros((CARTPOLE.steps, 2, 1)))
    np.testing.assert_array_equal(after.done[:-1], 0)
    np.testing.assert_array_equal(after.done[-1], 1)
    np.testing.assert_array_equal(after.info["truncation"][-1], 1)


def test_every_system_is_registered():
    for name in NAMES:
        assert make(name).system is systems.get(name)
        assert make(name).observation_size == len(systems.get(name).state_names)


def test_any_system_will_do():
    """One that is not registered, and has two actions."""
    system = dataclasses.replace(
        CARTPOLE,
        name="twice",
        action_limit=(25.0, 3.0),
        step=lambda state, action: CARTPOLE.step(state, action[:1] + action[1:]),
    )
    env = brax_env.SystemEnv(system)
    assert env.action_size == 2
    start = env.reset(KEY)
    after = env.step(start, jnp.array([0.1, -1.0]))
    want = CARTPOLE.step(start.pipeline_state.state, jnp.array([-0.5]))
    np.testing.assert_allclose(after.obs, want, rtol=1e-6, atol=1e-6)


def test_what_braxs_own_environments_take():
    """A physics engine, a picture's size and a camera; and an action of the right size."""
    env = make(backend="mjx")
    state, action = jnp.array([0.1, 0.0, 0.2, 0.0]), jnp.array([3.0])
    moment = brax_env.Moment(state, action, action[None])
    (picture,) = env.render([moment], height=32, width=48, camera="track")
    frame = dataclasses.replace(CARTPOLE, size=(32, 48)).frame(state, action)
    np.testing.assert_array_equal(picture, frame)
    with pytest.raises(ValueError, match=r"^action: expected numbers of shape \[1\], got "):
        jax.eval_shape(lambda key: env.step(env.reset(key), jnp.zeros(2)), KEY)


def test_unknown_observation():
    with pytest.raises(ValueError, match=r"observation: expected one of state, pixels.*got 'RGB'"):
        make(observation="RGB")


def test_importing_the_systems_does_not_import_brax():
    code = (
        "import sys, jaxdeconf, jaxdeconf.systems, jaxdeconf.evaluate;"
        "print('brax' in sys.modules, 'jaxdeconf.systems.brax_env' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["False", "False"]


# Brax's trainer calls a function of optax that has been renamed.
@pytest.mark.filterwarnings(
    "ignore:optax.global_norm is deprecated:DeprecationWarning:optax._src.linear_algebra"
)
@pytest.mark.slow
def test_a_brax_trainer_learns_to_balance():
    """Augmented random search (Mania et al. 2018) finds a linear policy that keeps the pole up."""
    env, progress = make(terminate=False), []
    ars.train(
        env,
        num_timesteps=8_000_000,
        episode_length=env.episode_length,
        number_of_directions=512,
        top_directions=32,
        exploration_noise_std=1.0,  # of any smaller size the falling policies are a local optimum
        step_size=0.05,
        num_evals=78,  # one after each update
        progress_fn=lambda _, metrics: progress.append(metrics),
        seed=2,  # finds the way up well before the end; others at times after it, as rounding goes
    )
    rewards = [metrics["eval/episode_reward"] for metrics in progress]
    steps_in_bounds = [metrics["eval/episode_in_bounds"] for metrics in progress]
    print(f"reward {rewards[0]:.0f} -> {rewards[-1]:.0f}")
    print(f"in bounds {steps_in_bounds[0]:.0f} -> {steps_in_bounds[-1]:.0f}")
    assert rewards[0] < -3000
    assert steps_in_bounds[0] < 25
    assert rewards[-1] > 0.5 * rewards[0]
    assert steps_in_bounds[-1] > 80
