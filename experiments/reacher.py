"""Reacher, the paper's second system: `python -m experiments.reacher` is `jaxdeconf reacher`.

Laptop, a quarter of an hour on two cores: behind Masked's reconstructions the arm stops half a
metre short; behind Inpainted's frames it arrives, as where a human has covered the dot. The numbers
are in docs/results.md.
"""

import sys

from jaxdeconf_command import main

if __name__ == "__main__":
    sys.exit(main(["reacher", *sys.argv[1:]]))
