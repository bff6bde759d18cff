"""Sweeps from the command line: on two devices, in two processes, as jobs, cut short."""

import copy
import json
import multiprocessing
import os
import shutil
import signal
import socket
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from jax.sharding import Mesh

from jaxdeconf.commands import sweep as sweep_command
from jaxdeconf.commands.main import main
from jaxdeconf.commands.sweep import submit
from jaxdeconf.learn.fit import FitConfig, Training, start
from jaxdeconf.learn.many import AXIS
from jaxdeconf.sweep import batch
from jaxdeconf.sweep.log import read_sweep

SWEEP = ("-m", "experiments.sweep")
# Two β-VAEs, each with two learning rates: every stage has models to train together.
GRID = ("--grid", "disentangle.beta=2,4", "clone.learning_rate=1e-3,3e-3")
# On one machine they are equal to the last bit. Another order of the same sums, which another XLA
# may choose, goes through 250 steps of a closed loop that multiplies it.
CLOSE = 1e-3


def rows(directory, file="sweep.jsonl"):
    return [json.loads(line) for line in (directory / file).read_text().splitlines()]


def numbers_of(row):
    """What must agree: all of a row but what is said in other words elsewhere."""
    masked = dict(row["policies"]["Masked"])
    loss = masked.pop("rollout_loss")
    masked.pop("predictability")  # a ratio of what regressions leave of a closed loop
    numbers = [loss["mean"], loss["std"], *masked.values(), *row["expert"].values()]
    return [row["mask"], row["precision"], row["recall"], *numbers]


def assert_same(found, expected, rtol=CLOSE):
    assert [row["values"] for row in found] == [row["values"] for row in expected]
    for mine, other in zip(found, expected, strict=True):
        for a, b in zip(numbers_of(mine), numbers_of(other), strict=True):
            np.testing.assert_allclose(np.asarray(a, float), np.asarray(b, float), rtol=rtol)


def by_point(found):
    return sorted(found, key=lambda row: row["point"])


def begun(swept, out, **changes):
    """A directory with what `swept` shares, and another grid."""
    shutil.copytree(swept[0] / "stages", out / "stages")
    plan = json.loads((swept[0] / "sweep.json").read_text())
    (out / "sweep.json").write_text(json.dumps(plan | changes))
    return out


@pytest.fixture(scope="module")
def experiment(experiment):
    """Compiled the short way: sweeps are compared with one another, and compile the most."""
    quick = copy.copy(experiment)
    quick.environment = experiment.environment | {"XLA_FLAGS": os.environ["XLA_FLAGS"]}
    return quick


@pytest.fixture(scope="module")
def sweep(experiment, tmp_path_factory):
    """Runs a sweep as a user does; returns its directory and the process."""

    def run(*arguments, out=None, code=0):
        out = out or tmp_path_factory.mktemp("sweeps") / "sweep"
        where = () if "--resume" in arguments else ("--out", out)
        process = experiment(*arguments, *where, start=SWEEP)
        assert process.returncode == code, process.stderr
        return out, process

    return run


@pytest.fixture(scope="module")
def swept(sweep, small):
    return sweep(*small, *GRID, "--devices", "2")


@pytest.mark.slow
def test_a_sweep_leaves_rows_a_table_and_plots(swept):
    """That a point is the run with its config: tests/test_extending.py."""
    directory, process = swept
    found = by_point(rows(directory))
    assert [row["values"] for row in found] == [
        {"seed": 0, "disentangle.beta": beta, "clone.learning_rate": rate}
        for beta in (2.0, 4.0)
        for rate in (1e-3, 3e-3)
    ]
    assert all(set(row["policies"]) == {"Masked"} for row in found)
    assert "2 at a time on 2 cpu devices" in process.stdout
    assert "report:" in process.stdout
    assert (directory / "figures" / "rollout_loss.png").stat().st_size > 10_000
    assert (directory / "report.html").read_text().count("data:image/png") == 1


@pytest.mark.slow
def test_two_processes_find_what_one_finds(swept, small, experiment, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    of = ("--coordinator", address, "--num-processes", "2", "--process-id")
    arguments = [*SWEEP, *small, *GRID, "--out", tmp_path / "sweep", *of]
    processes = [
        subprocess.Popen(
            [sys.executable, *map(str, [*arguments, number])],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=experiment.environment,
        )
        for number in range(2)
    ]
    said = [process.communicate(timeout=600) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
    assert "2 at a time on 2 cpu devices" in said[0][0]
    assert "report:" in said[0][0]
    assert "report:" not in said[1][0]
    assert_same(by_point(rows(tmp_path / "sweep")), by_point(rows(swept[0])))


@pytest.mark.slow
def test_what_is_done_is_not_done_again(sweep, swept, tmp_path):
    expected = (swept[0] / "sweep.jsonl").read_text().splitlines(keepends=True)
    again = tmp_path / "sweep"
    shutil.copytree(swept[0], again)
    (again / "sweep.jsonl").write_text("".join(expected[:2]) + expected[2][:40])  # killed there
    _, process = sweep("--resume", again)
    found = (again / "sweep.jsonl").read_text().splitlines(keepends=True)
    assert found[:2] == expected[:2]
    assert_same(by_point(rows(again)), by_point(rows(swept[0])))
    assert "2 points done" in process.stderr
    _, process = sweep("--resume", again)
    assert "points done" not in process.stderr


@pytest.mark.slow
def test_shards_run_as_jobs_of_an_executor(swept, experiment, tmp_path, monkeypatch):
    for name, value in experiment.environment.items():
        monkeypatch.setenv(name, value)
    out = tmp_path / "sweep"
    for part in ("1-of-2", "2-of-2"):
        shutil.copytree(swept[0] / "stages", out / f"stages-{part}")
    spawn = multiprocessing.get_context("spawn")  # a process whose JAX is its own
    with ProcessPoolExecutor(2, mp_context=spawn) as executor:
        jobs = submit(executor, read_sweep(swept[0]), out, shards=2)
        assert [job.result() for job in jobs] == [0, 0]
    found = [*rows(out, "sweep-1-of-2.jsonl"), *rows(out, "sweep-2-of-2.jsonl")]
    assert_same(by_point(found), by_point(rows(swept[0])))
    assert "not done yet" not in (out / "report.html").read_text()
    assert sorted(path.name for path in out.glob("*.json")) == ["sweep.json"]


@pytest.mark.slow
def test_a_point_that_diverges_is_recorded_and_stops_no_other(sweep, swept, tmp_path):
    out = begun(swept, tmp_path / "sweep", axes={"clone.learning_rate": [1e-3, 1e30]})
    _, process = sweep("--resume", out)
    well, ill = by_point(rows(out))
    assert well["diverged"] == []
    assert_same([well | {"values": 0}], [rows(swept[0])[0] | {"values": 0}])
    assert ill["diverged"] == ["Masked"]
    assert ill["policies"]["Masked"]["rollout_loss"]["mean"] is None
    assert "diverged" in process.stdout
    assert "Diverged: 1." in (out / "report.html").read_text()


@pytest.mark.slow
def test_programs_of_one_model_train_side_by_side_as_they_do_alone(sweep, swept, tmp_path):
    out = begun(swept, tmp_path / "sweep", axes={"clone.batch_size": [64, 32]})
    _, process = sweep("--resume", out)
    usual, other = by_point(rows(out))
    assert process.stderr.count("policies × 1:") == 2
    assert_same([usual | {"values": 0}], [rows(swept[0])[0] | {"values": 0}])
    assert numbers_of(other) != numbers_of(usual)


@pytest.mark.slow
def test_masks_alone_for_a_thousand_thresholds(sweep, swept, tmp_path):
    gammas = np.geomspace(1e-4, 0.5, 100).tolist()
    axes = {"mask.threshold": gammas, "mask.reaction_horizon": list(range(1, 11))}
    base = json.loads((swept[0] / "sweep.json").read_text())["base"] | {"methods": []}
    out = begun(swept, tmp_path / "sweep", axes=axes, base=base)
    sweep("--resume", out)
    found = rows(out)
    assert len(found) == 1000
    by_gamma = [row for row in found if row["values"]["mask.reaction_horizon"] == 3]
    masked = [sum(row["mask"]) for row in by_gamma]
    assert masked == sorted(masked)  # a higher threshold masks no less
    assert masked[-1] == 4
    names = {path.name for path in (out / "figures").iterdir()}
    assert names == {"mask.png", "precision_recall.png"}


@pytest.mark.slow
def test_an_interrupted_sweep_says_how_to_go_on(experiment, small, tmp_path):
    out = tmp_path / "sweep"
    process = subprocess.Popen(
        [sys.executable, *SWEEP, *small, "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=experiment.environment,
    )
    assert process.stdout is not None
    for line in process.stdout:
        if "mask" in line:  # the plan has been said
            process.send_signal(signal.SIGINT)
            break
    _, error = process.communicate(timeout=300)
    assert process.returncode == 130, error
    assert f"interrupted; go on with --resume {out}" in error


@pytest.mark.slow
def test_another_grid_is_refused(swept, small, capsys, monkeypatch):
    monkeypatch.setattr(jax.config, "update", lambda *_: None)  # JAX has its devices by now
    directory = swept[0]
    before = (directory / "sweep.jsonl").read_bytes()
    assert main(["sweep", "--seeds", "2", "--resume", str(directory)]) == 2
    assert "holds another sweep" in capsys.readouterr().err
    assert main(["sweep", "--out", str(directory), "--resume-if-exists", "--seeds", "2"]) == 2
    assert "holds another sweep" in capsys.readouterr().err
    assert main(["sweep", *small, *GRID, "--out", str(directory)]) == 2
    assert f"holds a sweep; use --resume {directory}" in capsys.readouterr().err
    assert (directory / "sweep.jsonl").read_bytes() == before


def test_rows_that_come_while_the_report_is_drawn_are_drawn_too():
    """Of two shards that end at once: the one that began to draw with fewer rows may be last."""
    log = SimpleNamespace(directory=None, rows=lambda: rows[: 1 + len(drawn)])
    rows, drawn = ["one", "two", "three"], []

    def draw(directory, sweep, found):
        drawn.append(found)
        return f"{len(found)} rows"

    assert sweep_command._drawn(draw, None, log, rows[:1]) == "3 rows"
    assert drawn == [rows[:1], rows[:2], rows[:3]]


def test_a_batch_fills_the_devices_within_memory():
    devices = tuple(jax.devices())
    assert batch.room(jobs=8, bytes_a_model=1e9, budget=1.5e9) == batch.Room(devices[:1], 1)
    assert batch.room(jobs=8, bytes_a_model=1e12, budget=1e9).models == 1


def test_groups_that_fill_no_devices_train_side_by_side_within_memory(monkeypatch):
    monkeypatch.setattr(jax, "devices", lambda: [None] * 4)
    monkeypatch.setattr(batch, "model_bytes", lambda training: training)
    groups = [[batch.Job(1e9, "data")] * models for models in (2, 5, 1)]
    assert [*batch.lots(groups, budget=1e12)] == [batch.Lot([1], 1), batch.Lot([0, 2], 2)]
    assert [*batch.lots(groups, budget=1e9)] == [batch.Lot([1], 1), batch.Lot([0, 2], 1)]
    many = [[batch.Job(1e9, "data")]] * 20
    assert [(len(lot.groups), lot.at_once) for lot in batch.lots(many, 1e12)] == [(16, 4), (4, 4)]
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert {lot.at_once for lot in batch.lots(many, 1e12)} == {1}


def test_a_device_holds_each_data_set_once():
    mesh = Mesh(np.array(jax.devices()[:1]), (AXIS,))
    made = []

    def data(value):
        made.append(value)
        return jax.numpy.full((4,), value)

    def job(name, value):
        one = Training(
            objective=lambda _: None,
            config=FitConfig(),
            samples=4,
            key=jax.random.key(0),
            data=lambda: data(value),
            start=lambda _: start({"params": {"w": jax.numpy.zeros(2)}, "batch_stats": {}}),
            trained=lambda state: state,
        )
        return batch.Job(one, name)

    models, joined = batch._place([job("a", 1.0), job("b", 2.0), job("a", 1.0)], mesh)
    assert made == [1.0, 2.0]
    np.testing.assert_array_equal(joined, [1, 1, 1, 1, 2, 2, 2, 2])
    np.testing.assert_array_equal(models.first_sample, [0, 4, 0])
