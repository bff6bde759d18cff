"""A run that is killed again and again ends with the numbers of one that is left alone.

Reference: the uninterrupted smoke run, bit for bit.
"""

import json
import random
import signal
import subprocess
import sys
import time

import pytest

from jaxdeconf.pipeline import checkpoint
from jaxdeconf.pipeline.interruption import Interrupted, Interruption

KILLED = ("-m", "tests.pipeline.killed")
# One of each way in which a run saves: a stage in one piece, a training in the middle, and the
# results. Two of the kills come in the middle of a save: the new checkpoint is whole but not yet in
# its place; it is, but the old one has not been removed.
STRIKES = [
    ("SIGKILL", "collect", "random"),
    ("SIGTERM", "disentangle", "random"),
    ("SIGKILL", "disentangle", "renaming"),
    ("SIGKILL", "clone BcManual", "renamed"),
    ("SIGKILL", "save", "random"),
]


@pytest.mark.slow
def test_a_run_killed_in_every_kind_of_stage_ends_with_the_same_numbers(
    done, experiment, smoke, numbers, tmp_path
):
    directory, moment = tmp_path / "run", random.Random(7)
    seconds = json.loads((done.directory / "results.json").read_text())["seconds"]
    arguments = [*smoke, "--out", directory]
    for name, stage, when in STRIKES:
        if when == "random":
            when = moment.uniform(0.0, min(seconds.get(stage, 0.1), 10.0))
        run = experiment(name, stage, when, *arguments, start=KILLED)
        words = f"{name} in {stage} at {when}: {run.stderr}"
        if name == "SIGKILL":
            assert run.returncode == -signal.SIGKILL, words
        else:
            assert run.returncode == 128 + signal.Signals[name], words
            last = run.stderr.splitlines()[-1]
            assert last == f"interrupted; go on with --resume {directory}"
            assert not list(directory.glob("owner*"))
            saved = checkpoint.latest(directory / "checkpoints" / stage)
            assert saved is not None, words  # its end is not for many seconds, nor its next save
        assert not (directory / "results.json").exists() or stage == "save"
        arguments = ["--resume", directory]
    last = experiment(*arguments)
    assert last.returncode == 0, last.stderr
    assert numbers(directory) == numbers(done.directory)


def listening(body):
    """A process that prints `ready`, listening, and then runs `body`."""
    code = (
        "import hashlib\nfrom jaxdeconf.pipeline.interruption import Interruption\n"
        "asked = Interruption()\nwith asked.listening('go on with it'):\n"
        f"    print('ready', flush=True)\n    {body}\nasked.check()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "ready\n"
    return process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_ends_it_at_once_even_in_one_long_instruction(number):
    # As a compiled program does: it frees the interpreter, but no handler runs for minutes.
    process = listening("hashlib.pbkdf2_hmac('sha256', b'', b'', 10**9)")
    process.send_signal(number)
    time.sleep(0.1)
    process.send_signal(number)  # a wrapper passes on what the terminal sent to all
    time.sleep(0.6)
    assert process.poll() is None
    process.send_signal(number)
    _, errors = process.communicate(timeout=10)
    assert (process.returncode, errors) == (128 + number, "go on with it\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_only_asks(number):
    before = signal.getsignal(number)
    asked = Interruption()
    with asked.listening("never said"):
        signal.raise_signal(number)
        assert asked.asked == number
    assert signal.getsignal(number) == before
    with pytest.raises(Interrupted, match=number.name) as stopped:
        asked.check()
    assert stopped.value.exit_code == 128 + number


def test_nothing_asked_nothing_stops():
    Interruption().check()
