"""A sweep: the stages of a run over a grid of configs, what points share done once, in batches.

Trajectories are shared by points of one seed, β-VAEs by points of one β-VAE config, policies by
points with the same mask: a sweep over thresholds trains few. Models of one shape train together
(`batch`). A point's row is on disk as soon as its last policy has driven.

With several processes (`jax.distributed`) all run this same program. The first alone writes, and
the others read what it wrote: they need the same directory.
"""

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
from jax.experimental import multihost_utils

from jaxdeconf import evaluate, mask
from jaxdeconf.independence import hoeffding_d
from jaxdeconf.learn import clone, disentangle
from jaxdeconf.learn.fit import FitConfig, FitState, Objective
from jaxdeconf.pipeline import batch, findings, grid, results, stages
from jaxdeconf.pipeline.batch import Job, Trained
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.grid import Point
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.stages import Collected, Disentangled, Run
from jaxdeconf.pipeline.store import Store
from jaxdeconf.pipeline.sweep_log import Log, Row, Sweep

# Columns of what a policy's rollouts come to.
_JUDGED = ("rollout_loss", "std", "outcome")


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


def sweep(
    asked: Sweep,
    log: Log,
    reporter: Reporter,
    interruption: Interruption,
    budget: float,
    shard: tuple[int, int] = (1, 1),
) -> list[Row]:
    """Does, or finishes, a sweep or one shard of it.

    Args:
      asked: the grid.
      log: where rows go; those that are there are not done again.
      reporter: the screen.
      interruption: asks it to stop.
      budget: bytes that a batch of models may take.
      shard: (i, n): the i-th of n parts of the points, which others do elsewhere.
    Returns:
      The rows of all points that are done.
    Raises:
      StoreError, WriteError, Interrupted: as a run does.
    """
    work = Work(asked, log, reporter, interruption, budget)
    mine = part(asked.points, shard)
    done = {row["point"]: row for row in log.rows()}
    if all(point.index in done for point in mine):
        return log.rows()
    for config in distinct((point.config for point in mine), data_name):
        work.collected[data_name(config)] = collect(work, config)
    train_encoders(work, [point.config for point in mine])
    for name, rows in _finish(work, mine, done):
        if jax.process_index() == 0:
            log.append(rows)
        reporter.console.print(f"{name}: {len(rows)} points done", highlight=False)
    return log.rows()


def part(all_points: Sequence[Point], shard: tuple[int, int]) -> list[Point]:
    """The points of a shard: neighbours, which share more than points far apart."""
    i, n = shard
    return list(all_points[(i - 1) * len(all_points) // n : i * len(all_points) // n])


def distinct(configs: Iterable[Config], name: Callable[[Config], str]) -> list[Config]:
    """The first config of each name."""
    return list({name(config): config for config in reversed(list(configs))}.values())[::-1]


def _digest(*parts: Any) -> str:
    plain = [part if isinstance(part, int) else asdict(part) for part in parts]
    return hashlib.sha256(json.dumps(plain).encode()).hexdigest()[:12]


def data_name(config: Config) -> str:
    """What trajectories depend on, as a folder's name."""
    rest = _digest(config.collect, config.expert, config.eval.rollouts)
    return f"{config.system}-seed{config.seed}-{rest}"


def encoder_name(config: Config) -> str:
    """What a β-VAE depends on."""
    return f"{data_name(config)} {_digest(config.vae)}"


def collect(work: Work, config: Config) -> tuple[Run, Collected]:
    """The trajectories of a config's points; made once, by the first process."""
    base = work.sweep.base
    changes = {name: getattr(base, name) for name in ("vae", "mask", "bc")}
    own = dataclasses.replace(config, **changes)
    folder = work.log.stages / data_name(config)

    def open_and_collect() -> tuple[Run, Collected]:
        store = Store(folder, own, resume=(folder / "config.json").is_file())
        run = Run(own, store, work.reporter, {}, work.interruption)
        return run, stages.collect(run)

    return in_turn(open_and_collect)


def in_turn(work: Callable[[], Any]) -> Any:
    """The first process does it, and then the others, which find its files."""
    if jax.process_count() == 1:
        return work()
    first = jax.process_index() == 0
    value = work() if first else None
    multihost_utils.sync_global_devices("sweep")
    return value if first else work()


def finite(tree: Any) -> bool:
    """Whether all numbers are finite."""
    return all(bool(np.isfinite(np.asarray(leaf)).all()) for leaf in jax.tree.leaves(tree))


def train_encoders(work: Work, configs: Sequence[Config]) -> None:
    """Trains, or loads, the β-VAEs of the configs, and judges them."""
    missing: dict[Any, list[Config]] = defaultdict(list)
    for config in distinct(configs, encoder_name):
        run, collected = work.run_of(config)
        images, _ = stages.valid_frames(run.system, collected.random)
        stage = f"disentangle {_digest(config.vae)}"
        saved = run.store.load(stage, partial(_first_vae, config, run, images), ["collect"])
        if saved:
            _judge(work, config, saved[0].variables)
        else:
            missing[work.shape_of(config, "vae"), len(images)].append(config)
    for (shape, samples), group in missing.items():
        jobs = [_vae_job(work, config) for config in group]
        for batch_ in _train(work, "β-VAE", disentangle.objective, shape, samples, jobs):
            for trained in batch_:
                _keep_encoder(work, group[trained.job], trained)


def _train(
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

        def progress(done: int, _: int) -> None:
            bar.update(done, "model-steps")
            work.interruption.check()

        yield from batch.train_all(objective, shape, samples, jobs, work.budget, progress)


def _first_vae(config: Config, run: Run, images: jax.Array) -> FitState:
    return disentangle.initial_state(config.vae, images, run.key("VAE initial weights"))


def _vae_job(work: Work, config: Config) -> Job:
    run, collected = work.run_of(config)

    def images() -> jax.Array:
        return stages.valid_frames(run.system, collected.random)[0]

    return Job(
        lambda: _first_vae(config, run, images()),
        work.numbers(config, "vae"),
        run.key("VAE training"),
        data_name(config),
        images,
    )


def _keep_encoder(work: Work, config: Config, trained: Trained) -> None:
    if not finite(trained.state):
        work.encoders[encoder_name(config)] = None
        return
    run, _ = work.run_of(config)
    state = jax.tree.map(jnp.asarray, trained.state)
    if jax.process_index() == 0:
        name, notes = f"disentangle {_digest(config.vae)}", {"seconds": trained.seconds}
        run.store.save(name, int(state.step), state, notes, ["collect"])
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
        encoder = work.encoders[name]
        if encoder is None:
            continue
        d = encoder.state_observation
        acted = work.actions[data_name(group[0].config)][:, :horizon]
        tests = d.size + acted.size
        _, collected = work.run_of(group[0].config)
        count = len(collected.expert.states)
        rules = [point.config.mask for point in group]
        gammas = [mask.effective_threshold(m.threshold, m.alpha, count, tests) for m in rules]
        causes = mask.potential_causes(d, acted, np.array(gammas))
        masks = np.asarray(~causes.any(axis=(2, 3)))
        for point, one, gamma in zip(group, masks, gammas, strict=True):
            found[point.index] = one, gamma
    return found


def _finish(
    work: Work, points: Sequence[Point], done: dict[int, Row]
) -> Iterator[tuple[str, list[Row]]]:
    """Clones what the points need; yields rows as they become complete."""
    masks = find_masks(work, points)
    policies: dict[str, tuple[Point, str]] = {}  # name -> whose, and which
    needs: dict[int, dict[str, str]] = {}  # point -> policy -> name
    for point in points:
        needs[point.index] = {}
        for policy in work.sweep.policies if point.index in masks else ():
            name = _policy_name(work, point, policy, masks[point.index][0])
            policies.setdefault(name, (point, policy))
            needs[point.index][policy] = name
    judged: dict[str, dict[str, float]] = {}
    for point in points:  # what an earlier process found
        for policy, name in needs[point.index].items():
            if point.index in done:
                judged[name] = done[point.index]["policies"][policy]
    waiting = [point for point in points if point.index not in done]

    def complete() -> list[Row]:
        rows = []
        for point in [p for p in waiting if all(n in judged for n in needs[p.index].values())]:
            waiting.remove(point)
            rows.append(_row(work, point, masks.get(point.index), needs[point.index], judged))
        return rows

    if rows := complete():
        yield "masks", rows
    wanted = {name for point in waiting for name in needs[point.index].values()} - judged.keys()
    groups: dict[Any, list[str]] = defaultdict(list)
    for name, (point, policy) in policies.items():
        if name in wanted:
            kind = (
                policy if policy in ("BcVanilla", "BcManual") else _digest(point.config.vae.network)
            )
            groups[work.shape_of(point.config, "bc"), kind].append(name)
    for (shape, _), names in groups.items():
        for found in _clone(work, shape, names, policies, masks):
            judged |= found
            if rows := complete():
                yield "policies", rows


def _policy_name(work: Work, point: Point, policy: str, found: np.ndarray) -> str:
    """What a policy depends on: points of the same name share it."""
    config, sees = point.config, ""
    if policy == "Masked":
        active = np.asarray(work.encoders[encoder_name(config)].vae.active)  # type: ignore
        sees = f"{encoder_name(config)} {(active & ~found).astype(int).tolist()}"
    if policy == "Reconstructed":
        sees = encoder_name(config)
    return f"{policy} {data_name(config)} {sees} {_digest(config.bc)}"


def _clone(
    work: Work,
    shape: Any,
    names: Sequence[str],
    policies: dict[str, tuple[Point, str]],
    masks: dict[int, tuple[np.ndarray, float]],
) -> Iterator[dict[str, dict[str, float]]]:
    """Trains policies of one shape, lets them drive, and yields what they came to, by name."""
    jobs, views = [], []
    for name in names:
        point, policy = policies[name]
        run, collected = work.run_of(point.config)
        view = _view(work, point, policy, masks[point.index][0])
        views.append(view)
        steps = stages.imitated_steps(point.config.bc, collected)
        # Without what only the policy's training depends on: the same frames are held once.
        seen = name.rpartition(" ")[0] + f" {point.config.bc.trajectory_steps}"
        jobs.append(
            Job(
                partial(stages.initial_policy, run),
                work.numbers(point.config, "bc"),
                run.key("cloning"),
                seen,
                partial(stages.demonstrations, run.system, view[0], view[1], steps),
            )
        )
    point, _ = policies[names[0]]
    samples = stages.imitated_steps(point.config.bc, work.run_of(point.config)[1]).valid.size
    for trained in _train(work, "policies", clone.objective, shape, samples, jobs):
        judged = _drive(
            work, [(policies[names[one.job]][0], views[one.job], one) for one in trained]
        )
        yield {names[one.job]: found for one, found in zip(trained, judged, strict=True)}


def _drive(work: Work, policies: Sequence[tuple[Point, Any, Trained]]) -> list[dict[str, float]]:
    """What trained policies come to; with several processes, each lets its share drive."""
    mine = np.full((len(policies), len(_JUDGED)), np.nan)
    for i, (point, (view, parameters), trained) in enumerate(policies):
        if i % jax.process_count() == jax.process_index() and finite(trained.state):
            run, collected = work.run_of(point.config)
            variables = jax.tree.map(jnp.asarray, trained.state.variables)
            weights = evaluate.Weights(variables, parameters)
            driven = stages.drive(run, collected, view, weights)
            loss = evaluate.rollout_loss(run.system, driven)
            outcome = evaluate.outcome(run.system, driven).mean()
            mine[i] = float(loss.mean()), float(loss.std()), float(outcome)
    whole = multihost_utils.process_allgather(mine).reshape(-1, *mine.shape)
    found = [whole[i % jax.process_count(), i] for i in range(len(policies))]
    return [
        dict(zip(_JUDGED, map(float, numbers), strict=True)) | {"train_loss": float(trained.loss)}
        for numbers, (_, _, trained) in zip(found, policies, strict=True)
    ]


def _row(
    work: Work,
    point: Point,
    found: tuple[np.ndarray, float] | None,
    needs: dict[str, str],
    judged: dict[str, dict[str, float]],
) -> Row:
    """A point's line. Numbers that are not finite are null, and said to have diverged."""
    row: Row = {"point": point.index, "values": point.values, "diverged": []}
    if found is None:
        return row | {"diverged": ["disentangle"], "policies": {}}
    run, collected = work.run_of(point.config)
    encoder = work.encoders[encoder_name(point.config)]
    assert encoder is not None  # it has a mask
    masked = found[0] & np.asarray(encoder.vae.active)
    nuisance = (encoder.share >= findings.SAME) & np.asarray(encoder.vae.active)
    right = int((masked & nuisance).sum())
    policies = {policy: _plain(judged[name]) for policy, name in needs.items()}
    return row | {
        "diverged": [name for name, one in policies.items() if one["rollout_loss"] is None],
        "threshold": found[1],
        "mask": masked,
        "active": encoder.vae.active,
        "nuisance_share": encoder.share,
        "precision": right / int(masked.sum()) if masked.any() else None,
        "recall": right / int(nuisance.sum()) if nuisance.any() else None,
        "expert": float(evaluate.rollout_loss(run.system, collected.driven).mean()),
        "policies": policies,
    }


def _plain(judged: dict[str, float]) -> dict[str, float | None]:
    return {k: v if v is not None and np.isfinite(v) else None for k, v in judged.items()}


def _view(work: Work, point: Point, policy: str, found: np.ndarray) -> tuple[Any, Any]:
    run, _ = work.run_of(point.config)
    encoder = work.encoders[encoder_name(point.config)]
    return stages.view_of(run, policy, encoder.vae, found)  # type: ignore
