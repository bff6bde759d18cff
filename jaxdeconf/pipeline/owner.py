"""Whose a directory is: one process at a time works there, and the next one is told which."""

import contextlib
import json
import os
import platform
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from jaxdeconf.pipeline.plain import UNREADABLE, from_plain, to_plain
from jaxdeconf.pipeline.store import StoreError


class Owner(NamedTuple):
    """A process, as the file of a directory that it owns says it."""

    host: str
    pid: int
    began: str  # see `_began`
    since: str


@contextlib.contextmanager
def owned(file: Path, take_over: bool = False) -> Iterator[None]:
    """Makes a directory this process's own while it works there.

    Args:
      file: in that directory; each of those that may work side by side has a name of its own.
      take_over: from a process on another machine, of which this one cannot see that it is gone.
    Raises:
      StoreError: if another process owns it.
    """
    now = datetime.now().astimezone().isoformat(" ", "seconds")
    own = Owner(platform.node(), os.getpid(), _began(os.getpid()), now)
    text = json.dumps(to_plain(own)) + "\n"
    with contextlib.suppress(OSError):  # where nothing can be written, what comes next says so
        file.parent.mkdir(parents=True, exist_ok=True)
        while not _write(file, text):
            _remove_if_left(file, take_over)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            if file.read_text(encoding="utf-8") == text:  # nobody has taken over
                file.unlink()


def _write(file: Path, text: str) -> bool:
    """Writes a file, and says whether; not if there is one."""
    try:
        new = file.open("x", encoding="utf-8")
    except FileExistsError:
        return False
    try:
        with new:
            new.write(text)
    except OSError:  # a full disk: a part of it would be taken for another machine's
        file.unlink()
        raise
    return True


def _remove_if_left(file: Path, take_over: bool) -> None:
    """Removes what a process left that is gone.

    Raises:
      StoreError: if it is not, or if nobody here can know.
    """
    aside = file.with_name(f"{file.name}.{os.getpid()}")
    with contextlib.suppress(FileNotFoundError):  # its owner, or who was faster, has removed it
        text = file.read_text(encoding="utf-8")
        owner = _read(text)
        here = owner.host == platform.node()
        if _began(owner.pid) in (owner.began, "running") if here else not take_over:
            more = "" if here else "; if that is gone, add --take-over"
            raise StoreError(
                f"{file.parent}: in use by process {owner.pid} on {owner.host} "
                f"since {owner.since}{more}"
            )
        file.rename(aside)
        if aside.read_text(encoding="utf-8") == text:
            aside.unlink()
        else:  # the file of who was faster
            aside.rename(file)


def _read(text: str) -> Owner:
    try:
        return from_plain(Owner, json.loads(text))
    except UNREADABLE:  # it is being written, or its process was killed just then
        return Owner("an unknown machine", 0, "", "an unknown time")


def _began(pid: int) -> str:
    """When a process of this machine began, which tells it from a later one with its id.

    `gone` if there is none, or it has ended and waits for its parent to notice; `running` where the
    system does not say when.
    """
    with contextlib.suppress(OSError):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return "gone" if fields[0] in "ZX" else fields[19]
    with contextlib.suppress(PermissionError):  # there is one, of another user
        try:
            os.kill(pid, 0)  # no signal: asks whether there is such a process
        except ProcessLookupError:
            return "gone"
    return "running"
