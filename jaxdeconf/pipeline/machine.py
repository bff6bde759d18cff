"""What this machine is, with a fallback where its operating system has no answer."""

import os
import platform
import sys
from pathlib import Path

import jax

from jaxdeconf import threads
from jaxdeconf.version import __version__


def free_memory() -> float:
    """Bytes that nobody uses; 4 GB where the system does not say."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES"))
    except (AttributeError, ValueError, OSError):  # no such name on macOS, no sysconf on Windows
        return 4e9


def trainings(data_bytes: float) -> int:
    """How many networks to train side by side: a CPU's cores and its memory allow several.

    Args:
      data_bytes: of what each is trained on.
    """
    if jax.default_backend() != "cpu":
        return 1
    # Beside these frames each has those that its view makes of them, and what making them takes.
    return max(1, min(threads.cores(), int(free_memory() // (4.0 * data_bytes))))


def forget_programs(most: int = 30_000) -> None:
    """Forgets compiled programs where this process has more memory maps than `most`.

    XLA keeps three maps for each object file of a program on a CPU, and Linux ends a process, in
    the middle of whatever it does, at 65,530 (vm.max_map_count).
    """
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > most:
        jax.clear_caches()


def peak_memory_mb() -> float:
    """The most memory that this process has held at a time, MB (2^20 bytes); NaN if unknown."""
    status = Path("/proc/self/status")
    if status.exists():  # Linux, whose ru_maxrss may be that of the process that started this one
        lines = status.read_text().splitlines()
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:"))
    try:
        import resource
    except ImportError:  # Windows
        return float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 1024  # bytes there, else KiB


def versions() -> dict[str, str]:
    """What numbers depend on beside the config."""
    return {
        "jaxdeconf": __version__,
        "python": platform.python_version(),
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
        "platform": f"{sys.platform} {platform.machine()}",
    }
