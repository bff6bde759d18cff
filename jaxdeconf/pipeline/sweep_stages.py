"""What points of a sweep share, each done once: trajectories, β-VAEs, and masks in one pass."""

import dataclasses
import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdeconf import mask
from jaxdeconf.independence import hoeffding_d
from jaxdeconf.learn import disentangle
from jaxdeconf.learn.fit import FitConfig, Objective
from jaxdeconf.pipeline import batch, grid, results, stages
from jaxdeconf.pipeline.batch import Job, Trained
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.grid import Point
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.stages import Collected, Disentangled, Run
from jaxdeconf.pipeline.store import Nowhere, Store
from jaxdeconf.pipeline.sweep_log import Log, Sweep


class Encoder(NamedTuple):
    """A β-VAE with what Algorithm 1 needs of it."""

    vae: Disentangled
    share: np.ndarray  # [O] of its latents, what the previous action explains
    state_observation: np.ndarray  # [S, O] Hoeffding's D


@dataclass
class Work:
    """A sweep in progress."""

    sweep: Sweep
    log: Log
    reporter: Reporter
    interruption: Interruption
    budget: float  # bytes
    collected: dict[str, tuple[Run, Collected]] = field(default_factory=dict)
    encoders: dict[str, Encoder | None] = field(default_factory=dict)  # None: diverged
    actions: dict[str, np.ndarray] = field(default_factory=dict)  # [S, H, A] Hoeffding's D

    @cached_property
    def longest(self) -> int:
        """The longest reaction horizon of all points."""
        return max(point.config.mask.reaction_horizon for point in self.sweep.points)

    def run_of(self, config: Config) -> tuple[Run, Collected]:
        """The trajectories that a config's points share, and the run whose stage they are."""
        run, collected = self.collected[data_name(config)]
        return dataclasses.replace(run, config=config), collected

    def numbers(self, config: Config, stage: str) -> dict[str, float]:
        """What traced axes set in a stage."""
        return grid.numbers(config, stage, self.sweep.axes, self.sweep.base)

    def shape_of(self, config: Config, stage: str) -> FitConfig:
        """A stage's config without what traced axes set: equal for models of one program."""
        own, base = getattr(config, stage), getattr(self.sweep.base, stage)
        traced = {name: getattr(base, name) for name in self.numbers(config, stage)}
        return dataclasses.replace(own, **traced)


def distinct(configs: Iterable[Config], name: Callable[[Config], str]) -> list[Config]:
    """The first config of each name."""
    return list({name(config): config for config in reversed(list(configs))}.values())[::-1]


def digest(*parts: Any) -> str:
    """Of configs and integers: equal for equal ones, in every process."""
    plain = [part if isinstance(part, int) else asdict(part) for part in parts]
    return hashlib.sha256(json.dumps(plain).encode()).hexdigest()[:12]


def data_name(config: Config) -> str:
    """What trajectories depend on, as a folder's name."""
    rest = digest(config.collect, config.expert, config.eval.rollouts)
    return f"{config.system}-seed{config.seed}-{rest}"


def encoder_name(config: Config) -> str:
    """What a β-VAE depends on."""
    return f"{data_name(config)} {digest(config.vae)}"


def encoder_stage(config: Config) -> str:
    """The name that its data's store keeps a β-VAE by."""
    return f"disentangle {digest(config.vae)}"


def collect(work: Work, config: Config) -> tuple[Run, Collected]:
    """The trajectories of a config's points.

    Of several processes each makes them, and none keeps them: Orbax saves only what all save.
    """
    base = work.sweep.base
    changes = {name: getattr(base, name) for name in ("vae", "mask", "bc")}
    own = dataclasses.replace(config, **changes)
    folder = work.log.stages / data_name(config)
    if jax.process_count() > 1:
        store = Nowhere()
    else:
        begun = (folder / "config.json").is_file()
        store = Store(folder, own, begun, home=work.log.directory)
    run = Run(own, store, work.reporter, {}, work.interruption)
    return run, stages.collect(run)


def train_encoders(work: Work, configs: Sequence[Config]) -> None:
    """Trains, or loads, the β-VAEs of the configs, and judges them."""
    missing: dict[Any, list[Config]] = defaultdict(list)
    for config in distinct(configs, encoder_name):
        run, collected = work.run_of(config)
        job = _vae_job(work, config)
        saved = run.store.load(encoder_stage(config), lambda j=job: j.state(j.data()), ["collect"])
        if saved:
            _judge(work, config, saved[0].variables)
        else:
            samples = int(collected.random.valid.sum())
            missing[work.shape_of(config, "vae"), samples].append(config)
    for (shape, samples), group in missing.items():
        jobs = [_vae_job(work, config) for config in group]
        for batch_ in train(work, "β-VAE", disentangle.objective, shape, samples, jobs):
            for trained in batch_:
                _keep_encoder(work, group[trained.job], trained)


def train(
    work: Work,
    what: str,
    objective: Objective,
    shape: FitConfig,
    samples: int,
    jobs: Sequence[Job],
) -> Iterator[list[Trained]]:
    """Trains jobs in batches, with a bar, until asked to stop."""
    total = shape.steps(samples) * len(jobs)
    with work.reporter.bar(f"{what} × {len(jobs)}", total) as bar:

        def progress(done: int) -> None:
            bar.update(done, "model-steps")
            work.interruption.check()

        yield from batch.train_all(objective, shape, samples, jobs, work.budget, progress)


def _vae_job(work: Work, config: Config) -> Job:
    run, collected = work.run_of(config)

    def images() -> jax.Array:
        return stages.valid_frames(run.system, collected.random)[0]

    return Job(
        partial(stages.initial_disentangler, run),
        work.numbers(config, "vae"),
        stages.disentangling_key(run),
        data_name(config),
        images,
    )


def _keep_encoder(work: Work, config: Config, trained: Trained) -> None:
    if not stages.finite(trained.state):
        work.encoders[encoder_name(config)] = None
        return
    run, _ = work.run_of(config)
    state = jax.tree.map(jnp.asarray, trained.state)
    notes = {"seconds": trained.seconds}
    run.store.save(encoder_stage(config), int(state.step), state, notes, ["collect"])
    _judge(work, config, state.variables)


def _judge(work: Work, config: Config, variables: Any) -> None:
    """Hoeffding's D for all thresholds and horizons at once, and what the latents are."""
    run, collected = work.run_of(config)
    vae = stages.judge_disentangler(run, collected, variables)
    latents = stages.first_latents(run, collected, vae)
    first = collected.expert.states[:, 0]
    share = np.asarray(results.nuisance_share(run, collected, vae))
    work.encoders[encoder_name(config)] = Encoder(
        vae, share, np.asarray(hoeffding_d(first, latents))
    )
    if data_name(config) not in work.actions:
        actions = collected.expert.actions[:, : work.longest]
        d = hoeffding_d(first, actions.reshape(len(actions), -1))
        work.actions[data_name(config)] = np.asarray(d).reshape(-1, *actions.shape[1:])


def find_masks(work: Work, points: Sequence[Point]) -> dict[int, tuple[np.ndarray, float]]:
    """The mask [O] and the threshold of every point; all thresholds of a β-VAE in one pass."""
    groups: dict[Any, list[Point]] = defaultdict(list)
    for point in points:
        groups[encoder_name(point.config), point.config.mask.reaction_horizon].append(point)
    found = {}
    for (name, horizon), group in groups.items():
        encoder = work.encoders.get(name)
        if encoder is None:  # diverged, or not needed any more
            continue
        d = encoder.state_observation
        acted = work.actions[data_name(group[0].config)][:, :horizon]
        tests = d.size + acted.size
        count = group[0].config.collect.expert_trajectories
        rules = [point.config.mask for point in group]
        gammas = [mask.effective_threshold(m.threshold, m.alpha, count, tests) for m in rules]
        causes = mask.potential_causes(d, acted, np.array(gammas))
        masks = np.asarray(~causes.any(axis=(2, 3)))
        for point, one, gamma in zip(group, masks, gammas, strict=True):
            found[point.index] = one, gamma
    return found
