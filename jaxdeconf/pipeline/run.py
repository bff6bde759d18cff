"""One run from a config to its report."""

import time
from pathlib import Path
from typing import Any

from jaxdeconf.pipeline import results, stages
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.interruption import Interruption
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.report import POLICIES, write_report
from jaxdeconf.pipeline.store import Store, write_json, writing


def run(
    config: Config,
    directory: Path,
    reporter: Reporter,
    resume: bool = False,
    interruption: Interruption | None = None,
) -> dict[str, Any]:
    """Does, or finishes, a run.

    Args:
      config: what is asked for.
      directory: where everything goes.
      reporter: the screen.
      resume: go on with the run that is there.
      interruption: asks it to stop; by default nothing does.
    Returns:
      What results.json holds.
    Raises:
      StoreError: if the directory, or a checkpoint in it, cannot be used.
      WriteError: if the disk does not take what is written.
      FloatingPointError: if a loss is not finite; says which stage, step and value.
      Interrupted: if asked to stop; everything is saved.
      ValueError: if the config asks for more than there is, a batch larger than the data, say.
    """
    interruption, store = interruption or Interruption(), Store(directory, config, resume)
    this = stages.Run(config, store, reporter, {}, interruption)
    collected = stages.collect(this)
    vae = stages.train_disentangler(this, collected)
    found = stages.find_mask(this, collected, vae)
    cloned, policies, driven = {}, {}, {}
    for policy in POLICIES:
        view = stages.view_of(this, policy, vae, found.mask)
        cloned[policy] = stages.train_policy(this, policy, collected, *view)
    # After the last one is trained: what is resumed before then need not judge the first again.
    for policy in POLICIES:
        with reporter.bar(f"judge {policy}", 1) as bar:
            policies[policy], driven[policy] = results.judge_policy(
                this, policy, collected, vae, found, cloned[policy]
            )
            bar.update(1, f"rollout loss {float(policies[policy]['rollout_loss']['mean']):.3g}")
        interruption.check()
    begin = time.perf_counter()
    numbers = results.results(this, collected, vae, found, policies)
    images = results.pictures(this, collected, vae, found, driven)
    this.seconds["report"] = time.perf_counter() - begin
    with writing(directory):
        numbers = write_json(directory / "results.json", numbers)
        write_report(directory, numbers, images)
    return numbers
