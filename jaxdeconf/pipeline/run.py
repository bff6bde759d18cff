"""One run from a config to its report."""

import time
from pathlib import Path
from typing import Any

from jaxdeconf.pipeline import results, stages
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.progress import Reporter
from jaxdeconf.pipeline.report import POLICIES, write_report
from jaxdeconf.pipeline.store import Store, write_json


def run(
    config: Config, directory: Path, reporter: Reporter, resume: bool = False
) -> dict[str, Any]:
    """Does, or finishes, a run.

    Args:
      config: what is asked for.
      directory: where everything goes.
      reporter: the screen.
      resume: go on with the run that is there.
    Returns:
      What results.json holds.
    """
    this = stages.Run(config, Store(directory, config, resume), reporter, seconds={})
    collected = stages.collect(this)
    vae = stages.train_disentangler(this, collected)
    found = stages.find_mask(this, collected, vae)
    policies, driven = {}, {}
    for policy in POLICIES:
        view = stages.view_of(this, policy, vae, found)
        cloned = stages.train_policy(this, policy, collected, *view)
        with reporter.bar(f"judge {policy}", 1) as bar:
            policies[policy], driven[policy] = results.judge_policy(
                this, policy, collected, vae, found, cloned
            )
            bar.update(1, f"rollout loss {float(policies[policy]['rollout_loss']['mean']):.3g}")
    begin = time.perf_counter()
    numbers = results.results(this, collected, vae, found, policies)
    images = results.pictures(this, collected, vae, found, driven)
    this.seconds["report"] = time.perf_counter() - begin
    numbers = write_json(directory / "results.json", numbers)
    write_report(directory, numbers, images)
    return numbers
