"""What a run found: the numbers of results.json and the pictures of its report.

Shapes: O latents, S state, H reaction horizon, A action, T time, n frames, V values.
"""

import platform
import resource
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxdeconf
from jaxdeconf import evaluate, leakage, mask
from jaxdeconf.learn import disentangle
from jaxdeconf.learn.views import View
from jaxdeconf.nets import vae as network
from jaxdeconf.pipeline.report import Pictures
from jaxdeconf.pipeline.stages import (
    Cloned,
    Collected,
    Disentangled,
    Run,
    drive,
    valid_frames,
    view_of,
)
from jaxdeconf.systems.rollout import frames
from jaxdeconf.vision import raster

# Frames that train, and that test, the regression of leakage: its time is cubic in them.
_JUDGE_FRAMES = 1500
_TRAVERSAL = np.linspace(-2.5, 2.5, 9)  # prior standard deviations
_STRIP = 10  # frames


def judge_latents(
    run: Run, collected: Collected, vae: Disentangled, found: mask.Mask
) -> dict[str, Any]:
    """The β-VAE on held-out random-policy frames, where the nuisance is known."""
    images, actions = valid_frames(run.system, collected.held_out)
    config = run.config.vae.network
    mean, _ = disentangle.encode(config, vae.variables, images)
    correlation = jnp.abs(leakage.spearman(mean, actions)).max(axis=1)
    view, parameters = view_of(run, "Reconstructed", vae, found.mask)
    images = images[:_JUDGE_FRAMES]
    error = raster.dequantize(_seen(view, parameters, images)) - raster.dequantize(images)
    where = raster.dequantize(images) != raster.dequantize(
        _seen(*view_of(run, "BcManual", vae, found.mask), images)
    )
    squared = (error**2).sum(axis=-1)
    nuisance = where.any(axis=(0, 3))
    return {
        "active": vae.active,
        "kl": vae.kl,
        "nuisance_correlation": correlation,
        "nuisance_share": _share(run, mean, actions),
        "reconstruction": {
            "nuisance": jnp.where(nuisance, squared, 0.0).sum(axis=(1, 2)).mean(),
            "elsewhere": jnp.where(nuisance, 0.0, squared).sum(axis=(1, 2)).mean(),
        },
    }


def nuisance_share(run: Run, collected: Collected, vae: Disentangled) -> Array:
    """[O] of each latent's variance, what the previous action explains, as in results.json."""
    images, actions = valid_frames(run.system, collected.held_out)
    mean, _ = disentangle.encode(run.config.vae.network, vae.variables, images)
    return _share(run, mean, actions)


def _share(run: Run, mean: Array, actions: Array) -> Array:
    signal, some = actions / run.system.limits, slice(0, 2 * _JUDGE_FRAMES)
    return leakage.explained(signal[some], mean[some], run.key("nuisance share"))


def judge_expert(run: Run, collected: Collected) -> dict[str, Array]:
    """The expert on the evaluation's initial states, and its faults on all of its own."""
    system, trajectories = run.system, collected.expert
    penalty = jax.vmap(jax.vmap(system.state_penalty))(trajectories.states[:, 1:])
    return {
        "rollout_loss": evaluate.rollout_loss(system, collected.driven).mean(),
        "outcome": evaluate.outcome(system, collected.driven).mean(),
        "violation_rate": (penalty > 0).mean(),
        "unconverged": collected.unconverged.sum() / trajectories.valid.size,
    }


def judge_policy(
    run: Run, policy: str, collected: Collected, vae: Disentangled, found: mask.Mask, cloned: Cloned
) -> tuple[dict[str, Any], Any]:
    """A trained policy's numbers, and its last rollouts."""
    system = run.system
    view, _ = view_of(run, policy, vae, found.mask)
    driver = evaluate.Driver(run.config.bc.network, view)
    driven = drive(run, collected, view, cloned.weights)
    loss = evaluate.rollout_loss(system, driven)
    copied = evaluate.copycat(system, driver, cloned.weights, collected.driven, run.key("copycat"))
    return {
        "train_loss": cloned.train_loss,
        "outcome": evaluate.outcome(system, driven).mean(),
        "copycat": copied,
        "leakage": leaked(run, policy, collected, vae, found),
        "rollout_loss": {"mean": loss.mean(), "std": loss.std(), "per_epoch": cloned.history},
    }, driven


def leaked(
    run: Run, policy: str, collected: Collected, vae: Disentangled, found: mask.Mask
) -> Array:
    """[] R² of the previous action regressed from a view's held-out random-policy frames.

    There the action is independent of everything in the frame but the nuisance: 0 is no leak.
    """
    images, actions = valid_frames(run.system, collected.held_out)
    seen = _seen(*view_of(run, policy, vae, found.mask), images[: 2 * _JUDGE_FRAMES])
    signal, half = actions / run.system.limits, len(seen) // 2
    return leakage.r_squared(
        seen[:half], signal[:half], seen[half:], signal[half : len(seen)], run.key("leakage")
    )


def results(
    run: Run, collected: Collected, vae: Disentangled, found: mask.Mask, policies: dict[str, Any]
) -> dict[str, Any]:
    """Everything that results.json holds."""
    config = run.config
    return {
        "system": config.system,
        "preset": config.preset,
        "seed": config.seed,
        "state_names": run.system.state_names,
        "action_names": run.system.action_names,
        "outcome": {name: getattr(run.system.outcome, name) for name in ("name", "form", "note")},
        "reaction_horizon": config.mask.reaction_horizon,
        "mask": found.mask,
        "threshold": found.threshold,
        "state_observation": found.state_observation,
        "state_action": found.state_action,
        "p_values": {
            "state_observation": found.p_state_observation,
            "state_action": found.p_state_action,
        },
        **judge_latents(run, collected, vae, found),
        "expert": judge_expert(run, collected),
        "policies": policies,
        "seconds": run.seconds,
        "peak_memory_mb": peak_memory_mb(),
        "versions": versions(),
        "config": asdict(config),
    }


def peak_memory_mb() -> float:
    """The most memory that this process has held at a time, MB (2^20 bytes)."""
    status = Path("/proc/self/status")
    if status.exists():  # Linux, whose ru_maxrss may be that of the process that started this one
        lines = status.read_text().splitlines()
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:"))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 1024  # bytes there, else KiB


def versions() -> dict[str, str]:
    """What the numbers depend on beside the config."""
    return {
        "jaxdeconf": jaxdeconf.__version__,
        "python": platform.python_version(),
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
        "platform": f"{sys.platform} {platform.machine()}",
    }


def pictures(
    run: Run, collected: Collected, vae: Disentangled, found: mask.Mask, driven: dict[str, Any]
) -> Pictures:
    """The frames that the report shows."""
    system = run.system
    stride = max(1, system.steps // 2 // _STRIP)
    example = jax.tree.map(lambda a: a[0, : stride * _STRIP : stride], collected.expert)
    images = frames(system, example)
    strips = {"Frame": images}
    for policy in ("BcManual", "Masked", "Reconstructed"):
        strips[policy] = _seen(*view_of(run, policy, vae, found.mask), images)
    trajectories = {"Expert": collected.driven, **driven}
    # The start that is of middling difficulty to the expert.
    order = jnp.argsort(evaluate.rollout_loss(system, collected.driven))
    start = order[len(order) // 2]
    shown = {
        name: jax.tree.map(lambda a: a[start], rolled) for name, rolled in trajectories.items()
    }
    return Pictures(
        strips={name: np.asarray(strip) for name, strip in strips.items()},
        traversals=_traversals(run.config.vae.network, vae.variables),
        traversal_values=_TRAVERSAL,
        rollouts={name: np.asarray(frames(system, one)) for name, one in shown.items()},
        alive={name: np.asarray(one.valid) for name, one in shown.items()},
        dt=system.dt,
    )


@partial(jax.jit, static_argnames="view")
def _seen(view: View, parameters: Any, images: Array) -> Array:
    """What a view makes of uint8 images [n, ...], a batch at a time."""
    return jax.lax.map(lambda image: view(parameters, image[None])[0], images, batch_size=256)


def _traversals(config: network.VAEConfig, variables: Any) -> np.ndarray:
    """uint8 [O, V, 64, 64, 3]: each latent moved alone, the others at their prior mean."""
    size = config.latents
    latents = jnp.eye(size)[:, None] * jnp.asarray(_TRAVERSAL, jnp.float32)[None, :, None]
    decoded = network.decode(config, variables, latents.reshape(-1, size), train=False)[0]
    return np.asarray(raster.quantize(decoded)).reshape(size, len(_TRAVERSAL), *decoded.shape[1:])
