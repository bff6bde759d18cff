"""What a masking does to a policy: one cloned from frames as recorded, one from frames as written.

Open loop: there is no simulator to let them drive in. Shapes: m frames, n steps, A action.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf import threads
from jaxdeconf.formats.source import Redraw
from jaxdeconf.learn import clone
from jaxdeconf.learn.clone import CloneConfig, Demonstrations, Policy
from jaxdeconf.learn.fit import FitState, Training
from jaxdeconf.owndata.dataset import Dataset
from jaxdeconf.owndata.view import View
from jaxdeconf.views import identity

_TEST = 2000  # steps on which they are compared, at most


class Clone(NamedTuple):
    """A policy's numbers, on episodes that it has not seen."""

    error: float  # mean squared, of the action over its limit
    # Mean change of the action over its limit, when all that is redrawn of a frame is taken from
    # another frame, and all else stays; None where every pixel is redrawn.
    copycat: float | None


def compared(
    demos: Dataset,
    out: np.ndarray,
    view: View,
    key: Array,
    watch: Callable[[str, Training, Array], FitState],
    config: CloneConfig = clone.CPU,
    together: Callable[[list[Callable[[], Clone]]], list[Clone]] = threads.together,
) -> dict[str, Clone]:
    """{"recorded", "written": of the policy that is cloned from these frames}.

    Args:
      demos: the demonstrations.
      out: [n] bool, the steps of episodes that are held out.
      view: from frames as recorded to frames as written, which the policy is shown.
      key: of both alike.
      watch: what the trainings pass through: a name, a training, the frames that it learns.
      config: of both.
      together: does both, one after the other or side by side.
    """
    redraws: dict[str, Redraw] = {"recorded": np.copy, "written": view}
    step = np.arange(len(out)) - np.repeat(demos.first, demos.lengths)
    tested = np.flatnonzero(out & (step >= config.frames - 1))
    tested = tested[:: -(-len(tested) // _TEST)]

    def one(name: str) -> Clone:
        frames = jnp.asarray(redraws[name](demos.frames[~out]))
        data = Demonstrations(frames, jnp.asarray(step[~out]), jnp.asarray(demos.actions[~out]))
        training = clone.training(config, lambda: data, len(frames), identity, {}, key)
        policy = training.trained(watch(f"clone {name}", training, frames))
        return _judged(policy, redraws[name], demos, tested, view.region)

    done = together([partial(one, name) for name in redraws])
    return dict(zip(redraws, done, strict=True))


def _judged(
    policy: Policy, redraw: Redraw, demos: Dataset, steps: np.ndarray, region: np.ndarray
) -> Clone:
    recent = np.stack([demos.frames[steps - ago] for ago in reversed(range(policy.frames))])
    acted = _act(policy, redraw, recent)
    error = float(np.mean((acted - demos.actions[steps]) ** 2))
    if region.all():
        return Clone(error, None)
    # The pixels of a frame from half the data away: of another episode, at another time.
    changed = np.where(region[..., None], np.roll(recent, len(steps) // 2, axis=1), recent)
    return Clone(error, float(np.abs(_act(policy, redraw, changed) - acted).mean()))


def _act(policy: Policy, redraw: Redraw, recent: np.ndarray) -> np.ndarray:
    """Actions [m, A] for the last L frames [L, m, H, W, 3]."""
    return np.asarray(_acted(policy, jnp.asarray(np.stack([*map(redraw, recent)], axis=1))))


@jax.jit
def _acted(policy: Policy, seen: Array) -> Array:
    """Of frames [m, L, H, W, 3]."""
    return jax.lax.map(lambda one: policy.act(one[:, None])[0], seen, batch_size=256)
