"""Does a network find what a regression does not? `python -m benchmarks.leakage --system cartpole`.

How well what the nuisance shows can be told from one frame, as each method is shown it: R² on
held-out frames, by the kernel regression that every run reports (`jaxdeconf/leakage.py`), and by
networks that are trained to tell it from all exploration frames: a ResNet-18 of width 16, and
centroids before the background (`nets/places.py`). 0, or less, is no leak. A laptop preset's data,
β-VAE and mask, learnt anew for each seed.
"""

import argparse
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf import collect, systems
from jaxdeconf.commands.guard import cache_compilations
from jaxdeconf.learn import clone
from jaxdeconf.learn.clone import CloneConfig, Demonstrations
from jaxdeconf.learn.fit import finish
from jaxdeconf.method import Evidence
from jaxdeconf.methods import METHODS
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.pipeline import judge
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.judge import Trial
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.run import collect_for, deconfounded, evidence_for, region_for
from jaxdeconf.pipeline.stages import Run
from jaxdeconf.pipeline.store import Nowhere
from jaxdeconf.presets import PRESETS
from jaxdeconf.views import identity, see

NETWORKS = {
    "ResNet": NetworkConfig(width=16, stem="imagenet"),
    "places": NetworkConfig(kind="places", width=16, hidden=(128,)),
}
STEPS, BATCH = 2000, 64


def learnt(config: Config, trial: Trial) -> Evidence:
    """What a run of that config learns of the frames."""
    encoder, found = deconfounded(Run(config, Nowhere(), Reporter()), trial)
    region = region_for(trial, encoder, found.mask, config.methods)
    return evidence_for(config, trial, encoder, found.mask, region)


def told(
    seen: Array, signals: Array, asked: Array, truth: Array, network: NetworkConfig, key: Array
) -> float:
    """R², the mean over what the nuisance shows, of a network that sees one frame.

    It learns from frames [n, H, W, 3], which show signals [n, A], and is asked of others.
    """
    config = CloneConfig(
        steps=STEPS,
        batch_size=BATCH,
        learning_rate=2e-3,
        decay=0.02,
        frames=1,
        average=0.99,
        network=network,
    )
    data = Demonstrations(seen, jnp.zeros(len(seen), jnp.int32), signals)
    training = clone.training(config, lambda: data, len(seen), identity, {}, key)
    policy = training.trained(finish("leakage", training))
    guess = jax.jit(lambda x: jax.lax.map(lambda one: policy.act([one[None]])[0], x, batch_size=64))
    error = ((np.asarray(guess(asked)) - np.asarray(truth)) ** 2).mean(axis=0)
    return float((1 - error / np.asarray(truth).var(axis=0)).mean())


def main() -> None:
    """Prints a row a view and seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--system", default="cartpole", choices=sorted(PRESETS))
    parser.add_argument("--seeds", type=int, default=3)
    names = ["BcVanilla", "BcManual", "Masked", "Inpainted"]
    parser.add_argument("--methods", nargs="+", default=names, choices=names)
    asked = parser.parse_args()
    cache_compilations()
    config, system = PRESETS[asked.system]["laptop"], systems.get(asked.system)
    config = replace(config, methods=tuple(asked.methods))
    print("seed | shown as to | regression |", " | ".join(NETWORKS))
    for seed in range(asked.seeds):
        key = jax.random.key(seed)
        trial = judge.trial(system, key, collect_for(config, system, key))
        evidence = learnt(replace(config, seed=seed), trial)
        explored, held_out = collect.exploration(system, trial.collected.random), trial.held_out
        for name in config.methods:
            view, parameters = METHODS[name].view(evidence)
            seen, asked_of = (see(view, parameters, of.images) for of in (explored, held_out))
            row = [float(judge.leaked(trial, view, parameters))]
            row += [
                told(seen, explored.signals, asked_of, held_out.signals, network, key)
                for network in NETWORKS.values()
            ]
            print(seed, "|", name, "|", " | ".join(f"{value:.4f}" for value in row), flush=True)


if __name__ == "__main__":
    main()
