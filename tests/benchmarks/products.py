"""The matrix products of a compiled update, without everything around them."""

from __future__ import annotations

import numpy as np
from numba import njit

from sb3_flock.rl.blas_kernels import product, product_transposed, transposed_product
from sb3_flock.rl.compiled_update import _shapes
from sb3_flock.rl.layer_kernels import matrix
from sb3_flock.rl.update_kernels import HALVES

FORWARD, DOWN, WEIGHTS = range(3)
"""x W^T; dy W; dy^T x."""


def products_of(model, batch_size):
    """The products of one update in order: rows of kind, samples, inputs and outputs of a layer, ``(products, 4)``."""
    shapes = _shapes(model, batch_size)
    n, area, n_actions = batch_size // HALVES, shapes.kernel_size**2, model.action_space.shape[0]
    convolutions = shapes.convolutions.tolist()
    extractor = [(n * positions, below * area, channels) for channels, below, positions, _ in convolutions]
    extractor.append((n, convolutions[-1][0] * convolutions[-1][2], shapes.features))

    def head(widths):
        return [(n, below, above) for below, above in zip(widths[:-1].tolist(), widths[1:].tolist(), strict=True)]

    actor, critic = head(shapes.actor_widths), head(shapes.critic_widths)
    join = (n, n_actions, shapes.action_layer)

    def forward(layers):
        return [(FORWARD, *layer) for layer in layers]

    def backward(layers, first_gets_input):
        both = [(kind, *layer) for layer in reversed(layers) for kind in (WEIGHTS, DOWN)]
        return both if first_gets_input else both[:-1]

    critics = [join, *critic] * shapes.n_critics
    critic_step = [
        *forward([*extractor, *actor]), *forward([*extractor, *critics]), *forward([*extractor, *critics]),
        *[*backward(critic, True), (WEIGHTS, *join)] * shapes.n_critics, *backward(extractor, False),
    ]  # fmt: skip
    actor_step = [
        *forward(extractor), *forward([*extractor, *actor]), *forward([join, *critic]),
        *((DOWN, *layer) for layer in reversed([join, *critic])), *backward(actor, True), *backward(extractor, False),
    ]  # fmt: skip
    return np.array((critic_step + actor_step) * HALVES)


def flops(products):
    """Additions and multiplications."""
    return 2 * int(products[:, 1:].prod(1).sum())


def memory_of(products):
    """Memory for the products, used again and again: the caches hold as much as they can."""
    samples, inputs, outputs = products[:, 1:].T
    rng = np.random.default_rng(0)
    sizes = [int(numbers.max()) for numbers in (samples * inputs, samples * outputs, inputs * outputs)]
    return *(rng.normal(size=size).astype(np.float32) for size in sizes), np.zeros(max(sizes), np.float32)


@njit(error_model="numpy")
def run_products(products, updates, below, above, weights, out):
    """Compute the products so many times, on :func:`memory_of` them."""
    for _ in range(updates):
        for kind, n, inputs, outputs in products:
            x, y, weight = matrix(below, 0, n, inputs), matrix(above, 0, n, outputs), matrix(weights, 0, outputs, inputs)
            if kind == FORWARD:
                product_transposed(x, weight, matrix(out, 0, n, outputs))
            elif kind == DOWN:
                product(y, weight, matrix(out, 0, n, inputs))
            else:
                transposed_product(y, x, matrix(out, 0, outputs, inputs))
