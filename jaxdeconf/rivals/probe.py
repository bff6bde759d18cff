"""A mask for who knows what the nuisance shows, the previous action, but not where.

Under random actions the previous action is independent of the state, so a latent that it explains
is the nuisance's. No test of independence, and no initial states set at random. Ours, as the least
that methods do which take the previous action for given. Shapes: n frames, O latents, A action.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array

from jaxdeconf import leakage
from jaxdeconf.demos import Demos
from jaxdeconf.keys import named
from jaxdeconf.learn import disentangle
from jaxdeconf.method import Ask, Evidence, Method, masked

_FRAMES = 3000  # half for the regression, half to judge it: its time is cubic in them
_SHARE = 0.5  # of a latent's variance; under random actions shares are about 0 or about 1


def explained(_: Callable[[], Demos], evidence: Evidence, ask: Ask) -> Array:
    """[O] bool, the active latents that the previous action explains."""
    encoder, exploration = evidence.encoder, evidence.exploration
    assert encoder is not None
    assert exploration is not None
    images = jnp.asarray(exploration.images[:_FRAMES])
    latents, _ = disentangle.encode(encoder.network, encoder.variables, images)
    signal = jnp.asarray(exploration.previous_actions[:_FRAMES])
    share = leakage.explained(signal, latents, named(ask.key, "probe"))
    return encoder.active & (share > _SHARE)


ROWS: dict[str, Method] = {
    "Probe": Method(
        masked,
        "Masked, but the mask is of the latents that the previous action explains.",
        needs=("encoder", "exploration"),
        rival=True,
        select=explained,
    ),
}
