"""The theory's experiments from a config to their results: each claim's rates, kept and resumed."""

import math
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxdeconf import checks, threads
from jaxdeconf.pipeline import machine, results
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.plain import to_plain
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.results import Pictures
from jaxdeconf.pipeline.stages import Run
from jaxdeconf.pipeline.store import Store, writing
from jaxdeconf.theory import claims, pixels
from jaxdeconf.theory.claims import ClaimsConfig, Rate
from jaxdeconf.theory.pixels import Driven, PixelsConfig


@dataclass(frozen=True)
class TheoryConfig:
    """What is run of the theory's experiments."""

    seed: int = 0  # every random choice derives from it
    on_pixels: bool = True  # also the claims on CartPole's frames, the longer part
    claims: ClaimsConfig = field(default_factory=ClaimsConfig)
    pixels: PixelsConfig = field(default_factory=PixelsConfig)

    def __post_init__(self):
        checks.integer("seed", self.seed, least=0, most=2**32 - 1)


class Theory(NamedTuple):
    """Everything that results.json holds: a list of rates for each claim."""

    conservative: list[Rate]
    no_more_conservative: list[Rate]
    strictly_less: list[Rate]
    threshold: list[Rate]
    pairs: list[Rate]
    pixels: list[Rate] = []  # noqa: RUF012
    driven: list[Driven] = []  # noqa: RUF012  a policy of each condition
    square: np.ndarray | None = None  # [O] R² of each latent that the previous action explains
    seconds: dict[str, float] = {}  # noqa: RUF012  by stage
    peak_memory_mb: float = float("nan")
    versions: dict[str, str] = {}  # noqa: RUF012
    config: dict[str, Any] = {}  # noqa: RUF012


def run(
    config: TheoryConfig,
    directory: Path,
    reporter: Reporter | None = None,
    resume: bool = False,
    interruption: Interruption | None = None,
) -> Theory:
    """Does, or finishes, the experiments; leaves results.json and pictures.npz.

    Args:
      config: what is asked for.
      directory: where everything goes.
      reporter: the screen.
      resume: go on with what is there; if it is finished, say what it found.
      interruption: asks it to stop; by default nothing does.
    Raises:
      StoreError, WriteError, FloatingPointError, Interrupted: as `pipeline.run.run` does.
    """
    store = Store(directory, config, resume)
    if resume and (found := results.finished(directory, Theory)):
        return found
    this = Run(config, store, reporter or Reporter(), interruption or Interruption())
    key, of = this.key, config.claims
    measured = claims.measure(of, key, this.stage)
    found = Theory(
        conservative=claims.conservative(of, measured, key, this.stage),
        no_more_conservative=claims.no_more_conservative(of, measured, key),
        strictly_less=claims.strictly_less(of, measured, key),
        threshold=claims.threshold(of, measured, key, this.stage),
        pairs=claims.pairs(of, key, this.stage),
    )
    strips: dict[str, np.ndarray] = {}
    if config.on_pixels:
        found, strips = _on_pixels(this, found)
    found = found._replace(
        seconds=this.seconds,
        peak_memory_mb=machine.peak_memory_mb(),
        versions=machine.versions(),
        config=to_plain(config),
    )
    nothing = np.zeros(0)
    pictures = Pictures(strips, nothing, nothing, np.zeros((0, 0), bool), {}, {}, 1.0)
    with writing(directory):
        results.save(directory, found, pictures)
    return found


def _on_pixels(this: Run, found: Theory) -> tuple[Theory, dict[str, np.ndarray]]:
    config, key = this.config.pixels, this.key
    scene = pixels.prepare(config, key, this.stage, this.watch)
    rates = pixels.mask_rates(config, scene, key, this.stage)
    data_bytes = 3.0 * scene.collected.expert.valid.size * math.prod(scene.system.size)
    at_once = machine.trainings(data_bytes)
    clones = [partial(pixels.clone, config, scene, c, key, this.watch) for c in config.couplings]
    of = threads.together(clones, at_once, this.interruption.stop)
    driven = [*threads.each(lambda one: pixels.drive(scene, one, key), of)]
    strips = {f"{one.coupling:g}": one.shown for one in of}
    return found._replace(pixels=rates, driven=driven, square=scene.square), strips
