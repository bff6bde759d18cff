"""The pre-activation ResNet-18: size, batch statistics, gradients, and many models at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.nets import network
from jaxdeconf.nets.network import NetworkConfig

SMALL = NetworkConfig(width=4, stem="imagenet")


init = jax.jit(network.init, static_argnums=(0, 2, 3))
apply = jax.jit(network.apply, static_argnums=(0, 3))


def images(batch=6, size=(32, 32)):
    return jax.random.uniform(jax.random.key(1), (batch, *size, 6))


def test_parameter_count_is_resnet_18s():
    # torchvision-style count of He et al.'s pre-activation form with 6 input channels, 1 output.
    shapes = jax.eval_shape(
        lambda key: network.init(NetworkConfig(), key, (64, 64, 6), 1), jax.random.key(0)
    )
    sizes = [np.prod(leaf.shape) for leaf in jax.tree.leaves(shapes["params"])]
    assert sum(sizes) == 11_169_281


@pytest.mark.parametrize(
    ("stem", "norm", "size"), [("cifar", "batch", (20, 28)), ("imagenet", "none", (48, 80))]
)
def test_outputs_have_the_stated_shape(stem, norm, size):
    config = NetworkConfig(width=4, stem=stem, norm=norm)
    variables = init(config, jax.random.key(0), (*size, 6), 2)
    outputs, batch_stats = apply(config, variables, images(size=size), True)
    assert outputs.shape == (6, 2)
    assert jnp.isfinite(outputs).all()
    assert jax.tree.structure(batch_stats) == jax.tree.structure(variables["batch_stats"])


def test_running_statistics_follow_the_batches():
    variables = init(SMALL, jax.random.key(0), (32, 32, 6), 1)
    step = jax.jit(lambda variables: network.apply(SMALL, variables, images(), True))
    trained, _ = step(variables)
    for _ in range(200):
        variables = {**variables, "batch_stats": step(variables)[1]}
    evaluated, kept = apply(SMALL, variables, images(), False)
    # Flax keeps the biased variance, so on one repeated batch the two modes meet.
    np.testing.assert_allclose(evaluated, trained, rtol=1e-3, atol=1e-4)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, kept, variables["batch_stats"]))


def test_evaluation_treats_every_image_alone():
    variables = init(SMALL, jax.random.key(0), (32, 32, 6), 1)
    together, _ = apply(SMALL, variables, images(), False)
    alone, _ = apply(SMALL, variables, images()[:1], False)
    np.testing.assert_allclose(together[:1], alone, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_vmap_over_models_equals_loop_and_compiles_once():
    keys = jax.random.split(jax.random.key(0), 2)
    compiled = []

    def loss_and_gradient(variables, x):
        compiled.append(1)

        def loss(params):
            outputs, _ = apply(SMALL, {**variables, "params": params}, x, True)
            return jnp.mean((outputs - 1) ** 2)

        return jax.value_and_grad(loss)(variables["params"])

    many = jax.vmap(lambda key: network.init(SMALL, key, (32, 32, 6), 1))(keys)
    together = jax.jit(jax.vmap(loss_and_gradient, (0, None)))
    losses, gradients = together(many, images())
    together(many, images())
    assert len(compiled) == 1
    one = jax.jit(loss_and_gradient)
    for m in range(2):
        loss, gradient = one(jax.tree.map(lambda leaf, m=m: leaf[m], many), images())
        np.testing.assert_allclose(losses[m], loss, rtol=1e-4)
        for a, b in zip(jax.tree.leaves(gradients), jax.tree.leaves(gradient), strict=True):
            np.testing.assert_allclose(a[m], b, rtol=1e-3, atol=1e-4 * float(jnp.abs(b).max()))


def test_bfloat16_computes_close_to_float32_with_float32_parameters():
    half = NetworkConfig(width=4, stem="imagenet", dtype="bfloat16")
    variables = init(half, jax.random.key(0), (32, 32, 6), 1)
    assert {leaf.dtype for leaf in jax.tree.leaves(variables)} == {jnp.dtype("float32")}
    outputs, _ = apply(half, variables, images(), False)
    reference, _ = apply(SMALL, variables, images(), False)
    assert outputs.dtype == jnp.float32
    assert jnp.abs(outputs - reference).max() < 0.05 * jnp.abs(reference).max()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"width": 0}, "width"),
        ({"stem": "vgg"}, "stem"),
        ({"norm": "layer"}, "norm"),
        ({"dtype": "int8"}, "dtype"),
    ],
)
def test_wrong_configuration_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        NetworkConfig(**arguments)


def test_hidden_layers_train_too():
    config = NetworkConfig(width=4, stem="imagenet", norm="none", stages=1, hidden=(8, 6))
    variables = init(config, jax.random.key(0), (32, 32, 6), 2)
    assert variables["params"]["hidden_1"]["kernel"].shape == (4, 8)
    assert variables["params"]["head"]["kernel"].shape == (6, 2)
    assert "stage_2_block_1" not in variables["params"]

    def loss(params):
        return jnp.sum(
            network.apply(config, {**variables, "params": params}, images(), True)[0] ** 2
        )

    # A norm-free block without biases: every layer gets a gradient.
    for leaf in jax.tree.leaves(jax.grad(loss)(variables["params"])):
        assert jnp.abs(leaf).max() > 0


def test_a_look_is_what_apply_gives_and_the_features_of_the_last_layer():
    config = NetworkConfig(width=4, stem="imagenet", stages=2, hidden=(6,))
    variables = init(config, jax.random.key(0), (32, 32, 6), 2)
    look = jax.jit(network.look, static_argnums=(0, 3, 4))
    for train in (True, False):
        outputs, features, stats = look(config, variables, images(), train, None)
        plain, plain_stats = apply(config, variables, images(), train)
        np.testing.assert_array_equal(outputs, plain)
        assert jax.tree.all(jax.tree.map(jnp.array_equal, stats, plain_stats))
        assert features.shape == (6, 6)
        head = variables["params"]["head"]
        np.testing.assert_allclose(features @ head["kernel"] + head["bias"], outputs, rtol=1e-5)


def test_a_gate_stands_between_the_last_map_and_its_pool():
    config, shapes = NetworkConfig(width=4, stem="imagenet", stages=2), []
    variables = init(config, jax.random.key(0), (32, 48, 6), 2)

    def gate(x):
        shapes.append(x.shape)
        return x.at[:, 1:].set(0.0).at[:, :1].multiply(2.0)

    size = (32, 48)
    whole = []
    network.look(config, variables, images(size=size), False, lambda x: whole.append(x) or x)
    _, features, _ = network.look(config, variables, images(size=size), False, gate)
    assert shapes == [(6, 4, 6, 8)]
    np.testing.assert_allclose(features, 2 * whole[0][:, :1].sum((1, 2)) / 24, rtol=1e-5)
