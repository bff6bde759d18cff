"""How good is the mask? Precision and recall, seed after seed: `python -m benchmarks.masks`.

CartPole as the laptop preset has it, from its data to the mask, with new trajectories a seed; for
the latents, the components of the linear start alone, with which the preset's β-VAE begins, or with
--steps that β-VAE after so many. For N demonstrations and a rule for γ, over all seeds, and beside
each what N, γ and the tests predict:

    recall      of the latents that are the nuisance's, the share that is masked. Independent of
                every state, one is kept only if a test of it errs: predicted is (1 - p(γ))^S, or
                more, where some states are not seen to move an action
    precision   of the active latents that are masked, the share that is the nuisance's
    missed      of the other active latents, the share that is masked. A latent is masked if and
                only if its margin, the largest over states of the lesser of D with it and D of the
                state and an action, is at most γ: what the margins at the largest N predict.

--out holds what was found of each seed; what is there is not measured again. Shapes: N
trajectories, S state, O latent, H horizon.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf import collect, systems
from jaxdeconf.commands.guard import cache_compilations
from jaxdeconf.deconfound import learn_latents
from jaxdeconf.expert import expert_trajectories
from jaxdeconf.independence import p_value
from jaxdeconf.keys import named
from jaxdeconf.leakage import explained
from jaxdeconf.learn import disentangle
from jaxdeconf.learn.linear_start import linear_start
from jaxdeconf.mask import effective_threshold, family, find_mask
from jaxdeconf.pipeline.plain import write_json
from jaxdeconf.pipeline.results import SAME
from jaxdeconf.presets import PRESETS
from jaxdeconf.systems.rollout import frames, random_trajectories
from jaxdeconf.theory.claims import rate
from jaxdeconf.vision import raster

CONFIG = PRESETS["cartpole"]["laptop"]
CARTPOLE = systems.get("cartpole")
# No mask needs more steps of an expert.
SHORT = replace(CARTPOLE, steps=CONFIG.mask.reaction_horizon)
_LEARNED, _JUDGED = 4096, 1200  # frames, of which the linear start takes as many
Latents = Callable[[Array], Array]
COUNTS = (100, 300, 1000)
RULES = {"γ = 0.001": None, "family-wise 5 %": 0.05}


class Seed(NamedTuple):
    """What is known of a seed's latents."""

    nuisance: np.ndarray  # [O] bool: the previous action explains 90 % of it
    masks: np.ndarray  # [counts, rules, O] bool
    margins: np.ndarray  # [counts, O]
    active: np.ndarray  # [O] bool


def flat(images: Array) -> Array:
    """[n, P] in [0, 1]."""
    return raster.dequantize(images).reshape(len(images), -1)


def learned(images: Array, held_out: Array, steps: int, key: Array) -> tuple[Array, Latents]:
    """[O] bool, which latents are active, and what tells them, uint8 [n, H, W, 3] -> [n, O]."""
    config = CONFIG.disentangle
    if not steps:
        count = config.network.latents
        start = linear_start(flat(images), count, named(key, "linear start"))
        return jnp.ones(count, bool), lambda of: (flat(of) - start.mean) @ start.encoder
    encoder = learn_latents(images, held_out, key, replace(config, steps=steps))

    def latents(of: Array) -> Array:
        mean, _ = disentangle.encode(encoder.network, encoder.variables, of)
        return jnp.where(encoder.active, mean, 0.0)

    return encoder.active, latents


def measure(seed: int, steps: int) -> Seed:
    """The masks of one seed's demonstrations."""
    key, most = jax.random.key(seed), COUNTS[-1]
    random = random_trajectories(CARTPOLE, named(key, "random"), 5000)
    valid = np.flatnonzero(np.asarray(random.valid))
    chosen = np.random.default_rng(seed).choice(valid, _LEARNED + _JUDGED, replace=False)
    some = jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:])[chosen], random)
    images, signal = frames(CARTPOLE, some), some.signals / CARTPOLE.limits
    active, latents = learned(images[:_LEARNED], images[_LEARNED:], steps, key)
    share = explained(signal[_LEARNED:], latents(images[_LEARNED:]), named(key, "told"))
    keys = jax.random.split(named(key, "expert initial states"), most)
    states = jax.vmap(CARTPOLE.sample_initial)(keys)
    driven, _ = expert_trajectories(SHORT, states, named(key, "expert"), CONFIG.expert)
    demos = collect.demonstrations(SHORT, driven)
    first = latents(demos.images[:, 0])
    masks, margins = [], []
    for n in COUNTS:
        rules = np.array([gamma(n, alpha) for alpha in RULES.values()])
        found = find_mask(demos.initial_states[:n], first[:n], demos.actions[:n], rules, None)
        moved = found.state_action.max(axis=(1, 2))[:, None]
        margins.append(jnp.minimum(found.state_observation, moved).max(axis=0))
        masks.append(found.mask)
    nuisance = np.asarray(share >= SAME) & np.asarray(active)
    return Seed(nuisance, np.asarray(masks), np.asarray(margins), np.asarray(active))


def gamma(n: int, alpha: float | None) -> float:
    """The threshold of a rule for N demonstrations."""
    states, tested = len(CARTPOLE.state_names), CONFIG.disentangle.network.latents
    tested += CONFIG.mask.reaction_horizon * len(CARTPOLE.action_names)
    return float(effective_threshold(1e-3, alpha, n, family(states, tested, 1)))


def interval(happened: np.ndarray) -> str:
    """How often something happened, with an interval."""
    if not happened.size:
        return "none"
    found = rate("", 0, 0.0, happened)
    low, high = found.interval
    return f"{found.events} of {found.n} = {found.rate:.3f} ({low:.3f} to {high:.3f})"


def say(seeds: list[Seed]) -> None:
    """A row for each N and rule."""
    nuisance, masks, margins, active = (np.array(part) for part in zip(*seeds, strict=True))
    others = active & ~nuisance
    print(f"{len(seeds)} seeds; latents that are the nuisance's: {np.bincount(nuisance.sum(1))}")
    print("| N | rule (γ) | recall | predicted | precision | missed | predicted |")
    for i, n in enumerate(COUNTS):
        for j, (rule, alpha) in enumerate(RULES.items()):
            mask, level = masks[:, i, j], gamma(n, alpha)
            p = float(p_value(level, n))
            cells = (
                interval(mask[nuisance]),
                f"{(1 - p) ** len(CARTPOLE.state_names):.3f}",
                interval(nuisance[mask & active]),
                interval(mask[others]),
                f"{(margins[:, -1] <= level)[others].mean():.3f}",
            )
            print(f"| {n} | {rule} ({level:.4f}) | " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    """Measures seed after seed, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=100, help="the first seed")
    parser.add_argument("--seeds", type=int, default=100, help="how many")
    parser.add_argument("--steps", type=int, default=0, help="of the β-VAE; 0: its linear start")
    parser.add_argument("--out", type=Path, default=Path("runs/masks.json"))
    options = parser.parse_args()
    cache_compilations()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    known = json.loads(options.out.read_text()) if options.out.exists() else {}
    wanted, begin = map(str, range(options.seed, options.seed + options.seeds)), time.process_time()
    found = {}
    for seed in wanted:
        name = f"{seed}, {options.steps} steps"
        if name not in known:
            known[name] = measure(int(seed), options.steps)._asdict()
            write_json(options.out, known)
        found[seed] = Seed(*map(np.asarray, known[name].values()))
    say([*found.values()])
    print(f"{time.process_time() - begin:.0f} s of processor time")


if __name__ == "__main__":
    main()
