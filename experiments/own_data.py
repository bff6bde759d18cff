"""Your own dataset, masked: `python -m experiments.own_data` is `jaxdeconf mask`.

    python -m experiments.own_data DEMOS.npz --exploration MORE.npz --out DIR

docs/own-data.md has the forms that it reads, and what to do with what it writes.
"""

import sys

from jaxdeconf_command import main

if __name__ == "__main__":
    sys.exit(main(["mask", *sys.argv[1:]]))
