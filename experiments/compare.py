"""Methods against causal confusion side by side: `python -m experiments.compare`.

    python -m experiments.compare --system cartpole --methods all --seeds 5

It is `jaxdeconf compare`; a minute or two a method and seed. docs/methods.md has what came of it.
"""

import sys

from jaxdeconf_command import main

if __name__ == "__main__":
    sys.exit(main(["compare", *sys.argv[1:]]))
