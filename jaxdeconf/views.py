"""What a policy is shown of a frame: functions of (its parameters, images) -> images.

Images are floats in [0, 1], so that a view has a derivative; `see` takes and gives uint8, as frames
are stored and as cameras hand them over.

Shapes: B batch, N episodes, T steps, n frames, H × W pixels, O latent.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf.demos import Demos
from jaxdeconf.learn import disentangle
from jaxdeconf.learn.clone import Demonstrations, View, show
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.learn.fit import Variables
from jaxdeconf.nets import vae


def identity(_: Variables, images: Array) -> Array:
    """Frames [B, H, W, 3] as they are."""
    return images


@cache
def covered(cover: Callable[[Array], Array]) -> View:
    """Frames with the nuisance covered; the same view for the same cover, so it compiles once."""

    def view(_: Variables, images: Array) -> Array:
        return jax.vmap(cover)(images)

    return view


@cache
def reconstructed(config: vae.VAEConfig) -> View:
    """The β-VAE's reconstruction of the latents that are kept, others at their prior mean.

    Its parameters are {"variables": of the β-VAE, "keep": [O] bool}.
    """

    def view(parameters: Variables, images: Array) -> Array:
        variables = parameters["variables"]
        mean, _, _ = vae.encode(config, variables, images, train=False)
        latents = jnp.where(parameters["keep"], mean, 0.0)
        _, height, width, _ = images.shape
        drawn, _ = vae.decode(config, variables, latents, (height, width), train=False)
        return drawn

    return view


def inpainted(parameters: Variables, images: Array) -> Array:
    """Frames as they are, but for a region, which stands still.

    Its parameters are {"region": [H, W] bool, "still": uint8 [H, W, 3]}.
    """
    return jnp.where(parameters["region"][..., None], parameters["still"] / 255.0, images)


def still(encoder: Encoder, region: Array) -> Variables:
    """The parameters of `inpainted` by which a region [H, W] is as the decoder draws no latent.

    Nothing that is kept is drawn there, since latents may be mixed: one that shows the pose and a
    little of the nuisance is kept.
    """
    none, size = jnp.zeros((1, encoder.network.latents)), (region.shape[0], region.shape[1])
    drawn = disentangle.decode(encoder.network, encoder.variables, none, size)
    return {"region": region, "still": drawn[0]}


@partial(jax.jit, static_argnames="view")
def see(view: View, parameters: Any, images: Array) -> Array:
    """What a view makes of uint8 images [n, H, W, 3], a batch at a time."""
    return jax.lax.map(lambda image: show(view, parameters, image[None])[0], images, batch_size=256)


def shown(
    demos: Demos, view: View, parameters: Any, steps: int | None, extra: Any = None
) -> Demonstrations:
    """The first steps of each episode, as a view shows them; None is all.

    Args:
      demos: the episodes.
      view: what is shown of a frame.
      parameters: of the view.
      steps: of each episode, or None.
      extra: a pytree [N, T, ...] that goes along.
    """
    images = _through(view, parameters, jnp.asarray(demos.images[:, :steps]))
    count, length = images.shape[:2]
    step = jnp.broadcast_to(jnp.arange(length, dtype=jnp.int32), (count, length))
    along = demos.actions, demos.previous_actions, demos.weights, extra
    along = jax.tree.map(lambda a: jnp.asarray(a[:, :steps]), along)
    padded = Demonstrations(images, step, *along)
    if demos.valid is None:
        return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), padded)
    valid = np.asarray(demos.valid)[:, :steps]
    return jax.tree.map(lambda a: a[valid], padded)


@partial(jax.jit, static_argnames="view")
def _through(view: View, parameters: Any, images: Array) -> Array:
    """A view of uint8 images [N, T, H, W, 3], an episode at a time."""
    return jax.lax.map(partial(show, view, parameters), images)
