"""Flags for every field of a config, by tyro; what is wrong is said in one line."""

import contextlib
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints

import tyro

from jaxdeconf.pipeline.config import Config

Arguments = TypeVar("Arguments")
# A config's fields are flags of their own: --seed, --clone.learning-rate.
Flags = Annotated[Config, tyro.conf.arg(name="")]


@dataclass(frozen=True)
class First:
    """What the other flags' defaults depend on."""

    preset: str = "laptop"
    system: str = "cartpole"
    resume: Path | None = None


def first(arguments: Sequence[str]) -> First:
    """The flags that decide what the others change.

    Raises:
      ValueError: one line that says what is wrong.
    """
    wanted = ("--preset", "--system", "--resume")
    found: list[str] = []
    for place, word in enumerate(arguments):
        if word.split("=")[0] in wanted:
            found += arguments[place : place + 1 + ("=" not in word)]
    return _quietly(lambda: tyro.cli(First, args=found, default=First()))


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
