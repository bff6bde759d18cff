"""`jaxdeconf mask` on demonstrations that no line of this project made.

    python -m benchmarks.own_data DATA                        every part, about an hour of one core
    python -m benchmarks.own_data DATA --only formats checks

DATA holds NAME_demos.npz and NAME_random.npz, and in formats/ the first episodes of reacher_demos
as the libraries of users' trainers wrote them. Parts: `formats`, that each reads to the same
frames, and is written and read again without loss, by its own library, too, where that is
installed; `checks`, what is refused before training, and in which time; `masks`, whole maskings,
each a process; `policy`, scikit-learn's network on two frames, cloned from frames as recorded and
as `masks` wrote them. Its copycat score is how far its action moves, over the limit, when a frame's
region, the pixels that the view redraws, is taken from another frame and all else stays.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

import jaxdeconf as jd
from jaxdeconf.formats import find
from jaxdeconf.formats.source import Names, Redraw, Source, bounds
from jaxdeconf.owndata.results import Found
from jaxdeconf.pipeline.results import load

_FORMATS = (
    *("reacher_robomimic.hdf5", "lerobot_images", "lerobot_video"),
    *("minari/reacher/raw-v0", "minari/reacher/jpeg-v0", "minari/reacher/arrow-v0"),
)
_CHECKS = ("pendulum", "reacher", "pendulum96", "dmc_cartpole", "reacher_circle")
_MASKS = {"pendulum": 64, "reacher": 64, "pendulum96": 64, "pendulum96 at 96": 96}
_COMPONENTS, _TEST = 64, 5  # of the pixels; every fifth episode is held out


def formats(data: Path, _: Path) -> None:
    """A line a format: the error of what is read, and whether it comes through being written."""
    wanted = [*find(data / "reacher_demos.npz", None, Names()).episodes()]
    for name in _FORMATS:
        source = find(data / "formats" / name, None, Names())
        read = [*source.episodes()]
        errors = [np.abs(a - b.astype(float))[: len(a)].mean() for a, b in _pairs(read, wanted)]
        with tempfile.TemporaryDirectory() as folder:
            new = Path(folder) / name
            new.parent.mkdir(parents=True, exist_ok=True)
            source.write(new, _half)
            again = [*find(new, None, Names()).episodes()]
            exact = all(np.array_equal(_half(a), b) for a, b in zip(read, again, strict=True))
            other = _library(new, Path(folder))
            theirs = "not installed"
            if other is not None:
                theirs = all(np.array_equal(_half(a), b) for a, b in zip(read, other, strict=True))
        print(
            f"{name:24} {len(read)} episodes, mean error {np.mean(errors):.2f} of 255; "
            f"written and read again exactly: {exact}, by its library: {theirs}"
        )


def _pairs(read: list[np.ndarray], wanted: list[np.ndarray]) -> Iterator:
    """Minari has a frame, and no action, more: its episodes are a step shorter."""
    return ((a, b[: len(a)]) for a, b in zip(read, wanted, strict=False))


def _half(frames: np.ndarray) -> np.ndarray:
    return np.where(np.arange(frames.shape[1])[:, None, None] < 20, frames // 2, frames)


def _library(path: Path, folder: Path) -> list[np.ndarray] | None:
    """Frames as the format's own library reads them; None: it is not installed."""
    try:
        if "minari" in path.parts:
            os.environ["MINARI_DATASETS_PATH"] = str(folder / "minari")
            import minari  # type: ignore

            episodes = minari.load_dataset("/".join(path.parts[-2:])).iterate_episodes()
            return [episode.observations["pixels"][:-1] for episode in episodes]
        if "lerobot" in path.name:
            from lerobot.datasets.lerobot_dataset import LeRobotDataset  # type: ignore

            data = LeRobotDataset("a/b", root=path)
            frames = np.stack([np.asarray(row["observation.images.top"]) for row in data])
            frames = np.round(255 * np.moveaxis(frames, 1, -1)).astype(np.uint8)
            return np.split(frames, np.cumsum(find(path, None, Names()).lengths)[:-1])
    except ImportError:
        pass
    return None


def checks(data: Path, _: Path) -> None:
    """A line a set: seconds, and the last that is said."""
    for name in _CHECKS:
        minutes, said = _command(data, name, "--check")
        print(f"{name:16} {60 * minutes:5.1f} s of processor time  {said.splitlines()[-1]}")


def masks(data: Path, out: Path) -> None:
    """Whole maskings, of which those that are finished in `out` are not done again."""
    for name, size in _MASKS.items():
        place, minutes = out / name.replace(" ", "-"), float("nan")
        if not (place / "results.json").exists():
            how = ("--size", str(size), "--out", str(place))
            minutes = _command(data, name.split()[0], *how)[0]
        found, _ = load(place, Found)
        print(f"{name:16} " + _row(found, minutes))


def _row(found: Found, minutes: float) -> str:
    if found.leakage is None or found.written is None:
        return found.refused or "nothing is masked"
    mask, asked = (np.flatnonzero(m & found.active).tolist() for m in (found.mask, found.asked))
    kept = "  ".join(f"{state} {a:.3f} → {b:.3f}" for state, (a, b) in found.retention.items())
    raw, _, written = found.leakage
    return (
        f"masked {mask} of {int(found.active.sum())}, asked {asked}  leakage {raw:.3f} → "
        f"{written:.3f}  {kept}  {found.written.mode} {found.written.region_pixels} pixels  "
        f"{minutes:.1f} min of processor time  {found.peak_memory_mb:.0f} MB"
    )


def _command(data: Path, name: str, *how: str) -> tuple[float, str]:
    """Minutes of processor time, and what is said, of a masking of a set."""
    more = data / f"{name.removesuffix('_circle')}_random.npz"
    words = ["experiments.own_data", data / f"{name}_demos.npz", "--exploration", more, *how]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-m", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = sum(getattr(after, of) - getattr(before, of) for of in ("ru_utime", "ru_stime"))
    return seconds / 60.0, done.stdout


def policy(data: Path, out: Path) -> None:
    """A line for frames as recorded, one for frames as the masking of the pendulum wrote them."""
    recorded, place = data / "pendulum_demos.npz", out / "pendulum"
    view, size = jd.load_view(place), find(recorded, None, Names()).size
    written = place / "dataset" / recorded.name
    for name, path, redraw in (("recorded", recorded, np.copy), ("written", written, view)):
        error, copycat, seconds = _cloned(path, view.region_at(size), redraw)
        print(f"{name:9} held-out error {error:.5f}  copycat {copycat:.4f}  {seconds:.0f} s")


def _stacked(source: Source) -> tuple[np.ndarray, np.ndarray]:
    """uint8 [n, 2, H, W, 3], previous and present frame, and actions over the largest [n, A]."""
    frames, actions = [], source.actions / np.abs(source.actions).max(axis=0)
    for shown in source.episodes():
        frames.append(np.stack([shown[[0, *range(len(shown) - 1)]], shown], axis=1))
    return np.concatenate(frames), actions


def _cloned(path: Path, region: np.ndarray, redraw: Redraw) -> tuple[float, float, float]:
    """(error on held-out steps, copycat, seconds) of a policy cloned from a dataset.

    Args:
      path: of the dataset.
      region: [H, W] bool, what is exchanged between frames.
      redraw: what the policy sees of a frame; of recorded ones, the frame itself.
    """
    from sklearn.decomposition import PCA  # type: ignore
    from sklearn.neural_network import MLPRegressor  # type: ignore
    from sklearn.pipeline import make_pipeline  # type: ignore

    source, began = find(path, None, Names()), time.perf_counter()
    frames, actions = _stacked(source)
    held = np.zeros(len(actions), bool)
    for episode, (first, end) in enumerate(bounds(source.lengths)):
        held[first:end] = episode % _TEST == 0

    def flat(images: np.ndarray) -> np.ndarray:
        return images.reshape(len(images), -1).astype(np.float32) / 255.0

    network = MLPRegressor(
        hidden_layer_sizes=(64, 64), max_iter=60, early_stopping=True, random_state=0
    )
    # Whitened: a faint mark counts as much as what moves many pixels.
    policy = make_pipeline(PCA(_COMPONENTS, whiten=True, random_state=0), network)
    policy.fit(flat(frames[~held]), actions[~held].squeeze())
    test = frames[held][:: max(1, held.sum() // 1000)]
    seconds = time.perf_counter() - began
    error = float(np.mean((policy.predict(flat(frames[held])) - actions[held].squeeze()) ** 2))
    other = np.random.default_rng(0).permutation(len(test))
    changed = np.where(region[..., None], test[other], test)
    before, after = (
        policy.predict(flat(redraw(images.reshape(-1, *images.shape[2:])).reshape(images.shape)))
        for images in (test, changed)
    )
    return error, float(np.abs(after - before).mean()), seconds


PARTS: dict[str, Callable[[Path, Path], None]] = {
    "formats": formats,
    "checks": checks,
    "masks": masks,
    "policy": policy,
}


def main() -> None:
    """Prints the parts that are asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=[*PARTS])
    parser.add_argument("--out", type=Path, default=Path("runs/own_data"), help="of the maskings")
    asked = parser.parse_args()
    for name in asked.only:
        PARTS[name](asked.data, asked.out)


if __name__ == "__main__":
    main()
