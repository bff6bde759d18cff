"""Convolution on a CPU: which algorithm for which shape, and each algorithm.

XLA's CPU backend has a fast convolution, which it reaches only from a canonical form: NHWC input,
HWIO kernel, no window reversal, and in a loop body no transpose left for it to make. Gradients and
transposed convolutions seldom arrive in that form, and then run 10 to 1000 times slower. Here each
becomes a canonical convolution or a matrix product. The thresholds are measured on x86 with
AVX-512, two cores, batch 64.

Letters: N images, H × W pixels, C input channels, O output channels, K kernel side. On each axis

    output[o] = Σ_k dilated_input[stride · o + k − low] · kernel[k],

`low` being the padding before the first pixel and `dilated_input` the input with zeros between.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

NHWC = ("NHWC", "HWIO", "NHWC")
# Smallest images: XLA's convolution runs at 1-5 GFLOP/s on 2 × 2 pixels, a matrix product at 100.
_FEW_PIXELS = 4
# Up to 16 × 16 pixels, a transposed convolution is fastest as one product for all taps; above, its
# K² · O columns fall out of cache and a convolution of blocks wins.
_SCATTER_PIXELS = 256
# A weight gradient reads the output's gradient once for every kernel entry: it should fit in cache.
_CACHED_ELEMENTS = 2**18


@dataclass(frozen=True)
class Geometry:
    """What is static: per axis (rows, columns)."""

    strides: tuple[int, int]
    padding: tuple[tuple[int, int], tuple[int, int]]
    dilation: tuple[int, int]  # of the input: the stride of a transposed convolution

    def output_size(self, axis: int, size: int, kernel: int) -> int:
        """Pixels that come out along one axis."""
        dilated = (size - 1) * self.dilation[axis] + 1
        return (dilated + sum(self.padding[axis]) - kernel) // self.strides[axis] + 1

    def adjoint(self, x_shape: tuple[int, ...], w_shape: tuple[int, ...]) -> "Geometry":
        """Of the map from the output's gradient to the input's, with the kernel flipped."""
        padding = []
        for axis, (stride, dilation) in enumerate(zip(self.strides, self.dilation, strict=True)):
            size, kernel = x_shape[1 + axis], w_shape[axis]
            low = kernel - 1 - self.padding[axis][0]
            gradient = (self.output_size(axis, size, kernel) - 1) * stride + 1
            padding.append((low, (size - 1) * dilation + kernel - gradient - low))
        return Geometry(self.dilation, (padding[0], padding[1]), self.strides)


def forward(geometry: Geometry, x: Array, w: Array) -> Array:
    """The convolution, by the algorithm that is fastest for its shape on a CPU."""
    n, height, width = x.shape[:3]
    kernel, outputs = w.shape[:2], w.shape[3]
    out = (
        geometry.output_size(0, height, kernel[0]),
        geometry.output_size(1, width, kernel[1]),
    )
    if geometry.dilation != (1, 1):
        divisible = all(o % d == 0 for o, d in zip(out, geometry.dilation, strict=True))
        if divisible and height * width > _SCATTER_PIXELS:
            return _blocked(geometry, x, w, geometry.dilation)
        return _scatter(geometry, x, w, out)
    if kernel == (1, 1) or out[0] * out[1] <= _FEW_PIXELS:
        patches = jnp.concatenate(_taps(geometry, x, kernel, out), axis=-1)
        y = patches.reshape(n * out[0] * out[1], -1) @ w.reshape(-1, outputs)
        return y.reshape(n, *out, outputs)
    blocks = _blocks(geometry, x.shape, w.shape, out)
    if blocks != (0, 0):
        return _blocked(geometry, x, w, blocks)
    return _xla(geometry, x, w)


def _xla(geometry: Geometry, x: Array, w: Array) -> Array:
    return lax.conv_general_dilated(
        x, w, geometry.strides, geometry.padding, dimension_numbers=NHWC
    )


def _taps(geometry: Geometry, x: Array, kernel, out) -> list[Array]:
    """For every kernel position, row-major, the input pixels it meets: K·K of [N, *out, C]."""
    x = jnp.pad(x, ((0, 0), *geometry.padding, (0, 0)))
    (rows, columns), (down, right) = out, geometry.strides
    return [
        x[:, i : i + down * (rows - 1) + 1 : down, j : j + right * (columns - 1) + 1 : right]
        for i in range(kernel[0])
        for j in range(kernel[1])
    ]


def _scatter(geometry: Geometry, x: Array, w: Array, out: tuple[int, int]) -> Array:
    """A transposed convolution: one product for all taps, then each output phase sums its own."""
    n, height, width, channels = x.shape
    kernel, outputs = w.shape[:2], w.shape[3]
    blocks = tuple(-(-o // d) for o, d in zip(out, geometry.dilation, strict=True))
    # taps[axis][phase]: (kernel position, shift of the input) that reach this phase of the output
    taps = [
        [
            [(k, (r + k - low) // d) for k in range(kernel[axis]) if (r + k - low) % d == 0]
            for r in range(d)
        ]
        for axis, (d, (low, _)) in enumerate(zip(geometry.dilation, geometry.padding, strict=True))
    ]
    shifts = [[shift for phase in axis for _, shift in phase] for axis in taps]
    before = [max(0, -min(s)) for s in shifts]
    after = [
        max(0, b + max(s) - size)
        for s, b, size in zip(shifts, blocks, (height, width), strict=True)
    ]
    products = x.reshape(-1, channels) @ w.transpose(2, 0, 1, 3).reshape(channels, -1)
    products = products.reshape(n, height, width, *kernel, outputs)
    products = jnp.pad(
        products,
        ((0, 0), (before[0], after[0]), (before[1], after[1]), (0, 0), (0, 0), (0, 0)),
    )

    def phase(rows, columns):
        total = jnp.zeros((n, *blocks, outputs), x.dtype)
        for i, down in rows:
            for j, right in columns:
                top, left = before[0] + down, before[1] + right
                total += products[:, top : top + blocks[0], left : left + blocks[1], i, j]
        return total

    phases = jnp.stack([phase(rows, columns) for rows in taps[0] for columns in taps[1]])
    phases = phases.reshape(*geometry.dilation, n, *blocks, outputs).transpose(2, 3, 0, 4, 1, 5)
    full = phases.reshape(n, *(b * d for b, d in zip(blocks, geometry.dilation, strict=True)), -1)
    return full[:, : out[0], : out[1]]


def _blocks(geometry: Geometry, x_shape, w_shape, out) -> tuple[int, int]:
    """Output pixels per block for an undilated convolution whose channels are too few to fill a
    vector register; (0, 0) where blocks do not pay (all measured)."""
    (kernel, _, channels, outputs), width = w_shape, x_shape[2]
    if geometry.strides == (2, 2) and channels <= 8:
        rows, columns = (1, 1) if kernel >= 5 else (0, 2)
    elif (
        geometry.strides == (1, 1) and min(channels, outputs) <= 8 and max(channels, outputs) <= 16
    ):
        rows, columns = 0, 4 if max(channels, outputs) <= 8 else 2
    else:
        return 0, 0
    fits = out[1] % columns == 0 and width == out[1] * geometry.strides[1]
    fits &= rows == 0 or x_shape[1] == out[0] * geometry.strides[0]
    return (rows, columns) if fits else (0, 0)


def _blocked(geometry: Geometry, x: Array, w: Array, blocks: tuple[int, int]) -> Array:
    """The same convolution between images of blocks: blocks[axis] output pixels become channels.

    Strides and dilation become 1 on a blocked axis (0: left as it is), the channels more, the
    kernel's entries shared between them. A block of columns costs nothing: it is a reshape.
    """
    n, outputs = x.shape[0], w.shape[3]
    selections, padding, strides, inputs, pixels = [], [], [], [], []
    for axis, size in enumerate(blocks):
        kernel = w.shape[axis]
        if size == 0:
            selections.append(np.eye(kernel, dtype=np.float32)[:, None, None])
            padding.append(geometry.padding[axis])
            strides.append(geometry.strides[axis])
        else:
            selection, pads = _block_axis(geometry, axis, x.shape[1 + axis], kernel, size)
            selections.append(selection)
            padding.append(pads)
            strides.append(1)
        inputs.append(selections[axis].shape[1])
        pixels.append(selections[axis].shape[2])
    rows, columns = selections
    w = jnp.einsum("apqk,brsl,klco->abprcqso", rows, columns, w)
    w = w.reshape(len(rows), len(columns), -1, pixels[0] * pixels[1] * outputs)
    x = _to_blocks(x, inputs[0], inputs[1])
    y = _xla(Geometry(tuple(strides), tuple(padding), (1, 1)), x, w)
    y = y.reshape(*y.shape[:3], pixels[0], pixels[1] * outputs).swapaxes(2, 3)
    return y.reshape(n, y.shape[1] * pixels[0], -1, outputs)


def _to_blocks(x: Array, rows: int, columns: int) -> Array:
    n, height, width, channels = x.shape
    x = x.reshape(n, height // rows, rows, width // columns, columns * channels)
    return x.swapaxes(2, 3).reshape(n, height // rows, width // columns, -1)


def _block_axis(geometry: Geometry, axis: int, size: int, kernel: int, block: int):
    """One axis of a blocked convolution: which kernel entry joins which pixels, and the padding.

    Returns:
      [T, P, Q, K] zeros and ones: entry k joins pixel p of the t-th input block in reach to pixel q
      of the output block; and the padding in blocks.
    """
    stride, dilation = geometry.strides[axis], geometry.dilation[axis]
    low = geometry.padding[axis][0]
    inputs = stride * block // dilation
    joins = [
        (*divmod((stride * q + k - low) // dilation, inputs), q, k)
        for q in range(block)
        for k in range(kernel)
        if (stride * q + k - low) % dilation == 0
    ]
    first, last = min(j[0] for j in joins), max(j[0] for j in joins)
    selection = np.zeros((last - first + 1, inputs, block, kernel), np.float32)
    for t, p, q, k in joins:
        selection[t - first, p, q, k] = 1
    out_blocks = geometry.output_size(axis, size, kernel) // block
    return selection, (-first, out_blocks - 1 + last - size // inputs + 1)


def weight_gradient(geometry: Geometry, x: Array, gradient: Array, kernel) -> Array:
    """The gradient with respect to the kernel, [K, K, C, O]."""
    if geometry.dilation != (1, 1):  # the same sum with input and output in each other's place
        adjoint = geometry.adjoint(x.shape, (*kernel, x.shape[3], gradient.shape[3]))
        return weight_gradient(adjoint, gradient, x, kernel)[::-1, ::-1].swapaxes(2, 3)
    n, out = len(x), gradient.shape[1:3]
    if kernel == (1, 1):
        (pixels,) = _taps(geometry, x, kernel, out)
        product = pixels.reshape(-1, x.shape[3]).T @ gradient.reshape(-1, gradient.shape[3])
        return product[None, None]
    chunks = 1
    while n % (2 * chunks) == 0 and n // chunks >= 32 and gradient.size > chunks * _CACHED_ELEMENTS:
        chunks *= 2
    parts = zip(jnp.split(x, chunks), jnp.split(gradient, chunks), strict=True)
    return jnp.sum(jnp.stack([_images_as_channels(geometry, *p, kernel) for p in parts]), axis=0)


def _images_as_channels(geometry: Geometry, x: Array, gradient: Array, kernel) -> Array:
    """A weight gradient as a convolution of the input by the output's gradient."""
    padding = [
        (low, s * (o - 1) + k - size - low)
        for s, o, k, size, (low, _) in zip(
            geometry.strides,
            gradient.shape[1:3],
            kernel,
            x.shape[1:3],
            geometry.padding,
            strict=True,
        )
    ]
    # The barriers keep XLA from folding the transposes into the convolution's layout, which in a
    # loop body it cannot undo: the fast path would be lost.
    y = lax.conv_general_dilated(
        lax.optimization_barrier(x.transpose(3, 1, 2, 0)),
        lax.optimization_barrier(gradient.transpose(1, 2, 0, 3)),
        (1, 1),
        padding,
        rhs_dilation=geometry.strides,
        dimension_numbers=NHWC,
    )
    return lax.optimization_barrier(y).transpose(1, 2, 0, 3)
