"""A damaged, foreign or full run directory: one line that names the file, and nothing lost."""

import ast
import contextlib
import pickle
import random
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from jaxdeconf import collect
from jaxdeconf.commands.main import main
from jaxdeconf.learn.fit import FitConfig, Training, start
from jaxdeconf.pipeline import checkpoint, stages, store
from jaxdeconf.pipeline.plain import write_json
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.store import Store, StoreError, WriteError
from jaxdeconf.presets import PRESETS
from jaxdeconf.version import __version__

CONFIG = PRESETS["cartpole"]["smoke"]
PICKLERS = {"pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve"}


def state(fill=1.0, size=6):
    return start({"params": {"w": jnp.full(size, fill)}, "batch_stats": {}})


@pytest.fixture
def run(tmp_path):
    """A run directory with a `collect`, and a `mask` that was made from it."""
    directory = tmp_path / "run"
    run = Store(directory, CONFIG, resume=False)
    run.save("collect", 3, state(), {"seconds": 1.0}, {})
    run.save("mask", 0, state(2.0), {}, made_from(state()))
    return directory


def made_from(collected):
    return {"collect": checkpoint.fingerprint(collected)}


def reopened(directory, config=CONFIG):
    return Store(directory, config, resume=True)


def refused(directory, words):
    """Loading `collect` ends with one line that says so, and leaves every file as it is."""
    before = contents(directory)
    with pytest.raises(StoreError, match=words) as error:
        reopened(directory).load("collect", state, {})
    assert "\n" not in str(error.value)
    assert str(directory / "checkpoints" / "collect") in str(error.value)
    assert "delete" in str(error.value)
    assert contents(directory) == before


def contents(directory):
    return {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()}


def files(directory):
    return sorted(
        path for path in (directory / "checkpoints/collect/3").rglob("*") if path.is_file()
    )


def test_a_flipped_byte_anywhere_is_seen(run):
    chance = random.Random(0)
    names = {path.name for path in files(run)}
    assert names == {"SHA256SUMS", "notes.json", "arrays.npz"}
    for path in files(run):
        whole = path.read_bytes()
        # All of the list of checksums, which nothing else guards; some bytes of every other file.
        few = min(len(whole), 3)
        every = path.name == "SHA256SUMS"
        for place in range(len(whole)) if every else chance.sample(range(len(whole)), few):
            flipped = bytearray(whole)
            flipped[place] ^= 1 << chance.randrange(8)
            path.write_bytes(flipped)
            refused(run, "differs from what was written")
        path.write_bytes(whole)
    assert reopened(run).load("collect", state, {}) is not None


def test_a_truncated_a_missing_and_an_added_file_are_seen(run):
    for path in files(run):
        whole = path.read_bytes()
        if whole:
            path.write_bytes(whole[: len(whole) // 2])
            refused(run, "not a checkpoint of this run")
        path.unlink()
        refused(run, "not a checkpoint of this run")
        path.write_bytes(whole)
    (files(run)[0].parent / "more").write_text("")
    refused(run, "more differs from what was written")


def test_a_checkpoint_of_another_run_is_seen(run, tmp_path):
    other = Store(tmp_path / "other", replace(CONFIG, seed=1), resume=False)
    other.save("collect", 3, state(), {}, {})
    shutil.rmtree(run / "checkpoints" / "collect")
    shutil.copytree(tmp_path / "other/checkpoints/collect", run / "checkpoints/collect")
    refused(run, "made with another config, or another version")


def test_a_missing_stage_is_redone_and_what_follows_from_it_kept_if_it_comes_out_the_same(run):
    shutil.rmtree(run / "checkpoints" / "collect")
    again = reopened(run)
    assert again.load("collect", state, {}) is None
    again.save("collect", 3, state(), {}, {})
    assert again.load("mask", state, made_from(state())) is not None


def test_what_follows_from_a_stage_that_came_out_otherwise_is_refused(run):
    shutil.rmtree(run / "checkpoints" / "collect")
    again = reopened(run)
    again.save("collect", 3, state(1.0 + 1e-6), {}, {})
    with pytest.raises(StoreError, match=r"mask/0: .*made from another collect.*delete .*mask"):
        again.load("mask", state, made_from(state(1.0 + 1e-6)))


def test_a_killed_saves_remains_are_not_read_and_then_removed(run):
    partial = run / "checkpoints/collect/7.partial"
    shutil.copytree(run / "checkpoints/collect/3", partial)
    again = reopened(run)
    assert int(again.load("collect", state, {})[0].step) == 0
    again.save("collect", 7, state(3.0), {}, {})
    assert [path.name for path in (run / "checkpoints/collect").iterdir()] == ["7"]


def full(directory):
    """A file system of less than a megabyte, if this user may mount one."""
    directory.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", str(directory)]
    return shutil.which("mount") and subprocess.run(mount, capture_output=True).returncode == 0


@pytest.fixture
def small_disk(tmp_path):
    if not full(tmp_path / "disk"):
        pytest.skip("no right to mount a file system")
    yield tmp_path / "disk"
    subprocess.run(["umount", str(tmp_path / "disk")], check=True)


@pytest.fixture
def small_files():
    """Files cannot grow beyond 100 kB: a full disk for whoever may not mount one."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def save_too_much(directory):
    run = Store(directory, CONFIG, resume=False)
    run.save("collect", 3, state(), {}, {})
    noise = jnp.asarray(np.random.default_rng(0).normal(size=400_000), jnp.float32)
    words = r"collect/7: cannot be written .*; see to the disk"
    with pytest.raises(WriteError, match=words) as error:
        run.save("collect", 7, start({"params": {"w": noise}, "batch_stats": {}}), {}, {})
    assert "\n" not in str(error.value)
    assert str(error.value).endswith(f"--resume {directory}")
    assert [path.name for path in (directory / "checkpoints/collect").iterdir()] == ["3"]
    assert reopened(directory).load("collect", state, {}) is not None


def test_a_full_disk_keeps_what_was_saved(small_disk):
    save_too_much(small_disk / "run")


def test_a_file_too_large_keeps_what_was_saved(small_files, tmp_path):
    save_too_much(tmp_path / "run")


@pytest.mark.slow
def test_a_full_disk_ends_a_run_with_one_line(small_disk, experiment, smoke):
    process = experiment(*smoke, "--out", small_disk / "run")
    assert process.returncode == 1, process.stderr
    run = small_disk / "run"
    words = r"error: (.*): cannot be written \(No space left on device\); "
    last = process.stderr.splitlines()[-1]
    said = re.fullmatch(words + f"see to the disk, then go on with --resume {run}", last)
    assert said, process.stderr
    assert said[1].startswith(str(run))
    assert checkpoint.read_notes(run / "checkpoints/collect/0")


def test_a_report_that_cannot_be_written_names_its_file(tmp_path):
    words = r"nowhere/results.json.*: cannot be written \(No such"
    with pytest.raises(WriteError, match=words), store.writing(tmp_path):
        write_json(tmp_path / "nowhere" / "results.json", {})
    words = f"^{tmp_path}: cannot be written .No space"
    with pytest.raises(WriteError, match=words), store.writing(tmp_path):
        raise OSError(28, "No space left on device")


def exits_with(code, words, capsys, *arguments, command="cartpole"):
    assert main([command, *map(str, arguments)]) == code
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert printed.err.startswith("error: ")
    assert words in printed.err


def test_a_directory_that_cannot_be_written_is_named(tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    for place in (tmp_path / "file", tmp_path / "file" / "run"):
        exits_with(2, f"{place}: cannot be", capsys, "--preset", "smoke", "--out", place)
    assert (tmp_path / "file").read_text() == "mine"


def test_a_read_only_directory_is_named(small_disk, capsys):
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    exits_with(
        2, f"{small_disk}/run: cannot be written (Read-only", capsys, "--out", small_disk / "run"
    )


@pytest.mark.parametrize("seeds", [1, 2])
def test_other_files_are_not_overwritten(tmp_path, capsys, seeds):
    (tmp_path / "results.json").write_text("mine")
    words = f"{tmp_path / 'results.json'}: is no run's"
    exits_with(2, words, capsys, "--out", tmp_path, "--seeds", seeds)
    assert contents(tmp_path) == {tmp_path / "results.json": b"mine"}


def test_a_run_is_not_overwritten(run, capsys):
    before = contents(run)
    exits_with(2, f"{run}: holds a run; use --resume {run}", capsys, "--out", run)
    assert contents(run) == before


def test_a_run_of_another_config_system_or_version_is_not_resumed(run, capsys, monkeypatch):
    before = contents(run)
    flags = ("--disentangle.beta", "9")
    exits_with(2, "--disentangle.beta was 2.0, is 9.0; leave", capsys, "--resume", run, *flags)
    flags = ("--preset", "laptop")
    exits_with(2, "--preset was smoke, is laptop", capsys, "--resume", run, *flags)
    words = f"{run}: a run of cartpole, not of reacher; use jaxdeconf cartpole"
    exits_with(2, words, capsys, "--resume", run, command="reacher")
    monkeypatch.setattr(store, "__version__", "9.9.9")
    words = f"{run / 'config.json'}: a run of jaxdeconf {__version__}, not of this version, 9.9.9"
    exits_with(2, words, capsys, "--resume", run)
    assert contents(run) == before


def test_the_first_moment_of_a_killed_run_is_no_run(tmp_path):
    (tmp_path / "config.json.partial").write_text("{")
    Store(tmp_path, CONFIG, resume=False)
    assert reopened(tmp_path).load("collect", state, {}) is None


class Trap:
    """Leaves a mark where it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


def test_a_planted_pickle_does_not_run(run, tmp_path):
    mark = tmp_path / "sprung"
    planted = pickle.dumps(Trap(mark))
    pickle.loads(planted)
    assert mark.exists()  # the trap works
    mark.unlink()
    folder = run / "checkpoints/collect/3"
    for path in files(run):
        whole, sums = path.read_bytes(), (folder / "SHA256SUMS").read_text()
        path.write_bytes(planted)
        if path.name != "SHA256SUMS":  # an attacker writes new checksums, too
            (folder / "SHA256SUMS").write_text(checkpoint._sums(folder))
        with contextlib.suppress(StoreError):
            reopened(run).load("collect", state, {})
        path.write_bytes(whole)
        (folder / "SHA256SUMS").write_text(sums)
    assert not mark.exists()


def test_nothing_imports_pickle_or_allows_it():
    files = [*Path(checkpoint.__file__).parents[1].rglob("*.py")]
    assert len(files) > 30
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = {
                alias.name for alias in getattr(node, "names", []) if isinstance(alias, ast.alias)
            }
            assert not names & PICKLERS, file
            assert getattr(node, "module", None) not in PICKLERS, file
            assert getattr(node, "arg", None) != "allow_pickle", file


def ill(weight):
    """A loss that is `weight`(step) times that of a flat valley."""

    def objective(_):
        def loss(variables, data, indices, key, step):
            return weight(step) * jnp.sum(variables["params"]["w"] ** 2), ({}, {})

        return loss

    return objective


@pytest.fixture
def training(tmp_path):
    """A run that trains with a given loss; saves at every chunk's edge."""
    held = Store(tmp_path / "run", CONFIG, resume=False)
    reporter = Reporter(Console(quiet=True))
    run = stages.Run(CONFIG, held, reporter)

    def train(objective):
        config = FitConfig(steps=32, batch_size=8, chunk=8)
        key = jax.random.key(0)
        one = Training(objective, config, 64, key, lambda: None, lambda _: state(), lambda s: s)
        return run.watch("train", one)

    def saved():
        none = checkpoint.fingerprint(None)
        return held.load("train", state, {"collect": none, "view": none})

    train.saved = saved
    return train


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_loss_that_is_not_finite_stops_the_stage_and_keeps_the_last_good_checkpoint(
    training, value, monkeypatch
):
    monkeypatch.setattr(stages, "SAVE_SECONDS", 0.0)
    bad = ill(lambda step: jnp.where(step == 23, value, 1.0))
    with pytest.raises(FloatingPointError, match=f"^train, step 24: loss is {value}$"):
        training(bad)
    assert int(training.saved()[0].step) == 16


def test_weights_that_are_not_finite_are_not_saved(training, monkeypatch):
    monkeypatch.setattr(stages, "SAVE_SECONDS", 0.0)

    def objective(_):
        def loss(variables, *_):  # 0 at 1, where its slope is infinite
            return jnp.sqrt(jnp.abs(variables["params"]["w"] - 1.0)).sum() * 0.0, ({}, {})

        return loss

    with pytest.raises(FloatingPointError, match=r"^train, step 8: "):
        training(objective)
    assert training.saved() is None


def test_divergence_exits_with_1_and_one_line(tmp_path, capsys, monkeypatch):
    def diverge(*_):
        raise FloatingPointError("disentangle, step 24: loss is nan")

    monkeypatch.setattr(collect, "collect", diverge)
    words = f"disentangle, step 24: loss is nan; the last good checkpoint is in {tmp_path / 'run'}"
    exits_with(1, words, capsys, "--preset", "smoke", "--out", tmp_path / "run")


def test_too_little_memory_exits_with_1_and_one_line(tmp_path, capsys, monkeypatch):
    huge = ("--collect.random-trajectories", 2_000_000_000)
    arguments = ("--preset", "smoke", "--out", tmp_path / "run", *huge)
    exits_with(1, "not enough memory; make sizes smaller", capsys, *arguments)
