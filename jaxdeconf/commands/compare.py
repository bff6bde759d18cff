"""`jaxdeconf compare`: methods against causal confusion side by side, on the same data.

    jaxdeconf compare --system cartpole --methods all --seeds 5
    jaxdeconf compare --methods BcVanilla Masked Palr --nuisance previous_action two_steps_ago

A seed's methods share trajectories, β-VAE and shuffles. DIR gets a table sorted by rollout loss,
compare.jsonl with a row a method and seed, and a report; it is a sweep over methods, and takes what
`jaxdeconf sweep` takes: --grid, --shard, --resume. `--methods` takes names, or all, fair, oracle.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from jaxdeconf import checks
from jaxdeconf.commands import sweep as sweeps
from jaxdeconf.commands.parse import choose, first, parse, parse_value
from jaxdeconf.methods import named_by
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.results import Row
from jaxdeconf.presets import PRESETS
from jaxdeconf.sweep.grid import METHODS_AXIS, Axis, read_axis
from jaxdeconf.sweep.log import Sweep, read_sweep, require_same

_KINDS = "all", "fair", "oracle", "control"


@dataclass(frozen=True)
class Arguments(sweeps.Arguments):
    """What can be said on the command line."""

    nuisance: tuple[str, ...] = ()  # what the mark shows, one or several: see --collect.nuisance


def main(words: Sequence[str], presets: Mapping[str, Mapping[str, Config]] = PRESETS) -> int:
    """Compares methods as the command line asks; presets by system and name.

    Returns:
      The exit code, as of `guard.guarded`.
    """
    return sweeps.perform("compare", lambda: read(words, presets), _draw)


def _draw(directory: Path, sweep: Sweep, rows: Sequence[Row]) -> str:
    from jaxdeconf.report.compare import write  # late: it loads figures

    return write(directory, sweep, rows)


def read(
    words: Sequence[str], presets: Mapping[str, Mapping[str, Config]]
) -> tuple[Arguments, Sweep]:
    """The arguments, on top of the preset that they name, or of the comparison to resume.

    Raises:
      ValueError: one line that says what is wrong.
      StoreError: if there is no comparison to resume, or another one.
    """
    words = _spelled_out(words)
    early = first(words)
    checks.one_of("--system", early.system, tuple(presets))
    place, held = early.held, None
    if place is None:
        preset = choose(presets[early.system], early.preset)
        default = Arguments(config=replace(preset, methods=named_by("all")))
    else:
        held = read_sweep(place)
        default = Arguments(config=held.base, seeds=held.seeds)
    asked = parse(Arguments, "jaxdeconf compare", __doc__ or "", words, default)
    axes = [read_axis(word, asked.config, parse_value) for word in asked.grid]
    if asked.nuisance:
        values = (parse_value("collect.nuisance", word) for word in asked.nuisance)
        axes.append(Axis("collect.nuisance", tuple(values)))
    kept = [axis for axis in held.axes if axis.name != METHODS_AXIS] if held and not axes else axes
    methods = Axis(METHODS_AXIS, tuple((name,) for name in asked.config.methods))
    sweep = Sweep(asked.config, (*kept, methods), asked.seeds)
    assert sweep.points  # every combination is a valid config, or this raises
    if place is not None:
        require_same(place, sweep)
    return asked, sweep


def _spelled_out(words: Sequence[str]) -> list[str]:
    """The words, with the methods' names where a kind of them is asked for."""
    found, after = [], False
    for word in words:
        after = word == "--methods" or (after and not word.startswith("-"))
        found += named_by(word) if after and word in _KINDS else [word]
    return found
