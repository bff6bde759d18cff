"""Where in the image the masked latents reach: the pixels that Inpainted replaces.

A reconstruction is needed only where the nuisance is; of all other pixels a policy is better off
with what the camera gave. Nobody says where that is, but the decoder knows. Of a pixel's variance
over frames it tells, as a sensitivity analysis does, which share is left if all kept latents are
known, and which if all masked ones are (total indices, Homma & Saltelli 1996, by the estimator of
Jansen 1999: a frame's latents with some of another's). A pixel is reached if the first is larger.
No threshold: a trace of an arm in a masked latent, by which the decoder moves the arm a little,
loses against the latents that move the arm. The pixels beside those join: a mark's edge covers them
in part, or so seldom that the decoder did not learn it.

What is found has to hold what Theorem 1 promises of a masked frame, that a masked latent cannot be
told from it. So it is asked of the inpainted frames themselves: a regression of the masked latents
may find no more than it finds in frames that are reconstructed as a whole. A region that leaks
grows by another pixel, and another; then the reach is not local: the region is the whole image.
Shapes: n frames, H × W pixels, O latent.
"""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf import checks, leakage
from jaxdeconf.keys import named
from jaxdeconf.learn import disentangle
from jaxdeconf.learn.clone import View
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.learn.fit import Variables
from jaxdeconf.views import inpainted, reconstructed, see, still

_FRAMES = 2048  # of those that are given, at even distances
# Mean squared change, in grey levels of 255: a decoder's own noise is about one level.
_FLOOR = 4.0
# R² above that of whole reconstructions: chance alone brings about 0.01.
_LEAK = 0.05
_GROWTH = 3  # pixels, the first of them always


def find_region(encoder: Encoder, mask: Array, images: Array, key: Array) -> Array:
    """The pixels that masked latents move more than kept ones do, and a border that leaks nothing.

    Args:
      encoder: a trained β-VAE.
      mask: [O] bool, True where a latent is masked.
      images: uint8 [n, H, W, 3], n >= 4, under random actions.
      key: for the regression.
    Returns:
      [H, W] bool; nowhere True if no active latent is masked.
    Raises:
      ValueError: if the images are not what is said, or of another size than the encoder learnt.
    """
    checks.instance("encoder", encoder, Encoder)
    count = len(encoder.active)
    mask = jnp.asarray(checks.array("mask", mask, f"[{count}]", (count,), "bool")) & encoder.active
    images = checks.array("images", images, "[n, H, W, 3]", (None, None, None, 3), "uint8")
    checks.integer("frames in images", len(images), least=4)
    size = images.shape[1], images.shape[2]
    disentangle.check_images(encoder, size)
    images = jnp.asarray(images[:: -(-len(images) // _FRAMES)])
    if not mask.any():
        return jnp.zeros(size, bool)
    mean, _ = disentangle.encode(encoder.network, encoder.variables, images)
    latents = jnp.where(encoder.active, mean, 0.0)

    def told(view: View, parameters: Variables) -> float:
        """R² of the masked latents, from what is seen of the frames."""
        seen = see(view, parameters, images)
        return float(leakage.leaked(seen, latents[:, mask], named(key, "region")))

    drawn = {"variables": encoder.variables, "keep": encoder.active & ~mask}
    most = told(reconstructed(encoder.network), drawn) + _LEAK
    regions = _growing(_reached(encoder, mask, latents, size))
    local = (region for region in regions if told(inpainted, still(encoder, region)) <= most)
    return next(local, jnp.ones(size, bool))


def _reached(encoder: Encoder, mask: Array, latents: Array, size: tuple[int, int]) -> np.ndarray:
    """[H, W] bool, the pixels that masked latents move more; latents [n, O] are those of frames."""

    def drawn(latents: Array) -> np.ndarray:
        images = disentangle.decode(encoder.network, encoder.variables, latents, size)
        return np.asarray(images, np.float32)

    def change(latents: Array) -> np.ndarray:
        return ((drawn(latents) - own) ** 2).mean(axis=(0, 3))

    own, others = drawn(latents), jnp.roll(latents, len(latents) // 2, axis=0)
    masked = change(jnp.where(mask, others, latents))
    kept = change(jnp.where(mask, latents, others))
    return (masked > kept) & (masked > _FLOOR)


def _growing(region: np.ndarray) -> Iterator[Array]:
    """What becomes of a region as every pixel's eight neighbours join it, again and again."""
    for _ in range(_GROWTH):
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(region, 1), (3, 3))
        region = np.asarray(windows.any(axis=(2, 3)))
        yield jnp.asarray(region)
