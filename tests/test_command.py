"""The command as a process: signals while it imports, readers who leave, terminals of few letters.

A stand-in for the package shows what the first lines do, whatever is imported after them; the last
tests run the real one.
"""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
START = "import sys, jaxdeconf_command as command; sys.exit(command.main())"
STUBBORN = """
import time
print("importing", flush=True)
while True:
    try:
        time.sleep(60)
    except BaseException:
        pass
"""
# As a run does: rich would end it with an exit code of its own.
TALKATIVE = """
import sys
from rich.console import Console
def main(_):
    for _ in range(1000):
        print(100 * "x")
        print(100 * "x", file=sys.stderr)
        Console(stderr=True).out("more")
    return 3
"""


@pytest.fixture
def standin(tmp_path):
    """The command with a package `jaxdeconf` of one module, `commands.main`, of that text."""

    def make(body):
        commands = tmp_path / "jaxdeconf" / "commands"
        commands.mkdir(parents=True)
        for folder in (commands.parent, commands):  # else the one that is installed comes before it
            (folder / "__init__.py").touch()
        (commands / "main.py").write_text(body)
        (tmp_path / "jaxdeconf_command.py").symlink_to(ROOT / "jaxdeconf_command.py")
        return {"args": [sys.executable, "-c", START], "cwd": tmp_path}

    return make


@pytest.fixture
def unread():
    """A pipe whose reader has left."""
    reader, writer = os.pipe()
    os.close(reader)
    yield writer
    os.close(writer)


def interrupted(process):
    process.send_signal(signal.SIGINT)
    return (*process.communicate(timeout=60), process.returncode)


PIPES = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}


def test_an_import_that_catches_everything_is_interrupted(standin):
    process = subprocess.Popen(**standin(STUBBORN), **PIPES)
    assert process.stdout.readline() == b"importing\n"
    assert interrupted(process) == (b"", b"", 130)


@pytest.mark.parametrize("entry", ["cartpole", "sweep"])
@pytest.mark.parametrize("seconds", [0.5, 1.0])
def test_ctrl_c_while_it_imports_ends_it_without_a_trace(tmp_path, entry, seconds):
    start = [sys.executable, "-m", f"experiments.{entry}", "--out", str(tmp_path / "run")]
    process = subprocess.Popen(start, cwd=ROOT, **PIPES)
    time.sleep(seconds)
    _, error, code = interrupted(process)
    assert code == 130
    # A fast machine has begun, and may be done with a stage: one of JAX's calls is not interrupted.
    error = re.sub(rb"\Acollect: [\d.]+ s\n", b"", error)
    assert error == b"" or error.startswith(b"interrupted; ")


def test_letters_that_a_terminal_has_not_are_written_as_others(standin):
    few = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        **standin("def main(_):\n    print('o₁ × 2')\n    return 3"), env=few, capture_output=True
    )
    assert (done.stdout, done.stderr, done.returncode) == (b"o\\u2081 \\xd7 2\n", b"", 3)


def test_a_reader_who_leaves_is_no_reason_to_stop(standin, unread):
    assert subprocess.run(**standin(TALKATIVE), stdout=unread, stderr=unread).returncode == 3


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no file that is always full")
def test_a_log_on_a_full_disk_is_no_reason_to_stop(standin):
    with open("/dev/full", "w") as full:
        assert subprocess.run(**standin(TALKATIVE), stdout=full, stderr=full).returncode == 3


@pytest.mark.parametrize("words", [["cartpole", "--help"], ["--help"]])
def test_help_into_a_closed_pipe_ends_quietly(words, unread):
    start = [sys.executable, "-c", START, *words]
    done = subprocess.run(start, cwd=ROOT, stdout=unread, stderr=subprocess.PIPE)
    assert (done.stderr, done.returncode) == (b"", 0)
