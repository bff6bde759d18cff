"""A grid of fields and seeds: `python -m experiments.sweep` is `jaxdeconf sweep`.

    python -m experiments.sweep --seeds 4 --grid mask.threshold=1e-3,3e-3,1e-2

Minutes a model, fewer where points share; docs/sweep.md has one of 160 points in an hour.
"""

import sys

from jaxdeconf_command import main

if __name__ == "__main__":
    sys.exit(main(["sweep", *sys.argv[1:]]))
