"""The β-VAE's networks: size, ranges, the linear path, gradients, and many models at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.nets import vae
from jaxdeconf.nets.vae import VAEConfig

SMALL = VAEConfig(channels=(4, 6), latents=2)
LINEAR = VAEConfig(channels=(4, 6), latents=2, linear_path=True)
SIZE = (16, 16)


init = jax.jit(vae.init, static_argnums=(0, 2))
encode = jax.jit(vae.encode, static_argnums=(0, 3))
decode = jax.jit(vae.decode, static_argnums=(0, 3, 4))


def images(batch=5, size=SIZE):
    return jax.random.uniform(jax.random.key(1), (batch, *size, 3))


@pytest.mark.parametrize(("latents", "count"), [(3, 3_169_385), (12, 3_224_699)])
def test_parameter_count_is_pytorch_vaes(latents, count):
    # BetaVAE's own: weights, biases, and two per normalised channel; running statistics apart.
    config = VAEConfig(latents=latents)
    shapes = jax.eval_shape(lambda key: vae.init(config, key, (64, 64)), jax.random.key(0))
    assert sum(np.prod(leaf.shape) for leaf in jax.tree.leaves(shapes["params"])) == count


@pytest.mark.parametrize(
    ("linear_path", "norm", "decoder", "size"),
    [
        (False, "batch", "convolutions", (32, 64)),
        (True, "none", "convolutions", (64, 32)),
        (True, "batch", "coordinates", (32, 64)),
        (False, "batch", "coordinates", (14, 22)),
    ],
)
def test_round_trip_shapes_and_range(linear_path, norm, decoder, size):
    config = VAEConfig((4, 6), 2, linear_path, norm, decoder=decoder, width=8)
    variables = init(config, jax.random.key(0), size)
    mean, log_variance, batch_stats = encode(config, variables, images(size=size), True)
    assert mean.shape == log_variance.shape == (5, 2)
    variables = {**variables, "batch_stats": batch_stats}
    decoded, batch_stats = decode(config, variables, mean, size, True)
    assert decoded.shape == (5, *size, 3)
    assert jax.tree.structure(batch_stats) == jax.tree.structure(variables["batch_stats"])
    if not linear_path:
        assert decoded.min() >= 0  # the tanh saturates in float32
        assert decoded.max() <= 1


def test_each_half_updates_its_own_statistics():
    variables = init(SMALL, jax.random.key(0), SIZE)
    mean, _, encoded = encode(SMALL, variables, images(), True)
    _, decoded = decode(SMALL, {**variables, "batch_stats": encoded}, mean, SIZE, True)
    before = variables["batch_stats"]

    def same(a, b):
        return jax.tree.all(jax.tree.map(jnp.array_equal, a, b))

    assert not same(encoded["encoder"], before["encoder"])
    assert same(encoded["decoder"], before["decoder"])
    assert same(decoded["encoder"], encoded["encoder"])
    assert not same(decoded["decoder"], before["decoder"])


def test_linear_path_starts_as_the_linear_autoencoder_it_is_given():
    variables = init(LINEAR, jax.random.key(0), SIZE)
    assert all(not leaf.any() for leaf in jax.tree.leaves(variables["params"]["linear"]))
    pixels = images().reshape(5, -1)
    pixel_mean = pixels.mean(0)
    components = jnp.linalg.svd(pixels - pixel_mean, full_matrices=False)[2][:2]
    variables["params"]["linear"] = {
        "encoder": components.T,
        "decoder": components,
        "pixel_mean": pixel_mean,
    }
    mean, log_variance, _ = encode(LINEAR, variables, images(), False)
    np.testing.assert_allclose(mean, (pixels - pixel_mean) @ components.T, atol=1e-5)
    assert not log_variance.any()
    decoded, _ = decode(LINEAR, variables, mean, SIZE, False)
    expected = pixel_mean + mean @ components
    np.testing.assert_allclose(decoded.reshape(5, -1), expected, atol=1e-5)


def reconstruction_loss(config, variables, params, x):
    variables = {**variables, "params": params}
    mean, log_variance, batch_stats = encode(config, variables, x, True)
    decoded, _ = decode(config, {**variables, "batch_stats": batch_stats}, mean, SIZE, True)
    return jnp.mean((decoded - x) ** 2) + jnp.mean(log_variance**2)


def test_silent_convolutions_of_the_linear_path_still_learn():
    variables = init(LINEAR, jax.random.key(0), SIZE)
    linear = variables["params"]["linear"]
    linear["encoder"] = linear["encoder"] + 0.01
    linear["decoder"] = linear["decoder"] + 0.01
    # Arguments, not constants: XLA would spend half a minute folding them.
    gradient = jax.jit(
        lambda v, x: jax.grad(lambda p: reconstruction_loss(LINEAR, v, p, x))(v["params"])
    )(variables, images())
    assert jnp.abs(gradient["encoder"]["mean"]["kernel"]).max() > 0
    assert jnp.abs(gradient["decoder"]["rgb"]["kernel"]).max() > 0


def test_vmap_over_models_equals_loop():
    def loss_and_gradient(variables, x):
        return jax.value_and_grad(lambda p: reconstruction_loss(SMALL, variables, p, x))(
            variables["params"]
        )

    many = jax.vmap(lambda key: vae.init(SMALL, key, SIZE))(jax.random.split(jax.random.key(0), 2))
    losses, gradients = jax.jit(jax.vmap(loss_and_gradient, (0, None)))(many, images())
    one = jax.jit(loss_and_gradient)
    largest = max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(gradients))
    for m in range(2):
        loss, gradient = one(jax.tree.map(lambda leaf, m=m: leaf[m], many), images())
        np.testing.assert_allclose(losses[m], loss, rtol=1e-5)
        for a, b in zip(jax.tree.leaves(gradients), jax.tree.leaves(gradient), strict=True):
            np.testing.assert_allclose(a[m], b, rtol=1e-3, atol=1e-5 * largest)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"channels": ()}, "channels"),
        ({"latents": 0}, "latents"),
        ({"norm": "layer"}, "norm"),
        ({"dtype": "int8"}, "dtype"),
    ],
)
def test_wrong_configuration_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        VAEConfig(**arguments)


@pytest.mark.parametrize(
    ("decoder", "size", "expected"),
    [
        ("convolutions", (84, 84), r"multiples of 32 \(each of the 5 channels halves it\)"),
        ("convolutions", (64, 48), r"multiples of 32 \(each of the 5 channels halves it\)"),
        ("coordinates", (84, 63), r"multiples of 2 \(it is drawn in patches of 2 × 2\)"),
    ],
)
def test_sizes_that_the_decoder_cannot_draw_are_refused(decoder, size, expected):
    shown = f"{size[0]} × {size[1]}"
    with pytest.raises(ValueError, match=f"^size: expected {expected}, got {shown}$"):
        vae.init(VAEConfig(decoder=decoder), jax.random.key(0), size)
