"""PALR: features that do not depend on the previous action, given the present one.

S. Seo et al. (2023), "Regularized behavior cloning for blocking the leakage of past action
information", NeurIPS 2023.
"""

from dataclasses import replace

from jax import Array

from jaxdeconf.independence.hscic import hscic
from jaxdeconf.learn import clone
from jaxdeconf.learn.clone import CloneConfig, Demonstrations
from jaxdeconf.learn.fit import Loss, Variables

LEAST_BATCH = 128  # samples a step, of which HSCIC tells anything; the authors' is 1024


def in_larger_batches(config: CloneConfig) -> CloneConfig:
    """Batches that HSCIC tells anything of, on as many samples in all.

    Adam's learning rate goes with the root of the batch size (Malladi et al. 2022): a rule to begin
    with. It is to be tuned, for the plain policy with such batches too.
    """
    if config.batch_size >= LEAST_BATCH:
        return config
    larger = LEAST_BATCH / config.batch_size
    steps = None if config.steps is None else max(1, round(config.steps / larger))
    rate = config.learning_rate * larger**0.5
    return replace(config, batch_size=LEAST_BATCH, learning_rate=rate, steps=steps)


def objective(config: CloneConfig) -> Loss:
    """The action's error + strength · HSCIC(features, previous action | the expert's action).

    The features are those that the last layer is given. An episode's first step has no previous
    action of the expert's: it has weight 0 in HSCIC.
    """

    def loss(variables: Variables, data: Demonstrations, indices: Array, key: Array, step: Array):
        assert data.previous_actions is not None
        assert config.strength is not None
        images = clone.stacked(config, data, indices)
        error, features, stats = clone.imitate(config, variables, data, indices, images)
        previous, actions = data.previous_actions[indices], data.actions[indices]
        leak = hscic(features, previous, actions, weight=data.step[indices] > 0)
        return error + config.strength * leak, (stats, {"error": error, "hscic": leak})

    return loss
