"""Every claim of the paper as an experiment: `python -m experiments.theory` is `jaxdeconf theory`.

Random causal systems by the thousand through Algorithm 1, with the intervention on the initial
state, without, and with each assumption broken; then CartPole. docs/theory.md has the verdicts.
"""

import sys

from jaxdeconf_command import main

if __name__ == "__main__":
    sys.exit(main(["theory", *sys.argv[1:]]))
