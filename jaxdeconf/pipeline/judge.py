"""What a run's numbers are: of latents, of the expert, of policies; and the pictures of its report.

Shapes: O latents, A action, T time, n frames, V values.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxdeconf import evaluate, leakage
from jaxdeconf.collect import Collected, Exploration, exploration
from jaxdeconf.independence.hscic import hscic
from jaxdeconf.keys import named
from jaxdeconf.learn import disentangle
from jaxdeconf.learn.clone import Policy, View
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.pipeline.results import (
    SAME,
    Judged,
    JudgedExpert,
    Losses,
    Pictures,
    Reconstruction,
    Sight,
)
from jaxdeconf.systems import System, Trajectories
from jaxdeconf.systems.rollout import frames
from jaxdeconf.views import covered, identity, reconstructed, see

# Frames that train, and that test, the regression of leakage: its time is cubic in them.
_JUDGE_FRAMES = 1500
_HSCIC_SAMPLES = 1024  # its time is cubic, too; the authors' batch
_TRAVERSAL = np.linspace(-2.5, 2.5, 9)  # prior standard deviations
_STRIP = 10  # frames
_SIGHT = 4  # frames, each of another rollout


@dataclass(frozen=True, eq=False)
class Trial:
    """What everything of a run is judged on, the same for all policies."""

    system: System
    key: Array
    collected: Collected
    held_out: Exploration  # under the random policy, where the nuisance is known

    @cached_property
    def unpredicted(self) -> float:
        """The error of telling the expert's actions each from the one before."""
        return _unpredicted(self, self.collected.evaluation)

    @property
    def apart(self) -> slice:
        """Held-out frames at even distances, for regressions: neighbours in a trajectory are alike.

        Of those, leave-one-out is told what it should not be, and chooses a ridge that overfits.
        """
        return slice(None, None, -(-len(self.held_out.images) // (2 * _JUDGE_FRAMES)))

    @cached_property
    def shown(self) -> Trajectories:
        """Some steps of the expert's rollouts, at which policies are asked."""
        return evaluate.in_turns(self.collected.evaluation)


def trial(system: System, key: Array, collected: Collected) -> Trial:
    """A run's trial; draws the held-out frames."""
    return Trial(system, key, collected, exploration(system, collected.held_out))


class JudgedLatents(NamedTuple):
    """The β-VAE's numbers, on held-out frames; see `Results`."""

    nuisance_correlation: Array  # [O]
    nuisance_share: Array  # [O]
    reconstruction: Reconstruction


def judge_latents(trial: Trial, encoder: Encoder) -> JudgedLatents:
    """The β-VAE on held-out random-policy frames."""
    images, _, signals = trial.held_out
    mean, _ = disentangle.encode(encoder.network, encoder.variables, images)
    key = named(trial.key, "nuisance share")
    return JudgedLatents(
        jnp.abs(leakage.spearman(mean, signals)).max(axis=1),
        leakage.explained(signals[trial.apart], mean[trial.apart], key),
        _reconstruction(trial, encoder, images[:_JUDGE_FRAMES]),
    )


def _reconstruction(trial: Trial, encoder: Encoder, images: Array) -> Reconstruction:
    """The error where the nuisance is, by whoever knows it, and elsewhere."""
    parameters = {"variables": encoder.variables, "keep": encoder.active}
    drawn = see(reconstructed(encoder.network), parameters, images)
    truth, drawn = (np.asarray(frame, np.float32) for frame in (images, drawn))
    error = (((drawn - truth) / 255.0) ** 2).mean(axis=0).sum(axis=-1)  # [H, W]
    nuisance = np.zeros(error.shape, bool)
    if hasattr(trial.system.nuisance, "cover"):
        without = see(covered(trial.system.nuisance.cover), {}, images)
        nuisance = (truth != without).any(axis=(0, 3))
    return Reconstruction(float(error[nuisance].sum()), float(error[~nuisance].sum()))


def precision_recall(
    mask: ArrayLike, encoder: Encoder, share: ArrayLike
) -> tuple[float | None, float | None]:
    """Of the masked active latents the share that is the nuisance's, and the reverse."""
    active = np.asarray(encoder.active)
    masked, nuisance = np.asarray(mask) & active, (np.asarray(share) >= SAME) & active
    right = int((masked & nuisance).sum())
    return (
        right / int(masked.sum()) if masked.any() else None,
        right / int(nuisance.sum()) if nuisance.any() else None,
    )


def judge_expert(system: System, collected: Collected) -> JudgedExpert:
    """The expert on the evaluation's initial states, and its faults on all of its own."""
    trajectories = collected.expert
    penalty = jax.jit(jax.vmap(jax.vmap(system.state_penalty)))(trajectories.states[:, 1:])
    return JudgedExpert(
        float(evaluate.rollout_loss(system, collected.evaluation).mean()),
        float(evaluate.outcome(system, collected.evaluation).mean()),
        float((penalty > 0).mean()),
        float(collected.unconverged.sum() / trajectories.valid.size),
    )


def drive(trial: Trial, policy: Policy, rollouts: int | None = None) -> Trajectories:
    """Rollouts of a policy from the initial states that all policies of a run share, or the first.

    Those of more rollouts begin with those of fewer.
    """
    states, key = trial.collected.evaluation.states[:, 0], named(trial.key, "evaluation")
    return evaluate.drive(trial.system, policy, states[:rollouts], key)


def rollout_loss(trial: Trial, driven: Trajectories) -> Losses:
    """Over the rollouts of a policy."""
    return Losses.of(np.asarray(evaluate.rollout_loss(trial.system, driven)))


def judge_policy(
    trial: Trial, policy: Policy, train_loss: float, curve: list[list[float]] | None = None
) -> tuple[Judged, Trajectories]:
    """A trained policy's numbers, and its last rollouts.

    Args:
      trial: what it is judged on.
      policy: the policy.
      train_loss: at its end.
      curve: [epoch, mean, standard deviation] of the rollout loss while it was trained.
    """
    driven = drive(trial, policy)
    copied = evaluate.copycat(trial.system, policy, trial.shown, named(trial.key, "copycat"))
    judged = Judged(
        rollout_loss=rollout_loss(trial, driven)._replace(per_epoch=curve or []),
        outcome=float(evaluate.outcome(trial.system, driven).mean()),
        copycat=float(copied),
        leakage=float(leaked(trial, policy.view, policy.parameters)),
        train_loss=train_loss,
        predictability=predictability(trial, driven),
    )
    return judged, driven


def predictability(trial: Trial, driven: Trajectories) -> float:
    """The error of telling an action from the one before, over that of the expert's actions."""
    expert = trial.unpredicted
    return _unpredicted(trial, driven) / expert if expert > 0 else float("nan")


def compared(trial: Trial, policy: Policy, judged: Judged) -> tuple[Judged, Sight]:
    """With what only comparisons show: it takes programs of its own, a good while to compile."""
    found = evaluate.saliency(trial.system, policy, trial.shown)
    judged = judged._replace(
        copycat_slope=float(found.slope), past_leakage=past_leakage(trial, policy)
    )
    return judged, sight(trial, policy, np.asarray(found.pixels))


def sight(trial: Trial, policy: Policy, salient: np.ndarray) -> Sight:
    """Of some frames; salient is [R, n, H, W], at the last n steps of the trial's `shown`."""
    rollouts, steps = salient.shape[:2]
    count = min(_SIGHT, rollouts)
    which = np.arange(count) * rollouts // count
    some = jax.tree.map(lambda a: a[which, -steps:][:, steps // 2], trial.shown)
    seen = see(policy.view, policy.parameters, frames(trial.system, some))
    return Sight(np.asarray(seen), salient[which, steps // 2])


def past_leakage(trial: Trial, policy: Policy) -> float:
    """HSCIC of a policy's action and the expert's one before, given the expert's action.

    At some steps of the expert's rollouts, but for the first, before which nobody acted.
    """
    expert, first = trial.shown, max(1, policy.frames - 1)
    answered = evaluate.answers(trial.system, policy, expert)[:, first - (policy.frames - 1) :]
    stride = -(-answered.shape[0] * answered.shape[1] // _HSCIC_SAMPLES)
    own, previous, acted = (
        values.reshape(-1, values.shape[-1])[::stride]
        for values in (answered, expert.previous_actions[:, first:], expert.actions[:, first:])
    )
    return float(hscic(own, previous, acted))


def _unpredicted(trial: Trial, driven: Trajectories) -> float:
    """Mean squared error of a regression on half of the trajectories, judged on the others.

    Without first steps, before which nobody acted.
    """
    past, acted = driven.actions[:, :-1], driven.actions[:, 1:]
    half, limits = len(past) // 2, trial.system.limits
    stride = -(-half * past.shape[1] // _JUDGE_FRAMES)
    seen, told = (
        (v[: 2 * half] / limits).reshape(2, -1, len(limits))[:, ::stride].reshape(-1, len(limits))
        for v in (past, acted)
    )
    share = leakage.explained(seen, told, named(trial.key, "predictability"))
    return float(((1.0 - share) * told[len(told) // 2 :].var(axis=0)).mean())


def leaked(trial: Trial, view: View, parameters: Any) -> Array:
    """[] how much of what the nuisance shows can be told from what a view shows of held-out frames.

    There the signal is independent of everything in the frame but the nuisance: 0 is no leak.
    """
    images, signal = trial.held_out.images[trial.apart], trial.held_out.signals[trial.apart]
    return leakage.leaked(see(view, parameters, images), signal, named(trial.key, "leakage"))


def pictures(
    trial: Trial,
    encoder: Encoder,
    region: Array | None,
    policies: Mapping[str, Policy],
    driven: Mapping[str, Trajectories],
) -> Pictures:
    """The frames that the report shows."""
    system, collected = trial.system, trial.collected
    stride = max(1, system.steps // 2 // _STRIP)
    example = jax.tree.map(
        lambda a: a[0, : stride * _STRIP : stride], jax.device_get(collected.expert)
    )
    images = frames(system, example)
    changed = {name: policy for name, policy in policies.items() if policy.view is not identity}
    strips = {name: see(one.view, one.parameters, images) for name, one in changed.items()}
    # The start that is of middling difficulty to the expert.
    order = np.argsort(evaluate.rollout_loss(system, collected.evaluation))
    start = order[len(order) // 2]
    shown = {
        name: jax.tree.map(lambda a: a[start], jax.device_get(rolled))
        for name, rolled in {"Expert": collected.evaluation, **driven}.items()
    }
    return Pictures(
        strips={name: np.asarray(strip) for name, strip in {"Frame": images, **strips}.items()},
        traversals=_traversals(encoder, system.size),
        traversal_values=_TRAVERSAL,
        region=np.zeros((0, 0), bool) if region is None else np.asarray(region),
        rollouts={name: np.asarray(frames(system, one)) for name, one in shown.items()},
        alive={name: np.asarray(one.valid) for name, one in shown.items()},
        dt=system.dt,
    )


def _traversals(encoder: Encoder, size: tuple[int, int]) -> np.ndarray:
    """uint8 [O, V, H, W, 3]: each latent moved alone, the others at their prior mean."""
    count, network = encoder.network.latents, encoder.network
    latents = np.eye(count)[:, None] * _TRAVERSAL[None, :, None]
    flat = latents.reshape(-1, count).astype(np.float32)
    drawn = disentangle.decode(network, encoder.variables, flat, size)
    return np.asarray(drawn).reshape(count, len(_TRAVERSAL), *size, 3)
