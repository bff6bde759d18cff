"""The flow of a run: collect, disentangle, mask, clone, evaluate. Each stage resumes by itself.

Shapes: N trajectories, T time, S state, A action, O latent, H reaction horizon, n frames.
"""

import math
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxdeconf import evaluate, mask, systems
from jaxdeconf.expert import expert_trajectories
from jaxdeconf.learn import clone, disentangle, views
from jaxdeconf.learn.fit import FitState, Variables
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.store import Store
from jaxdeconf.systems import System, Trajectories, random_trajectories
from jaxdeconf.systems.rollout import frames

# Of work that a kill may cost; a save takes a few tenths of one.
SAVE_SECONDS = 30.0


class Collected(NamedTuple):
    """All trajectories of a run."""

    random: Trajectories  # for the β-VAE
    held_out: Trajectories  # random-policy ones that nothing is trained on
    expert: Trajectories  # for the mask and for cloning
    driven: Trajectories  # the expert from the initial states of the evaluation
    unconverged: Array  # [N] steps of `expert` whose plan had not converged


class Disentangled(NamedTuple):
    """The trained β-VAE and which of its latents carry anything."""

    variables: Variables
    kl: Array  # [O] nats, on held-out frames
    active: Array  # [O] bool


class Cloned(NamedTuple):
    """A trained policy, and how it drove while it was trained."""

    weights: evaluate.Weights
    history: list[list[float]]  # [epoch, mean, standard deviation] of the rollout loss
    train_loss: float


@dataclass(frozen=True)
class Run:
    """What every stage needs: the question, the disk and the screen."""

    config: Config
    store: Store
    reporter: Reporter
    seconds: dict[str, float]  # filled in stage by stage
    interruption: Interruption = field(default_factory=Interruption)

    @property
    def system(self) -> System:
        """The system that the config names."""
        return systems.get(self.config.system)

    def key(self, name: str) -> Array:
        """The key of one named random choice: same seed and name, same key."""
        return jax.random.fold_in(jax.random.key(self.config.seed), zlib.crc32(name.encode()))

    def stage(self, name: str, compute: Callable[[], Any], made_from: Sequence[str] = ()) -> Any:
        """A stage in one piece: loaded if it was done before, else computed and saved."""
        saved = self.store.load(name, compute, made_from)
        if saved is not None:
            self.seconds[name] = saved[1]["seconds"]
            return saved[0]
        with self.reporter.bar(name, 1) as bar:
            begin = time.perf_counter()
            value = jax.block_until_ready(compute())
            self.seconds[name] = time.perf_counter() - begin
            bar.update(1, "")
        self.store.save(name, 0, value, {"seconds": self.seconds[name]}, made_from)
        self.interruption.check()
        return value

    def checkpoint(
        self,
        name: str,
        state: FitState,
        notes: dict[str, Any],
        made_from: Sequence[str],
        now: bool,
    ) -> None:
        """At a chunk's edge: saves `now`, when the last save is long ago, or to stop.

        Raises:
          FloatingPointError: instead of saving weights that are not finite.
          Interrupted: after saving, if the run has been asked to stop.
        """
        late = time.monotonic() - self.store.saved_at > SAVE_SECONDS
        if now or late or self.interruption.asked:
            if not finite(state):
                raise FloatingPointError(f"{name}, step {state.step}: weights are not finite")
            self.store.save(name, int(state.step), state, notes, made_from)
        self.interruption.check()


def finite(tree: Any) -> bool:
    """Whether all numbers of a pytree are finite."""
    return all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree))


def collect(run: Run) -> Collected:
    """Random-policy and expert trajectories, from initial states set at random."""
    config, system = run.config, run.system
    learned, held_out = config.collect.random_trajectories, config.collect.held_out_trajectories
    imitated, driven = config.collect.expert_trajectories, config.eval.rollouts

    def compute() -> Collected:
        # Each policy rolls out all its trajectories in one call: one shape, one compilation.
        random = random_trajectories(system, run.key("random"), learned + held_out)
        random = jax.tree.map(lambda a: a[:, : config.collect.random_steps], random)
        keys = jax.random.split(run.key("expert initial states"), imitated + driven)
        states = jax.vmap(system.sample_initial)(keys)
        expert, unconverged = expert_trajectories(system, states, run.key("expert"), config.expert)
        return Collected(
            jax.tree.map(lambda a: a[:learned], random),
            jax.tree.map(lambda a: a[learned:], random),
            jax.tree.map(lambda a: a[:imitated], expert),
            jax.tree.map(lambda a: a[imitated:], expert),
            unconverged[:imitated],
        )

    return run.stage("collect", compute)


def valid_frames(system: System, trajectories: Trajectories) -> tuple[Array, Array]:
    """The frames of all valid steps.

    Returns:
      uint8 [n, 64, 64, 3], and the previous actions [n, A] that their nuisance shows.
    """
    flat = jax.tree.map(lambda a: a[trajectories.valid], trajectories)
    return frames(system, flat), flat.previous_actions


def train_disentangler(run: Run, collected: Collected) -> Disentangled:
    """Trains the β-VAE on random-policy frames."""
    config, name = run.config.vae, "disentangle"
    images, _ = valid_frames(run.system, collected.random)
    total, made_from = config.steps(len(images)), ["collect"]
    begin_state = partial(initial_disentangler, run, images)
    state, notes = run.store.load(name, begin_state, made_from) or (None, {"seconds": 0.0})
    seconds = notes["seconds"]
    with run.reporter.bar(name, total, int(state.step) if state else 0) as bar:
        begin = time.perf_counter() - seconds
        state = state or begin_state()  # after the clock: fitting the linear start takes seconds
        chunks = disentangle.disentangle(config, state, images, disentangling_key(run))
        for state, _ in bar.track(chunks, config):
            seconds = time.perf_counter() - begin
            run.checkpoint(name, state, {"seconds": seconds}, made_from, int(state.step) == total)
    run.seconds[name] = seconds
    return judge_disentangler(run, collected, state.variables)


def initial_disentangler(run: Run, images: Array) -> FitState:
    """The β-VAE before its first step, for images uint8 [n, 64, 64, 3]."""
    return disentangle.initial_state(run.config.vae, images, run.key("VAE initial weights"))


def disentangling_key(run: Run) -> Array:
    """Shuffles and noise of the β-VAE's training."""
    return run.key("VAE training")


def cloning_key(run: Run) -> Array:
    """Shuffles of the cloning, the same for all policies of a run."""
    return run.key("cloning")


def judge_disentangler(run: Run, collected: Collected, variables: Variables) -> Disentangled:
    """Which latents of a trained β-VAE are active, on held-out random-policy frames."""
    images, _ = valid_frames(run.system, collected.held_out)
    mean, log_variance = disentangle.encode(run.config.vae.network, variables, images)
    kl = disentangle.kl_divergence(mean, log_variance).mean(axis=0)
    return Disentangled(variables, kl, kl > disentangle.ACTIVE_KL)


def first_latents(run: Run, collected: Collected, vae: Disentangled) -> Array:
    """[N, O] latents of the expert trajectories' first frames; 0, the prior mean, if inactive."""
    first = jax.tree.map(lambda a: a[:, 0], collected.expert)
    images = frames(run.system, first)
    mean, _ = disentangle.encode(run.config.vae.network, vae.variables, images)
    return jnp.where(vae.active, mean, 0.0)


def find_mask(run: Run, collected: Collected, vae: Disentangled) -> mask.Mask:
    """Algorithm 1 on the expert trajectories."""
    config = run.config.mask

    def compute() -> mask.Mask:
        found = mask.find_mask(
            collected.expert.states[:, 0],
            first_latents(run, collected, vae),
            collected.expert.actions[:, : config.reaction_horizon],
            threshold=config.threshold,
            alpha=config.alpha,
        )
        return jax.tree.map(jnp.asarray, found)

    return run.stage("mask", compute, ["collect", "disentangle"])


def view_of(run: Run, policy: str, vae: Disentangled, masked: ArrayLike) -> tuple[views.View, Any]:
    """The view that a policy is cloned on and drives with, and the view's parameters.

    Args:
      run: whose system and networks.
      policy: its name.
      vae: the β-VAE.
      masked: [O] bool, the latents that Masked does not see.
    """
    keep = vae.active if policy == "Reconstructed" else vae.active & ~jnp.asarray(masked)
    reconstruction = {"variables": vae.variables, "keep": keep}
    return {
        "BcVanilla": (views.identity, {}),
        "BcManual": (views.covered(run.system.nuisance), {}),
        "Masked": (views.reconstructed(run.config.vae.network), reconstruction),
        "Reconstructed": (views.reconstructed(run.config.vae.network), reconstruction),
    }[policy]


@partial(jax.jit, static_argnames=("system", "view"))
def _seen(system: System, view: views.View, parameters: Any, trajectories: Trajectories) -> Array:
    """uint8 [N, T, 64, 64, 3]: the frames of trajectories through a view, one trajectory a time."""
    return jax.lax.map(lambda one: view(parameters, frames(system, one)), trajectories)


def demonstrations(
    system: System, view: views.View, parameters: Any, trajectories: Trajectories
) -> clone.Demonstrations:
    """Every step of trajectories [N, T], as a view shows it."""
    images = _seen(system, view, parameters, trajectories)
    count, length = images.shape[:2]
    first = jnp.tile(jnp.arange(length) == 0, count)
    actions = (trajectories.actions / system.limits).reshape(count * length, -1)
    return clone.Demonstrations(images.reshape(-1, *images.shape[2:]), first, actions)


def drive(
    run: Run, collected: Collected, view: views.View, weights: evaluate.Weights
) -> Trajectories:
    """Rollouts of a policy from the initial states that all policies of a run share."""
    driver = evaluate.Driver(run.config.bc.network, view)
    states, key = collected.driven.states[:, 0], run.key("evaluation")
    return evaluate.drive(run.system, driver, weights, states, key)


def imitated_steps(config: clone.CloneConfig, collected: Collected) -> Trajectories:
    """The part of the expert's trajectories that is cloned."""
    return jax.tree.map(lambda a: a[:, : config.trajectory_steps], collected.expert)


def train_policy(
    run: Run, policy: str, collected: Collected, view: views.View, parameters: Any
) -> Cloned:
    """Clones the expert on one view, driving as it goes."""
    config, name = run.config.bc, f"clone {policy}"
    imitated = imitated_steps(config, collected)
    samples = imitated.valid.size
    per_epoch, total = config.steps_per_epoch(samples), config.steps(samples)
    evaluations = run.config.eval.steps(per_epoch, total)
    made_from = ["collect", "disentangle", "mask"] if parameters else ["collect"]
    begin_state = partial(initial_policy, run)
    # losses: of the chunks since the last evaluation.
    notes: dict[str, Any] = {"seconds": 0.0, "history": [], "train_loss": math.nan, "losses": []}
    state, notes = run.store.load(name, begin_state, made_from) or (begin_state(), notes)
    if state.step < total:
        with run.reporter.bar(name, total, int(state.step)) as bar:
            begin = time.perf_counter() - notes["seconds"]
            data = demonstrations(run.system, view, parameters, imitated)
            chunks = clone.clone(config, state, data, cloning_key(run), evaluations)
            for state, metrics in bar.track(chunks, config):
                evaluated = int(state.step) in evaluations
                notes = {**notes, "losses": [*notes["losses"], metrics["loss"]]}
                if evaluated:
                    weights = evaluate.Weights(state.variables, parameters)
                    loss = evaluate.rollout_loss(run.system, drive(run, collected, view, weights))
                    point = [int(state.step) / per_epoch, float(loss.mean()), float(loss.std())]
                    notes["history"] = [*notes["history"], point]
                    notes |= {"train_loss": float(np.mean(notes["losses"])), "losses": []}
                notes["seconds"] = time.perf_counter() - begin
                run.checkpoint(name, state, notes, made_from, evaluated)
    run.seconds[name] = notes["seconds"]
    weights = evaluate.Weights(state.variables, parameters)
    return Cloned(weights, notes["history"], notes["train_loss"])


def initial_policy(run: Run) -> FitState:
    """Fresh weights; one key for all policies of a run: they differ in their views alone."""
    system, key = run.system, run.key("policy initial weights")
    state, action = jnp.zeros(len(system.state_names)), jnp.zeros_like(system.limits)
    frame = jax.eval_shape(system.frame, state, action)  # its shape; drawing would compile it
    return clone.initial_state(run.config.bc, frame.shape, len(system.action_limit), key)
