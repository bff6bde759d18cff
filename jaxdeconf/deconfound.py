"""Deconfounded imitation on arrays: the paper's workflow (Section III-C), a function a step.

    encoder = learn_latents(exploration, held_out, key)          1  a β-VAE on random-policy frames
    mask    = mask_latents(encoder, demos)                       2  Algorithm 1 on s₁, o₁, a₁..a_H
    region  = find_region(encoder, mask.mask, exploration, key)     the pixels that it is about
    known   = Evidence(encoder, mask.mask, region)
    policy  = clone_policy("Inpainted", demos, known, key)       3  behaviour cloning on the rest

`deconfound` does all of it. Nothing here knows where the frames came from: no simulator, no disk,
no screen. What a training passes through on its way, `watch`, is where a caller may save it, go on
with it, show it or stop it. Shapes: N episodes, T steps, n frames, H × W pixels, S state, A action,
O latent; H also is the reaction horizon, where it counts steps.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf import checks
from jaxdeconf import mask as algorithm
from jaxdeconf.demos import Demos
from jaxdeconf.learn import clone as bc
from jaxdeconf.learn import disentangle as vae
from jaxdeconf.learn.clone import CloneConfig, Policy
from jaxdeconf.learn.disentangle import DisentangleConfig, Encoder
from jaxdeconf.learn.fit import Watch, finish
from jaxdeconf.mask import Mask, MaskConfig
from jaxdeconf.method import Ask, Evidence, available, cloning, configured, imitated
from jaxdeconf.methods import METHODS, masking, require
from jaxdeconf.region import find_region


class Deconfounded(NamedTuple):
    """What came of the three steps."""

    encoder: Encoder
    mask: Mask
    region: Array  # [H, W] bool
    policies: dict[str, Policy]  # by method


def deconfound(
    demos: Demos,
    exploration: Array,
    key: Array,
    methods: Sequence[str] | None = None,
    known: Evidence = Evidence(),
    disentangle: DisentangleConfig = vae.CPU,
    mask: MaskConfig = MaskConfig(),
    clone: CloneConfig = bc.CPU,
    watch: Watch = finish,
) -> Deconfounded:
    """Finds the nuisance that a cloned policy would copy, masks it, and clones without it.

    Args:
      demos: the expert's, from initial states set at random.
      exploration: uint8 [n, H, W, 3], frames under random actions; every tenth is held out to see
        which latents carry anything.
      key: every random choice follows from it, by name.
      methods: which policies to clone, of `jaxdeconf.METHODS`; None: those that need a mask.
      known: what a method may be told, where the nuisance is, say.
      disentangle, mask, clone: the steps' configs; by default for a CPU, in minutes.
      watch: what trainings pass through.
    Raises:
      ValueError: if shapes do not fit, a method is unknown or its needs are not met.
    """
    methods = masking() if methods is None else methods
    # What a later step would refuse, before minutes are spent on the first.
    _check_cloning(methods, demos, known, clone, {"encoder", "mask", "region"})
    _check_masking(demos, mask)
    checks.array("exploration", exploration, "[n, ...]", (None, *demos.images.shape[2:]), "uint8")
    exploration = jnp.asarray(exploration)
    held_out = np.arange(len(exploration)) % 10 == 9
    encoder = learn_latents(exploration[~held_out], exploration[held_out], key, disentangle, watch)
    found = mask_latents(encoder, demos, mask)
    region = find_region(encoder, found.mask, exploration, key)
    evidence = known._replace(encoder=encoder, mask=found.mask, region=region)
    policies = {name: clone_policy(name, demos, evidence, key, clone, watch) for name in methods}
    return Deconfounded(encoder, found, region, policies)


def learn_latents(
    images: Array,
    held_out: Array,
    key: Array,
    config: DisentangleConfig = vae.CPU,
    watch: Watch = finish,
) -> Encoder:
    """Step 1: a β-VAE learns latents from images, uint8 [n, H, W, 3].

    Args:
      images: under random actions, so that the nuisance goes with nothing else in the frame.
      held_out: uint8 [m, H, W, 3], others, on which it is judged which latents are active.
      key: first weights, shuffles and noise.
      config: objective, network and budget.
      watch: what the training passes through.
    Raises:
      ValueError: if the images are not what is said, or the network cannot take their size.
    """
    images = checks.array("images", images, "[n, H, W, 3]", (None, None, None, 3), "uint8")
    _, height, width, _ = images.shape
    shape = None, height, width, 3
    checks.array("held_out", held_out, f"[m, {height}, {width}, 3]", shape, "uint8")
    checks.key("key", key)
    checks.instance("config", config, DisentangleConfig)
    vae.check_size(config, (height, width))
    config.total_steps(len(images))
    images, held_out = jnp.asarray(images), jnp.asarray(held_out)  # once, not at every chunk
    training = vae.training(config, lambda: images, len(images), lambda: held_out, key)
    return training.trained(watch("disentangle", training))


def mask_latents(encoder: Encoder, demos: Demos, config: MaskConfig = MaskConfig()) -> Mask:
    """Step 2: Algorithm 1 on the first frames, where nothing but the initial state can confound.

    Raises:
      ValueError: if an episode is shorter than the reaction horizon, there are too few of them, or
        their images have not the size of those that the encoder learnt.
    """
    checks.instance("encoder", encoder, Encoder)
    _check_masking(demos, config)
    vae.check_images(encoder, demos.images.shape[2:4])
    return algorithm.find_mask(
        demos.initial_states,
        first_latents(encoder, demos),
        demos.actions[:, : config.reaction_horizon],
        config.threshold,
        config.alpha,
        config.statistic,
        config.states_together,
    )


def first_latents(encoder: Encoder, demos: Demos) -> Array:
    """[N, O] latents of the first frames; 0, the prior's mean, where they carry nothing."""
    images = jnp.asarray(demos.images[:, 0])
    mean, _ = vae.encode(encoder.network, encoder.variables, images)
    return jnp.where(encoder.active, mean, 0.0)


def clone_policy(
    name: str,
    demos: Demos,
    evidence: Evidence,
    key: Array,
    config: CloneConfig = bc.CPU,
    watch: Watch = finish,
) -> Policy:
    """Step 3: behaviour cloning on what a method shows of the frames.

    Args:
      name: of the method; see `jaxdeconf.METHODS`.
      demos: what is cloned.
      evidence: what there is beside, of which the method takes what it needs.
      key: first weights and shuffles, the same for every method.
      config: network and budget.
      watch: what the training passes through.
    Raises:
      ValueError: if there is no such method, its needs are not met, or what there is does not fit.
    """
    checks.key("key", key)
    _check_cloning([name], demos, evidence, config)
    samples = imitated(demos.lengths, config)
    ask = Ask(config, key, watch)
    training = cloning(METHODS[name], lambda: demos, samples, evidence, ask)
    return training.trained(watch(f"clone {name}", training))


def _check_masking(demos: Demos, config: MaskConfig) -> None:
    checks.instance("demos", demos, Demos)
    checks.instance("config", config, MaskConfig)
    checks.integer("episodes in demos", len(demos.actions), least=5)
    checks.integer("reaction_horizon", config.reaction_horizon, most=int(demos.lengths.min()))


def _check_cloning(
    names: Sequence[str],
    demos: Demos,
    evidence: Evidence,
    config: CloneConfig,
    to_come: Collection[str] = (),
) -> None:
    """Whether what there is, and what is to come, suffices for each method."""
    checks.instance("demos", demos, Demos)
    checks.instance("evidence", evidence, Evidence)
    checks.instance("config", config, CloneConfig)
    for name in names:
        require(name, available(demos, evidence) | {*to_come})
        configured(METHODS[name], config).total_steps(imitated(demos.lengths, config))
    if evidence.encoder is not None:
        vae.check_images(evidence.encoder, demos.images.shape[2:4])
        latents = len(evidence.encoder.active)
        if evidence.mask is not None:
            checks.array("mask", evidence.mask, f"[{latents}]", (latents,), "bool")
    if evidence.region is not None:
        height, width = size = demos.images.shape[2:4]
        checks.array("region", evidence.region, f"[{height}, {width}]", size, "bool")
