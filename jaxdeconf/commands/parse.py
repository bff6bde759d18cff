"""Flags for every field of a config, by tyro; what is wrong is said in one line."""

import contextlib
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints

import tyro

from jaxdeconf.pipeline import store
from jaxdeconf.pipeline.config import Config

Arguments = TypeVar("Arguments")
# A config's fields are flags of their own: --seed, --clone.learning-rate.
Flags = Annotated[Config, tyro.conf.arg(name="")]


@dataclass(frozen=True)
class Where:
    """The directory of a run, or of a sweep."""

    out: Path | None = None  # a new directory; runs/SYSTEM-PRESET-... by default
    resume: Path | None = None  # go on with what is in this directory
    resume_if_exists: bool = False  # go on with what is in --out; start if that is nothing
    take_over: bool = False  # the directory, from a process on another machine that is gone

    def __post_init__(self):
        if self.out is not None and self.resume is not None:
            raise ValueError(f"out: expected only one of --out and --resume, got {self.out}")
        if self.resume_if_exists and self.out is None:
            raise ValueError("resume_if_exists: expected --out beside it, got none")

    @property
    def held(self) -> Path | None:
        """The directory to go on with, if it is not a start."""
        if self.resume_if_exists and self.out is not None and store.held(self.out):
            return self.out
        return self.resume


@dataclass(frozen=True)
class First(Where):
    """What the other flags' defaults depend on."""

    preset: str = "laptop"
    system: str = "cartpole"


Early = TypeVar("Early", bound=Where)


def first(arguments: Sequence[str], kind: type[Early] = First) -> Early:
    """The flags that decide what the others change.

    Args:
      arguments: of the command line.
      kind: which flags those are.
    Raises:
      ValueError: one line that says what is wrong.
    """
    words = [word for word in arguments if word not in ("-h", "--help")]
    return _quietly(lambda: tyro.cli(kind, args=words, default=kind(), return_unknown_args=True)[0])


def parse(
    kind: type[Arguments], program: str, description: str, words: Sequence[str], default: Any
) -> Arguments:
    """The arguments, on top of a default.

    Args:
      kind: a dataclass of them.
      program: as it is called.
      description: shown by --help.
      words: of the command line.
      default: what flags change.
    Raises:
      ValueError: one line that says what is wrong.
    """
    return _quietly(
        lambda: tyro.cli(kind, prog=program, description=description, args=words, default=default)
    )


def parse_value(field: str, value: str) -> Any:
    """A field's value, as its flag would set it.

    Args:
      field: of a config, dotted, as clone.learning_rate.
      value: a word, or several where the field is a tuple.
    Raises:
      ValueError: one line that says what is wrong.
    """
    kind: Any = Config
    for name in field.split("."):
        kind = get_type_hints(kind, include_extras=True)[name]
    try:
        return _quietly(lambda: tyro.cli(kind, args=value.split()))
    except ValueError as error:
        said = re.sub(r"^[^:]*: ", "", str(error))
        raise ValueError(f"--{field.replace('_', '-')}: {said}") from None


def choose(presets: Mapping[str, Config], preset: str) -> Config:
    """A preset by name.

    Raises:
      ValueError: if there is none.
    """
    if preset not in presets:
        raise ValueError(f"--preset: expected one of {', '.join(presets)}, got {preset!r}")
    return presets[preset]


def _quietly(read: Callable[[], Any]) -> Any:
    """What tyro reads, or a ValueError of one line."""
    messages = io.StringIO()
    try:
        with contextlib.redirect_stderr(messages):
            return read()
    except SystemExit as stop:
        if stop.code == 0:  # --help
            raise
        raise ValueError(_one_line(messages.getvalue())) from None


def _one_line(box: str) -> str:
    """tyro's boxed message, without the box and its advice on what to read next."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", box)
    lines = [re.sub(r"^[\s│|]+|[\s│|]+$", "", line) for line in plain.splitlines()]
    words = [line for line in lines if line and not re.match(r"^[╭╰─]", line)]
    text = " ".join(word for word in words if not set(word) <= {"─", "-"})
    text = re.split(r" ?(?:Argument helptext:|For full helptext)", text)[0]
    return re.sub(r"^Error parsing (?:config\.|Arguments: |--)?", "--", text)
