"""One masking from a dataset to a dataset: read, check, disentangle, mask, judge, write."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf import threads
from jaxdeconf.deconfound import first_latents, learn_latents, mask_latents
from jaxdeconf.formats import find
from jaxdeconf.formats.source import Names, Source
from jaxdeconf.learn import disentangle
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.learn.fit import FitState, Training
from jaxdeconf.mask import MaskConfig
from jaxdeconf.owndata import dataset, judge
from jaxdeconf.owndata.check import UNVARIED, Check, check, spread, unvaried_words
from jaxdeconf.owndata.clones import Clone, compared
from jaxdeconf.owndata.config import Masking
from jaxdeconf.owndata.dataset import Dataset
from jaxdeconf.owndata.results import Found, Written
from jaxdeconf.owndata.view import View, make_view, save_view
from jaxdeconf.owndata.write import write_dataset
from jaxdeconf.pipeline import machine, results
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.plain import to_plain
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.results import Pictures
from jaxdeconf.pipeline.stages import Run
from jaxdeconf.pipeline.store import Store, writing
from jaxdeconf.region import find_region

_STRIP = 8  # frames that the report shows
_REGION = 1024  # frames that show where masked latents reach


def opened(config: Masking) -> tuple[Source, Source]:
    """The demonstrations, and the exploration or, where there is none, the demonstrations again.

    Raises:
      ValueError: one line on what cannot be read.
    """
    names = names_of(config)
    demos = find(Path(config.demos), config.format, names)
    if config.exploration is None:
        return demos, demos
    names = replace(names, initial_states=None)
    more = find(Path(config.exploration), config.format, names)
    if more.size != demos.size:
        wanted, got = (f"{h} × {w}" for h, w in (demos.size, more.size))
        raise ValueError(f"{config.exploration}: expected frames of {wanted}, got {got}")
    return demos, more


def names_of(config: Masking) -> Names:
    """What of the dataset a config takes."""
    return Names(config.frames, config.actions, config.initial_states)


def read(config: Masking, sources: tuple[Source, Source]) -> tuple[Dataset, Dataset]:
    """Both, at the size that the β-VAE learns."""
    demos = dataset.read(Path(config.demos), sources[0], config.size).longer(config.drop_short)
    if config.exploration is None:
        return demos, demos
    return demos, dataset.read(Path(config.exploration), sources[1], config.size, demos)


def held_out(exploration: Dataset) -> np.ndarray:
    """[m] bool: every tenth episode; of few episodes, every tenth frame."""
    episodes = np.repeat(np.arange(len(exploration.lengths)), exploration.lengths)
    count = episodes if len(exploration.lengths) >= 10 else np.arange(len(episodes))
    return count % 10 == 9


def mask_dataset(
    config: Masking,
    directory: Path,
    reporter: Reporter | None = None,
    resume: bool = False,
    interruption: Interruption | None = None,
) -> Found:
    """Does, or finishes, a masking; leaves a dataset, a view, results.json and pictures.npz.

    Args:
      config: what is asked for.
      directory: where everything goes.
      reporter: the screen.
      resume: go on with the masking that is there; if it is finished, say what it found.
      interruption: asks it to stop; by default nothing does.
    Raises:
      ValueError: if the dataset cannot be read or masked, before anything is trained.
      StoreError, WriteError, FloatingPointError, Interrupted: as `pipeline.run.run` does.
    """
    sources = opened(config)
    store = Store(directory, config, resume)
    if resume and (found := results.finished(directory, Found)):
        return found
    this = Run(config, store, reporter or Reporter(), interruption or Interruption())
    with _timed(this, "read"):
        demos, exploration = read(config, sources)
    with _timed(this, "check"):
        checked = check(demos, exploration.frames, config, this.key)
    found = Found(
        refused=checked.refused,
        check=checked,
        state_names=checked.state_names,
        action_names=[f"action {place + 1}" for place in range(demos.actions.shape[1])],
        statistic=MaskConfig.statistic,
    )
    pictures = _pictures(demos, None)
    if found.refused is None:
        found, pictures = _masked(this, demos, exploration, found, directory, sources[0])
    found = found._replace(
        seconds=this.seconds,
        peak_memory_mb=machine.peak_memory_mb(),
        versions=machine.versions(),
        config=to_plain(config),
    )
    with writing(directory):
        results.save(directory, found, pictures)
    return found


def _masked(
    this: Run, demos: Dataset, exploration: Dataset, found: Found, directory: Path, source: Source
) -> tuple[Found, Pictures]:
    """What is found once latents are learnt, and if nothing speaks against it, written."""
    config, out, frames = this.config, held_out(exploration), exploration.frames
    watch = partial(this.watch, data=frames)
    images, others = jnp.asarray(frames[~out]), jnp.asarray(frames[out])
    encoder = learn_latents(images, others, this.key, config.disentangle, watch)
    with _timed(this, "mask"):
        found = _judged(this, demos, exploration, found, encoder)
    if found.refused is not None or not found.mask.any():
        return found, _pictures(demos, None)
    with _timed(this, "region"):
        some = jnp.asarray(frames[:: -(-len(frames) // _REGION)])
        region = find_region(encoder, jnp.asarray(found.mask), some, this.key)
    view = make_view(encoder, jnp.asarray(found.mask), region)
    with _timed(this, "judge"):
        found = _compared(this, demos, exploration, found, view, encoder)
    with _timed(this, "write"), writing(directory):
        place = directory / "dataset" / Path(config.demos).name
        write_dataset(source, names_of(config), config.format, place, view)
        save_view(directory / "view", view)
    if config.clone:
        found = found._replace(clones=_clones(this, demos, view))
    mode = "inpaint" if view.local else "reconstruct"
    written = Written(mode, int(view.region.sum()), list(source.size))
    return found._replace(written=written), _pictures(demos, view)


def _judged(
    this: Run, demos: Dataset, exploration: Dataset, found: Found, encoder: Encoder
) -> Found:
    """What Algorithm 1 masks, what of that stands, and how firmly."""
    config, checked = this.config, found.check
    begin = _begin(demos, checked)
    mask = mask_latents(encoder, begin, config.rule(checked.horizon))
    latents, active = np.asarray(first_latents(encoder, begin)), np.asarray(encoder.active)
    some = jnp.asarray(judge.past(exploration).images)
    spreads = spread(
        jnp.asarray(latents), disentangle.encode(encoder.network, encoder.variables, some)[0]
    )
    share = judge.told(encoder, judge.past(exploration), this.key)
    asked = np.asarray(mask.mask) & active
    unvaried, names = active & (spreads < UNVARIED), [f"o{i + 1}" for i in range(len(active))]
    chosen = judge.confirmed(asked, share, len(latents), config)
    if config.unvaried != "refuse":
        chosen = np.where(unvaried, config.unvaried == "mask", chosen)
    refused = None
    if unvaried.any() and config.unvaried == "refuse":
        refused = unvaried_words([names[place] for place in np.flatnonzero(unvaried)])
    elif not active.any():
        refused = "no latent is active: the β-VAE has learnt nothing; train it for longer"
    elif not (active & ~chosen).any():
        refused = "every latent would be masked, and nothing would be left of the frames"
    return found._replace(
        refused=refused,
        mask=chosen,
        asked=asked,
        active=active,
        kl=np.asarray(encoder.kl),
        threshold=float(mask.threshold),
        state_observation=np.asarray(mask.state_observation),
        state_action=np.asarray(mask.state_action),
        nuisance_share=share,
        spread=spreads,
        stability=judge.stability(begin, latents, config, np.asarray(mask.mask), this.key),
        elsewhere=judge.elsewhere(mask, active),
    )


def _compared(
    this: Run, demos: Dataset, exploration: Dataset, found: Found, view: View, encoder: Encoder
) -> Found:
    """Leakage and retention, of frames as they are and as they are written."""
    checked, nothing = found.check, jnp.zeros(len(encoder.active), bool)
    whole = make_view(encoder, nothing, jnp.ones(view.region.shape, bool))
    moves = checked.state_action.max(axis=(1, 2)) > checked.threshold
    kept = judge.retention(_begin(demos, checked), demos.starts, view, this.key)
    return found._replace(
        leakage=judge.leakage(judge.past(exploration), view, whole, this.key),
        retention={name: kept[name] for name in np.array(checked.state_names)[moves].tolist()},
    )


def _clones(this: Run, demos: Dataset, view: View) -> dict[str, Clone]:
    """Policies cloned from frames as recorded and as written."""

    def watch(name: str, training: Training, frames: Array) -> FitState:
        return this.watch(name, training, data=frames)

    at_once = machine.trainings(demos.frames.nbytes)
    together = partial(threads.together, at_once=at_once, stop=this.interruption.stop)
    return compared(demos, held_out(demos), view, this.key, watch, together=together)


def _begin(demos: Dataset, checked: Check):
    chosen = np.isin(demos.state_names, checked.state_names)
    return demos.begin(checked.horizon, chosen)


def _pictures(demos: Dataset, view: View | None) -> Pictures:
    """Frames of one demonstration, and of first frames, before and after."""
    length = int(demos.lengths[0])
    along = demos.frames[np.linspace(0, length - 1, min(_STRIP, length)).astype(int)]
    shown = {"Frame": along}
    region = np.zeros(demos.frames.shape[1:3], bool)
    if view is not None:
        shown["Written"], region = view(along), view.region
    nothing = np.zeros(0)
    return Pictures(shown, nothing, nothing, region, {}, {}, 1.0)


@contextlib.contextmanager
def _timed(this: Run, name: str) -> Iterator[None]:
    """A stage that is done again when a masking is resumed."""
    with this.timed(name):
        yield
    this.interruption.check()
