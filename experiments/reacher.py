"""Reacher, the paper's second system: `python -m experiments.reacher` is `jaxdeconf reacher`.

Laptop, 35 to 50 minutes on one or two cores: of twelve latents the nuisance's three are masked;
Masked's rollout loss is 1.4 times BcManual's, BcVanilla's 2.3 times. See docs/reacher.md.
"""

import sys

from jaxdeconf_command import main

if __name__ == "__main__":
    sys.exit(main(["reacher", *sys.argv[1:]]))
