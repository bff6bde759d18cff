"""Behaviour cloning: regress the expert's action on the last L frames (paper, Section III-A).

Shapes: n samples, B batch, L frames, H × W pixels, A action.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf import checks
from jaxdeconf.keys import named
from jaxdeconf.learn.fit import FitConfig, FitState, Loss, Objective, Training, Variables, start
from jaxdeconf.nets import network
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.traced import Traced, traceable
from jaxdeconf.vision import raster

# (its parameters, images [B, H, W, 3] in [0, 1]) -> what the network is shown, of the same kind
View = Callable[[Any, Array], Array]


@traceable
@dataclass(frozen=True)
class CloneConfig(FitConfig):
    """The policy's training and network; the defaults are the paper's where it gives them."""

    epochs: float = 100.0  # ours: the paper gives none
    batch_size: int = 256  # the paper's
    frames: int = 2  # L, the frames that it sees, the present one last; the paper's
    # Steps of each trajectory that are cloned, from the first; None is all, the paper's.
    trajectory_steps: int | None = None
    # Errors of the action over its limit count squared up to here and linearly beyond (Huber 1964);
    # None is the squared error, the paper's. Ours, for short trainings: no frame shows the first
    # step's velocity, so its error is ten times the others' and cannot be learnt.
    huber: Traced | None = None
    # A method's own number: the weight of a penalty, the share that is dropped. None is the table's
    # of methods; the paper's have none.
    strength: Traced | None = None
    network: NetworkConfig = field(default_factory=NetworkConfig)

    def __post_init__(self):
        super().__post_init__()
        checks.integer("frames", self.frames, most=4)
        if self.trajectory_steps is not None:
            checks.integer("trajectory_steps", self.trajectory_steps)
        if self.huber is not None:
            checks.positive("huber", self.huber)
        if self.strength is not None:
            checks.not_negative("strength", self.strength)
        checks.instance("network", self.network, NetworkConfig)


# For a CPU and data of any size, in a minute: an early-pooling stem, narrow, and few steps.
CPU = CloneConfig(
    steps=1250,
    batch_size=32,
    learning_rate=2e-3,
    decay=0.02,
    huber=0.1,
    average=0.99,
    network=NetworkConfig(width=16, stem="imagenet"),
)


class Demonstrations(NamedTuple):
    """What is cloned: n samples, one for each time step of each trajectory, in order."""

    frames: Array  # [n, H, W, 3] uint8, as the policy's view shows them
    step: Array  # [n] int32, steps since the first of its trajectory
    actions: Array  # [n, A] over the limit, in [-1, 1]
    previous_actions: Array | None = None  # [n, A], for losses that need them
    weight: Array | None = None  # [n] of each in the loss; None: all alike
    extra: Any = None  # a pytree [n, ...], what else a method's loss needs


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Policy:
    """A cloned policy: what it is shown, and its network. A pytree of its weights."""

    view: View = field(metadata={"static": True})
    network: NetworkConfig = field(metadata={"static": True})
    frames: int = field(metadata={"static": True})  # L
    parameters: Any  # of the view
    variables: Variables  # of the network

    def see(self, images: Array) -> Array:
        """What the view makes of uint8 images [B, H, W, 3], uint8."""
        return show(self.view, self.parameters, images)

    def act(self, seen: Sequence[Array]) -> Array:
        """Actions [B, A] over the limit, for L batches of seen frames, the present one last."""
        return self.decide(stack(seen))

    def decide(self, images: Array) -> Array:
        """Actions [B, A] over the limit, for the network's input [B, H, W, 3 L] in [0, 1]."""
        return network.apply(self.network, self.variables, images, train=False)[0]


def show(view: View, parameters: Any, images: Array) -> Array:
    """What a view makes of uint8 images [B, H, W, 3], as they would be stored: uint8.

    Raises:
      ValueError: if the view makes something else of them than images.
    """
    seen = view(parameters, raster.dequantize(images))
    checks.array("view", seen, "[B, H, W, 3]", (len(images), None, None, 3), of="floats")
    return raster.quantize(seen)


def stack(frames: Sequence[Array]) -> Array:
    """[B, H, W, 3 L] float in [0, 1], the network's input, of L uint8 frames [B, H, W, 3]."""
    return raster.dequantize(jnp.concatenate(list(frames), axis=-1))


def blank(frames: Array) -> Array:
    """A frame from before the first: black, which no frame of a trajectory is."""
    return jnp.zeros_like(frames)


def action_error(
    config: CloneConfig, predicted: Array, actions: Array, weight: Array | None = None
) -> Array:
    """[] mean squared, or Huber, error of actions [B, A] over their limit, weighted by [B]."""
    error = jnp.abs(predicted - actions)
    if config.huber is None:
        errors = error**2
    else:
        linear = config.huber * (2 * error - config.huber)
        errors = jnp.where(error < config.huber, error**2, linear)
    if weight is None:
        return jnp.mean(errors)
    return (errors.mean(axis=1) * weight).sum() / weight.sum()


def ago(data: Demonstrations, indices: Array, steps: int) -> tuple[Array, Array]:
    """[B] the samples so many steps before those that are named, and [B] bool where there is none.

    Where there is none the index is of some other sample.
    """
    return jnp.maximum(indices - steps, 0), data.step[indices] < steps


def stacked(config: CloneConfig, data: Demonstrations, indices: Array) -> Array:
    """[B, H, W, 3 L] the network's input for the samples that are named."""

    def frame(steps: int) -> Array:
        then, none = ago(data, indices, steps)
        frames = data.frames[then]
        return jnp.where(none[:, None, None, None], blank(frames), frames) if steps else frames

    return stack([frame(steps) for steps in reversed(range(config.frames))])


def imitate(
    config: CloneConfig,
    variables: Variables,
    data: Demonstrations,
    indices: Array,
    images: Array,
    gate: Callable[[Array], Array] | None = None,
) -> tuple[Array, Array, Any]:
    """A batch's error, the features [B, F] that its actions follow from, the new `batch_stats`.

    Args:
      config: the policy's.
      variables: of the network.
      data: what is cloned.
      indices: [B] the samples.
      images: [B, H, W, 3 L] what the network is given for them; `stacked` as a rule.
      gate: see `network.look`.
    """
    predicted, features, stats = network.look(config.network, variables, images, True, gate)
    weight = None if data.weight is None else data.weight[indices]
    return action_error(config, predicted, data.actions[indices], weight), features, stats


def objective(config: CloneConfig) -> Loss:
    """The error of the action, for `fit`; data are Demonstrations."""

    def loss(variables: Variables, data: Demonstrations, indices: Array, key: Array, step: Array):
        images = stacked(config, data, indices)
        error, _, stats = imitate(config, variables, data, indices, images)
        return error, (stats, {})

    return loss


def training(
    config: CloneConfig,
    data: Callable[[], Demonstrations],
    samples: int,
    view: View,
    parameters: Any,
    key: Array,
    objective: Objective = objective,
    more: Callable[[Variables], Variables] = lambda variables: variables,
) -> Training:
    """A policy's training, not yet begun.

    Args:
      config: how it is trained, and its network.
      data: makes the demonstrations, as the view shows them.
      samples: how many those are.
      view: what the policy is going to be shown, as it was in `data`.
      parameters: of the view.
      key: its random choices follow from it by name, the same for all policies: these differ in
        what they are shown, and in nothing else.
      objective: config -> loss.
      more: adds to the first variables what else the objective trains, or reads.
    """

    def begin(data: Demonstrations) -> FitState:
        height, width, channels = data.frames.shape[1:]
        shape = height, width, config.frames * channels
        first = named(key, "policy initial weights")
        variables = network.init(config.network, first, shape, data.actions.shape[1])
        variables = more(network.with_background(variables, data.frames))
        return start(variables, config.average is not None)

    def trained(state: FitState) -> Policy:
        return Policy(view, config.network, config.frames, parameters, state.best)

    shuffles = named(key, "cloning")
    return Training(objective, config, samples, shuffles, data, begin, trained, parameters)
