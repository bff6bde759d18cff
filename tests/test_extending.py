"""What docs/extending.md shows is run: a system and a method of one's own, through run, sweep and
report, in a folder that the package knows nothing of."""

import importlib.util
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import jaxdeconf as jd
from jaxdeconf.collect import CollectConfig
from jaxdeconf.evaluate import EvaluateConfig
from jaxdeconf.expert import ExpertConfig
from jaxdeconf.learn.clone import CloneConfig
from jaxdeconf.learn.disentangle import DisentangleConfig
from jaxdeconf.mask import MaskConfig
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.pipeline import results
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.report import compare
from jaxdeconf.report import sweep as sweep_report
from jaxdeconf.report.run import write_report
from jaxdeconf.sweep import sights
from jaxdeconf.sweep.grid import Axis
from jaxdeconf.sweep.log import Log, Sweep, write_sweep
from jaxdeconf.sweep.sweep import sweep

PAGE = Path(__file__).parents[1] / "docs" / "extending.md"
QUIET = Reporter(Console(quiet=True))
# As small as it goes: three frames of 32 × 48 pixels, one step of most things.
CONFIG = jd.Config(
    collect=CollectConfig(
        random_trajectories=20, expert_trajectories=30, held_out_trajectories=20, size=(32, 48)
    ),
    expert=ExpertConfig(horizon=10, initial_iterations=10),
    disentangle=DisentangleConfig(
        steps=30,
        batch_size=16,
        objective="H",
        beta=2.0,
        network=VAEConfig(channels=(4, 4), latents=3, linear_path=True),
    ),
    mask=MaskConfig(reaction_horizon=2),
    clone=CloneConfig(
        steps=8,
        batch_size=16,
        frames=3,
        trajectory_steps=10,
        network=NetworkConfig(width=2, stem="imagenet", stages=1, norm="none"),
    ),
    evaluate=EvaluateConfig(rollouts=3, every=0.25),
)


def block(first_words):
    """The Python of the page that begins so."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (found,) = [text for text in blocks if text.startswith(first_words)]
    return found


def imported(file):
    """The page's system, from a file outside of the package."""
    text = block('"""A pendulum')
    assert text.count("\n") < 80
    file.write_text(text)
    spec = importlib.util.spec_from_file_location("pendulum", file)
    module = importlib.util.module_from_spec(spec)
    sys.modules["pendulum"] = module
    spec.loader.exec_module(module)
    return module.PENDULUM


def add_the_pages_method():
    exec(block("import jax.numpy as jnp\nimport jaxdeconf as jd"), {})


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    return imported(tmp_path_factory.mktemp("elsewhere") / "pendulum.py")


@pytest.fixture
def blurred():
    """The page's method, in the table while the test runs."""
    before = dict(jd.METHODS)
    add_the_pages_method()
    yield jd.METHODS["Blurred"]
    jd.METHODS.clear()
    jd.METHODS.update(before)


def grid(config):
    axes = Axis("mask.threshold", (1e-3, 0.4)), Axis("clone.learning_rate", (1e-3, 3e-3))
    return Sweep(config, axes)


def comparison(config):
    return Sweep(config, (Axis("methods", tuple((name,) for name in config.methods)),))


def run_and_sweep(place):
    """In a process of its own, which compiles as users' do."""
    add_the_pages_method()
    system = imported(place / "pendulum.py")
    config = replace(CONFIG, methods=("Blurred", "Masked"))
    jd.run(config, system, place / "run", QUIET)
    for name, asked in (("sweep", grid(config)), ("comparison", comparison(config))):
        write_sweep(place / name, asked)
        sweep(asked, Log(place / name), QUIET, Interruption(), 1e9, system=system)


@pytest.mark.slow
def test_a_system_and_a_method_of_ones_own_go_through_run_report_and_sweep(
    experiment, blurred, tmp_path
):
    process = experiment(tmp_path, start=("-m", "tests.test_extending"))
    assert process.returncode == 0, process.stderr
    place = tmp_path / "run"
    found, pictures = results.load(place)
    assert found.system == "pendulum"
    assert list(found.policies) == ["Blurred", "Masked"]
    assert found.mask.shape == (3,)
    assert all(np.isfinite(judged.rollout_loss.mean) for judged in found.policies.values())
    assert len(found.policies["Blurred"].rollout_loss.per_epoch) >= 1
    assert pictures.strips["Blurred"].shape[1:] == (32, 48, 3)
    assert set(pictures.rollouts) == {"Expert", "Blurred", "Masked"}
    write_report(place, found, pictures)
    page = (place / "report.html").read_text(encoding="utf-8")
    assert "pendulum, seed 0" in page
    assert "Blurred" in page

    rows = Log(tmp_path / "sweep").rows()
    assert [row.point for row in rows] == [0, 1, 2, 3]
    # A point is the run with its config; what does not look at the mask is cloned once for both.
    for method, judged in found.policies.items():
        own = rows[0].policies[method]
        assert own.rollout_loss.mean == pytest.approx(judged.rollout_loss.mean, rel=1e-3)
        assert own.copycat == pytest.approx(judged.copycat, rel=1e-3, abs=1e-6)
    assert rows[0].policies["Blurred"] == rows[2].policies["Blurred"]
    assert rows[0].policies["Blurred"] != rows[1].policies["Blurred"]
    config = replace(CONFIG, methods=("Blurred", "Masked"))
    said = sweep_report.write(tmp_path / "sweep", grid(config), rows)
    assert "Blurred" in said

    place = tmp_path / "comparison"
    sight = sights.kept(place, 0)
    assert sight.seen.shape == (3, 32, 48, 3)
    assert sight.salient.shape == (3, 32, 48)
    assert sight.salient.any()
    said = compare.write(place, comparison(config), Log(place).rows())
    assert "Blurred" in said
    assert (place / "figures" / "0" / "sights.png").stat().st_size > 5000


def test_a_system_that_does_not_fit_is_refused_before_anything_is_collected(pendulum, tmp_path):
    for words, config, system in (
        (
            "size: expected multiples of 4",
            replace(CONFIG, collect=replace(CONFIG.collect, size=(30, 48))),
            pendulum,
        ),
        (
            r"draw: expected images of shape \[32, 48, 3\], got \[64, 64, 3\]",
            CONFIG,
            replace(pendulum, draw=lambda state, _: pendulum.draw(state, (64, 64))),
        ),
        (
            "one that needs no cover, got 'BcManual'",
            replace(CONFIG, methods=("BcManual",)),
            replace(pendulum, nuisance=Uncovered()),
        ),
    ):
        with pytest.raises(ValueError, match=words):
            jd.run(config, system, tmp_path / "run", QUIET)
        assert not (tmp_path / "run").exists()


class Uncovered:
    """A nuisance that nobody knows the place of."""

    def draw(self, image, signal):
        return image


if __name__ == "__main__":
    run_and_sweep(Path(sys.argv[1]))
