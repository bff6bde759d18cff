"""Behaviour cloning: regress the expert's action on the last two frames (paper, Section III-A).

Shapes: N trajectories, T time, B batch, L = 2 frames, A action.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxdeconf import checks
from jaxdeconf.learn.fit import FitConfig, FitState, Loss, Variables, fit, start
from jaxdeconf.nets import resnet
from jaxdeconf.vision import raster


@dataclass(frozen=True)
class CloneConfig(FitConfig):
    """The policy's training and network; the defaults are the paper's where it gives them."""

    epochs: float = 100.0  # ours: the paper gives none
    batch_size: int = 256  # the paper's
    # Steps of each trajectory that are cloned, from the first; None is all, the paper's.
    trajectory_steps: int | None = None
    # Errors of the action over its limit count squared up to here and linearly beyond (Huber 1964);
    # None is the squared error, the paper's. Ours, for short trainings: no frame shows the first
    # step's velocity, so its error is ten times the others' and cannot be learnt.
    huber: float | None = None
    network: resnet.ResNetConfig = field(default_factory=resnet.ResNetConfig)

    TRACED: ClassVar[tuple[str, ...]] = (*FitConfig.TRACED, "huber")

    def __post_init__(self):
        super().__post_init__()
        if self.trajectory_steps is not None:
            checks.integer("trajectory_steps", self.trajectory_steps)
        if self.huber is not None:
            checks.positive("huber", self.huber)
        checks.instance("network", self.network, resnet.ResNetConfig)


class Demonstrations(NamedTuple):
    """What is cloned: n samples, one for each time step of each trajectory, in order."""

    frames: Array  # [n, 64, 64, 3] uint8, as the policy's view shows them
    first: Array  # [n] bool, the first step of its trajectory: no frame before it
    actions: Array  # [n, A] over the limit, in [-1, 1]


def stack(previous: Array, current: Array) -> Array:
    """[B, 64, 64, 6] float in [0, 1], the network's input, of two uint8 frames [B, 64, 64, 3]."""
    form = "[B, H, W, 3]"
    current = checks.array("current", current, form, (None, None, None, 3), of="uint8")
    previous = checks.array("previous", previous, form, current.shape, of="uint8")
    return raster.dequantize(jnp.concatenate([previous, current], axis=-1))


def blank(frames: Array) -> Array:
    """The frame before the first: black, which no frame of a trajectory is."""
    return jnp.zeros_like(frames)


def initial_state(config: CloneConfig, frame_shape: tuple[int, ...], actions: int, key: Array):
    """Fresh weights of a policy for frames of [H, W, C] and A = actions."""
    if not isinstance(frame_shape, tuple) or len(frame_shape) != 3:
        raise ValueError(f"frame_shape: expected (height, width, channels), got {frame_shape!r}")
    height, width, channels = frame_shape
    return start(resnet.init(config.network, key, (height, width, 2 * channels), actions))


def action_error(config: CloneConfig, predicted: Array, actions: Array) -> Array:
    """[] mean squared, or Huber, error of actions [B, A] over their limit."""
    predicted = checks.array("predicted", predicted, "[B, A]", (None, None))
    checks.array("actions", actions, "[B, A]", predicted.shape)
    error = jnp.abs(predicted - actions)
    if config.huber is None:
        return jnp.mean(error**2)
    return jnp.mean(
        jnp.where(error < config.huber, error**2, config.huber * (2 * error - config.huber))
    )


def objective(config: CloneConfig) -> Loss:
    """The error of the action, for `fit`; data are Demonstrations."""

    def loss(variables: Variables, data: Demonstrations, indices: Array, key: Array, step: Array):
        current = data.frames[indices]
        first = data.first[indices][:, None, None, None]
        previous = jnp.where(first, blank(current), data.frames[jnp.maximum(indices - 1, 0)])
        predicted, stats = resnet.apply(
            config.network, variables, stack(previous, current), train=True
        )
        return action_error(config, predicted, data.actions[indices]), (stats, {})

    return loss


def clone(
    config: CloneConfig, state: FitState, data: Demonstrations, key: Array, stops: Sequence[int]
) -> Iterator[tuple[FitState, dict[str, Array]]]:
    """Trains a policy on demonstrations; yields as `fit` does, and at every step in `stops`.

    Raises:
      ValueError: if the demonstrations are not what Demonstrations says, or too few for a batch.
    """
    checks.instance("config", config, CloneConfig)
    checks.instance("data", data, Demonstrations)
    frames = checks.array("frames", data.frames, "[n, H, W, 3]", (None, None, None, 3), of="uint8")
    checks.array("first", data.first, f"[{len(frames)}]", (len(frames),), of="bool")
    checks.array("actions", data.actions, f"[{len(frames)}, A]", (len(frames), None), finite=True)
    return fit(objective, state, data, len(data.actions), key, config, stops)


def act(config: resnet.ResNetConfig, variables: Variables, previous: Array, current: Array):
    """The policy's actions [B, A], over the limit, for two uint8 frames [B, 64, 64, 3] each."""
    return resnet.apply(config, variables, stack(previous, current), train=False)[0]
