"""`jaxdeconf COMMAND ...`: an experiment, a sweep, your own data, or a report again."""

import sys
from collections.abc import Sequence

_COMMANDS = {
    "cartpole": "a cart with a pole; a square shows the last force",
    "reacher": "a two-link arm; a dot shows the last torques",
    "mask": "your own demonstrations, with the nuisance taken out of every frame",
    "compare": "methods against causal confusion side by side, on the same data",
    "sweep": "a grid of fields and seeds; what points share is done once",
    "theory": "every claim of the paper as an experiment; what the intervention is for",
    "report": "draw a finished run's report again",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """The console command; returns the exit code, as of `guard.guarded`."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    name, rest = (words or ["--help"])[0], words[1:]
    if name in ("-h", "--help"):
        print("usage: jaxdeconf COMMAND [--help] ...\n")
        print("\n".join(f"  {command:<10} {about}" for command, about in _COMMANDS.items()))
        return 0
    if name == "--version":
        from jaxdeconf.version import __version__

        print(__version__)
        return 0
    if name not in _COMMANDS:
        print(f"error: expected one of {', '.join(_COMMANDS)}, got {name!r}", file=sys.stderr)
        return 2
    return _command(name, rest)


def _command(name: str, words: list[str]) -> int:
    # Imported late: each takes what it needs to load.
    if name == "report":
        from jaxdeconf.commands import report

        return report.main(words)
    if name == "mask":
        from jaxdeconf.commands import mask

        return mask.main(words)
    if name == "theory":
        from jaxdeconf.commands import theory

        return theory.main(words)
    if name == "compare":
        from jaxdeconf.commands import compare

        return compare.main(words)
    if name == "sweep":
        from jaxdeconf.commands import sweep

        return sweep.main(words)
    from jaxdeconf import presets
    from jaxdeconf.commands import run

    module = getattr(presets, name)
    return run.main(module.__doc__ or "", module.PRESETS, words)
