"""What every command line does around its work: signals, exit codes, the cache of programs."""

import os
import platform
import re
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

import jax
from jax.errors import JaxRuntimeError

from jaxdeconf.pipeline.interruption import Interrupted, Interruption
from jaxdeconf.pipeline.store import StoreError, WriteError

_NO_MEMORY = "RESOURCE_EXHAUSTED|Out of memory"  # how XLA says so, on one platform or another


def guarded(work: Callable[[Interruption], None], directory: Path) -> int:
    """Does the work of a command line in a run's directory; says in one line what stops it.

    Returns:
      The exit code: 0; 1 if training diverges, the disk is full or memory too small; 2 for a wrong
      argument or directory; 130 or 143 if stopped by SIGINT or SIGTERM.
    """
    advice, interruption = f"go on with --resume {shlex.quote(str(directory))}", Interruption()
    try:
        with interruption.listening(f"stopped at once; {advice}"):
            work(interruption)
    except Interrupted as stop:
        begun = any(directory.glob("*.json"))  # config.json, or sweep.json
        print("interrupted;", advice if begun else "nothing was begun", file=sys.stderr)
        return stop.exit_code
    except (ValueError, StoreError) as error:
        return complain(error, 2)
    except WriteError as error:
        return complain(error, 1)
    except (MemoryError, JaxRuntimeError) as error:
        if not isinstance(error, MemoryError) and not re.search(_NO_MEMORY, str(error)):
            raise
        words = "not enough memory; make sizes smaller, or"
        return complain(f"{words} with more of it {advice}", 1)
    except FloatingPointError as error:
        return complain(f"{error}; the last good checkpoint is in {directory}", 1)
    return 0


def complain(words: object, code: int) -> int:
    """One line on standard error; returns the exit code."""
    print(f"error: {words}", file=sys.stderr)
    return code


def cache_compilations() -> None:
    """Keeps compiled programs between runs; only command lines do so, never an import.

    In JAX_COMPILATION_CACHE_DIR if that is set, else below XDG_CACHE_HOME or ~/.cache.
    """
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    try:
        home = Path(os.environ.get("XDG_CACHE_HOME", ""))
        home = home if home.is_absolute() else Path.home() / ".cache"
    except RuntimeError:  # no HOME, and nobody knows this user
        return
    # By version and machine: XLA's programs for another processor would not run on this one.
    where = home / "jaxdeconf" / f"jax-{jax.__version__}-{platform.node()}"
    jax.config.update("jax_compilation_cache_dir", str(where))
