"""What the intervention is for, on pixels: CartPole with the paper's fork made real.

The seed W, uniform in [-1, 1], sets where the cart starts and what the first square shows, as if an
operator had pressed the button the harder, the farther left the cart stood. The intervention draws
the start anew, from the same law, and leaves the square to W. So all conditions share the expert's
trajectories, the random-policy frames and the β-VAE; they differ in the first squares alone.
Shapes: N trajectories, S state, H reaction horizon, A action, O latent.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf import checks, collect, evaluate
from jaxdeconf.collect import CollectConfig, Collected
from jaxdeconf.deconfound import clone_policy, learn_latents, mask_latents
from jaxdeconf.expert import ExpertConfig
from jaxdeconf.keys import named
from jaxdeconf.leakage import explained
from jaxdeconf.learn import clone as bc
from jaxdeconf.learn import disentangle as vae
from jaxdeconf.learn.clone import CloneConfig, Policy
from jaxdeconf.learn.disentangle import DisentangleConfig, Encoder
from jaxdeconf.learn.fit import FitState, Training, Watch, finish
from jaxdeconf.mask import Mask, MaskConfig, find_mask
from jaxdeconf.method import Evidence
from jaxdeconf.methods import METHODS, masking
from jaxdeconf.region import find_region
from jaxdeconf.systems import System, Trajectories, cartpole
from jaxdeconf.systems.rollout import frames
from jaxdeconf.theory.claims import Rate, Stage, at_once, rate

_HAND = 0.8  # how much of the first square's range follows from where the cart stands
_SHOWN = 10  # first frames of a condition, for its report
_SAME = 0.9  # share of a latent's variance that the previous action explains, if it is the square's


@dataclass(frozen=True)
class PixelsConfig:
    """A small budget: the linear start, a short β-VAE, small networks. All ours."""

    couplings: tuple[float, ...] = (1.0, 0.5, 0.0)  # share of trajectories not intervened on
    method: str = field(default_factory=lambda: masking()[-1])  # cloned behind each mask
    datasets: int = 40  # that are masked; of `dataset` of the expert's trajectories, squares anew
    dataset: int = 1000
    rollouts: int = 100
    # H, W: half the pixels and half the time; at 32 × 32 the masked latents' reach is not local.
    size: tuple[int, int] = (48, 48)
    random_trajectories: int = 1500
    random_steps: int = 10
    expert_trajectories: int = 1500
    expert: ExpertConfig = field(default_factory=ExpertConfig)
    disentangle: DisentangleConfig = field(
        default_factory=lambda: replace(
            vae.CPU,
            steps=200,
            start_components=12,
            network=replace(vae.CPU.network, channels=(8, 16, 32, 64), latents=6),
        )
    )
    mask: MaskConfig = field(default_factory=lambda: MaskConfig(reaction_horizon=3))
    clone: CloneConfig = field(
        default_factory=lambda: replace(bc.CPU, steps=1000, trajectory_steps=40)
    )

    def __post_init__(self):
        for one in self.couplings:
            checks.number("couplings", one, "numbers in [0, 1]", -1e-9, 1 + 1e-9)
        checks.one_of("method", self.method, tuple(METHODS))
        checks.integer("dataset", self.dataset, least=5, most=self.expert_trajectories)
        for name in ("datasets", "rollouts"):
            checks.integer(name, getattr(self, name))


class Driven(NamedTuple):
    """What became of one condition: its mask, and the policy behind it."""

    coupling: float  # the share of trajectories that was not intervened on
    mask: np.ndarray  # [O] bool
    state_observation: np.ndarray  # [S, O] D
    threshold: float
    loss: float  # mean rollout loss
    error: float  # its standard error over rollouts
    survival: float  # share of rollouts in bounds to the end
    copycat: float  # mean change of the action over its limit when only the square is redrawn


class Condition(NamedTuple):
    """What was cloned where a share of trajectories was not intervened on."""

    coupling: float  # that share
    mask: Mask
    policy: Policy
    shown: np.ndarray  # uint8 [_SHOWN, H, W, 3] first frames, by where the cart starts


class Scene(NamedTuple):
    """What all conditions share."""

    system: System
    collected: Collected
    encoder: Encoder
    exploration: Array  # uint8 [n, H, W, 3] held out
    square: np.ndarray  # [O] R² of each latent that the previous action explains


def prepare(
    config: PixelsConfig, key: Array, stage: Stage = at_once, watch: Watch = finish
) -> Scene:
    """Collects what the conditions share, and learns the latents."""
    system = replace(cartpole.CARTPOLE, size=config.size)
    wanted = CollectConfig(
        random_trajectories=config.random_trajectories,
        expert_trajectories=config.expert_trajectories,
        held_out_trajectories=max(100, config.random_trajectories // 10),
        random_steps=config.random_steps,
    )
    collected = stage(
        "collect", lambda: collect.collect(system, wanted, config.expert, config.rollouts, key)
    )
    images = collect.exploration(system, collected.random).images
    held_out = collect.exploration(system, collected.held_out)
    encoder = learn_latents(images, held_out.images, key, config.disentangle, watch)
    mean, _ = vae.encode(encoder.network, encoder.variables, held_out.images)
    share = explained(held_out.signals, mean, named(key, "square"))
    share = np.where(np.asarray(encoder.active), np.maximum(share, 0.0), 0.0)
    return Scene(system, collected, encoder, held_out.images, share)


def coupled(
    system: System, trajectories: Trajectories, coupling: float, key: Array
) -> Trajectories:
    """Trajectories [N, T] with the first squares of a condition.

    Args:
      system: CartPole, whose first coordinate is the cart's place.
      trajectories: from starts drawn uniformly.
      coupling: the share of them in which the start is the seed's; in the others it was set.
      key: of the seeds, and of the operator's hand.
    """
    of_seed, of_hand, of_choice = jax.random.split(key, 3)
    n = trajectories.states.shape[0]
    place = trajectories.states[:, 0, 0] / cartpole.PARAMS.initial_box[0]
    anew = jax.random.uniform(of_seed, (n,), minval=-1.0, maxval=1.0)
    seed = jnp.where(jax.random.uniform(of_choice, (n,)) < coupling, place, anew)
    hand = jax.random.uniform(of_hand, (n,), minval=-1.0, maxval=1.0)
    pressed = ((1 - _HAND) * hand - _HAND * seed)[:, None] * system.limits
    shown = jnp.asarray(trajectories.signals).at[:, 0].set(pressed)
    return trajectories._replace(signals=shown)


def mask_rates(
    config: PixelsConfig, scene: Scene, key: Array, stage: Stage = at_once
) -> list[Rate]:
    """How often the square's latent is masked, and how often any other is, for each condition."""
    square = scene.square > _SAME
    others = np.asarray(scene.encoder.active) & ~square
    rows, keys = [], jax.random.split(named(key, "first squares"), config.datasets)
    for coupling in config.couplings:

        def masks(coupling: float = coupling) -> Array:
            of = scene.system, scene.encoder, scene.collected.expert, coupling, keys
            columns = _columns(*of, config.dataset, config.mask.reaction_horizon)
            gamma, alpha = config.mask.threshold, config.mask.alpha
            datasets = zip(*columns, strict=True)
            return jnp.stack([find_mask(s, o, a, gamma, alpha).mask for s, o, a in datasets])

        found = np.asarray(stage(f"masks {coupling:g}", masks))
        n, gamma = config.dataset, config.mask.threshold
        for name, which in (("the square", square), ("any other latent", others)):
            if which.any():
                happened = found[:, which].any(axis=1)
                rows.append(rate(f"{name} is masked, coupling {coupling:g}", n, gamma, happened))
    return rows


@partial(jax.jit, static_argnames=("system", "count", "horizon"))
def _columns(
    system: System,
    encoder: Encoder,
    expert: Trajectories,
    coupling: float,
    keys: Array,
    count: int,
    horizon: int,
) -> tuple[Array, Array, Array]:
    """Data sets of `count` of the expert's trajectories, with squares anew.

    Returns:
      First states [datasets, count, S], latents [.., count, O] and actions [.., count, H, A].
    """

    def one(key: Array) -> tuple[Array, Array, Array]:
        of_rows, of_squares = jax.random.split(key)
        rows = jax.random.permutation(of_rows, len(expert.states))[:count]
        some = jax.tree.map(lambda a: a[rows, :horizon], expert)
        some = coupled(system, some, coupling, of_squares)
        images = frames(system, jax.tree.map(lambda a: a[:, 0], some))
        mean, _ = vae.encode(encoder.network, encoder.variables, images)
        latents = jnp.where(encoder.active, mean, 0.0)
        return some.states[:, 0], latents, some.actions / system.limits

    return jax.lax.map(one, keys)


def clone(
    config: PixelsConfig, scene: Scene, coupling: float, key: Array, watch: Watch = finish
) -> Condition:
    """Masks with all of a condition's trajectories, and clones behind that mask."""
    system = scene.system
    expert = coupled(system, scene.collected.expert, coupling, named(key, "coupled"))
    demos = collect.demonstrations(system, expert, config.clone.trajectory_steps)
    found = mask_latents(scene.encoder, demos, config.mask)
    evidence = Evidence(scene.encoder, found.mask)
    if "region" in METHODS[config.method].needs:
        region = find_region(scene.encoder, found.mask, scene.exploration, key)
        evidence = evidence._replace(region=region)

    def named_watch(name: str, training: Training) -> FitState:
        return watch(f"{name}, coupling {coupling:g}", training)

    policy = clone_policy(config.method, demos, evidence, key, config.clone, named_watch)
    place = np.argsort(np.asarray(demos.initial_states)[:, 0])
    shown = place[np.linspace(0, len(place) - 1, _SHOWN).astype(int)]
    return Condition(coupling, found, policy, np.asarray(demos.images)[shown, 0])


def drive(scene: Scene, condition: Condition, key: Array) -> Driven:
    """Lets the policy of a condition drive."""
    system, evaluation = scene.system, scene.collected.evaluation
    driven = evaluate.drive(system, condition.policy, evaluation.states[:, 0], named(key, "driven"))
    loss = np.asarray(evaluate.rollout_loss(system, driven))
    shown = evaluate.in_turns(evaluation)
    moved = evaluate.copycat(system, condition.policy, shown, named(key, "redrawn"))
    return Driven(
        condition.coupling,
        np.asarray(condition.mask.mask),
        np.asarray(condition.mask.state_observation),
        float(condition.mask.threshold),
        float(loss.mean()),
        float(loss.std(ddof=1) / np.sqrt(len(loss))),
        float(evaluate.outcome(system, driven).mean()),
        float(moved),
    )
