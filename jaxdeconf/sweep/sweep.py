"""A sweep: the stages of a run over a grid of configs, what points share done once, in batches.

Trajectories are shared by points of one seed, β-VAEs by points of one β-VAE config, policies by
points whose method sees the same: a sweep over thresholds trains few. Models of one shape train
together (`batch`). A point's row is on disk as soon as its last policy has driven.

With several processes (`jax.distributed`) all run this same program, and the first alone writes:
rows, by which a sweep goes on, but not what points share, which each of them makes again. They need
the same directory and the same kind of machine.
"""

import threading
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from jaxdeconf import systems, threads
from jaxdeconf.learn.fit import FitState, Training
from jaxdeconf.method import Ask, Method, cloning, imitated
from jaxdeconf.methods import METHODS
from jaxdeconf.pipeline import judge, machine
from jaxdeconf.pipeline.checkpoint import fingerprint
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.results import Judged, Losses, Row
from jaxdeconf.pipeline.run import demonstrations_for
from jaxdeconf.pipeline.stages import finite
from jaxdeconf.sweep import sights
from jaxdeconf.sweep.batch import Job, Trained, lots
from jaxdeconf.sweep.grid import Point
from jaxdeconf.sweep.log import Log, Sweep
from jaxdeconf.sweep.shared import (
    PointMask,
    Work,
    data_name,
    data_of,
    digest,
    encoder_name,
    evidence_of,
    find_masks,
    train,
    train_encoders,
)
from jaxdeconf.systems import System


class Name(NamedTuple):
    """What a policy depends on: points of the same name share it."""

    method: Method  # without what only names it
    data: str
    sees: str  # fingerprint of what it is made from beside the trajectories
    clone: str


def sweep(
    sweep: Sweep,
    log: Log,
    reporter: Reporter,
    interruption: Interruption,
    budget: float,
    shard: tuple[int, int] = (1, 1),
    system: System | None = None,
) -> list[Row]:
    """Does, or finishes, a sweep or one shard of it.

    Args:
      sweep: the grid.
      log: where rows go; those that are there are not done again.
      reporter: the screen.
      interruption: asks it to stop.
      budget: bytes that a batch of models may take.
      shard: (i, n): the i-th of n parts of the points, which others do elsewhere.
      system: what moves, yours say; None: the one that the base names.
    Returns:
      The rows of all points that are done.
    Raises:
      StoreError, WriteError, Interrupted: as a run does.
    """
    system = systems.get(sweep.base.system) if system is None else system
    work = Work(sweep, system, log, reporter, interruption, budget)
    points = part(sweep.points, shard)
    done = {row.point: row for row in log.rows()}
    train_encoders(work, [point.config for point in points if point.index not in done])

    def keep(name: str, rows: list[Row]) -> None:
        if rows and jax.process_index() == 0:
            log.append(rows)
            reporter.console.print(f"{name}: {len(rows)} points done", highlight=False)

    _finish(work, points, done, keep)
    return log.rows()


def part(points: Sequence[Point], shard: tuple[int, int]) -> list[Point]:
    """The points of a shard: neighbours, which share more than points far apart."""
    i, n = shard
    return list(points[(i - 1) * len(points) // n : i * len(points) // n])


def _finish(
    work: Work,
    points: Sequence[Point],
    done: dict[int, Row],
    keep: Callable[[str, list[Row]], None],
) -> None:
    """Clones what the points need; keeps rows as they become complete."""
    masks = find_masks(work, points)
    jobs, needs = _needed(work, points, masks)
    judged: dict[Name, Judged] = {}
    seconds: dict[Name, float] = {}
    for point in points:  # what an earlier process found
        for method, name in needs[point.index].items():
            if point.index in done:
                judged[name] = done[point.index].policies[method]
                seconds[name] = done[point.index].seconds[method]
    waiting = [point for point in points if point.index not in done]

    def complete() -> list[Row]:
        rows = []
        for point in [p for p in waiting if judged.keys() >= {*needs[p.index].values()}]:
            waiting.remove(point)
            names = needs[point.index].items()
            row = _row(work, point, masks.get(point.index), {m: judged[name] for m, name in names})
            rows.append(row._replace(seconds={m: seconds[name] for m, name in names}))
        return rows

    keep("masks", complete())
    wanted = {name for point in waiting for name in needs[point.index].values()} - judged.keys()
    groups: dict[Any, list[Name]] = defaultdict(list)
    for name in [name for name in jobs if name in wanted]:
        groups[jobs[name][1].shape].append(name)
    one_at_a_time = threading.Lock()

    def clone(names: list[Name], alone: bool) -> None:
        for batch in train(work, "policies", [jobs[name][1] for name in names]):
            found = [names[one.job] for one in batch]
            come_to = _judge(work, [(*jobs[names[one.job]], one) for one in batch])
            with one_at_a_time:
                judged.update(zip(found, come_to, strict=True))
                seconds.update(zip(found, (one.seconds for one in batch), strict=True))
                keep("policies", complete())
            if alone:  # nobody else is in the middle of a program
                machine.forget_programs()

    order, stop = [*groups.values()], work.interruption.stop
    for lot in lots([[jobs[name][1] for name in names] for names in order], work.budget):
        clones = [partial(clone, order[i], lot.at_once == 1) for i in lot.groups]
        threads.together(clones, lot.at_once, stop)
        machine.forget_programs()


def _needed(
    work: Work, points: Sequence[Point], masks: dict[int, PointMask]
) -> tuple[dict[Name, tuple[Point, Job]], dict[int, dict[str, Name]]]:
    """The policies to clone, name -> whose and how; and the names of each point's, by method."""
    jobs, needs = {}, {}
    for point in points:
        methods = point.config.methods if point.index in masks else ()
        own = {method: _job(work, point, method, masks[point.index].mask) for method in methods}
        needs[point.index] = {method: name for method, (name, _) in own.items()}
        for name, job in own.values():
            jobs.setdefault(name, (point, job))
    return jobs, needs


def _job(work: Work, point: Point, name: str, found: np.ndarray) -> tuple[Name, Job]:
    """What a point's method depends on, and its training."""
    config, method = point.config, METHODS[name]
    run, trial, _ = data_of(work, config)
    lengths = np.asarray(trial.collected.expert.valid).sum(axis=1)

    def watch(name: str, inner: Training) -> FitState:
        """What points train before their policies is kept by all that it follows from."""
        own = digest(inner.config, fingerprint(inner.made_from))
        return run.watch(f"{name} {own}", inner, trial.collected)

    training = cloning(
        method,
        lambda: demonstrations_for(config, trial.system, trial.collected),
        imitated(lengths, config.clone),
        evidence_of(work, config, name, found),
        Ask(config.clone, run.key, watch),
    )
    data, sees = data_name(config), fingerprint(training.made_from)
    # Without what only the training depends on: the same frames are held once.
    frames = method.view, method.data, method.extra, data, sees, config.clone.trajectory_steps
    if training.like is not None:  # then the data may follow from how they are learnt
        frames = *frames, digest(training.config)
    recipe = method._replace(
        note="", needs=(), kind="fair", rival=False, select=None, strength=None, price=None
    )
    return Name(recipe, data, sees, digest(training.config)), Job(
        training, frames, method.kind_of_data
    )


def _judge(work: Work, policies: Sequence[tuple[Point, Job, Trained]]) -> list[Judged]:
    """What trained policies come to; with several processes, each lets its share drive."""
    count = jax.process_count()
    unknown = Judged(Losses(np.nan, np.nan), np.nan, np.nan, np.nan, np.nan)
    leaves, form = jax.tree.flatten(unknown)
    mine = np.full((len(policies), len(leaves)), np.nan)

    def one(i: int) -> list[float]:
        point, job, trained = policies[i]
        policy = job.training.trained(jax.tree.map(jnp.asarray, trained.state))
        trial = data_of(work, point.config).trial
        found, _ = judge.judge_policy(trial, policy, trained.loss)
        if work.sweep.compares:
            found, sight = judge.compared(trial, policy, found)
            if sights.asked(work.sweep, point):
                sights.keep(work.log.directory, point.index, sight)
        return jax.tree.leaves(found)

    share = range(jax.process_index(), len(policies), count)
    of = [i for i in share if finite(policies[i][2].state)]
    for i, found in zip(of, threads.each(one, of), strict=True):
        mine[i] = found
    whole = multihost_utils.process_allgather(mine).reshape(-1, *mine.shape)
    judged = []
    for i, (_, _, trained) in enumerate(policies):
        found = jax.tree.unflatten(form, map(float, whole[i % count, i]))
        judged.append(found._replace(train_loss=float(trained.loss)))
    return judged


def _row(work: Work, point: Point, found: PointMask | None, policies: dict[str, Judged]) -> Row:
    """A point's line. Numbers that are not finite are said to have diverged."""
    if found is None:
        return Row(point.index, point.values, ["disentangle"])
    encoder = work.encoders[encoder_name(point.config)]
    assert encoder is not None  # it has a mask
    precision, recall = judge.precision_recall(found.mask, encoder.encoder, encoder.share)
    return Row(
        point=point.index,
        values=point.values,
        diverged=[m for m, one in policies.items() if not np.isfinite(one.rollout_loss.mean)],
        policies=policies,
        threshold=found.threshold,
        mask=found.mask & np.asarray(encoder.encoder.active),
        active=np.asarray(encoder.encoder.active),
        nuisance_share=encoder.share,
        precision=precision,
        recall=recall,
        expert=data_of(work, point.config).expert,
    )
