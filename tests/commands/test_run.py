"""The command line: presets, flags, and what a wrong argument costs."""

import contextlib
import json
import re
import subprocess
import sys
from dataclasses import replace

import jax.numpy as jnp
import pytest

from jaxdeconf.commands import run
from jaxdeconf.commands.guard import cache_compilations
from jaxdeconf.commands.main import main
from jaxdeconf.pipeline.store import Store, begin
from jaxdeconf.presets import PRESETS
from jaxdeconf.version import __version__

CARTPOLE = PRESETS["cartpole"]


def read(*words):
    return run.read("", CARTPOLE, words)


def test_the_default_is_the_laptop_preset():
    asked = read()
    assert asked.config == CARTPOLE["laptop"]
    assert (asked.seeds, asked.out, asked.resume) == (1, None, None)


def test_flags_change_the_preset_they_are_given_with():
    asked = read(
        *("--preset", "smoke", "--clone.learning-rate", "0.5", "--clone.frames", "3"),
        *("--disentangle.network.latents", "7", "--methods", "BcVanilla", "Masked"),
        *("--mask.statistic", "refined", "--mask.alpha", "None", "--collect.size", "96", "128"),
    )
    config = asked.config
    assert (config.clone.learning_rate, config.clone.frames) == (0.5, 3)
    assert config.disentangle.network.latents == 7
    assert config.methods == ("BcVanilla", "Masked")
    assert (config.mask.statistic, config.mask.alpha) == ("refined", None)
    assert config.collect == replace(CARTPOLE["smoke"].collect, size=(96, 128))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--preset", "big"], "--preset: expected one of smoke, laptop, paper, got 'big'"),
        (["--preset"], "--preset"),
        (["--clone.learning-rate", "fast"], "--clone.learning-rate: .*'fast'"),
        (["--clone.learning-rate", "nan"], "learning_rate: expected a positive number, got nan"),
        (["--clone.learning-rate", "1e400"], "learning_rate: expected a positive number, got inf"),
        (["--disentangle.epochs", "inf"], "epochs: expected a positive number, got inf"),
        (["--clone.epochs", "1e30"], "epochs: expected at most 2147483647 steps in all, got 1e.30"),
        (["--clone.batch-size", "1e3"], "--clone.batch-size: .*1e3"),
        (["--clone.batch-size", "1" + 30 * "0"], "batch_size: expected an integer <= 2147483647"),
        (["--clone.batch-size", "1000000"], "batch_size: expected at most 40000 samples, got 1000"),
        (["--clone.frames", "5"], "frames: expected an integer <= 4, got 5"),
        (["--disentangle.network.channels", "8", "0"], "channels: expected a positive integer"),
        (["--disentangle.network.channels"], "channels: expected positive integers, got .."),
        (["--disentangle.objective", "G"], "choice 'G' for argument '--disentangle.objective'"),
        (["--disentangle.capacity", "-inf"], "capacity: expected a number >= 0, got -inf"),
        (["--mask.threshold", "-1e-9"], "threshold: expected a number >= 0, got -1e-09"),
        (["--mask.alpha", "2"], "alpha: expected a number in .0, 1., got 2.0"),
        (["--mask.reaction-horizon", "101"], "reaction_horizon: expected an integer <= 100"),
        (["--mask.statistic", "kendall"], "choice 'kendall' for argument '--mask.statistic'"),
        (["--collect.expert-trajectories", "4"], "expert_trajectories: expected .* >= 5, got 4"),
        (["--collect.size", "84", "84"], "size: expected multiples of 32 .*, got 84 × 84"),
        (["--evaluate.every", "inf"], "every: expected a positive number, got inf"),
        (["--expert.tolerance", "0"], "tolerance: expected a positive number, got 0"),
        (["--system", "reacher"], "--system: expected cartpole, got 'reacher'"),
        (["--methods", "Mystery"], "methods: expected one of BcVanilla, .*, got 'Mystery'"),
        (["--methods", "Masked", "Masked"], "methods: expected each once, got Masked Masked"),
        (["--clone.lerning-rate", "1"], "--clone.lerning-rate.*--clone.learning-rate"),
        (["--seed", "-1"], "seed: expected an integer >= 0, got -1"),
        (["--seed", "1.5"], "--seed: .*1.5"),
        (["--seeds", "2", "--seed", str(2**32 - 1)], "seeds: expected an integer <= 1, got 2"),
        (["--seeds", "nan"], "--seeds: .*nan"),
        (["--seeds", "0"], "seeds: expected a positive integer, got 0"),
        (["--resume", "b"], "b/config.json: no run to resume there"),
        (["--out", "a", "--resume", "b"], "expected only one of --out and --resume, got a"),
        (["--resume-if-exists"], "resume_if_exists: expected --out beside it, got none"),
    ],
)
def test_a_wrong_argument_exits_with_2_and_one_line(arguments, said, capsys):
    assert main(["cartpole", *arguments]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert printed.err.startswith("error: ")
    assert re.search(said, printed.err)


def test_resuming_needs_no_flags(tmp_path):
    config = read("--preset", "smoke", "--disentangle.beta", "3", "--seed", "5").config
    begin(tmp_path, config)
    assert read("--resume", str(tmp_path)).config == config


def test_several_runs_are_resumed_together(tmp_path, capsys):
    """Also if the first was killed in its first moment; not with another number of them."""
    config = replace(CARTPOLE["smoke"], seed=9)
    begin(tmp_path, config, seeds=2)
    asked = read("--resume", str(tmp_path))
    assert (asked.config, asked.seeds) == (config, 2)
    assert main(["cartpole", "--resume", str(tmp_path), "--seeds", "3"]) == 2
    assert "--seeds: expected 2, as was begun there, got 3" in capsys.readouterr().err
    begin(tmp_path / "seed-9", config)
    alone = ["cartpole", "--resume", str(tmp_path / "seed-9"), "--seeds", "2"]
    assert main(alone) == 2
    assert "--seeds: expected 1" in capsys.readouterr().err


def test_a_config_that_is_none_is_named(tmp_path, capsys):
    (tmp_path / "config.json").write_text(
        json.dumps({"jaxdeconf": __version__, "seed": 1, "wheels": 4})
    )
    assert main(["cartpole", "--resume", str(tmp_path)]) == 2
    assert "config.json: not a run of jaxdeconf" in capsys.readouterr().err


def test_out_and_resume_exclude_each_other(tmp_path, capsys):
    begin(tmp_path, CARTPOLE["smoke"])
    assert main(["cartpole", "--out", "a", "--resume", str(tmp_path)]) == 2
    assert "expected only one of --out and --resume" in capsys.readouterr().err


def test_help_shows_every_field_and_exits_with_0():
    command = [sys.executable, "-m", "experiments.cartpole", "--help"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for flag in (
        "--clone.learning-rate",
        "--disentangle.objective",
        "--mask.threshold",
        "--methods",
        "--resume",
        "--seeds",
    ):
        assert flag in done.stdout


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"]])
def test_the_command_says_what_it_can_do(words, capsys):
    assert main(words) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in ("cartpole", "reacher", "sweep", "report"))


def test_an_unknown_command_and_a_report_of_nothing_exit_with_2(tmp_path, capsys):
    for words in (["pendulum"], ["report", str(tmp_path)], ["report"], ["sweep", "--system", "x"]):
        assert main(words) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ")
        assert error.count("\n") == 1
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"{__version__}\n"


def test_the_cache_goes_where_the_rules_say(monkeypatch, tmp_path):
    """JAX's own variable wins; a relative XDG_CACHE_HOME counts as unset; no home stops nothing."""
    import jax

    found = {}
    monkeypatch.setattr(jax.config, "update", lambda name, value: found.__setitem__(name, value))

    def where(**environment):
        found.clear()
        for name in ("JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"):
            monkeypatch.delenv(name, raising=False)
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        cache_compilations()
        return found.get("jax_compilation_cache_dir")

    assert where(JAX_COMPILATION_CACHE_DIR="/elsewhere") is None
    assert where(XDG_CACHE_HOME=str(tmp_path)).startswith(str(tmp_path / "jaxdeconf"))
    for relative in ("", "here"):
        here = where(XDG_CACHE_HOME=relative, HOME=str(tmp_path / "home"))
        assert here.startswith(str(tmp_path / "home" / ".cache" / "jaxdeconf"))

    def nobody():
        raise RuntimeError("no home")

    monkeypatch.setattr("pathlib.Path.home", nobody)
    assert where() is None


@pytest.fixture
def failing(monkeypatch):
    """Every run fails in its first stage, in one of the ways in which one may."""

    def fail(error):
        def collect_for(*_):
            raise error

        monkeypatch.setattr("jaxdeconf.pipeline.run.collect_for", collect_for)

    return fail


@pytest.mark.parametrize("error", [MemoryError(), ValueError("late"), ZeroDivisionError("a bug")])
@pytest.mark.parametrize("seeds", ["1", "2"])
def test_a_start_that_fails_in_its_first_stage_leaves_no_claim(
    failing, tmp_path, capsys, error, seeds
):
    """The same --out takes a run of other flags; this one, too, and with it one that goes on."""
    failing(error)
    out = ["cartpole", "--preset", "smoke", "--out", str(tmp_path / "run")]
    for words in ([], ["--seeds", seeds], ["--seed", "5"], ["--clone.epochs", "1"]):
        for more in ([], ["--resume-if-exists"]):
            with contextlib.suppress(ZeroDivisionError):
                main([*out, *words, *more])
            said = capsys.readouterr().err
            assert "holds a run" not in said
            assert "was begun" not in said
            assert "another config" not in said
    assert not list((tmp_path / "run").rglob("owner*"))


def saved(directory, config):
    """A run of which the first stage is done."""
    Store(directory, config, resume=False).save("collect", 0, {"a": jnp.ones(2)}, {}, {})


def test_one_line_starts_or_goes_on(tmp_path, capsys):
    out = tmp_path / "run"
    words = ["--preset", "smoke", "--seed", "5", "--out", str(out), "--resume-if-exists"]
    start = read(*words, "--clone.epochs", "3")
    assert (start.held, start.config.clone.epochs) == (None, 3)
    saved(out, start.config)
    again = read(*words)
    assert (again.held, again.config) == (out, start.config)  # what is not said is as it was
    for other in (["--clone.epochs", "4"], ["--seed", "6"], ["--preset", "laptop"]):
        assert main(["cartpole", *words, *other]) == 2
        assert "config.json: resumed with another config: --" in capsys.readouterr().err
    assert main(["cartpole", *words, "--seeds", "2"]) == 2
    assert "--seeds: expected 1, as was begun there" in capsys.readouterr().err
    assert main(["reacher", *words]) == 2
    assert "a run of cartpole, not of reacher" in capsys.readouterr().err


def test_one_line_starts_or_goes_on_with_several_seeds(tmp_path, capsys):
    config = replace(CARTPOLE["smoke"], seed=5)
    begin(tmp_path, config, seeds=2)
    saved(tmp_path / "seed-5", config)
    words = ["--out", str(tmp_path), "--resume-if-exists"]
    assert (read(*words).config, read(*words).seeds) == (config, 2)
    assert main(["cartpole", *words, "--seeds", "3"]) == 2
    assert "--seeds: expected 2, as was begun there, got 3" in capsys.readouterr().err


def test_one_line_does_not_start_among_other_files(tmp_path, capsys):
    (tmp_path / "mine").write_text("")
    assert main(["cartpole", "--out", str(tmp_path), "--resume-if-exists"]) == 2
    assert f"{tmp_path / 'mine'}: is no run's" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
