"""Sweeps of hyperparameters and seeds: points that share a stage do it once, models train together.

    python -m experiments.sweep --system cartpole --seeds 4 \\
        --grid mask.threshold=1e-3,3e-3,1e-2 mask.reaction_horizon=1,3,5

Prints a plan, does it, and leaves rows, a table and plots in the directory. See docs/sweep.md.
"""

import sys

from experiments import cartpole, reacher
from jaxdeconf.pipeline.sweep_cli import main

PRESETS = {"cartpole": cartpole.PRESETS, "reacher": reacher.PRESETS}

if __name__ == "__main__":
    sys.exit(main(__doc__ or "", PRESETS))
