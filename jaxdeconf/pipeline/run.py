"""One run from a config to its results: collect, disentangle, mask, clone, evaluate."""

from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jax import Array

from jaxdeconf import collect, systems, threads
from jaxdeconf.collect import Collected
from jaxdeconf.deconfound import clone_policy, learn_latents, mask_latents
from jaxdeconf.demos import Demos
from jaxdeconf.learn.clone import Policy
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.learn.fit import FitState, Training
from jaxdeconf.mask import Mask
from jaxdeconf.method import Evidence
from jaxdeconf.methods import METHODS
from jaxdeconf.pipeline import judge, machine
from jaxdeconf.pipeline.checkpoint import fingerprint
from jaxdeconf.pipeline.config import Config, fitting
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.judge import JudgedLatents, Trial
from jaxdeconf.pipeline.plain import to_plain
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.results import Judged, OutcomeForm, PValues, Results, finished, save
from jaxdeconf.pipeline.stages import Run
from jaxdeconf.pipeline.store import Store, writing
from jaxdeconf.region import find_region
from jaxdeconf.rivals.simulator import Simulator
from jaxdeconf.systems import System, Trajectories


def run(
    config: Config,
    system: System | None = None,
    directory: Path | str | None = None,
    reporter: Reporter | None = None,
    resume: bool = False,
    interruption: Interruption | None = None,
) -> Results:
    """Does, or finishes, a run; leaves results.json and pictures.npz, which a report is drawn from.

    Args:
      config: what is asked for.
      system: what moves, yours say; None: the one that the config names.
      directory: where everything goes; None: runs/SYSTEM-seedK.
      reporter: the screen.
      resume: go on with the run that is there; if it is finished, say what it found.
      interruption: asks it to stop; by default nothing does.
    Raises:
      StoreError: if the directory, or a checkpoint in it, cannot be used.
      WriteError: if the disk does not take what is written.
      FloatingPointError: if a loss is not finite; says which stage, step and value.
      Interrupted: if asked to stop; everything is saved.
      ValueError: if config and system do not fit, before anything is done.
    """
    system = fitting(config, systems.get(config.system) if system is None else system)
    config = replace(config, system=system.name)
    directory = Path(directory or Path("runs") / f"{system.name}-seed{config.seed}")
    store = Store(directory, config, resume)
    if resume and (found := finished(directory)):
        return found
    this = Run(config, store, reporter or Reporter(), interruption or Interruption())
    collected = this.stage("collect", lambda: collect_for(config, system, this.key))
    trial = judge.trial(system, this.key, collected)
    latents, cloned = _learnt(this, trial)
    with this.timed("judge"):
        about = judge.judge_latents(trial, latents.encoder)
        policies = {name: one.policy for name, one in cloned.items()}
        driven = {name: one.driven for name, one in cloned.items()}
        pictures = judge.pictures(trial, latents.encoder, latents.region, policies, driven)
    judged = {name: one.judged for name, one in cloned.items()}
    found = _results(this, trial, latents, about, judged)
    with writing(directory):
        save(directory, found, pictures)
    return found


class Latents(NamedTuple):
    """What is learnt of the frames alone."""

    encoder: Encoder
    mask: Mask
    region: Array | None  # [H, W] bool, the pixels that masked latents reach, if a method asks


class Cloned(NamedTuple):
    """A policy, and what became of it."""

    policy: Policy
    judged: Judged
    driven: Trajectories  # its last rollouts


def _learnt(this: Run, trial: Trial) -> tuple[Latents, dict[str, Cloned]]:
    """The latents, and the policies of a config's methods, each judged beside what is trained next.

    Whichever needs no latents is cloned beside the β-VAE.
    """
    config, demos = this.config, demonstrations_for(this.config, trial.system, trial.collected)
    at_once, stop = machine.trainings(demos.images.nbytes), this.interruption.stop

    def clone(name: str, known: Evidence) -> tuple[str, Policy, Future[Any]]:
        policy = _clone(this, trial, demos, name, known)
        return name, policy, pool.submit(_judge, this, trial, name, policy)

    def learn() -> Latents:
        encoder, mask = deconfounded(this, trial)
        return Latents(encoder, mask, region_for(trial, encoder, mask.mask, config.methods))

    after = [name for name in config.methods if METHODS[name].needs_latents]
    beside = [name for name in config.methods if name not in after]
    known = evidence_for(config, trial)
    jobs: list[Callable[[], Any]] = [learn, *(partial(clone, name, known) for name in beside)]
    with ThreadPoolExecutor(threads.cores()) as pool:
        latents, *first = threads.together(jobs, at_once, stop)
        known = evidence_for(config, trial, latents.encoder, latents.mask.mask, latents.region)
        last = threads.together([partial(clone, name, known) for name in after], at_once, stop)
        of = {name: Cloned(policy, *judging.result()) for name, policy, judging in first + last}
    this.interruption.check()
    return latents, {name: of[name] for name in config.methods}


def _clone(this: Run, trial: Trial, demos: Demos, name: str, evidence: Evidence) -> Policy:
    """A method's policy, which drives now and then while it is trained."""
    config = this.config

    def drive(policy: Policy) -> list[float]:
        driven = judge.drive(trial, policy, config.evaluate.training_rollouts)
        return [*judge.rollout_loss(trial, driven)[:2]]

    def watch(stage: str, training: Training) -> FitState:
        if stage != f"clone {name}":  # what a method learns before its policy
            return this.watch(stage, training, trial.collected)
        return this.watch(stage, training, trial.collected, config.evaluate.visits(training), drive)

    return clone_policy(name, demos, evidence, this.key, config.clone, watch)


def _judge(this: Run, trial: Trial, name: str, policy: Policy) -> tuple[Judged, Trajectories]:
    """A policy's numbers, and its last rollouts."""
    this.interruption.check()
    stage, history = f"judge {name}", this.history[f"clone {name}"]
    curve = [[epoch, *losses] for epoch, _, *losses in history]
    with this.reporter.bar(stage, 1) as bar, this.clock.running(stage):
        judged, driven = judge.judge_policy(trial, policy, history[-1][1], curve)
        bar.update(1, f"rollout loss {judged.rollout_loss.mean:.3g}")
    return judged, driven


def deconfounded(this: Run, trial: Trial) -> tuple[Encoder, Mask]:
    """The β-VAE, and what Algorithm 1 masks of it."""
    config, system, collected = this.config, trial.system, trial.collected
    images = collect.exploration(system, collected.random).images
    watch = partial(this.watch, data=collected)
    encoder = learn_latents(images, trial.held_out.images, this.key, config.disentangle, watch)
    first = collect.demonstrations(system, collected.expert, config.mask.reaction_horizon)
    made_from = {"collect": fingerprint(collected), "disentangle": fingerprint(encoder)}
    return encoder, this.stage("mask", lambda: mask_latents(encoder, first, config.mask), made_from)


def collect_for(config: Config, system: System, key: Array) -> Collected:
    """The trajectories that a config asks for."""
    return collect.collect(system, config.collect, config.expert, config.evaluate.rollouts, key)


def demonstrations_for(config: Config, system: System, collected: Collected) -> Demos:
    """What is cloned of them, drawn."""
    return collect.demonstrations(system, collected.expert, config.clone.trajectory_steps)


def region_for(
    trial: Trial, encoder: Encoder, mask: Array, methods: Collection[str]
) -> Array | None:
    """The pixels that masked latents reach, if one of the methods needs to know."""
    if not any("region" in METHODS[name].needs for name in methods):
        return None
    return find_region(encoder, mask, trial.held_out.images, trial.key)


def evidence_for(
    config: Config,
    trial: Trial,
    encoder: Encoder | None = None,
    mask: Array | None = None,
    region: Array | None = None,
) -> Evidence:
    """What a method may be made from; a simulator knows all there is."""
    cover = getattr(trial.system.nuisance, "cover", None)
    simulator = Simulator(trial.system, config.expert, trial.collected.expert)
    return Evidence(encoder, mask, region, cover, simulator.label, trial.held_out, simulator)


def _results(
    this: Run, trial: Trial, learnt: Latents, latents: JudgedLatents, judged: dict[str, Judged]
) -> Results:
    config, system, (encoder, mask, region) = this.config, trial.system, learnt
    return Results(
        system=system.name,
        preset=config.preset,
        seed=config.seed,
        state_names=list(system.state_names),
        action_names=list(system.action_names),
        outcome=OutcomeForm(*system.outcome[:3]),
        reaction_horizon=config.mask.reaction_horizon,
        statistic=config.mask.statistic,
        threshold=float(mask.threshold),
        mask=np.asarray(mask.mask),
        region=None if region is None else float(region.mean()),
        state_observation=np.asarray(mask.state_observation),
        state_action=np.asarray(mask.state_action),
        p_values=PValues(np.asarray(mask.p_state_observation), np.asarray(mask.p_state_action)),
        active=np.asarray(encoder.active),
        kl=np.asarray(encoder.kl),
        nuisance_correlation=np.asarray(latents.nuisance_correlation),
        nuisance_share=np.asarray(latents.nuisance_share),
        reconstruction=latents.reconstruction,
        expert=judge.judge_expert(system, trial.collected),
        policies=judged,
        seconds=this.seconds,
        peak_memory_mb=machine.peak_memory_mb(),
        versions=machine.versions(),
        config=to_plain(config),
    )
