"""How fast Hoeffding's D is, with its error beside it: `python -m benchmarks.hoeffding --out DIR`.

For each batch of pairs: compile time, median run from host arrays (ranking included, and its share
of the time), time a pair, peak memory, the worst error against an independent count in extended
precision; the time a pair of a plain loop of single calls, and of R, by which tied columns are
tested; and the same for the peers that are installed: wdm (pyvinecopulib) and hyppo, in Python, and
Hmisc and independence, through Rscript.
Peers are timed on a few pairs of the batch, start-up apart. Needs numpy and jax alone, matplotlib
for the plot.
"""

import argparse
import importlib
import json
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import numpy as np

from jaxdeconf.independence import hoeffding_d, refined_d
from jaxdeconf.independence.ranks import both_ranked

# Rows, columns, samples, and what the columns of x and of y are; see KINDS.
CASES = [(1, 1, 10**k, "real", "real") for k in range(3, 8)]
CASES += [(4, 6, 1000, "real", "real"), (6, 32, 2000, "real", "real")]
CASES += [(16, 64, 4096, "real", "real"), (64, 256, 10_000, "real", "real")]
CASES += [(64, 256, 1000, "real", "real"), (3, 2048, 1000, "real", "real")]
CASES += [(64, 256, 1000, "nine", "nine"), (3, 2048, 1000, "nine", "nine")]
CASES += [(64, 256, 4096, "real", "real")]
CASES += [
    (3, cols, 4096, "real", y) for cols in (2048, 12_288) for y in ("real", "bytes", "pixels")
]
CASES += [(3, 2048, 4096, "bytes", "bytes"), (3, 2048, 4096, "real", "saturated")]
CASES += [(64, 256, 4096, "real", "chance")]
KINDS = {  # of the ranks of a column [N], whose length is N
    "real": lambda rank, n: rank.astype(np.float64),
    "chance": lambda rank, n: np.where(rank % 1000 == 1, rank - 1, rank).astype(np.float32),
    "nine": lambda rank, n: (9.0 * rank) // n,
    "bytes": lambda rank, n: (256 * rank // n).astype(np.uint8),
    "pixels": lambda rank, n: (256 * np.maximum(rank - 0.9 * n, 0) // (0.1 * n)).astype(np.uint8),
    "saturated": lambda rank, n: np.clip(rank, 0.2 * n, 0.8 * n),
}
CHECKED = 3  # pairs of a batch that are checked and that peers are timed on
QUADRATIC = 5000  # samples beyond which the O(N^2) peers are left out

R_SCRIPT = """
a <- commandArgs(TRUE); n <- as.integer(a[2]); k <- as.integer(a[3])
v <- matrix(readBin(a[1], "double", 2 * n * k), nrow = n)
peers <- list()
has <- function(name) requireNamespace(name, quietly = TRUE)
if (has("Hmisc") && n <= as.integer(a[4]))
  peers$Hmisc <- function(x, y) Hmisc::hoeffd(x, y)$D[1, 2]
if (has("independence")) {
  suppressMessages(library(independence))
  peers$independence <- function(x, y) 30 * hoeffding.D.test(x, y, precision = 0)$Dn
  peers$independence_lean <- function(x, y)
    30 * .calc.hoeffding(relative.order(x, y, collisions = FALSE) - 1)
}
for (name in names(peers)) {
  d <- NA
  for (i in 1:k) {
    x <- v[, 2 * i - 1]; y <- v[, 2 * i]
    repeats <- 1
    repeat {
      t <- system.time(for (r in 1:repeats) d <- peers[[name]](x, y))[["elapsed"]]
      if (t > 0.2 || repeats >= 1000) break
      repeats <- repeats * 10
    }
    cat(name, t / repeats, sprintf("%.17g", d), "\\n")
  }
}
"""


def batch(rows: int, cols: int, n: int, *kinds: str) -> tuple[np.ndarray, np.ndarray]:
    """Weakly dependent columns of these kinds, exact in float32."""
    rng = np.random.default_rng(n + rows * cols)
    x = rng.normal(size=(n, rows))
    y = rng.normal(size=(n, cols)) + 0.1 * x[:, np.arange(cols) % rows]
    ranks = (np.argsort(np.argsort(v, axis=0), axis=0) for v in (x, y))
    x, y = (KINDS[kind](rank, n) for kind, rank in zip(kinds, ranks, strict=True))
    return x, y


def exact_d(x: np.ndarray, y: np.ndarray) -> float:
    """30 D_n by counts and in extended precision, sharing no line with ours."""
    tied = len(np.unique(x)) < len(x) or len(np.unique(y)) < len(y)
    a, b, c = (v.astype(np.longdouble) for v in (tied_counts if tied else merge_counts)(x, y))
    n = len(x)
    e, d = a * b - (n - 2) * c, n - 1 - a - b + c
    total = np.sum(e * (e + 1 - a - b) - (n - 2) * c * (d - 1))
    return float(30 * total / np.prod(np.longdouble(n) - np.arange(5)))


def tied_counts(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples below each in x, in y and in both, one that is tied counting half, in N^2."""

    def below(v: np.ndarray) -> np.ndarray:
        half = (v[None, :] < v[:, None]) + 0.5 * (v[None, :] == v[:, None])
        return half - 0.5 * np.eye(len(v))

    in_x, in_y = below(x), below(y)
    return in_x.sum(axis=1), in_y.sum(axis=1), (in_x * in_y).sum(axis=1)


def merge_counts(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same without ties, by merging."""
    n = len(x)
    bits = max(1, (n - 1).bit_length())
    size = 1 << bits
    stream = np.arange(size)  # x-ranks in the order of y, padded with samples above all
    stream[np.argsort(np.argsort(y))] = np.append(np.argsort(np.argsort(x)), np.arange(n, size))[:n]
    in_y = np.empty(size, np.int64)
    in_y[stream] = np.arange(size)
    both = np.zeros(size, np.int64)
    for bit in reversed(range(bits)):
        right = (stream >> bit) & 1
        start = stream >> (bit + 1) << (bit + 1)
        lefts = np.append(0, np.cumsum(1 - right))
        before = lefts[:-1] - lefts[start]  # of the left half of the segment, below in y
        both[stream] += right * before
        place = start + np.where(right, (1 << bit) + np.arange(size) - start - before, before)
        following = np.empty_like(stream)
        following[place] = stream
        stream = following
    return np.arange(n), in_y[:n], both[:n]


def seconds(call: Callable[[], object]) -> float:
    """Of a call, until its arrays are there."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def measure(rows: int, cols: int, n: int, kinds: tuple[str, str], repeats: int) -> dict:
    """One batch in this process, whose peak memory is then this batch's."""
    host = x, y = batch(rows, cols, n, *kinds)
    on_device = jax.default_backend() != "cpu"
    if on_device:
        x, y = (jax.device_put(v.astype(np.float32)) for v in host)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    first = seconds(lambda: hoeffding_d(x, y))
    repeats = repeats if rows * cols * n < 10**7 else 3
    run = float(np.median([seconds(lambda: hoeffding_d(x, y)) for _ in range(repeats)]))
    ranking = np.median([seconds(lambda: both_ranked(*(v.T for v in host))) for _ in range(3)])
    if on_device:
        peak = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0) / 2**20
    else:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - before
    refined = [seconds(lambda: refined_d(x, y)) for _ in range(4 if n <= QUADRATIC else 0)][1:]
    found = np.asarray(hoeffding_d(x, y))
    picked = [(i % rows, (7 * i) % cols) for i in range(min(CHECKED, rows * cols))]
    chosen = [(host[0][:, s] * 1.0, host[1][:, p] * 1.0) for s, p in picked]
    exact = [exact_d(*pair) for pair in chosen]
    error = max(abs(float(found[at]) - d) for at, d in zip(picked, exact, strict=True))
    single = [(x[:, s], y[:, p]) for s, p in picked]
    jax.block_until_ready(hoeffding_d(*single[0]))
    loop = np.mean([seconds(partial(hoeffding_d, *pair)) for pair in single * 3])
    return {
        "rows": rows,
        "cols": cols,
        "n": n,
        "kinds": kinds,
        "compile_s": max(0.0, first - run),
        "median_ms": 1e3 * run,
        "us_per_pair": 1e6 * run / (rows * cols),
        "ranking": 0.0 if on_device else float(ranking) / run,
        "pairs_per_s": rows * cols / run,
        "peak_mb_over_inputs": peak,
        "max_error": error,
        "loop_us_per_pair": 1e6 * float(loop),
        "refined_us_per_pair": 1e6 * float(np.median(refined)) / (rows * cols) if refined else None,
        "peers": peers(chosen, exact, n),
    }


def peers(chosen: list, exact: list[float], n: int) -> dict:
    """Microseconds a pair and worst error of each peer that is installed."""
    found: dict[str, list[tuple[float, float]]] = {}
    for name, compute in python_peers(n).items():
        compute(*chosen[0])  # compiles, where it does
        for (x, y), d in zip(chosen, exact, strict=True):
            taken = np.median([seconds(partial(compute, x, y)) for _ in range(3)])
            found.setdefault(name, []).append((float(taken), abs(float(compute(x, y)) - d)))
    for name, rows in r_peers(chosen, n).items():
        found[name] = [(t, abs(v - d)) for (t, v), d in zip(rows, exact, strict=True)]
    return {
        name: {
            "us_per_pair": 1e6 * float(np.mean([t for t, _ in rows])),
            "max_error": max(e for _, e in rows),
        }
        for name, rows in found.items()
    }


def python_peers(n: int) -> dict[str, Callable]:
    """Those that import."""
    found = {}
    try:
        wdm = importlib.import_module("pyvinecopulib.utils").wdm
        found["wdm"] = lambda x, y: wdm(x, y, "hoeffding")
    except ImportError:
        pass
    try:
        if n <= QUADRATIC:
            found["hyppo"] = importlib.import_module("hyppo.independence.hhg").hoeffdings
    except ImportError:
        pass
    return found


def r_peers(chosen: list, n: int) -> dict[str, list[tuple[float, float]]]:
    """Seconds and value for each pair, of the R packages that Rscript finds."""
    if shutil.which("Rscript") is None or n > 10**6:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        data, script = Path(folder) / "pairs.bin", Path(folder) / "peers.R"
        np.concatenate([v for pair in chosen for v in pair]).tofile(data)
        script.write_text(R_SCRIPT)
        command = ["Rscript", script, data, n, len(chosen), QUADRATIC]
        output = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=True)
    found: dict[str, list[tuple[float, float]]] = {}
    for line in output.stdout.splitlines():
        name, taken, value = line.split()
        found.setdefault(name, []).append((float(taken), float(value)))
    return found


def show(result: dict) -> None:
    """A row of the table, and under it the peers'."""
    r = result
    print(
        f"{r['rows']:>3}x{r['cols']:<5} N={r['n']:<9} {' x '.join(r['kinds']):17}"
        f"compile {r['compile_s']:5.1f} s   "
        f"median {r['median_ms']:9.2f} ms   {r['us_per_pair']:10.1f} us/pair   "
        f"ranking {100 * r['ranking']:3.0f} %   {r['pairs_per_s']:9.1f} pairs/s   "
        f"peak +{r['peak_mb_over_inputs']:.0f} MB   "
        f"error {r['max_error']:.0e}   loop {r['loop_us_per_pair']:.1f} us/pair"
        + (f"   R {r['refined_us_per_pair']:.1f} us/pair" if r["refined_us_per_pair"] else ""),
        flush=True,
    )
    for name, peer in r["peers"].items():
        ratio = peer["us_per_pair"] / r["us_per_pair"]
        print(
            f"        {name:18} {peer['us_per_pair']:12.1f} us/pair   {ratio:7.1f} x ours   "
            f"error {peer['max_error']:.0e}",
            flush=True,
        )


def plot(results: list[dict], device: str, path: Path) -> None:
    """Microseconds a pair over N, both logarithmic."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4.5), layout="constrained")
    one = [r for r in results if r["rows"] * r["cols"] == 1]
    many = [r for r in results if r["rows"] * r["cols"] > 1 and set(r["kinds"]) == {"real"}]
    axes.loglog([r["n"] for r in one], [r["us_per_pair"] for r in one], "k-o", label="one pair")
    axes.loglog([r["n"] for r in many], [r["us_per_pair"] for r in many], "ks", label="batches")
    for name in sorted({name for r in results for name in r["peers"]}):
        timed = sorted(
            (r["n"], r["peers"][name]["us_per_pair"]) for r in results if name in r["peers"]
        )
        axes.loglog(*zip(*timed, strict=True), ".", label=name)
    axes.set(xlabel="samples", ylabel="microseconds a pair", title=f"Hoeffding's D, {device}")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


def main() -> None:
    """Each batch in a process of its own, so that peak memory is its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="folder for hoeffding.json and hoeffding.png")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--largest", type=int, default=10**7, help="most samples of one pair")
    parser.add_argument("--case", type=int, help="number of one of CASES; prints JSON")
    arguments = parser.parse_args()
    if arguments.case is not None:
        rows, cols, n, *kinds = CASES[arguments.case]
        print(json.dumps(measure(rows, cols, n, tuple(kinds), arguments.repeats)))
        return
    device = jax.devices()[0].device_kind
    device = f"{platform.machine()} {device}" if device == "cpu" else device
    print(f"device {device}, jax {jax.__version__}")
    results = []
    for number, case in enumerate(CASES):
        if case[2] > arguments.largest:
            continue
        command = [sys.executable, "-m", "benchmarks.hoeffding", "--repeats", arguments.repeats]
        command += ["--case", number]
        child = subprocess.run(
            list(map(str, command)), stdout=subprocess.PIPE, text=True, check=True
        )
        results.append(json.loads(child.stdout.splitlines()[-1]))
        show(results[-1])
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        table = {"device": device, "jax": jax.__version__, "results": results}
        (arguments.out / "hoeffding.json").write_text(json.dumps(table, indent=1) + "\n")
        plot(results, device, arguments.out / "hoeffding.png")


if __name__ == "__main__":
    main()
