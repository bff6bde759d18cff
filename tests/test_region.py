"""The region that masked latents reach, with a linear β-VAE that is written down, not trained."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxdeconf import leakage
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.nets import vae
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.region import find_region
from jaxdeconf.views import inpainted, see, still

KEY = jax.random.key(0)
SIZE = (16, 24)
CONFIG = VAEConfig(channels=(4,), latents=4, linear_path=True, norm="none")
ACTIVE = jnp.array([True, True, True, False])
MASK = np.array([False, False, True, True])  # the signal's latent, and one that carries nothing
CONTRAST = 100 / 255


def patch(top, left, columns=5):
    """[16, 24] 1 where a shape of 5 × 5 pixels is, or its first columns."""
    place = np.zeros(SIZE)
    place[top : top + 5, left : left + columns] = 1
    return place


SHAPES = np.stack([patch(2, 10), patch(9, 16), patch(0, 0)])  # two that matter, and the nuisance
CORNER = np.indices(SIZE).max(axis=0) < 6  # it, and a pixel's breadth around


def frames(shapes=SHAPES, count=1200):
    """uint8 [n, 16, 24, 3]: every shape in a shade of its own, at random; and the shades [n, 3]."""
    shades = np.random.default_rng(0).uniform(-1, 1, (count, 3))
    images = np.round(128 + 100 * np.einsum("ns,shw->nhw", shades, shapes))
    return np.repeat(images[..., None], 3, axis=-1).clip(0, 255).astype(np.uint8), shades


def encoder(drawn=SHAPES, tint=0.0):
    """A β-VAE that reads shades off the shapes' middles, less a tint, and draws `drawn` of them."""
    variables = jax.tree.map(jnp.zeros_like, vae.init(CONFIG, KEY, SIZE))
    middle = [(4, 12), (11, 18), (2, 2)]
    read, draw = np.zeros((4, *SIZE, 3)), np.zeros((4, *SIZE, 3))
    for latent, (row, column) in enumerate(middle):
        read[latent, row, column] = 1 / 3 / CONTRAST
        draw[latent] = CONTRAST * drawn[latent][..., None]
    read[:2] -= tint * read[2]
    variables["params"]["linear"] = {
        "encoder": jnp.asarray(read.reshape(4, -1).T, jnp.float32),
        "decoder": jnp.asarray(draw.reshape(4, -1), jnp.float32),
        "pixel_mean": jnp.full(read[0].size, 128 / 255),
    }
    return Encoder(CONFIG, variables, jnp.ones(4), ACTIVE)


def told(encoder, region, images, shades):
    """R² of the nuisance's shade from the inpainted frames."""
    seen, signal = see(inpainted, still(encoder, region), images), shades[:, 2:]
    return leakage.leaked(seen, signal, KEY)


def test_it_is_where_the_masked_latent_draws():
    images, shades = frames()
    region = find_region(encoder(), MASK, images, KEY)
    np.testing.assert_array_equal(region, CORNER)
    assert told(encoder(), region, images, shades) < 0.02
    assert told(encoder(), jnp.zeros(SIZE, bool), images, shades) > 0.9


def test_a_trace_of_another_shape_in_a_masked_latent_is_not_reached():
    drawn = SHAPES.copy()
    drawn[2] += 0.5 * SHAPES[0]
    region = find_region(encoder(drawn), MASK, frames()[0], KEY)
    np.testing.assert_array_equal(region, CORNER)


def test_it_grows_where_the_decoder_misses_a_rim():
    images, shades = frames()
    drawn = SHAPES.copy()
    drawn[2] = patch(0, 0, columns=3)
    region = find_region(encoder(drawn), MASK, images, KEY)
    np.testing.assert_array_equal(np.flatnonzero(region.any(axis=0)), range(5))
    np.testing.assert_array_equal(np.flatnonzero(region.any(axis=1)), range(7))
    assert told(encoder(drawn), region, images, shades) < 0.02


def test_what_tints_the_whole_image_has_no_region():
    tinted, tint = SHAPES.copy(), 0.5
    tinted[2] += tint * (1 - SHAPES[2])
    region = find_region(encoder(tinted, tint), MASK, frames(tinted)[0], KEY)
    assert region.all()


def test_nothing_masked_reaches_nothing():
    inactive = np.array([False, False, False, True])
    assert not find_region(encoder(), inactive, frames()[0], KEY).any()
