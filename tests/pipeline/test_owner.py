"""One process at a time works in a directory; reference: two real ones, of which one is killed."""

import json
import os
import subprocess
import sys

import jax
import pytest

from jaxdeconf.commands.main import main
from jaxdeconf.pipeline.interruption import Interrupted
from jaxdeconf.pipeline.owner import owned
from jaxdeconf.pipeline.store import OWNER, StoreError
from jaxdeconf.sweep.log import Log

WORK = (
    "import sys\nfrom pathlib import Path\nfrom jaxdeconf.pipeline.owner import owned\n"
    "with owned(Path(sys.argv[1])):\n    print('mine', flush=True)\n    sys.stdin.read()"
)

# For every file that it is told of, whether it may work there; it stays until it is told so.
RIVAL = """
import sys
from pathlib import Path
from jaxdeconf.pipeline.owner import owned
from jaxdeconf.pipeline.store import StoreError
for line in sys.stdin:
    try:
        with owned(Path(line.strip())):
            print("won", flush=True)
            sys.stdin.readline()
    except StoreError:
        print("refused", flush=True)
        sys.stdin.readline()
"""


@pytest.fixture
def worker():
    """Starts a process that owns a directory until its standard input ends."""
    running = []

    def start(file):
        command = [sys.executable, "-c", WORK, str(file)]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        process = subprocess.Popen(command, **pipes)
        running.append(process)
        assert process.stdout.readline() == "mine\n"
        return process

    yield start
    for process in running:
        process.kill()
        process.communicate()


def left_by(file, **changes):
    """The file of a process that is gone: of this one, with changes."""
    with owned(file):
        whole = json.loads(file.read_text())
    file.write_text(json.dumps(whole | changes))


def test_the_second_process_is_refused_at_once_and_told_of_the_first(worker, tmp_path, capsys):
    first = worker(tmp_path / OWNER)
    before = (tmp_path / OWNER).read_bytes()
    for more in ([], ["--seeds", "2"], ["--take-over"], ["--resume-if-exists"]):
        assert main(["cartpole", "--preset", "smoke", "--out", str(tmp_path), *more]) == 2
        error = capsys.readouterr().err
        assert error.startswith(
            f"error: {tmp_path}: in use by process {first.pid} on {os.uname()[1]}"
        )
        assert error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == [OWNER]
    assert (tmp_path / OWNER).read_bytes() == before
    first.communicate("")
    assert not (tmp_path / OWNER).exists()


def test_shards_work_side_by_side_each_with_its_own_owner(worker, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(jax.config, "update", lambda *_: None)  # JAX has its devices by now
    first = worker(Log(tmp_path, (1, 2)).owner)
    words = ["sweep", "--preset", "smoke", "--out", str(tmp_path), "--seeds", "2", "--shard", "1/2"]
    assert main(words) == 2
    assert f"in use by process {first.pid} on" in capsys.readouterr().err
    with owned(Log(tmp_path, (2, 2)).owner):
        assert len(list(tmp_path.glob("owner*"))) == 2


def test_what_a_killed_process_left_is_taken_over(worker, tmp_path):
    """Also before its parent has noticed."""
    first = worker(tmp_path / OWNER)
    first.kill()
    os.waitid(os.P_PID, first.pid, os.WEXITED | os.WNOWAIT)
    with owned(tmp_path / OWNER):
        assert json.loads((tmp_path / OWNER).read_text())["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="a process's start is not known")
def test_a_process_with_the_id_of_one_that_is_gone_is_another(tmp_path):
    left_by(tmp_path / OWNER, began="1")
    with owned(tmp_path / OWNER):
        pass


@pytest.mark.parametrize("damage", [None, "", "{", '{"pid": 1}'])
def test_another_machines_process_is_taken_from_only_if_asked_to(tmp_path, damage):
    left_by(tmp_path / OWNER, host="elsewhere", pid=7)
    words = r"in use by process 7 on elsewhere since 20.*; if that is gone, add --take-over"
    if damage is not None:
        (tmp_path / OWNER).write_text(damage)
        words = r"on an unknown machine since an unknown time; if that is gone, add --take-over"
    before = (tmp_path / OWNER).read_bytes()
    with pytest.raises(StoreError, match=words), owned(tmp_path / OWNER):
        pass
    assert (tmp_path / OWNER).read_bytes() == before
    with owned(tmp_path / OWNER, take_over=True):
        assert json.loads((tmp_path / OWNER).read_text())["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("error", [Interrupted(2), StoreError("no"), ZeroDivisionError()])
def test_every_orderly_end_frees_the_directory(tmp_path, error):
    file = tmp_path / "new" / OWNER

    def work():
        assert file.exists()
        raise error

    with pytest.raises(type(error)), owned(file):
        work()
    assert list(file.parent.iterdir()) == []


def test_a_full_disk_keeps_no_part_of_a_file(tmp_path):
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, before[1]))
    try:
        with owned(tmp_path / OWNER):
            assert list(tmp_path.iterdir()) == []
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_who_was_taken_over_from_leaves_the_next_ones_file(tmp_path):
    with owned(tmp_path / OWNER):
        left_by_another = (tmp_path / OWNER).read_text().replace("since", "since ")
        (tmp_path / OWNER).write_text(left_by_another)
    assert (tmp_path / OWNER).read_text() == left_by_another


def test_of_two_that_find_a_file_left_one_wins(tmp_path):
    """All start at the same moment, again and again."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    processes = [subprocess.Popen([sys.executable, "-c", RIVAL], **pipes) for _ in range(2)]
    try:
        for attempt in range(20):
            file = tmp_path / str(attempt) / OWNER
            file.parent.mkdir()
            left_by(file, began="1")
            for process in processes:
                process.stdin.write(f"{file}\n")
            for process in processes:
                process.stdin.flush()
            assert sorted(process.stdout.readline() for process in processes) == [
                "refused\n",
                "won\n",
            ]
            for process in processes:
                process.stdin.write("\n")
                process.stdin.flush()
    finally:
        for process in processes:
            process.communicate()
