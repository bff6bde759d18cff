"""Does the β-VAE part the nuisance from the rest, seed after seed? A run's first three stages.

    python -m benchmarks.disentangling runs/cartpole-laptop-seed0 --seeds 10

takes the config of that run, and works in runs/cartpole-laptop-seed0/disentangling.

Prints, for every seed, on held-out random-policy frames: the largest rank correlation of an active
latent with the previous action, the second largest, what is masked, the leakage (R²) of the masked
frames, the reconstruction error on the nuisance and elsewhere, and the seconds of training.
"""

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np

from jaxdeconf import systems
from jaxdeconf.commands.guard import cache_compilations
from jaxdeconf.method import Evidence
from jaxdeconf.methods import METHODS, masking
from jaxdeconf.pipeline import judge
from jaxdeconf.pipeline.config import Config, fitting
from jaxdeconf.pipeline.plain import write_json
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.run import collect_for, deconfounded
from jaxdeconf.pipeline.stages import Run
from jaxdeconf.pipeline.store import Store, read_config
from jaxdeconf.report import words


def measure(config: Config, directory: Path) -> dict[str, Any]:
    """The numbers of one seed; resumes what is in its directory."""
    system = fitting(config, systems.get(config.system))
    store = Store(directory, config, (directory / "config.json").is_file())
    run = Run(config, store, Reporter())
    collected = run.stage("collect", lambda: collect_for(config, system, run.key))
    trial = judge.trial(system, run.key, collected)
    encoder, found = deconfounded(run, trial)
    latents = judge.judge_latents(trial, encoder)
    active = np.asarray(encoder.active)
    correlation = np.where(active, np.asarray(latents.nuisance_correlation), 0.0)
    second, first = np.sort(correlation)[-2:]
    view, parameters = METHODS[masking()[0]].view(Evidence(encoder, found.mask))
    return {
        "seed": config.seed,
        "first": first,
        "second": second,
        "active": int(active.sum()),
        "masked": np.flatnonzero(np.asarray(found.mask) & active),
        "latent": int(correlation.argmax()),
        "leakage": judge.leaked(trial, view, parameters),
        **latents.reconstruction._asdict(),
        "seconds": run.seconds["disentangle"],
    }


def main() -> int:
    """Runs the seeds one after another; writes disentangling.json."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("run", type=Path, help="a run directory, whose config is used")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--seeds", type=int, default=10, help="how many")
    asked = parser.parse_args()
    base, folder = read_config(asked.run), asked.run / "disentangling"
    cache_compilations()
    rows = []
    print("seed   first  second  masked (nuisance)  leakage  nuisance  elsewhere  seconds")
    for seed in range(asked.seed, asked.seed + asked.seeds):
        config = dataclasses.replace(base, seed=seed)
        row = measure(config, folder / f"seed-{seed}")
        rows.append(row)
        masked = f"{words.listing(row['masked'])} ({words.listing([row['latent']])})"
        print(
            f"{seed:4}  {row['first']:6.3f}  {row['second']:6.3f}  {masked:>17}  "
            f"{float(row['leakage']):7.3f}  {float(row['nuisance']):8.2f}  "
            f"{float(row['elsewhere']):9.2f}  {row['seconds']:7.0f}",
            flush=True,
        )
    write_json(folder / "disentangling.json", rows)
    parted = sum(row["first"] >= 0.9 and row["second"] <= 0.15 for row in rows)
    print(f"parted (first >= 0.9, second <= 0.15): {parted} of {len(rows)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
