"""The matrix products of a compiled update, without everything around them."""

from __future__ import annotations

import numpy as np
from numba import njit

from sb3_flock.rl.compiled_update import HALVES, _shapes
from sb3_flock.rl.layer_kernels import matrix, product, product_transposed, transposed_product

FORWARD, DOWN, WEIGHTS = range(3)
"""x W^T; dy W; dy^T x."""


def products_of(model, batch_size):
    """The products of one update in order: rows of kind, samples, inputs and outputs of a layer, ``(products, 4)``."""
    shapes = _shapes(model, batch_size)
    n, area, n_actions = batch_size // HALVES, shapes.kernel_size**2, model.action_space.shape[0]
    convolutions = [(n * positions, below * area, channels) for channels, below, positions, _ in shapes.convolutions.tolist()]
    channels, _, positions, _ = shapes.convolutions[-1].tolist()
    extractor = [*convolutions, (n, positions * channels, shapes.features)]

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
        *(backward(critic, True) + [(WEIGHTS, *join)]) * shapes.n_critics, *backward(extractor, False),
    ]  # fmt: skip
    actor_step = [
        *forward(extractor), *forward([*extractor, *actor]), *forward([join, *critic]),
        *((DOWN, *layer) for layer in reversed([join, *critic])), *backward(actor, True), *backward(extractor, False),
    ]  # fmt: skip
    return np.array((critic_step + actor_step) * HALVES)


def flops(products):
    """Additions and multiplications."""
    return 2 * int(products[:, 1:].prod(1).sum())


def run_products(products, updates):
    """Compute the products so many times, each layer's on memory of its own."""
    samples, inputs, outputs = products[:, 1:].T
    memory = [np.full(numbers.sum(), 0.01, np.float32) for numbers in (samples * inputs, samples * outputs, inputs * outputs)]
    _run(products, updates, *memory)


@njit(error_model="numpy")
def _run(products, updates, below, above, weights):
    for _ in range(updates):
        at_below, at_above, at_weights = 0, 0, 0
        for kind, n, inputs, outputs in products:
            x, y = matrix(below, at_below, n, inputs), matrix(above, at_above, n, outputs)
            weight = matrix(weights, at_weights, outputs, inputs)
            if kind == FORWARD:
                product_transposed(x, weight, y)
            elif kind == DOWN:
                product(y, weight, x)
            else:
                transposed_product(y, x, weight)
            at_below, at_above, at_weights = at_below + x.size, at_above + y.size, at_weights + weight.size
