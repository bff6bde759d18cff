"""How all figures look, and how they get to disk; nothing here depends on the user's environment.

Matplotlib is slow to import: modules that draw are imported only when there is something to write,
after `import_matplotlib`. Figures are objects, never pyplot's: no display, no state left behind.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxdeconf.methods import METHODS
from jaxdeconf.report import words

EXPERT, INK, FAINT = "#555555", "#222222", "#8A8A8A"
# Okabe & Ito's first, then what stays apart from those before it under each colour blindness
# (Machado et al. 2009; at least 13 in CIELAB). From the eighth on, the marker changes too.
PALETTE = (
    *("#D55E00", "#0072B2", "#009E73", "#B55D92", "#E69F00", "#4B0082", "#00C2D1"),
    *("#661100", "#9A8CE0", "#117733", "#1B3A5C", "#999933", "#7B3F00", "#222222"),
)
_MARKERS = "osD^vPX"
_STYLE = Path(__file__).with_name("house.mplstyle")


class Look(NamedTuple):
    """How a method is drawn, in every figure."""

    color: str
    marker: str
    thin: bool


def looks(names: Iterable[str]) -> dict[str, Look]:
    """The look of each method, by its place in the table, in the table's order."""
    found = words.ordered(names)
    places = list(dict.fromkeys([*METHODS, *found]))
    drawn = {}
    for name in found:
        place = places.index(name)
        color, marker = PALETTE[place % len(PALETTE)], _MARKERS[place // 7 % len(_MARKERS)]
        drawn[name] = Look(color, marker, words.kind(name) == "control")
    return drawn


def zoom(width: int, wanted: int) -> int:
    """By how much to enlarge images of a width so that they are about as wide as wanted."""
    return max(1, round(wanted / width))


def import_matplotlib() -> None:
    """Imports matplotlib; an MPLBACKEND that names what is not installed does not stop it."""
    if "matplotlib" in sys.modules:
        return
    backend = os.environ.pop("MPLBACKEND", "")
    import matplotlib

    if backend:  # for those who use matplotlib after us
        os.environ["MPLBACKEND"] = backend
        with contextlib.suppress(ValueError):
            matplotlib.rcParams["backend"] = backend


def write(
    folder: Path, figures: Sequence[Callable[..., Any]], *found: Any
) -> list[tuple[Path, str]]:
    """Writes figures of what was found, in our style whatever a matplotlibrc says.

    Args:
      folder: where to; made if it is not there.
      figures: functions of what was found; each returns a matplotlib figure, the bytes of a GIF,
        or None where there is nothing to see. Its name is the file's, and the first paragraph of
        its docstring the caption.
      *found: what they are called with.
    Returns:
      Files and captions.
    """
    from matplotlib import rc_context, rc_params_from_file
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    usual = rc_params_from_file(_STYLE)  # matplotlib's defaults, and ours
    style: dict[Any, Any] = {key: usual[key] for key in usual if "backend" not in key}
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with rc_context(style):
        for figure in figures:
            drawn, caption = (
                figure(*found),
                " ".join((figure.__doc__ or "").split("\n\n")[0].split()),
            )
            if drawn is None:
                continue
            file = folder / f"{figure.__name__}.{'gif' if isinstance(drawn, bytes) else 'png'}"
            if isinstance(drawn, bytes):
                file.write_bytes(drawn)
            else:
                FigureCanvasAgg(drawn).print_figure(file)
            written.append((file, caption))
    return written
