"""The convolution against XLA's own: values, both gradients, and every transformation we use."""

import jax
import jax.numpy as jnp
import pytest
from jax import lax
from jax.test_util import check_grads

from jaxdeconf.nets.cpu import conv_general_dilated

NHWC = ("NHWC", "HWIO", "NHWC")
# (image side, channels, outputs, kernel, stride, input dilation, padding)
LAYERS = [
    (32, 6, 5, 7, 2, 1, ((3, 3), (3, 3))),  # stem: blocks of rows and columns
    (16, 3, 8, 3, 2, 1, ((1, 1), (1, 1))),  # first VAE layer: blocks of columns
    (16, 8, 3, 3, 1, 1, "SAME"),  # RGB layer: blocks of four columns
    (12, 6, 16, 3, 1, 1, "SAME"),  # blocks of two columns
    (9, 5, 7, 3, 2, 1, "SAME"),  # odd side
    (8, 16, 17, 3, 1, 1, "VALID"),
    (2, 24, 20, 3, 1, 1, "SAME"),  # patches
    (4, 24, 20, 3, 2, 1, ((1, 1), (1, 1))),  # patches
    (8, 12, 20, 1, 2, 1, "SAME"),  # 1×1
    (2, 24, 20, 3, 1, 2, ((1, 2), (1, 2))),  # transposed: one product
    (5, 4, 6, 4, 1, 3, ((2, 1), (0, 2))),  # transposed, sides not divisible
    (18, 4, 6, 3, 1, 2, ((1, 2), (1, 2))),  # transposed: blocks
    (10, 4, 6, 3, 3, 1, ((0, 2), (1, 0))),  # stride 3, padded askew
    (6, 4, 6, 2, 1, 1, ((0, 1), (0, 1))),  # even kernel
    (6, 4, 6, 3, 2, 2, ((1, 1), (1, 1))),  # strided and dilated: XLA's
    (6, 4, 6, 1, 1, 1, ((1, 1), (1, 1))),  # padding beyond the kernel: XLA's
    (70, 16, 12, 3, 1, 1, "SAME"),  # its weight gradient comes in chunks of images
]


def arrays(side, channels, outputs, kernel, batch=3):
    x_key, w_key = jax.random.split(jax.random.key(0))
    return (
        jax.random.normal(x_key, (batch, side, side, channels)),
        jax.random.normal(w_key, (kernel, kernel, channels, outputs)),
    )


def convolution(function, stride, dilation, padding):
    def run(x, w):
        return function(
            x, w, (stride, stride), padding, (dilation, dilation), dimension_numbers=NHWC
        )

    return run


def value_and_gradients(run, x, w):
    def value(x, w):
        y, pull = jax.vjp(run, x, w)
        # A varied cotangent: all ones would hide a misplaced one.
        return y, *pull(jnp.sin(jnp.arange(y.size, dtype=jnp.float32)).reshape(y.shape))

    return value(x, w)


def assert_same(ours, theirs):
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert a.shape == b.shape
        assert jnp.abs(a - b).max() <= 1e-5 * jnp.abs(b).max()


@pytest.mark.parametrize("layer", LAYERS, ids=str)
def test_values_and_gradients_equal_xla(layer):
    side, channels, outputs, kernel, *rest = layer
    x, w = arrays(side, channels, outputs, kernel, batch=64 if side > 64 else 3)
    ours, theirs = (
        jax.jit(lambda x, w, f=f: value_and_gradients(convolution(f, *rest), x, w))(x, w)
        for f in (conv_general_dilated, lax.conv_general_dilated)
    )
    assert_same(ours, theirs)


@pytest.mark.parametrize("layer", [LAYERS[1], LAYERS[9]], ids=str)
def test_gradient_is_the_finite_difference(layer):
    side, channels, outputs, kernel, *rest = layer
    x, w = arrays(side, channels, outputs, kernel, batch=1)
    run = jax.jit(convolution(conv_general_dilated, *rest))
    # Linear in each operand: a step of one has no truncation error, only rounding.
    check_grads(run, (x, w), order=1, modes=["rev"], eps=1.0)


@pytest.mark.parametrize("layer", [LAYERS[5], LAYERS[9]], ids=str)
@pytest.mark.parametrize("in_axes", [(0, None), (None, 0), (0, 0)], ids=str)
def test_vmap_equals_loop(layer, in_axes):
    side, channels, outputs, kernel, *rest = layer
    x, w = arrays(side, channels, outputs, kernel)
    scale = jnp.array([1.0, -0.5])
    stacked = [
        v if axis is None else jnp.multiply.outer(scale, v)
        for v, axis in zip((x, w), in_axes, strict=True)
    ]

    def both(x, w):
        return value_and_gradients(convolution(conv_general_dilated, *rest), x, w)

    mapped = jax.jit(jax.vmap(both, in_axes))(*stacked)
    for m in range(2):
        pick = (v if axis is None else v[m] for v, axis in zip(stacked, in_axes, strict=True))
        assert_same([leaf[m] for leaf in mapped], jax.jit(both)(*pick))


def test_scan_equals_loop():
    x, w = arrays(8, 4, 4, 3)
    run = convolution(conv_general_dilated, 1, 1, "SAME")

    def step(w, _):
        gradient = jax.grad(lambda w: jnp.mean(run(x, w) ** 2))(w)
        return w - 0.1 * gradient, None

    scanned = jax.jit(lambda w: lax.scan(step, w, None, length=3)[0])(w)
    looped = w
    for _ in range(3):
        looped = jax.jit(lambda w: step(w, None)[0])(looped)
    assert_same(scanned, looped)


def test_bfloat16_other_layouts_and_groups_are_left_to_xla():
    x, w = arrays(6, 4, 4, 3)
    cases = [
        ((x.astype(jnp.bfloat16), w.astype(jnp.bfloat16)), {"dimension_numbers": NHWC}),
        ((x.transpose(0, 3, 1, 2), w.transpose(3, 2, 0, 1)), {}),
        ((x, w[:, :, :2]), {"dimension_numbers": NHWC, "feature_group_count": 2}),
        ((x, w), {"dimension_numbers": NHWC, "rhs_dilation": (2, 2)}),
    ]
    for operands, keywords in cases:
        ours = conv_general_dilated(*operands, (1, 1), "SAME", **keywords)
        theirs = lax.conv_general_dilated(*operands, (1, 1), "SAME", **keywords)
        assert ours.dtype == theirs.dtype
        assert (ours == theirs).all()


def test_errors_are_xlas():
    x, w = arrays(6, 4, 4, 3)
    with pytest.raises((TypeError, ValueError), match="feature_group_count"):
        conv_general_dilated(x, w[:, :, :3], (1, 1), "SAME", dimension_numbers=NHWC)
    with pytest.raises(ValueError, match="String padding"):
        conv_general_dilated(x, w, (1, 1), "SAME", (2, 2), dimension_numbers=NHWC)
