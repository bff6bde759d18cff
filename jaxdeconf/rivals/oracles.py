"""Rivals that may do what a file of demonstrations does not allow: ask, shake, redraw.

Dart (Laskey et al. 2017, arXiv 1703.09327), Dagger (Ross, Gordon & Bagnell 2011, arXiv 1011.0686),
and frames with a nuisance of chance; the masks that ask are in `ccil`, the one that is told what
the nuisance shows in `probe`. All imitate as many steps as there are demonstrations: part of these
are replaced. Shapes: N episodes, T steps, A action.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf.demos import Demos
from jaxdeconf.keys import named
from jaxdeconf.learn import clone
from jaxdeconf.learn.clone import CloneConfig, Policy
from jaxdeconf.method import Ask, Evidence, Method, Price, as_they_are, imitated
from jaxdeconf.rivals import ccil, probe
from jaxdeconf.views import identity, shown

_ROUNDS = 2  # of Dagger, after the first clone's; ours


def replaced(demos: Demos, rows: slice, others: Demos) -> Demos:
    """Demonstrations with others in the place of some rows, each cut where what was there ended."""

    def put(own: Any, new: Any) -> Array:
        return jnp.asarray(own).at[rows].set(new)

    previous, weights = demos.previous_actions, demos.weights
    if weights is None:
        weights = jnp.ones(demos.images.shape[:2])
    return replace(
        demos,
        images=put(demos.images, others.images),
        actions=put(demos.actions, others.actions),
        initial_states=put(demos.initial_states, others.initial_states),
        previous_actions=None if previous is None else put(previous, others.previous_actions),
        weights=put(weights, others.weights),
    )


def half_shaken(demos: Demos, evidence: Evidence, ask: Ask) -> Demos:
    """Dart's data: the first half of the trajectories anew, with noise on what is executed.

    One noise for all, of which `strength` is the standard deviation over the limit. The other half
    stays clean, which bounds the clone's error where the system alone is not stable (Zhang,
    Pfrommer et al. 2025, arXiv 2507.09061).
    """
    count, steps = demos.images.shape[:2]
    rows, key = slice(0, count // 2), named(ask.key, "shaken")
    shaken = evidence.simulator.shaken(ask.config.strength, key, steps, rows)
    return replaced(demos, rows, shaken)


def aggregated(demos: Demos, evidence: Evidence, ask: Ask) -> Demos:
    """Dagger's data: a quarter of the trajectories a round is replaced by what a clone does.

    The clone of each round drives by itself (β = 1, then 0) from where the replaced trajectories
    started; the labels are the expert's. It is trained on the data so far, for half of the steps,
    from fresh weights. So N trajectories are cloned in every round.
    """
    count, steps = demos.images.shape[:2]
    keys = jax.random.split(named(ask.key, "clone drives"), _ROUNDS)
    for turn, key in enumerate(keys):
        policy = _cloned(demos, ask, f"clone Dagger, round {turn + 1}")
        rows = slice(turn * (count // 4), (turn + 1) * (count // 4))
        driven = evidence.simulator.driven(policy, key, steps, rows)
        demos = replaced(demos, rows, evidence.simulator.labelled(driven))
    return demos


def _cloned(demos: Demos, ask: Ask, name: str) -> Policy:
    """A plain clone, in half of the steps."""
    config = _halved(ask.config)
    samples = imitated(demos.lengths, config)

    def data() -> clone.Demonstrations:
        return shown(demos, identity, {}, config.trajectory_steps)

    training = clone.training(config, data, samples, identity, {}, ask.key)
    return training.trained(ask.watch(name, training))


def _halved(config: CloneConfig) -> CloneConfig:
    if config.steps is not None:
        return replace(config, steps=max(1, config.steps // 2))
    return replace(config, epochs=config.epochs / 2)


def randomly_redrawn(demos: Demos, evidence: Evidence, ask: Ask) -> Demos:
    """The same trajectories; what the nuisance shows is drawn at random, once for each frame."""
    key, steps = named(ask.key, "nuisance redrawn"), demos.images.shape[1]
    return replace(demos, images=evidence.simulator.redrawn(key, steps))


ROWS: dict[str, Method] = {
    "Dart": Method(
        as_they_are,
        "Half of the demonstrations are given anew, by an expert whose hand is shaken.",
        needs=("simulator",),
        kind="oracle",
        rival=True,
        strength=0.1,
        data=half_shaken,
        price=lambda count, steps: Price(count // 2 * steps, count // 2),
    ),
    "Dagger": Method(
        as_they_are,
        "Half of the demonstrations give way to the clone's own driving, labelled by the expert.",
        needs=("simulator",),
        kind="oracle",
        rival=True,
        data=aggregated,
        price=lambda count, steps: Price(_ROUNDS * (count // 4) * steps, _ROUNDS * (count // 4)),
    ),
    "Redrawn": Method(
        as_they_are,
        "In every frame that is cloned the nuisance shows an action of chance.",
        needs=("simulator",),
        kind="oracle",
        rival=True,
        data=randomly_redrawn,
    ),
    **probe.ROWS,
    **ccil.ROWS,
}
