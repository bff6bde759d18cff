"""3×3 stride-2 max-pooling as elementwise maxima, which XLA fuses; its own reduce-window and
select-and-scatter cost a CPU more than the ResNet stage that follows.

Letters: N images, H × W pixels, C channels; window k = 3·row + column of nine, 4 the centre.
"""

import jax
import jax.numpy as jnp
from jax import Array


@jax.custom_vjp
def max_pool(x: Array) -> Array:
    """The maximum over 3×3 windows, stride 2, one pixel of padding (ResNet's stem).

    The gradient goes to a window's first maximum in row-major order, as XLA's and PyTorch's does.

    Args:
      x: [N, H, W, C] float.
    Returns:
      [N, ⌈H/2⌉, ⌈W/2⌉, C].
    """
    return _max_and_argmax(x)[0]


def _max_and_argmax(x: Array) -> tuple[Array, Array]:
    height, width = x.shape[1:3]
    x = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)), constant_values=-jnp.inf)
    windows = [x[:, i : i + height : 2, j : j + width : 2] for i in range(3) for j in range(3)]
    maximum = windows[0]
    argmax = jnp.zeros(maximum.shape, jnp.int8)
    for k, window in enumerate(windows[1:], 1):
        argmax = jnp.where(window > maximum, jnp.int8(k), argmax)
        maximum = jnp.maximum(maximum, window)
    return maximum, argmax


def _forward(x: Array):
    maximum, argmax = _max_and_argmax(x)
    # An empty slice carries the input's size to the gradient.
    return maximum, (argmax, x[:0])


def _backward(residuals, gradient: Array):
    argmax, empty = residuals
    n, height, width, channels = gradient.shape
    margin = ((0, 0), (0, 1), (0, 1), (0, 0))
    argmax = jnp.pad(argmax, margin, constant_values=-1)
    gradient = jnp.pad(gradient, margin)

    def from_window(k: int, down: int, right: int) -> Array:
        here = slice(None), slice(down, down + height), slice(right, right + width)
        return jnp.where(argmax[here] == k, gradient[here], 0)

    # An even pixel is the centre of one window; an odd one lies at the edge of two.
    even_even = from_window(4, 0, 0)
    even_odd = from_window(5, 0, 0) + from_window(3, 0, 1)
    odd_even = from_window(7, 0, 0) + from_window(1, 1, 0)
    odd_odd = sum(from_window(8 - 6 * i - 2 * j, i, j) for i in (0, 1) for j in (0, 1))
    even = jnp.stack([even_even, even_odd], 3).reshape(n, height, 2 * width, channels)
    odd = jnp.stack([odd_even, odd_odd], 3).reshape(n, height, 2 * width, channels)
    full = jnp.stack([even, odd], 2).reshape(n, 2 * height, 2 * width, channels)
    return (full[:, : empty.shape[1], : empty.shape[2]],)


max_pool.defvjp(_forward, _backward)
