"""An experiment that a signal strikes: `killed.py SIGNAL STAGE WHEN ARGUMENTS...`.

WHEN is a number of seconds after the stage began, or its end if that comes first; or `renaming` or
`renamed`: just before, or just after, its second checkpoint comes to stand in its place.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from pathlib import Path

from jaxdeconf.commands.main import main
from jaxdeconf.pipeline import run, stages
from jaxdeconf.pipeline.progress import Reporter


class Strike:
    """A signal to this process, once."""

    def __init__(self, name, stage, when):
        self.number, self.stage, self.when, self.saves = signal.Signals[name], stage, when, 0
        self.lock = threading.Lock()

    def now(self):
        if self.lock.acquire(blocking=False):
            os.kill(os.getpid(), self.number)

    def begin(self, stage):
        if stage == self.stage and not self.when.startswith("renam"):
            threading.Thread(target=self.later, daemon=True).start()

    def later(self):
        time.sleep(float(self.when))
        self.now()

    def end(self, stage):
        if stage == self.stage:
            self.now()

    def rename(self, rename, source, place):
        mine = Path(place).parent.name == self.stage
        self.saves += mine
        second = mine and self.saves == 2
        if second and self.when == "renaming":
            self.now()
        rename(source, place)
        if second and self.when == "renamed":
            self.now()


def arm(strike):
    """Lets every stage tell when it begins and ends, and every checkpoint when it is renamed."""
    rename, save, bar = os.rename, run.save, Reporter.bar

    @contextlib.contextmanager
    def shown(self, stage, *steps):
        strike.begin(stage)
        try:
            with bar(self, stage, *steps) as own:
                yield own
        finally:
            strike.end(stage)

    def reporting(*arguments):
        strike.begin("save")
        save(*arguments)
        strike.end("save")

    Reporter.bar, run.save = shown, reporting
    os.rename = lambda source, place: strike.rename(rename, source, place)


if __name__ == "__main__":
    arm(Strike(*sys.argv[1:4]))
    if sys.argv[1] == "SIGKILL":
        stages.SAVE_SECONDS = 0.0  # at every chunk's edge
    sys.exit(main(["cartpole", *sys.argv[4:]]))
