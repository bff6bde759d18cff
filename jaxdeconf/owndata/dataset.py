"""A dataset at the size that the β-VAE learns, in memory; and how its frames come to that size.

Shapes: N episodes, n steps of all, T steps of one, H × W pixels of the camera's, Z × Z of ours,
A action, S state.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxdeconf import checks
from jaxdeconf.demos import Demos
from jaxdeconf.formats.source import Source, bounds


class Dataset(NamedTuple):
    """Frames and actions of all episodes, one after another, and what each episode began from."""

    frames: np.ndarray  # uint8 [n, Z, Z, 3]
    actions: np.ndarray  # float32 [n, A] over their limit
    lengths: np.ndarray  # [N]
    initial_states: np.ndarray  # [N, S], S = 0 where nothing is known of them
    state_names: list[str]  # [S]

    @property
    def first(self) -> np.ndarray:
        """[N] the place of each episode's first step."""
        return np.cumsum(self.lengths) - self.lengths

    @property
    def starts(self) -> np.ndarray:
        """uint8 [N, Z, Z, 3], the first frames."""
        return self.frames[self.first]

    def longer(self, least: int) -> "Dataset":
        """Without the episodes of fewer steps.

        Raises:
          ValueError: if none is left.
        """
        kept = self.lengths >= least
        if not kept.any():
            longest = int(self.lengths.max())
            raise ValueError(
                f"drop_short: expected at most {longest}, no episode has {least} steps"
            )
        if kept.all():
            return self
        rows, states = np.repeat(kept, self.lengths), self.initial_states[kept]
        parts = self.frames[rows], self.actions[rows], self.lengths[kept], states
        return Dataset(*parts, self.state_names)

    def begin(self, horizon: int, states: np.ndarray) -> Demos:
        """The first steps of each episode, with the states [S] that are chosen."""
        steps = self.first[:, None] + np.arange(horizon)
        names = [name for name, chosen in zip(self.state_names, states, strict=True) if chosen]
        return Demos(
            self.frames[steps],
            self.actions[steps],
            self.initial_states[:, states],
            state_names=names,
        )


def read(path: Path, source: Source, size: int, like: "Dataset | None" = None) -> Dataset:
    """Reads a dataset, an episode at a time, to frames of size Z.

    Args:
      path: for messages.
      source: the opened dataset.
      size: Z.
      like: the demonstrations, of exploration: it need not say how its episodes began.
    Raises:
      ValueError: if what is there does not fit together; one line that says where.
    """
    lengths = source.lengths
    if not len(lengths) or lengths.min() < 1:
        raise ValueError(f"{path}: expected episodes of one step or more, got {lengths.tolist()}")
    frames = np.empty((int(lengths.sum()), size, size, 3), np.uint8)
    for (first, end), shown in zip(bounds(lengths), source.episodes(), strict=True):
        if shown.shape[:3] != (end - first, *source.size):
            expected = f"{end - first} frames of {source.size[0]} × {source.size[1]}"
            raise ValueError(f"{path}: expected {expected} in an episode, got {shown.shape[:3]}")
        frames[first:end] = fitted(shown, size)
    states, names = np.zeros((len(lengths), 0)), []
    if like is None:
        states, names = _initial_states(path, source)
    actions = _actions(path, source)
    if like is not None:
        wanted = like.actions.shape[1]
        checks.array(f"{path}: actions", actions, f"[n, {wanted}]", (None, wanted))
    return Dataset(frames, actions, lengths, states, names)


def _initial_states(path: Path, source: Source) -> tuple[np.ndarray, list[str]]:
    states, count = source.initial_states, len(source.lengths)
    if states is None:
        raise ValueError(
            f"{path}: expected initial states, what each episode was set to, got none; say "
            f"--initial-states KEY, or FILE.npy of [{count}, S]"
        )
    states = checks.array(
        f"{path}: initial states", states, f"[{count}, S]", (count, None), finite=True
    )
    if not np.ptp(states, axis=0).any():
        raise ValueError(f"{path}: expected initial states that vary, got the same in all episodes")
    names = source.state_names
    if len(names) != states.shape[1]:
        names = [f"s{column}" for column in range(states.shape[1])]
    return states, names


def _actions(path: Path, source: Source) -> np.ndarray:
    """Actions over their limit, float32 [n, A]."""
    actions = np.asarray(source.actions, np.float32)
    checks.finite_numbers(f"{path}: actions", actions)
    if not np.ptp(actions, axis=0).any():
        raise ValueError(f"{path}: expected actions that vary, got the same in all steps")
    most = np.abs(actions).max(axis=0) if source.limit is None else np.asarray(source.limit)
    return actions / np.where(most > 0.0, most, 1.0).astype(np.float32)


def inner(shape: tuple[int, int], size: int) -> tuple[int, int, int, int]:
    """Where in Z × Z pixels an image [H, W] stands: top, left, height, width."""
    height, width = (max(1, round(side * size / max(shape))) for side in shape)
    return (size - height) // 2, (size - width) // 2, height, width


def fitted(images: np.ndarray, size: int) -> np.ndarray:
    """uint8 [T, Z, Z, 3] of [T, H, W, 3]: the mean of what a pixel covers, padded with black."""
    if images.shape[1:3] == (size, size):
        return images
    top, left, height, width = inner(images.shape[1:3], size)
    padded = np.zeros((len(images), size, size, 3), np.uint8)
    for image, into in zip(images, padded[:, top : top + height, left : left + width], strict=True):
        into[:] = _resized(image, (height, width), "BOX")
    return padded


def unfitted(images: np.ndarray, shape: tuple[int, int], smooth: bool = True) -> np.ndarray:
    """uint8 [T, H, W, ...] of [T, Z, Z, ...], as if `fitted` had been undone."""
    size = images.shape[1]
    if shape == (size, size):
        return images
    top, left, height, width = inner(shape, size)
    filter = "BILINEAR" if smooth else "NEAREST"
    cut = images[:, top : top + height, left : left + width]
    return np.stack([_resized(image, shape, filter) for image in cut])


def _resized(image: np.ndarray, shape: tuple[int, int], filter: str) -> np.ndarray:
    from PIL import Image  # late: who imports the package need not wait for it

    size, how = (shape[1], shape[0]), Image.Resampling[filter]
    return np.asarray(Image.fromarray(image).resize(size, how))
