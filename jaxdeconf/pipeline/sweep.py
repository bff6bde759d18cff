"""A sweep: the stages of a run over a grid of configs, what points share done once, in batches.

Trajectories are shared by points of one seed, β-VAEs by points of one β-VAE config, policies by
points with the same mask: a sweep over thresholds trains few. Models of one shape train together
(`batch`). A point's row is on disk as soon as its last policy has driven.

With several processes (`jax.distributed`) all run this same program, and the first alone writes:
rows, by which a sweep goes on, but not what points share, which each of them makes again. They need
the same directory and the same kind of machine.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from jaxdeconf import evaluate
from jaxdeconf.learn import clone
from jaxdeconf.pipeline import findings, stages
from jaxdeconf.pipeline.batch import Job, Trained
from jaxdeconf.pipeline.grid import Point
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.sweep_log import Log, Row, Sweep
from jaxdeconf.pipeline.sweep_stages import (
    Work,
    collect,
    data_name,
    digest,
    distinct,
    encoder_name,
    find_masks,
    train,
    train_encoders,
)

# Columns of what a policy's rollouts come to.
_JUDGED = ("rollout_loss", "std", "outcome")


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
    configs = [point.config for point in mine if point.index not in done]
    for config in distinct(configs, data_name):
        work.collected[data_name(config)] = collect(work, config)
    train_encoders(work, configs)
    for name, rows in _finish(work, mine, done):
        if jax.process_index() == 0:
            log.append(rows)
            reporter.console.print(f"{name}: {len(rows)} points done", highlight=False)
    return log.rows()


def part(all_points: Sequence[Point], shard: tuple[int, int]) -> list[Point]:
    """The points of a shard: neighbours, which share more than points far apart."""
    i, n = shard
    return list(all_points[(i - 1) * len(all_points) // n : i * len(all_points) // n])


def _finish(
    work: Work, points: Sequence[Point], done: dict[int, Row]
) -> Iterator[tuple[str, list[Row]]]:
    """Clones what the points need; yields rows as they become complete."""
    masks = find_masks(work, points)
    policies, needs = _needed(work, points, masks)
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
    for name in [name for name in policies if name in wanted]:
        groups[work.shape_of(policies[name][0].config, "bc")].append(name)
    for shape, names in groups.items():
        for found in _clone(work, shape, names, policies, masks):
            judged |= found
            if rows := complete():
                yield "policies", rows


def _needed(
    work: Work, points: Sequence[Point], masks: dict[int, tuple[np.ndarray, float]]
) -> tuple[dict[str, tuple[Point, str]], dict[int, dict[str, str]]]:
    """The policies to clone, name -> whose and which; and of each point, policy -> name."""
    policies, needs = {}, {}
    for point in points:
        needs[point.index] = {}
        for policy in work.sweep.policies if point.index in masks else ():
            name = _policy_name(work, point, policy, masks[point.index][0])
            policies.setdefault(name, (point, policy))
            needs[point.index][policy] = name
    return policies, needs


def _policy_name(work: Work, point: Point, policy: str, found: np.ndarray) -> str:
    """What a policy depends on: points of the same name share it."""
    config, sees = point.config, ""
    if policy == "Masked":
        active = np.asarray(work.encoders[encoder_name(config)].vae.active)  # type: ignore
        sees = f"{encoder_name(config)} {(active & ~found).astype(int).tolist()}"
    if policy == "Reconstructed":
        sees = encoder_name(config)
    return f"{policy} {data_name(config)} {sees} {digest(config.bc)}"


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
                lambda _, r=run: stages.initial_policy(r),
                work.numbers(point.config, "bc"),
                stages.cloning_key(run),
                seen,
                partial(stages.demonstrations, run.system, view[0], view[1], steps),
            )
        )
    point, _ = policies[names[0]]
    samples = stages.imitated_steps(point.config.bc, work.run_of(point.config)[1]).valid.size
    for trained in train(work, "policies", clone.objective, shape, samples, jobs):
        judged = _drive(
            work, [(policies[names[one.job]][0], views[one.job], one) for one in trained]
        )
        yield {names[one.job]: found for one, found in zip(trained, judged, strict=True)}


def _drive(work: Work, policies: Sequence[tuple[Point, Any, Trained]]) -> list[dict[str, float]]:
    """What trained policies come to; with several processes, each lets its share drive."""
    mine = np.full((len(policies), len(_JUDGED)), np.nan)
    for i, (point, (view, parameters), trained) in enumerate(policies):
        if i % jax.process_count() == jax.process_index() and stages.finite(trained.state):
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
