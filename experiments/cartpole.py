"""CartPole, the paper's first system: `python -m experiments.cartpole` is `jaxdeconf cartpole`.

Laptop, 6 to 12 minutes on two cores: BcVanilla copies the square that shows the last force and
falls; Masked, which was not told of it, drives like BcManual. The numbers are in docs/results.md.
"""

import sys

from jaxdeconf_command import main

if __name__ == "__main__":
    sys.exit(main(["cartpole", *sys.argv[1:]]))
