"""`jaxdeconf compare`: methods against causal confusion side by side, on the same data.

    jaxdeconf compare --system cartpole --methods all --seeds 5
    jaxdeconf compare --methods BcVanilla Masked Palr --nuisance previous_action two_steps_ago

A seed's methods share trajectories, β-VAE and shuffles. DIR gets a table sorted by rollout loss,
compare.jsonl with a row a method and seed, and a report; it is a sweep over methods, and takes what
`jaxdeconf sweep` takes: --grid, --shard, --resume. `--methods` takes names, or all, fair, oracle.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxdeconf.commands import sweep as sweeps
from jaxdeconf.commands.parse import parse_value
from jaxdeconf.methods import named_by
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.results import Row
from jaxdeconf.presets import PRESETS
from jaxdeconf.sweep.grid import METHODS_AXIS, Axis
from jaxdeconf.sweep.log import Sweep

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
    words, program, about = _spelled_out(words), "jaxdeconf compare", __doc__ or ""
    asked, held = sweeps.begin(Arguments, program, about, words, presets, named_by("all"))
    axes = sweeps.named_axes(asked)
    if asked.nuisance:
        values = (parse_value("collect.nuisance", word) for word in asked.nuisance)
        axes = *axes, Axis("collect.nuisance", tuple(values))
    if held and not axes:
        axes = tuple(axis for axis in held.axes if axis.name != METHODS_AXIS)
    methods = Axis(METHODS_AXIS, tuple((name,) for name in asked.config.methods))
    return asked, sweeps.agreed(asked, (*axes, methods))


def _spelled_out(words: Sequence[str]) -> list[str]:
    """The words, with the methods' names where a kind of them is asked for."""
    found, after = [], False
    for word in words:
        after = word == "--methods" or (after and not word.startswith("-"))
        found += named_by(word) if after and word in _KINDS else [word]
    return found
