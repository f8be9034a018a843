"""Layers of the networks, forward and backward, compiled by numba: twins of torch's layers, tested against them.

Matrices are ``(rows, columns)`` float32 and contiguous. Products go to BLAS (``blas_kernels``); all around a product is one loop.
Images are channels last: the numbers under one row of a kernel stand side by side.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float32]
Indices = NDArray[np.int64]

ZERO, ONE = np.float32(0), np.float32(1)
_NORM_EPSILON = np.float32(1e-5)
_SMALLEST_NORMAL_HALF = np.float32(2.0**-14)

_kernel = njit(error_model="numpy", cache=True)
"""Without numba's ``fastmath``: with it a function rounds otherwise where it was compiled into another one, and a process that
compiles ends at other bits than one that loads the cache. Sums along a row are of 16 parts, for the vector units."""


@_kernel
def matrix(memory: Array, offset: int, rows: int, columns: int) -> Array:
    """A part of flat memory as a matrix."""
    return memory[offset : offset + rows * columns].reshape(rows, columns)


@_kernel
def add_bias(out: Array, bias: Array) -> None:
    """Add a bias to every row."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] += bias[j]


@_kernel
def bias_relu(out: Array, bias: Array) -> None:
    """Add a bias to every row, then ReLU."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = max(out[i, j] + bias[j], ZERO)


@_kernel
def relu_backward(gradient: Array, out: Array) -> None:
    """The gradient in front of a ReLU, in place, from that behind it and its output."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            gradient[i, j] = gradient[i, j] if out[i, j] > 0 else ZERO


@_kernel
def sum_rows(gradient: Array, out: Array) -> None:
    """The gradient of a bias."""
    out[:] = 0
    for i in range(gradient.shape[0]):
        for j in range(gradient.shape[1]):
            out[j] += gradient[i, j]


@_kernel
def _sum(row: Array, parts: Array) -> np.float32:
    """The sum of a row, of 16 parts, each for every 16th number."""
    parts[:] = 0
    whole = len(row) // 16 * 16
    for start in range(0, whole, 16):
        for lane in range(16):
            parts[lane] += row[start + lane]
    total = ZERO
    for lane in range(16):
        total += parts[lane]
    for j in range(whole, len(row)):
        total += row[j]
    return total


@_kernel
def norm_relu(z: Array, bias: Array, weight: Array, norm_bias: Array, normed: Array, scale: Array, out: Array) -> None:
    """Bias, layer norm and ReLU; ``normed`` and ``scale`` are kept for the backward pass."""
    n, width = z.shape
    parts = np.empty(16, np.float32)
    add_bias(z, bias)
    for i in range(n):
        mean = _sum(z[i], parts) / np.float32(width)
        for j in range(width):
            z[i, j] -= mean
            normed[i, j] = z[i, j] * z[i, j]
        scale[i] = ONE / np.sqrt(_sum(normed[i], parts) / np.float32(width) + _NORM_EPSILON)
        for j in range(width):
            normed[i, j] = z[i, j] * scale[i]
            out[i, j] = max(normed[i, j] * weight[j] + norm_bias[j], ZERO)


@_kernel
def norm_relu_backward(
    gradient: Array, weight: Array, normed: Array, scale: Array, out: Array, d_weight: Array, d_norm_bias: Array
) -> None:
    """The gradient in front of :func:`norm_relu`, in place, and those of its parameters."""
    n, width = out.shape
    parts, products = np.empty(16, np.float32), np.empty(width, np.float32)
    relu_backward(gradient, out)
    sum_rows(gradient, d_norm_bias)
    d_weight[:] = 0
    for i in range(n):
        for j in range(width):
            d_weight[j] += gradient[i, j] * normed[i, j]
            gradient[i, j] *= weight[j]
            products[j] = gradient[i, j] * normed[i, j]
        mean, product_mean = _sum(gradient[i], parts) / np.float32(width), _sum(products, parts) / np.float32(width)
        for j in range(width):
            gradient[i, j] = (gradient[i, j] - mean - normed[i, j] * product_mean) * scale[i]


@_kernel
def inverting_bound_backward(gradient: Array, raw: Array, margin: float) -> None:
    """The gradient in front of :class:`~sb3_flock.rl.policies.InvertingBound`, in place."""
    for i in range(raw.shape[0]):
        for j in range(raw.shape[1]):
            room = ONE - raw[i, j] if gradient[i, j] < 0 else ONE + raw[i, j]
            gradient[i, j] *= min(max(room / np.float32(margin), -ONE), ONE)


@_kernel
def tanh_backward(gradient: Array, out: Array) -> None:
    """The gradient in front of a tanh, in place."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            gradient[i, j] *= ONE - out[i, j] * out[i, j]


@_kernel
def gather_patches(patches: Array, images: Array, starts: Indices, run: int) -> None:
    """The inputs of every kernel position of a convolution, from the layer below.

    :param patches: ``(batch, rows of kernels * run)``, filled
    :param images: ``(batch, positions below * channels)``
    :param starts: where each row of each kernel position starts in an image
    :param run: numbers under one row of a kernel: its side times the channels
    """
    for b in range(len(images)):
        patch, image = patches[b], images[b]
        for t in range(len(starts)):
            for c in range(run):
                patch[t * run + c] = image[starts[t] + c]


@_kernel
def scatter_patches(gradient: Array, images: Array, starts: Indices, run: int) -> None:
    """The backward pass of :func:`gather_patches`: from the gradient of the patches to that of the images."""
    for b in range(len(images)):
        patch, image = gradient[b], images[b]
        image[:] = 0
        for t in range(len(starts)):
            for c in range(run):
                image[starts[t] + c] += patch[t * run + c]


@_kernel
def swap_inner(kernel: Array, out: Array, n_out: int, outer: int, inner: int) -> None:
    """``(n_out, outer, inner)`` to ``(n_out, inner, outer)``, both flat."""
    for o in range(n_out):
        for a in range(outer):
            for b in range(inner):
                out[(o * inner + b) * outer + a] = kernel[(o * outer + a) * inner + b]


@_kernel
def read_image(image: Array, half: NDArray[np.uint16], channels: int, side: int, is_mirrored: bool) -> None:
    """An observation in half precision as an image in single precision, exactly; NaN and infinity stay what they are.

    :param image: ``(positions * channels,)``, filled
    :param half: bits of the float16 observation, ``(channels * positions,)``
    :param is_mirrored: left for right
    """
    area, u32 = side * side, np.uint32
    values = np.empty(len(half), np.float32)
    bits = values.view(np.uint32)
    for i in range(len(half)):
        magnitude = (u32(half[i]) & u32(0x7FFF)) << u32(13)
        shift = u32(113 << 23) if magnitude < u32(1 << 23) else u32(112 << 23)
        bits[i] = magnitude + (u32(224 << 23) if magnitude >= u32(31 << 23) else shift)
    for i in range(len(half)):
        # A subnormal half was read as if it were the smallest normal one plus itself.
        value = values[i] - (_SMALLEST_NORMAL_HALF if half[i] & u32(0x7C00) == 0 else ZERO)
        values[i] = -value if half[i] & u32(0x8000) else value
    for c in range(channels):
        for y in range(side):
            row = values[c * area + y * side : c * area + (y + 1) * side]
            for x in range(side):
                image[(y * side + (side - 1 - x if is_mirrored else x)) * channels + c] = row[x]


@_kernel
def adam(
    parameters: Array, mean: Array, square: Array, first: Array, second: Array, learning_rate: float, step: int
) -> None:
    """One step of Adam with torch's default coefficients, in place.

    :param first: a gradient, to which ``second`` is added
    :param step: counts from 1
    """
    size = np.float32(learning_rate / (1.0 - 0.9**step))
    root = np.float32(math.sqrt(1.0 - 0.999**step))
    rest1, beta2, rest2, epsilon = np.float32(0.1), np.float32(0.999), np.float32(0.001), np.float32(1e-8)
    for i in range(len(parameters)):
        gradient = first[i] + second[i]
        mean[i] += (gradient - mean[i]) * rest1
        square[i] = square[i] * beta2 + gradient * gradient * rest2
        parameters[i] -= size * mean[i] / (np.sqrt(square[i]) / root + epsilon)


@_kernel
def polyak(target: Array, online: Array, tau: float) -> None:
    """Move a target network towards the network that it follows, in place."""
    share = np.float32(tau)
    for i in range(len(target)):
        target[i] += (online[i] - target[i]) * share
