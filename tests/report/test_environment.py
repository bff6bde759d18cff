"""Drawing does not depend on the user's environment: the reference is what is drawn without one."""

import os
import subprocess
import sys
from pathlib import Path

import matplotlib
import pytest

from jaxdeconf.pipeline import results as stored
from jaxdeconf.report import canvas
from jaxdeconf.report.run import redraw

REDRAW = """
import os, sys
from pathlib import Path
from jaxdeconf.report.run import redraw
assert not {"matplotlib", "PIL"} & {*sys.modules}, "loaded too early"
redraw(Path(sys.argv[1]))
assert os.environ["MPLBACKEND"] == sys.argv[2], "changed for others"
import matplotlib
assert "pyplot" not in {*sys.modules}
assert matplotlib.rcParams["text.usetex"] == (sys.argv[3] == "usetex"), "changed for others"
"""


def pictures_in(directory: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in (directory / "figures").iterdir()}


@pytest.fixture(scope="module")
def run(make, brief, tmp_path_factory) -> Path:
    directory = tmp_path_factory.mktemp("run")
    stored.save(directory, make(), brief)
    redraw(directory)
    return directory


@pytest.mark.parametrize(
    ("backend", "settings"),
    [
        ("module://matplotlib_inline.backend_inline", "text.usetex: True\nno.such.key: 1\n"),
        ("nonsense", None),
    ],
)
def test_backend_and_matplotlibrc_change_nothing(backend, settings, run: Path, tmp_path: Path):
    wanted, file = pictures_in(run), tmp_path / "matplotlibrc"
    if settings:
        file.write_text(settings)  # else the variable names a file that is not there
    for old in (run / "figures").iterdir():
        old.unlink()
    done = subprocess.run(
        [sys.executable, "-c", REDRAW, run, backend, "usetex" if settings else ""],
        env={**os.environ, "MPLBACKEND": backend, "MATPLOTLIBRC": str(file)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert pictures_in(run) == wanted


def test_settings_of_this_process_change_nothing(run: Path):
    wanted = pictures_in(run)
    with matplotlib.rc_context({"text.usetex": True, "savefig.dpi": 40, "axes.grid": True}):
        redraw(run)
        assert matplotlib.rcParams["savefig.dpi"] == 40
    assert pictures_in(run) == wanted


def test_a_backend_is_left_alone_once_matplotlib_is_there(monkeypatch):
    before = matplotlib.get_backend()
    monkeypatch.setenv("MPLBACKEND", "svg")
    canvas.import_matplotlib()
    assert matplotlib.get_backend() == before
    assert os.environ["MPLBACKEND"] == "svg"
