"""What masking a dataset does for a policy that is not ours: scikit-learn's, on two frames.

    python -m benchmarks.own_data DEMOS.npz DIR/dataset/DEMOS.npz DIR

clones a small network from a dataset as recorded and as `jaxdeconf mask --out DIR` wrote it. Its
copycat score is how far its action moves, over the limit, when a frame's region (the pixels that
`DIR/view` redraws) is taken from another frame and all else stays. Needs scikit-learn.
"""

import sys
import time
from pathlib import Path

import numpy as np

import jaxdeconf as jd
from jaxdeconf.formats import find
from jaxdeconf.formats.source import Names, Source, bounds

_COMPONENTS, _TEST = 64, 5  # of the pixels; every fifth episode is held out


def pairs(source: Source) -> tuple[np.ndarray, np.ndarray]:
    """uint8 [n, 2, H, W, 3], previous and present frame, and actions over the largest [n, A]."""
    frames, actions = [], source.actions / np.abs(source.actions).max(axis=0)
    for shown in source.episodes():
        frames.append(np.stack([shown[[0, *range(len(shown) - 1)]], shown], axis=1))
    return np.concatenate(frames), actions


def measure(path: Path, region: np.ndarray, redraw) -> tuple[float, float, float]:
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
    frames, actions = pairs(source)
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


def main(recorded: str, written: str, directory: str) -> None:
    """Prints a line a dataset."""
    view = jd.load_view(directory)
    source = find(Path(recorded), None, Names())
    for name, path, redraw in (
        ("recorded", Path(recorded), lambda frames: frames),
        ("written", Path(written), view),
    ):
        error, copycat, seconds = measure(path, view.region_at(source.size), redraw)
        print(f"{name:9} held-out error {error:.5f}  copycat {copycat:.4f}  {seconds:.0f} s")


if __name__ == "__main__":
    main(*sys.argv[1:])
