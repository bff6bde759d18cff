"""Keyframe weights: more on steps whose action does not follow from the one before.

C. Wen et al. (2021), "Keyframe-focused visual imitation learning", ICML 2021. Theirs regress an
action by a network on the last nine; here, in closed form, on the last one.
Shapes: N episodes, T steps, A action.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf.demos import Demos
from jaxdeconf.keys import named
from jaxdeconf.leakage import regression
from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.method import Ask, Evidence

_SHARE = 0.1  # of the steps that weigh more; the authors'
_MOST = 1000  # steps that the regression is fitted to: a function of one action or two needs few


def weighted(demos: Demos, _: Evidence, ask: Ask) -> Demos:
    """The demonstrations, each step with its weight: `strength` for the keyframes, 1 for others."""
    assert ask.config.strength is not None
    eligible = followed(demos, ask.config)
    key = named(ask.key, "keyframes")
    chosen = keyframes(demos.previous_actions, demos.actions, eligible, key)
    weights = jnp.where(chosen, ask.config.strength, 1.0)
    return replace(demos, weights=weights if demos.weights is None else weights * demos.weights)


def followed(demos: Demos, config: CloneConfig) -> np.ndarray:
    """[N, T] bool, True for the cloned steps that come after another one.

    The first is none: its previous action is nobody's, and its error would be the largest of all.
    """
    steps = np.shape(demos.actions)[1]
    step = np.arange(steps)
    cloned = step < (config.trajectory_steps or steps)
    return (step > 0) & cloned & (step < demos.lengths[:, None])


def keyframes(previous: Array, actions: Array, eligible: np.ndarray, key: Array) -> Array:
    """The tenth of the steps whose action the previous one tells least of.

    Args:
      previous: [N, T, A] previous actions.
      actions: [N, T, A].
      eligible: [N, T] bool, the steps that count; others may hold anything, and are no keyframes.
      key: chooses the steps that the regression is fitted to.
    Returns:
      [N, T] bool. None where no step is eligible.
    """
    if eligible.sum() < 2:
        return jnp.zeros(eligible.shape, bool)
    before, after = (jnp.asarray(a)[eligible] for a in (previous, actions))
    error = surprise(before, after, key)
    high = error > jnp.quantile(error, 1.0 - _SHARE)
    return jnp.zeros(eligible.shape, bool).at[np.nonzero(eligible)].set(high)


@jax.jit
def surprise(before: Array, after: Array, key: Array) -> Array:
    """[n] squared errors of a regression of actions [n, A] on those [n, A] before them."""
    choice_key, regression_key = jax.random.split(key)
    fitted = jax.random.permutation(choice_key, len(before))[:_MOST]
    predict = regression(before[fitted], after[fitted], regression_key, before.shape[1])
    predicted = jax.lax.map(lambda one: predict(one[None])[0], before, batch_size=_MOST)
    return ((predicted - after) ** 2).sum(axis=1)
