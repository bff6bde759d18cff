"""The workflow on a made-up scene: two blobs for what matters, a square for what only looks so."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.deconfound import (
    clone_policy,
    deconfound,
    first_latents,
    learn_latents,
    mask_latents,
)
from jaxdeconf.demos import Demos
from jaxdeconf.learn.clone import CloneConfig, Policy
from jaxdeconf.learn.disentangle import DisentangleConfig, Encoder
from jaxdeconf.mask import Mask, MaskConfig
from jaxdeconf.method import Evidence, Method, imitated
from jaxdeconf.methods import METHODS, usual
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.region import find_region
from jaxdeconf.views import identity, shown

KEY = jax.random.key(0)
N, T, SIZE = 150, 4, (16, 24)
LENGTHS = np.random.default_rng(1).integers(2, T + 1, N)
LATENTS = DisentangleConfig(
    steps=60,
    objective="H",
    beta=2.0,
    network=VAEConfig(channels=(4,), latents=3, linear_path=True, norm="none"),
)
NETWORK = NetworkConfig(width=4, stem="imagenet", stages=1, norm="none")
CLONE = CloneConfig(steps=20, batch_size=32, network=NETWORK)
HORIZON = MaskConfig(reaction_horizon=2)


def scene(states, signal):
    """uint8 [..., 16, 24, 3]: a blob for each of states [..., 2], a corner for signal [..., 1]."""
    values = np.concatenate([states, signal], axis=-1)
    image = np.full((*values.shape[:-1], *SIZE, 3), 128.0)
    for i, (top, left) in enumerate([(2, 10), (9, 16), (0, 0)]):
        image[..., top : top + 5, left : left + 5, :] += 100 * values[..., i, None, None, None]
    return np.round(image).astype(np.uint8)


def covered(image):
    """A human's cover of the corner."""
    return image.at[:5, :5].set(1.0)


def expert(states):
    """What is best in states [n, 2]."""
    return 0.5 * (states[:, :1] - states[:, 1:])


@pytest.fixture(scope="module")
def demos():
    """Episodes of 2 to 4 steps, whose corner shows the action before, at first one of chance."""
    rng = np.random.default_rng(0)
    state, previous = rng.uniform(-1, 1, (N, 2)), rng.uniform(-1, 1, (N, 1))
    steps = []
    for _ in range(T):
        action = expert(state)
        steps.append((scene(state, previous), action, state, previous))
        state, previous = 0.8 * state, action
    images, actions, states, previous = (
        np.stack(part, axis=1) for part in zip(*steps, strict=True)
    )
    valid = np.arange(T) < LENGTHS[:, None]
    images[~valid], actions[~valid] = 7, np.nan
    return Demos(images, actions, states[:, 0], valid, previous)


@pytest.fixture(scope="module")
def exploration():
    """Frames in which nothing goes with anything; and what the corner shows."""
    rng = np.random.default_rng(2)
    signal = rng.uniform(-1, 1, (400, 1))
    return scene(rng.uniform(-1, 1, (400, 2)), signal), signal


@pytest.fixture(scope="module")
def watched(demos, exploration):
    """All methods of a usual run, and the steps of every training that passed the watch."""
    steps = {}

    def watch(name, training):
        *_, (state, _) = training.chunks(name)
        steps[name] = int(state.step)
        return state

    known = Evidence(cover=covered)
    configs = LATENTS, HORIZON, CLONE
    found = deconfound(demos, exploration[0], KEY, usual(), known, *configs, watch)
    return found, steps


def test_it_gives_an_encoder_a_mask_and_the_policies(watched):
    found, _ = watched
    assert isinstance(found.encoder, Encoder)
    assert isinstance(found.mask, Mask)
    assert tuple(found.policies) == usual()
    assert {(policy.network, policy.frames) for policy in found.policies.values()} == {(NETWORK, 2)}
    assert found.mask.state_action.shape == (2, 2, 1)


def test_every_training_passes_the_watch(watched):
    clones = {f"clone {name}": 20 for name in usual()}
    assert watched[1] == {"disentangle": 60, **clones}


def test_the_nuisances_latent_is_masked_and_no_other(watched, exploration):
    found, (images, signal) = watched[0], exploration
    every = Demos(images[:, None], signal[:, None], signal)
    latents = np.asarray(first_latents(found.encoder, every))
    correlation = np.abs(np.corrcoef(latents.T, signal.T)[:3, 3])
    assert found.encoder.active.all()
    np.testing.assert_array_equal(found.mask.mask, correlation > 0.9)
    assert sorted(correlation > 0.1) == [False, False, True]


def test_a_latent_that_is_not_active_is_zero(watched, demos):
    encoder = watched[0].encoder
    whole = first_latents(encoder, demos)
    some = first_latents(encoder._replace(active=jnp.array([True, False, True])), demos)
    np.testing.assert_array_equal(some, whole.at[:, 1].set(0.0))


def test_what_the_policies_are_shown(watched):
    """Of one pose, under both extremes of the nuisance, what differs most by."""
    pose, extremes = np.array([[0.4, -0.6]] * 2), np.array([[-1.0], [1.0]])
    images = jnp.asarray(scene(pose, extremes))
    differ = {}
    for name, policy in watched[0].policies.items():
        seen = np.asarray(jax.jit(Policy.see)(policy, images), float)
        differ[name] = np.abs(seen[0] - seen[1]).max()
    assert differ["BcVanilla"] == 200
    assert differ["BcManual"] == 0
    assert differ["Reconstructed"] > 150
    assert differ["Masked"] < 20
    assert differ["Inpainted"] < 20


def test_the_region_covers_the_nuisance(watched):
    """So short a training leaves traces of it in other latents: the region may be the whole."""
    assert watched[0].region[:5, :5].all()


def test_it_is_the_three_steps_one_by_one(watched, demos, exploration):
    images, found = exploration[0], watched[0]
    held_out = np.arange(400) % 10 == 9
    encoder = learn_latents(images[~held_out], images[held_out], KEY, LATENTS)
    mask = mask_latents(encoder, demos, HORIZON)
    region = find_region(encoder, mask.mask, images, KEY)
    policy = clone_policy("Inpainted", demos, Evidence(encoder, mask.mask, region), KEY, CLONE)
    both = (encoder, found.encoder), (mask, found.mask), (policy, found.policies["Inpainted"])
    for a, b in both:
        assert jax.tree.all(jax.tree.map(lambda a, b: np.array_equal(a, b), a, b))


def test_by_default_those_that_need_a_mask_are_cloned(demos, exploration):
    def skip(name, training):
        return training.start(training.data())

    configs = {"disentangle": LATENTS, "mask": HORIZON, "clone": CLONE}
    found = deconfound(demos, exploration[0], KEY, watch=skip, **configs)
    assert tuple(found.policies) == ("Masked", "Inpainted")


def refuse(name, training):
    raise AssertionError(f"{name} was begun")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"methods": ["BcManual"]}, "methods: expected one that needs no cover, got 'BcManual'"),
        ({"methods": ["Masked", "Best"]}, "methods: expected one of BcVanilla, .*, got 'Best'"),
        ({"mask": MaskConfig(reaction_horizon=3)}, "reaction_horizon: .* <= 2, got 3"),
        ({"clone": replace(CLONE, batch_size=9999)}, "batch_size: .* samples, got 9999"),
        ({"disentangle": replace(LATENTS, batch_size=361)}, "batch_size: .* 360 samples, got 361"),
        (
            {"disentangle": replace(LATENTS, network=VAEConfig())},
            "size: expected multiples of 32 .*, got 16 × 24",
        ),
    ],
    ids=lambda value: value.split(":")[0] if isinstance(value, str) else "",
)
def test_what_cannot_be_done_is_refused_before_anything_is(demos, exploration, changed, message):
    configs = {"disentangle": LATENTS, "mask": HORIZON, "clone": CLONE}
    with pytest.raises(ValueError, match=f"^{message}$"):
        deconfound(demos, exploration[0], KEY, watch=refuse, **{**configs, **changed})


def shown_by_loops(demos, steps):
    """Upside-down frames, steps, actions and previous actions of every valid step, in order."""
    rows = [
        (255 - demos.images[n, t], t, demos.actions[n, t], demos.previous_actions[n, t])
        for n in range(N)
        for t in range(min(LENGTHS[n], steps or T))
    ]
    return [np.stack(column) for column in zip(*rows, strict=True)]


def upside_down(_, images):
    return 1.0 - images


@pytest.mark.parametrize("steps", [None, 3])
def test_what_is_cloned_is_every_valid_step_in_order(demos, steps):
    found = shown(demos, upside_down, {}, steps)
    expected = shown_by_loops(demos, steps)
    for a, b in zip(found[:4], expected, strict=True):
        np.testing.assert_array_equal(a, np.asarray(b, a.dtype))
    config = replace(CLONE, trajectory_steps=steps)
    assert imitated(demos.lengths, config) == len(expected[0])


def test_what_is_cloned_of_whole_episodes_without_previous_actions(demos):
    whole = Demos(demos.images[:3], np.zeros((3, T, 1)), demos.initial_states[:3])
    found = shown(whole, identity, {}, 2)
    np.testing.assert_array_equal(found.frames, demos.images[:3, :2].reshape(6, *SIZE, 3))
    np.testing.assert_array_equal(found.step, [0, 1] * 3)
    assert found.previous_actions is None


def corrected(demos, evidence, ask):
    """The demonstrations with the opposite of the expert's first actions."""
    actions = np.array(demos.actions)
    actions[:, 0] = -evidence.expert(demos.initial_states)
    return replace(demos, actions=actions)


def test_a_method_of_ones_own_has_its_view_its_data_and_its_loss(demos, monkeypatch):
    seen = []

    def objective(config):
        def loss(variables, data, indices, key, step):
            jax.debug.callback(seen.append, data)
            bias = variables["params"]["head"]["bias"]
            wanted = data.actions[indices] - data.previous_actions[indices]
            return jnp.mean((bias - 5.0 - wanted) ** 2), ({}, {})

        return loss

    mine = Method(
        lambda evidence: (upside_down, {"told": jnp.float32(1.0)}),
        "A made-up one.",
        needs=("expert", "previous_actions"),
        objective=objective,
        data=corrected,
    )
    monkeypatch.setitem(METHODS, "Mine", mine)
    evidence = Evidence(expert=expert)
    policy = clone_policy("Mine", demos, evidence, KEY, replace(CLONE, steps=3, learning_rate=0.1))
    jax.effects_barrier()
    expected = shown_by_loops(corrected(demos, evidence, None), None)
    assert len(seen) == 3
    for a, b in zip(seen[0][:4], expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)
    np.testing.assert_allclose(policy.variables["params"]["head"]["bias"], [0.3], atol=1e-2)
    assert policy.view is upside_down
    assert policy.parameters == {"told": 1.0}
    with pytest.raises(ValueError, match=r"needs no expert, got 'Mine'$"):
        clone_policy("Mine", demos, Evidence(), KEY, CLONE)
    silent = replace(demos, previous_actions=None)
    with pytest.raises(ValueError, match=r"needs no previous actions, got 'Mine'$"):
        clone_policy("Mine", silent, evidence, KEY, CLONE)


def test_the_data_of_a_method_are_as_many_steps_as_there_were(demos, monkeypatch):
    def shorter(demos, evidence, ask):
        return Demos(demos.images[:, :2], demos.actions[:, :2], demos.initial_states)

    monkeypatch.setitem(METHODS, "Mine", METHODS["BcVanilla"]._replace(data=shorter))
    words = f"^data: expected {LENGTHS.sum()} steps, got {2 * N}$"
    with pytest.raises(ValueError, match=words):
        clone_policy("Mine", demos, Evidence(), KEY, CLONE)
