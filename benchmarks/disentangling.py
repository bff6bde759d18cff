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

from jaxdeconf.pipeline import cli, findings, results, stages
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.store import Store, read_config, write_json


def judge(config: Config, directory: Path) -> dict[str, Any]:
    """The numbers of one seed; resumes what is in its directory."""
    resume = (directory / "config.json").is_file()
    run = stages.Run(config, Store(directory, config, resume), Reporter(), seconds={})
    collected = stages.collect(run)
    vae = stages.train_disentangler(run, collected)
    found = stages.find_mask(run, collected, vae)
    latents = results.judge_latents(run, collected, vae, found)
    active = np.asarray(latents["active"])
    correlation = np.where(active, np.asarray(latents["nuisance_correlation"]), 0.0)
    second, first = np.sort(correlation)[-2:]
    return {
        "seed": config.seed,
        "first": first,
        "second": second,
        "active": int(active.sum()),
        "masked": np.flatnonzero(np.asarray(found.mask) & active),
        "latent": int(correlation.argmax()),
        "leakage": results.leaked(run, "Masked", collected, vae, found),
        **latents["reconstruction"],
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
    cli.cache_compilations()
    rows = []
    print("seed   first  second  masked (nuisance)  leakage  nuisance  elsewhere  seconds")
    for seed in range(asked.seed, asked.seed + asked.seeds):
        config = dataclasses.replace(base, seed=seed)
        row = judge(config, folder / f"seed-{seed}")
        rows.append(row)
        masked = f"{findings.listing(row['masked'])} ({findings.listing([row['latent']])})"
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
