"""What points of a sweep share, each done once: trajectories, β-VAEs, and masks in one pass."""

import dataclasses
import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf import collect, mask
from jaxdeconf.deconfound import first_latents
from jaxdeconf.learn import disentangle
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.learn.fit import Training
from jaxdeconf.method import Evidence
from jaxdeconf.methods import METHODS
from jaxdeconf.pipeline import judge
from jaxdeconf.pipeline.checkpoint import fingerprint
from jaxdeconf.pipeline.config import Config, fitting
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.judge import Trial
from jaxdeconf.pipeline.plain import to_plain
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.results import JudgedExpert
from jaxdeconf.pipeline.run import collect_for, evidence_for, region_for
from jaxdeconf.pipeline.stages import Run, finite
from jaxdeconf.pipeline.store import Nowhere, Store, free
from jaxdeconf.sweep.batch import Job, Trained, train_all
from jaxdeconf.sweep.grid import Point
from jaxdeconf.sweep.log import Log, Sweep
from jaxdeconf.systems import System


class Data(NamedTuple):
    """The trajectories of a config's points."""

    run: Run  # whose stage they are
    trial: Trial
    expert: JudgedExpert


class Found(NamedTuple):
    """A β-VAE, and what its latents are."""

    encoder: Encoder
    share: np.ndarray  # [O] of each one's variance, what the previous action explains


@dataclass
class Work:
    """A sweep in progress."""

    sweep: Sweep
    system: System
    log: Log
    reporter: Reporter
    interruption: Interruption
    budget: float  # bytes
    data: dict[str, Data] = field(default_factory=dict)  # by data_name
    encoders: dict[str, Found | None] = field(default_factory=dict)  # None: diverged
    regions: dict[Any, Array | None] = field(default_factory=dict)  # by all they follow from


def distinct(configs: Iterable[Config], name: Callable[[Config], str]) -> list[Config]:
    """The first config of each name."""
    return list({name(config): config for config in reversed(list(configs))}.values())[::-1]


def digest(*parts: Any) -> str:
    """Of configs and integers: equal for equal ones, in every process."""
    return hashlib.sha256(json.dumps(to_plain(parts)).encode()).hexdigest()[:12]


def data_name(config: Config) -> str:
    """What trajectories depend on, as a folder's name."""
    rest = digest(config.collect, config.expert, config.evaluate.rollouts)
    return f"{config.system}-seed{config.seed}-{rest}"


def encoder_name(config: Config) -> str:
    """What a β-VAE depends on."""
    return f"{data_name(config)} {digest(config.disentangle)}"


def _encoder_stage(config: Config) -> str:
    """The name that its data's store keeps a β-VAE by."""
    return f"disentangle {digest(config.disentangle)}"


def data_of(work: Work, config: Config) -> Data:
    """The trajectories of a config's points, loaded or collected once.

    Of several processes each makes them, and none keeps them: one cannot wait for another's.
    """
    name, base = data_name(config), work.sweep.base
    if name not in work.data:
        changes = {part: getattr(base, part) for part in ("disentangle", "mask", "clone")}
        own = dataclasses.replace(config, **changes, methods=())
        folder = work.log.stages / name
        if jax.process_count() > 1:
            store = Nowhere()
        else:
            store = Store(folder, own, not free(folder), home=work.log.directory)
        system = fitting(own, work.system)
        run = Run(own, store, work.reporter, work.interruption)
        collected = run.stage("collect", lambda: collect_for(own, system, run.key))
        trial = judge.trial(system, run.key, collected)
        work.data[name] = Data(run, trial, judge.judge_expert(system, collected))
    return work.data[name]


def train_encoders(work: Work, configs: Sequence[Config]) -> None:
    """Trains, or loads, the β-VAEs of the configs, and judges them."""
    missing: dict[Any, list[tuple[Config, Job]]] = defaultdict(list)
    for config in distinct(configs, encoder_name):
        run, trial, _ = data_of(work, config)
        training = _disentangling(trial, config)
        made_from = {"collect": fingerprint(trial.collected)}
        saved = run.store.load(
            _encoder_stage(config), lambda t=training: t.start(t.data()), made_from
        )
        if saved:
            _judge(work, config, training.trained(saved[0]))
        else:
            job = Job(training, data_name(config))
            missing[job.shape].append((config, job))
    for group in missing.values():
        for batch in train(work, "β-VAE", [job for _, job in group]):
            for trained in batch:
                _keep(work, *group[trained.job], trained)


def _disentangling(trial: Trial, config: Config) -> Training:
    random, system = trial.collected.random, trial.system
    return disentangle.training(
        config.disentangle,
        lambda: collect.exploration(system, random).images,
        int(random.valid.sum()),
        lambda: trial.held_out.images,
        trial.key,
    )


def train(work: Work, what: str, jobs: Sequence[Job]) -> Iterator[list[Trained]]:
    """Trains jobs of one shape in batches, with a bar, until asked to stop."""
    first = jobs[0].training
    total = first.config.total_steps(first.samples) * len(jobs)
    with work.reporter.bar(f"{what} × {len(jobs)}", total) as bar:

        def progress(done: int, loss: float) -> None:
            bar.update(done, f"mean loss {loss:.4g}")
            work.interruption.check()

        yield from train_all(jobs, work.budget, progress)


def _keep(work: Work, config: Config, job: Job, trained: Trained) -> None:
    if not finite(trained.state):
        work.encoders[encoder_name(config)] = None
        return
    run, trial, _ = data_of(work, config)
    state = jax.tree.map(jnp.asarray, trained.state)
    made_from = {"collect": fingerprint(trial.collected)}
    notes = {"seconds": trained.seconds}
    run.store.save(_encoder_stage(config), int(state.step), state, notes, made_from)
    _judge(work, config, job.training.trained(state))


def _judge(work: Work, config: Config, encoder: Encoder) -> None:
    share = judge.judge_latents(data_of(work, config).trial, encoder).nuisance_share
    work.encoders[encoder_name(config)] = Found(encoder, np.asarray(share))


def evidence_of(work: Work, config: Config, method: str, mask: np.ndarray) -> Evidence:
    """What a method may be made from, given a point's mask [O]."""
    trial, found = data_of(work, config).trial, work.encoders[encoder_name(config)]
    assert found is not None  # it has a mask
    encoder, latents = found.encoder, jnp.asarray(mask)
    of = encoder_name(config), mask.tobytes(), "region" in METHODS[method].needs
    if of not in work.regions:
        work.regions[of] = region_for(trial, encoder, latents, [method])
    return evidence_for(config, trial, encoder, latents, work.regions[of])


class PointMask(NamedTuple):
    """A point's mask."""

    mask: np.ndarray  # [O] bool
    threshold: float


def find_masks(work: Work, points: Sequence[Point]) -> dict[int, PointMask]:
    """The mask of every point whose β-VAE there is, all thresholds and horizons in one pass."""
    groups: dict[Any, list[Point]] = defaultdict(list)
    for point in points:
        rule = point.config.mask
        groups[encoder_name(point.config), rule.statistic, rule.states_together].append(point)
    found = {}
    for (name, *_), group in groups.items():
        encoder = work.encoders.get(name)
        if encoder is not None:  # not diverged, and needed
            found |= _masks(data_of(work, group[0].config).trial, encoder.encoder, group)
    return found


def _masks(trial: Trial, encoder: Encoder, points: Sequence[Point]) -> dict[int, PointMask]:
    """The masks of points that share all but threshold, alpha and reaction horizon."""
    rules = [point.config.mask for point in points]
    longest = max(rule.reaction_horizon for rule in rules)
    demos = collect.demonstrations(trial.system, trial.collected.expert, longest)
    latents = first_latents(encoder, demos)
    count, states = demos.initial_states.shape
    latent, action = latents.shape[1], demos.actions.shape[2]
    statistic, together = rules[0].statistic, rules[0].states_together

    def gamma(rule: mask.MaskConfig) -> float:
        tests = mask.family(states, latent + rule.reaction_horizon * action, together)
        return float(mask.effective_threshold(rule.threshold, rule.alpha, count, tests))

    gammas = [gamma(rule) for rule in rules]
    found = mask.find_mask(
        demos.initial_states, latents, demos.actions, np.array(gammas), None, statistic, together
    )
    masks = {h: np.asarray(found.within(h)) for h in {rule.reaction_horizon for rule in rules}}
    return {
        point.index: PointMask(masks[rule.reaction_horizon][place], gammas[place])
        for place, (point, rule) in enumerate(zip(points, rules, strict=True))
    }
