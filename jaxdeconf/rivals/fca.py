"""FCA: an adversary tells the previous action from the features, and these learn to deny it.

C. Wen et al. (2020), "Fighting copycat agents in behavioral cloning from observation histories",
NeurIPS 2020. Theirs takes turns; with one gradient, the adversary's is reversed on its way to the
features (Ganin & Lempitsky 2015). The paper's information bottleneck is not in its code, nor here.
Shapes: B batch, F features, A action.
"""

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import Array

from jaxdeconf.keys import named
from jaxdeconf.learn import clone
from jaxdeconf.learn.clone import CloneConfig, Demonstrations
from jaxdeconf.learn.fit import Loss, Variables
from jaxdeconf.method import Evidence
from jaxdeconf.nets.initial import draw

_HIDDEN = 300  # units; the authors'


class _Adversary(nn.Module):
    outputs: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        x = nn.leaky_relu(nn.Dense(_HIDDEN, name="hidden")(x), 0.2)
        return nn.Dense(self.outputs, name="head")(x)


def begin(variables: Variables, _: Evidence, key: Array) -> Variables:
    """The policy's first variables, and an adversary's beside them, trained along."""
    features, actions = variables["params"]["head"]["kernel"].shape
    inputs = jnp.zeros((1, features + actions))
    shapes = jax.eval_shape(_Adversary(actions).init, key, inputs)
    fresh = draw(shapes, named(key, "adversary initial weights"), gain=2)
    return {**variables, "params": {**variables["params"], "adversary": fresh["params"]}}


def reverse(x: Array, strength: Array | float) -> Array:
    """x [...] itself, but its gradient is -strength times what comes back."""
    held = jax.lax.stop_gradient(x)
    return held - strength * (x - held)


def objective(config: CloneConfig) -> Loss:
    """The action's error + the adversary's, whose gradient reaches features by -strength.

    The adversary is given the features and the expert's action. An episode's first step has no
    previous action of the expert's: the adversary is not asked for it.
    """

    def loss(variables: Variables, data: Demonstrations, indices: Array, key: Array, step: Array):
        assert data.previous_actions is not None
        assert config.strength is not None
        images = clone.stacked(config, data, indices)
        error, features, stats = clone.imitate(config, variables, data, indices, images)
        told = jnp.concatenate([reverse(features, config.strength), data.actions[indices]], axis=1)
        previous = data.previous_actions[indices]
        adversary = {"params": variables["params"]["adversary"]}
        guess = jnp.asarray(_Adversary(previous.shape[1]).apply(adversary, told))
        weight = data.step[indices] > 0
        missed = ((guess - previous) ** 2).mean(axis=1)
        against = (missed * weight).sum() / jnp.maximum(weight.sum(), 1)
        return error + against, (stats, {"error": error, "adversary": against})

    return loss
