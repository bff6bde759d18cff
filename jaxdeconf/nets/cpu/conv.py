"""A drop-in for `lax.conv_general_dilated` that is fast on a CPU, inside `scan` and under `vmap`.

On a CPU it is one of `algorithms`, with a gradient of its own; on other platforms, and for cases
outside the fast path (groups, kernel dilation, other layouts or types), it is XLA's convolution
unchanged. Pass it to Flax as `nn.Conv(..., conv_general_dilated=...)`.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_batching import custom_vmap

from jaxdeconf.nets.cpu.algorithms import NHWC, Geometry, forward, weight_gradient


def conv_general_dilated(
    lhs: Array,
    rhs: Array,
    window_strides,
    padding,
    lhs_dilation=None,
    rhs_dilation=None,
    dimension_numbers=None,
    **kwargs,
) -> Array:
    """Convolve; arguments, errors and result as `jax.lax.conv_general_dilated`.

    Fast on a CPU for float32 [N, H, W, C] by [K, K, C, O] with any padding, and strides or input
    dilation. Reverse mode only there. Under `vmap` over kernels, models run one after another
    (XLA's own rule, grouped convolutions, is slow on a CPU).
    """
    dilation = (1, 1) if lhs_dilation is None else tuple(lhs_dilation)
    plain = (
        jax.default_backend() == "cpu"
        and lhs.ndim == rhs.ndim == 4
        and _is_nhwc(lhs.shape, rhs.shape, dimension_numbers)
        and lhs.dtype == rhs.dtype == jnp.float32
        and lhs.shape[3] == rhs.shape[2]
        and lhs.size > 0
        and (rhs_dilation is None or tuple(rhs_dilation) == (1, 1))
        and not (isinstance(padding, str) and dilation != (1, 1))
        and all(v is None or v == 1 for v in kwargs.values())  # groups, precision, sharding
    )
    if plain:
        if isinstance(padding, str):
            padding = lax.padtype_to_pads(lhs.shape[1:3], rhs.shape[:2], window_strides, padding)
        rows, columns = ((int(low), int(high)) for low, high in padding)
        geometry = Geometry(tuple(window_strides), (rows, columns), dilation)
        if _fast(geometry, lhs.shape, rhs.shape):
            return _conv(geometry, lhs, rhs)
    return lax.conv_general_dilated(
        lhs,
        rhs,
        window_strides,
        padding,
        lhs_dilation=lhs_dilation,
        rhs_dilation=rhs_dilation,
        dimension_numbers=dimension_numbers,
        **kwargs,
    )


def _is_nhwc(x_shape, w_shape, dimension_numbers) -> bool:
    given, wanted = (
        lax.conv_dimension_numbers(x_shape, w_shape, numbers)
        for numbers in (dimension_numbers, NHWC)
    )
    return given == wanted


def _fast(geometry: Geometry, x_shape, w_shape) -> bool:
    """Not both strided and dilated, and no padding that is negative here or in the gradient."""
    if any(s > 1 and d > 1 for s, d in zip(geometry.strides, geometry.dilation, strict=True)):
        return False
    if min(geometry.output_size(a, x_shape[1 + a], w_shape[a]) for a in (0, 1)) < 1:
        return False
    adjoint = geometry.adjoint(x_shape, w_shape)
    return min(p for g in (geometry, adjoint) for low_high in g.padding for p in low_high) >= 0


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _conv(geometry: Geometry, x: Array, w: Array) -> Array:
    return _vmappable(forward, geometry)(x, w)


def _conv_fwd(geometry, x, w):
    return _conv(geometry, x, w), (x, w)


def _conv_bwd(geometry, residuals, gradient):
    x, w = residuals
    adjoint = geometry.adjoint(x.shape, w.shape)
    # The barrier keeps XLA from folding the flip back into the convolution as a window reversal,
    # which has no fast path.
    flipped = lax.optimization_barrier(w[::-1, ::-1].swapaxes(2, 3))
    w_gradient = _vmappable(partial(weight_gradient, kernel=w.shape[:2]), geometry)
    return _vmappable(forward, adjoint)(gradient, flipped), w_gradient(x, gradient)


_conv.defvjp(_conv_fwd, _conv_bwd)


def _vmappable(operation, geometry: Geometry):
    """`operation(geometry, a, b)` with a batching rule that keeps every convolution ungrouped."""

    @custom_vmap
    def run(a: Array, b: Array) -> Array:
        return operation(geometry, a, b)

    @run.def_vmap
    def _rule(size, batched, a, b):
        if operation is forward and tuple(batched) == (True, False):  # one kernel: a larger batch
            y = run(a.reshape(-1, *a.shape[2:]), b)
            return y.reshape(size, -1, *y.shape[1:]), True
        each = tuple(v if many else None for v, many in zip((a, b), batched, strict=True))
        y = lax.map(
            lambda v: run(*(u if u is not None else w for u, w in zip(v, (a, b), strict=True))),
            each,
        )
        return y, True

    return run
