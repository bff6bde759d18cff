"""How good a mask is, without knowing the nuisance: by the previous action and the initial states.

Shapes: N episodes, S state, O latent, A action, m frames.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf.demos import Demos
from jaxdeconf.keys import named
from jaxdeconf.leakage import explained, leaked
from jaxdeconf.learn import disentangle
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.mask import Mask, MaskConfig, find_mask, potential_causes
from jaxdeconf.owndata.check import visible
from jaxdeconf.owndata.config import Masking
from jaxdeconf.owndata.dataset import Dataset
from jaxdeconf.owndata.view import View
from jaxdeconf.pipeline.results import APART

# Frames that train, and as many that test, a regression: its time is cubic in them.
_FRAMES = 600
_RESAMPLES = 50
# As many distinct episodes as a bootstrap resample has; those it repeats would be ties in ranks.
_DISTINCT = 1.0 - np.exp(-1.0)


class Leakage(NamedTuple):
    """R² of the previous action, or of its square, from frames in which nothing else goes with it.

    See `leakage.leaked`.
    """

    raw: float
    reconstructed: float  # by the β-VAE, with nothing masked
    written: float


class Past(NamedTuple):
    """Frames and what was done before them."""

    images: np.ndarray  # uint8 [m, Z, Z, 3]
    actions: np.ndarray  # [m, A], of the step before


def past(data: Dataset) -> Past:
    """Frames at even distances, without those that nothing precedes."""
    within = np.ones(len(data.frames), bool)
    within[data.first] = False
    places = np.flatnonzero(within)
    places = places[:: -(-len(places) // (2 * _FRAMES))]
    return Past(data.frames[places], data.actions[places - 1])


def told(encoder: Encoder, seen: Past, key: Array) -> np.ndarray:
    """[O] the share of each latent that the previous action explains, R²."""
    mean, _ = disentangle.encode(encoder.network, encoder.variables, jnp.asarray(seen.images))
    return np.asarray(explained(jnp.asarray(seen.actions), mean, named(key, "told")))


def confirmed(mask: np.ndarray, share: np.ndarray, episodes: int, config: Masking) -> np.ndarray:
    """[O] what of a mask stands: all of it, or with few episodes what tells the previous action.

    With few episodes a cause that moves the actions little is not seen to, and Algorithm 1 masks
    what shows it. The previous action is a second witness, on frames of which there are many.
    """
    if visible(episodes) <= config.min_power:
        return mask
    return mask & (share > APART)


def stability(
    demos: Demos, latents: np.ndarray, config: Masking, mask: np.ndarray, key: Array
) -> np.ndarray:
    """[O] the share of resamples of the episodes, each with 63 % of them, that mask a latent so."""
    count = max(5, round(_DISTINCT * len(latents)))
    generator = np.random.default_rng(jax.random.bits(named(key, "stability"), (4,)).tolist())
    agree, rule = [], (config.threshold, config.alpha, MaskConfig.statistic, config.states_together)
    for _ in range(_RESAMPLES):
        some = generator.choice(len(latents), count, replace=False)
        states, actions = (np.asarray(v)[some] for v in (demos.initial_states, demos.actions))
        found = find_mask(states, latents[some], actions, *rule)
        agree.append(np.asarray(found.mask) == mask)
    return np.mean(agree, axis=0)


def elsewhere(mask: Mask, active: np.ndarray) -> dict[str, list[int]]:
    """The latents that other horizons, and other thresholds, would mask."""
    horizon = mask.state_action.shape[1]
    found = {f"H = {h}": mask.within(h) for h in range(1, horizon + 1)}
    for gamma in (np.array([0.5, 2.0, 4.0]) * float(mask.threshold)).tolist():
        causes = potential_causes(mask.state_observation, mask.state_action, gamma)
        found[f"γ = {gamma:.2g}"] = ~causes.any(axis=(-2, -1))
    return {name: np.flatnonzero(np.asarray(m) & active).tolist() for name, m in found.items()}


def leakage(seen: Past, written: View, whole: View, key: Array) -> Leakage:
    """What a regression finds of the previous action, before and after."""

    def of(images: np.ndarray) -> float:
        return float(leaked(jnp.asarray(images), jnp.asarray(seen.actions), named(key, "written")))

    return Leakage(of(seen.images), of(whole(seen.images)), of(written(seen.images)))


def retention(
    demos: Demos, starts: np.ndarray, written: View, key: Array
) -> dict[str, list[float]]:
    """{state: R² of it, regressed from first frames [N, Z, Z, 3], before and after}."""
    states, of = np.asarray(demos.initial_states, np.float32), named(key, "retention")
    both = np.stack(
        [explained(jnp.asarray(v), jnp.asarray(states), of) for v in (starts, written(starts))]
    )
    return dict(zip(demos.state_names, both.T.tolist(), strict=True))
