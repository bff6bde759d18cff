"""A made-up dataset: two blobs that matter, and a corner that shows the past."""

import numpy as np

from jaxdeconf.formats import find
from jaxdeconf.formats.source import Names
from jaxdeconf.learn.disentangle import DisentangleConfig
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.owndata import dataset
from jaxdeconf.owndata.config import Masking

CONFIG = Masking(
    demos="scene",
    size=32,
    disentangle=DisentangleConfig(
        steps=64,
        objective="H",
        beta=2.0,
        network=VAEConfig(channels=(4, 4), latents=3, linear_path=True, norm="none"),
    ),
)


def drawn(states, mark, random):
    """uint8 [n, 32, 32, 3]: two blobs as bright as states [n, 2], a corner for mark [n]; noise."""
    image = np.full((len(states), 32, 32, 3), 128.0)
    image[:, 4:12, 14:24] += 90 * states[:, 0, None, None, None]
    image[:, 18:26, 4:16] += 90 * states[:, 1, None, None, None]
    image[:, 22:30, 22:30] += 110 * mark[:, None, None, None]
    return np.round(image + random.normal(0, 4, image.shape)).clip(0, 255).astype(np.uint8)


def scene(episodes, steps, expert, seed, mark=None):
    """The arrays of a dataset; each episode's length differs by one from the next one's.

    Args:
      episodes, steps: how many, and of the longest.
      expert: whether actions follow from the states; else they are random.
      seed: of all of it.
      mark: what first frames show in the corner; None: anything.
    """
    random = np.random.default_rng(seed)
    initial = random.uniform(-1, 1, (episodes, 2))
    frames, actions, lengths = [], [], []
    for episode, state in enumerate(initial):
        length = steps - episode % 2
        states = state * np.linspace(1.0, 0.6, length)[:, None]
        if expert:
            acts = 0.5 * (states[:, 0] - states[:, 1]) + random.normal(0, 0.05, length)
        else:
            states = random.uniform(-1, 1, (length, 2))
            acts = random.uniform(-1, 1, length)
        first = random.uniform(-1, 1) if mark is None else mark
        frames.append(drawn(states, np.clip([first, *acts[:-1]], -1, 1), random))
        actions.append(np.clip(acts, -1, 1))
        lengths.append(length)
    return {
        "frames": np.concatenate(frames),
        "actions": 7 * np.concatenate(actions).astype(np.float32)[:, None],
        "episode_lengths": np.array(lengths),
        "initial_states": initial.astype(np.float32),
        "state_names": np.array(["left", "right"]),
        "action_limit": np.array([7.0], np.float32),
        "note": np.array("kept as it is"),
    }


def opened(arrays, path):
    """A dataset of arrays at a path, read."""
    np.savez_compressed(path, **arrays)
    return dataset.read(path, find(path, None, Names()), 32)
