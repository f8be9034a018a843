"""Layers of the networks, forward and backward, compiled by numba: twins of torch's layers, tested against them.

Matrices are ``(rows, columns)`` float32 and contiguous. Matrix products go to BLAS; everything around a product is one loop.
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
_HALF_SCALE = np.float32(2.0**112)


@njit(error_model="numpy", cache=True)
def matrix(memory: Array, offset: int, rows: int, columns: int) -> Array:
    """A part of flat memory as a matrix."""
    return memory[offset : offset + rows * columns].reshape(rows, columns)


@njit(error_model="numpy", cache=True)
def product(a: Array, b: Array, out: Array) -> None:
    """a b."""
    np.dot(a, b, out)


@njit(error_model="numpy", cache=True)
def product_transposed(a: Array, b: Array, out: Array) -> None:
    """a b^T."""
    np.dot(a, b.T, out)


@njit(error_model="numpy", cache=True)
def transposed_product(a: Array, b: Array, out: Array) -> None:
    """a^T b."""
    np.dot(a.T, b, out)


@njit(error_model="numpy", cache=True)
def add_bias(out: Array, bias: Array) -> None:
    """Add a bias to every row."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] += bias[j]


@njit(error_model="numpy", cache=True)
def bias_relu(out: Array, bias: Array) -> None:
    """Add a bias to every row, then ReLU."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = max(out[i, j] + bias[j], ZERO)


@njit(error_model="numpy", cache=True)
def relu_backward(gradient: Array, out: Array) -> None:
    """The gradient in front of a ReLU, in place, from that behind it and its output."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            gradient[i, j] = gradient[i, j] if out[i, j] > 0 else ZERO


@njit(error_model="numpy", cache=True)
def sum_rows(gradient: Array, out: Array) -> None:
    """The gradient of a bias."""
    out[:] = 0
    for i in range(gradient.shape[0]):
        for j in range(gradient.shape[1]):
            out[j] += gradient[i, j]


@njit(error_model="numpy", cache=True)
def norm_relu(z: Array, bias: Array, weight: Array, norm_bias: Array, normed: Array, scale: Array, out: Array) -> None:
    """Bias, layer norm and ReLU; ``normed`` and ``scale`` are kept for the backward pass."""
    n, width = z.shape
    for i in range(n):
        total = ZERO
        for j in range(width):
            z[i, j] += bias[j]
            total += z[i, j]
        mean = total / np.float32(width)
        variance = ZERO
        for j in range(width):
            variance += (z[i, j] - mean) * (z[i, j] - mean)
        scale[i] = ONE / np.sqrt(variance / np.float32(width) + _NORM_EPSILON)
        for j in range(width):
            normed[i, j] = (z[i, j] - mean) * scale[i]
            out[i, j] = max(normed[i, j] * weight[j] + norm_bias[j], ZERO)


@njit(error_model="numpy", cache=True)
def norm_relu_backward(
    gradient: Array, weight: Array, normed: Array, scale: Array, out: Array, d_weight: Array, d_norm_bias: Array
) -> None:
    """The gradient in front of :func:`norm_relu`, in place, and those of its parameters."""
    n, width = out.shape
    d_weight[:] = 0
    d_norm_bias[:] = 0
    for i in range(n):
        mean, product_mean = ZERO, ZERO
        for j in range(width):
            g = gradient[i, j] if out[i, j] > 0 else ZERO
            d_weight[j] += g * normed[i, j]
            d_norm_bias[j] += g
            g *= weight[j]
            gradient[i, j] = g
            mean += g
            product_mean += g * normed[i, j]
        mean /= np.float32(width)
        product_mean /= np.float32(width)
        for j in range(width):
            gradient[i, j] = (gradient[i, j] - mean - normed[i, j] * product_mean) * scale[i]


@njit(error_model="numpy", cache=True)
def inverting_bound_backward(gradient: Array, raw: Array, margin: float) -> None:
    """The gradient in front of :class:`~sb3_flock.rl.policies.InvertingBound`, in place."""
    for i in range(raw.shape[0]):
        for j in range(raw.shape[1]):
            room = ONE - raw[i, j] if gradient[i, j] < 0 else ONE + raw[i, j]
            gradient[i, j] *= min(max(room / np.float32(margin), -ONE), ONE)


@njit(error_model="numpy", cache=True)
def tanh_backward(gradient: Array, out: Array) -> None:
    """The gradient in front of a tanh, in place."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            gradient[i, j] *= ONE - out[i, j] * out[i, j]


@njit(error_model="numpy", cache=True)
def gather_rows(out: Array, below: Array, taps: Indices, batch: int, channels: int) -> None:
    """The patches of a convolution, ``batch * taps * channels``, from the layer below, ``batch * positions * channels``."""
    n_taps, n_below = len(taps), len(below) // (batch * channels)
    for b in range(batch):
        for t in range(n_taps):
            to, at = (b * n_taps + t) * channels, (b * n_below + taps[t]) * channels
            for c in range(channels):
                out[to + c] = below[at + c]


@njit(error_model="numpy", cache=True)
def scatter_rows(gradient: Array, below: Array, taps: Indices, batch: int, channels: int) -> None:
    """The backward pass of :func:`gather_rows`."""
    n_taps, n_below = len(taps), len(below) // (batch * channels)
    below[:] = 0
    for b in range(batch):
        for t in range(n_taps):
            at, to = (b * n_taps + t) * channels, (b * n_below + taps[t]) * channels
            for c in range(channels):
                below[to + c] += gradient[at + c]


@njit(error_model="numpy", cache=True)
def swap_inner(kernel: Array, out: Array, n_out: int, outer: int, inner: int) -> None:
    """``(n_out, outer, inner)`` to ``(n_out, inner, outer)``, both flat."""
    for o in range(n_out):
        for a in range(outer):
            for b in range(inner):
                out[(o * inner + b) * outer + a] = kernel[(o * outer + a) * inner + b]


@njit(error_model="numpy", cache=True)
def gather_patches(
    patches: Array,
    observations: NDArray[np.uint16],
    rows: Indices,
    envs: Indices,
    separate: NDArray[np.uint16],
    separate_index: Indices,
    taps: Indices,
    mirrored_taps: Indices,
    n_mirrored: int,
) -> None:
    """The first convolution's patches of a minibatch, straight from the replay buffer in half precision.

    :param patches: ``(batch * positions, channels * kernel_size^2)``, filled
    :param observations: bits of the float16 observations, ``(rows, envs, pixels)``
    :param rows: row of each sample in the buffer, taken modulo its length
    :param envs: env of each sample
    :param separate: observations stored outside the rows, ``(any, pixels)``
    :param separate_index: for each sample its row there, or -1
    :param taps: pixel of each entry of a sample's patches
    :param mirrored_taps: the same, left for right, for the first ``n_mirrored`` samples
    """
    pixels, n_rows = observations.shape[2], observations.shape[0]
    bits = np.empty(pixels, np.uint32)
    values = bits.view(np.float32)
    flat = patches.reshape(len(rows), len(taps))
    for b in range(len(rows)):
        if separate_index[b] >= 0:
            half = separate[separate_index[b]]
        else:
            half = observations[rows[b] % n_rows, envs[b]]
        for i in range(pixels):  # exact for every finite number: the exponent's bias is corrected by a product
            h = np.uint32(half[i])
            bits[i] = ((h & np.uint32(0x7FFF)) << np.uint32(13)) | ((h & np.uint32(0x8000)) << np.uint32(16))
        for i in range(pixels):
            values[i] *= _HALF_SCALE
        if b < n_mirrored:
            for j in range(len(taps)):
                flat[b, j] = values[mirrored_taps[j]]
        else:
            for j in range(len(taps)):
                flat[b, j] = values[taps[j]]


@njit(error_model="numpy", cache=True)
def adam(parameters: Array, mean: Array, square: Array, gradient: Array, learning_rate: float, step: int) -> None:
    """One step of Adam with torch's default coefficients, in place; ``step`` counts from 1."""
    size = np.float32(learning_rate / (1.0 - 0.9**step))
    root = np.float32(math.sqrt(1.0 - 0.999**step))
    rest1, beta2, rest2, epsilon = np.float32(0.1), np.float32(0.999), np.float32(0.001), np.float32(1e-8)
    for i in range(len(parameters)):
        mean[i] += (gradient[i] - mean[i]) * rest1
        square[i] = square[i] * beta2 + gradient[i] * gradient[i] * rest2
        parameters[i] -= size * mean[i] / (np.sqrt(square[i]) / root + epsilon)


@njit(error_model="numpy", cache=True)
def polyak(target: Array, online: Array, tau: float) -> None:
    """Move a target network towards the network that it follows, in place."""
    share = np.float32(tau)
    for i in range(len(target)):
        target[i] += (online[i] - target[i]) * share
