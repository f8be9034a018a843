"""The update of DDPG and TD3 as one function, compiled by numba: the twin of SB3's, tested against it.

The parameters of a network are one flat array in the order of ``module.parameters()``; torch's modules are views of it.

A minibatch is two halves, whose gradients are added. Two threads compute one half each; one thread computes one after the
other and ends at the same bits.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sb3_flock.rl.barrier_kernels import wait_for_other
from sb3_flock.rl.blas_kernels import product, product_transposed, transposed_product
from sb3_flock.rl.layer_kernels import (
    ONE,
    ZERO,
    Array,
    Indices,
    adam,
    add_bias,
    bias_relu,
    gather_patches,
    inverting_bound_backward,
    matrix,
    norm_relu,
    norm_relu_backward,
    polyak,
    read_image,
    relu_backward,
    scatter_patches,
    sum_rows,
    swap_inner,
    tanh_backward,
)

HALVES = 2
"""Parts of a minibatch, whose gradients are added."""

_options: dict[str, Any] = {"error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_kernel = njit(**_options)
"""For functions that only compiled code calls: without wrappers for Python they compile twice as fast. Not cached: numba would
load them although a function that they call, in another file, has changed."""


class Shapes(NamedTuple):
    """Shapes of the networks and of a minibatch."""

    batch: int
    channels: int
    """Channels of an observation."""
    side: int
    """Anchors along a side of an observation."""
    kernel_size: int
    convolutions: Indices
    """A row for each convolution: output channels, input channels, positions, numbers in an image below."""
    starts: Indices
    """For each convolution where each row of each kernel position starts in an image below, filled up with zeros."""
    features: int
    has_norm: bool
    actor_widths: Indices
    """Widths of the actor's layers behind the features, the features' first."""
    critic_widths: Indices
    n_critics: int
    action_layer: int
    is_inverting: bool
    bound_margin: float
    at_head: int
    """Where a network's parameters behind the features extractor start."""
    at_actions: int
    """Where the parameters of the critics' action layers start."""


class Network(NamedTuple):
    """A network with its target network and the moments of its optimizer, as torch's Adam names them."""

    parameters: Array
    exp_avg: Array
    exp_avg_sq: Array
    target: Array
    """The target network's parameters."""
    gradients: Array
    """``(2, parameters)``, one row for each half of a minibatch."""


class ReplayArrays(NamedTuple):
    """The arrays of a :class:`~sb3_flock.rl.buffers.CompactReplayBuffer`."""

    observations: NDArray[np.uint16]
    """Bits of the float16 observations, ``(rows, envs, numbers)``."""
    actions: Array
    rewards: Array
    dones: Array
    timeouts: Array
    """1 where an episode ended by its time limit."""
    expert_actions: Array


class Batches(NamedTuple):
    """What the minibatches of a round of updates are, a row for each update."""

    rows: Indices
    envs: Indices
    last_index: Indices
    """Row of the next observation in ``last``, where an episode ended; else -1."""
    last: NDArray[np.uint16]
    noise: Array
    """Noise on the target actions, ``(updates, batch, actions)``; empty for none."""
    n_mirrored: int
    """Samples at the start of a minibatch that are mirrored, left for right."""


class Hyperparameters(NamedTuple):
    """Hyperparameters of an update."""

    gamma: float
    tau: float
    bc_coef: float
    actor_learning_rate: float
    critic_learning_rate: float


class Workspace(NamedTuple):
    """Memory of each half of a minibatch, a row for each; what ends in ``back`` holds gradients."""

    images: Array
    patches: Array
    next_patches: Array
    inputs: Array
    inputs_back: Array
    outputs: Array
    outputs_back: Array
    kernels: Array
    dense: Array
    normed: Array
    scale: Array
    features: Array
    features_back: Array
    hidden: Array
    hidden_back: Array
    critic_hidden: Array
    joined: Array
    joined_back: Array
    action_layer: Array
    actions: Array
    """Those of the replay buffer."""
    expert: Array
    chosen: Array
    """Those of the actor or of its target."""
    raw: Array
    """The same in front of the action bound."""
    raw_back: Array
    value: Array
    value_back: Array
    target: Array
    losses: NDArray[np.float64]
    """Sums over the half: critic, actor and behavior cloning loss."""


@_kernel
def _half(half: int, count: int) -> tuple[int, int]:
    """Where a half of so many things starts and stops."""
    middle = (count + 1) // HALVES
    return (0, middle) if half == 0 else (middle, count)


@_kernel
def _extract(half: int, n: int, patches: Array, w: Array, shapes: Shapes, ws: Workspace, features: Array) -> None:
    """The features extractor's forward pass over ``n`` samples."""
    at, at_in, at_out, below = 0, 0, 0, 0
    for layer in range(len(shapes.convolutions)):
        channels, channels_below, positions, size_below = shapes.convolutions[layer]
        area = shapes.kernel_size * shapes.kernel_size
        k, rows = area * channels_below, n * positions
        out = matrix(ws.outputs[half], at_out, rows, channels)
        kernel = ws.kernels[half, at : at + channels * k]
        swap_inner(w[at : at + channels * k], kernel, channels, channels_below, area)
        inputs = patches
        if layer:
            inputs = ws.inputs[half, at_in : at_in + rows * k]
            starts = shapes.starts[layer, : positions * shapes.kernel_size]
            images = matrix(ws.outputs[half], below, n, size_below)
            gather_patches(inputs.reshape(n, positions * k), images, starts, shapes.kernel_size * channels_below)
            at_in += rows * k
        product_transposed(inputs.reshape(rows, k), kernel.reshape(channels, k), out)
        bias_relu(out, w[at + channels * k : at + channels * (k + 1)])
        at += channels * (k + 1)
        below, at_out = at_out, at_out + rows * channels
    width, size = shapes.features, (at_out - below) // n
    dense, normed = matrix(ws.dense[half], 0, n, width), matrix(ws.normed[half], 0, n, width)
    product_transposed(matrix(ws.outputs[half], below, n, size), matrix(w, at, width, size), dense)
    at += width * size
    bias = w[at : at + width]
    if shapes.has_norm:
        norm, norm_bias = w[at + width : at + 2 * width], w[at + 2 * width : at + 3 * width]
        norm_relu(dense, bias, norm, norm_bias, normed, ws.scale[half], features)
    else:
        bias_relu(dense, bias)
        for i in range(n):
            for j in range(width):
                features[i, j] = dense[i, j]


@_kernel
def _extract_backward(
    half: int, n: int, gradient: Array, patches: Array, w: Array, g: Array, shapes: Shapes, ws: Workspace, features: Array
) -> None:
    """Its backward pass; ``gradient`` of the features is overwritten, the parameters' goes to ``g``."""
    width, area = shapes.features, shapes.kernel_size * shapes.kernel_size
    at, at_in, at_out, size = 0, 0, 0, 0
    for layer in range(len(shapes.convolutions)):
        channels, channels_below, positions, _ = shapes.convolutions[layer]
        at += channels * (area * channels_below + 1)
        at_in += n * positions * area * channels_below if layer else 0
        size = positions * channels
        at_out += n * size
    bias = at + width * size
    if shapes.has_norm:
        norm, norm_bias = bias + width, bias + 2 * width
        d_norm, d_norm_bias = g[norm:norm_bias], g[norm_bias : norm_bias + width]
        normed = matrix(ws.normed[half], 0, n, width)
        norm_relu_backward(gradient, w[norm:norm_bias], normed, ws.scale[half], features, d_norm, d_norm_bias)
    else:
        relu_backward(gradient, features)
    sum_rows(gradient, g[bias : bias + width])
    at_out -= n * size
    transposed_product(gradient, matrix(ws.outputs[half], at_out, n, size), matrix(g, at, width, size))
    product(gradient, matrix(w, at, width, size), matrix(ws.outputs_back[half], at_out, n, size))
    for layer in range(len(shapes.convolutions) - 1, -1, -1):
        channels, channels_below, positions, size_below = shapes.convolutions[layer]
        k, rows = area * channels_below, n * positions
        at -= channels * (k + 1)
        up = matrix(ws.outputs_back[half], at_out, rows, channels)
        relu_backward(up, matrix(ws.outputs[half], at_out, rows, channels))
        sum_rows(up, g[at + channels * k : at + channels * (k + 1)])
        inputs = patches
        if layer:
            at_in -= rows * k
            at_out -= n * size_below
            inputs = ws.inputs[half, at_in : at_in + rows * k]
            d_inputs = matrix(ws.inputs_back[half], 0, rows, k)
            product(up, matrix(ws.kernels[half], at, channels, k), d_inputs)
            starts = shapes.starts[layer, : positions * shapes.kernel_size]
            images = matrix(ws.outputs_back[half], at_out, n, size_below)
            scatter_patches(d_inputs.reshape(n, positions * k), images, starts, shapes.kernel_size * channels_below)
        d_kernel = ws.kernels[half, at : at + channels * k]
        transposed_product(up, inputs.reshape(rows, k), d_kernel.reshape(channels, k))
        swap_inner(d_kernel, g[at : at + channels * k], channels, area, channels_below)


@_kernel
def _head(below: Array, w: Array, at: int, widths: Indices, hidden: Array, out: Array) -> None:
    """Linear layers with ReLU between them, whose parameters start at ``at``."""
    n, o = len(below), 0
    for k in range(len(widths) - 1):
        n_in, n_out = widths[k], widths[k + 1]
        weight, bias = matrix(w, at, n_out, n_in), w[at + n_in * n_out : at + (n_in + 1) * n_out]
        if k == len(widths) - 2:
            product_transposed(below, weight, out)
            add_bias(out, bias)
        else:
            above = matrix(hidden, o, n, n_out)
            product_transposed(below, weight, above)
            bias_relu(above, bias)
            o += n * n_out
            below = above
        at += n_out * (n_in + 1)


@_kernel
def _head_backward(
    up: Array,
    bottom: Array,
    w: Array,
    g: Array,
    at: int,
    widths: Indices,
    hidden: Array,
    hidden_back: Array,
    bottom_back: Array,
    needs_weights: bool,
) -> None:
    """Its backward pass, from the gradient ``up`` of its output to that of its input."""
    n, o = len(bottom), 0
    for k in range(len(widths) - 1):
        at += widths[k + 1] * (widths[k] + 1)
        o += n * widths[k] if k else 0
    for k in range(len(widths) - 2, -1, -1):
        n_in, n_out = widths[k], widths[k + 1]
        at -= n_out * (n_in + 1)
        o -= n * n_in if k else 0
        below = matrix(hidden, o, n, n_in) if k else bottom
        if needs_weights:
            transposed_product(up, below, matrix(g, at, n_out, n_in))
            sum_rows(up, g[at + n_in * n_out : at + (n_in + 1) * n_out])
        down = matrix(hidden_back, o, n, n_in) if k else bottom_back
        product(up, matrix(w, at, n_out, n_in), down)
        if k:
            relu_backward(down, below)
        up = down


@_kernel
def _concat_action(features: Array, actions: Array, w: Array, at: int, action_layer: Array, joined: Array) -> None:
    """A critic's action layer, whose parameters start at ``at``, and its concatenation with the features."""
    (n, width), n_actions, n_out = features.shape, actions.shape[1], action_layer.shape[1]
    product_transposed(actions, matrix(w, at, n_out, n_actions), action_layer)
    bias_relu(action_layer, w[at + n_out * n_actions : at + n_out * (n_actions + 1)])
    for i in range(n):
        for j in range(width):
            joined[i, j] = features[i, j]
        for j in range(n_out):
            joined[i, width + j] = action_layer[i, j]


@_kernel
def _concat_action_backward(joined_back: Array, action_layer: Array, features_back: Array) -> None:
    """The backward pass of :func:`_concat_action`: adds to ``features_back``, and replaces ``action_layer`` by its gradient."""
    n, width = features_back.shape
    for i in range(n):
        for j in range(width):
            features_back[i, j] += joined_back[i, j]
        for j in range(action_layer.shape[1]):
            action_layer[i, j] = joined_back[i, width + j] if action_layer[i, j] > 0 else ZERO


@_kernel
def _bound(raw: Array, is_inverting: bool, out: Array) -> None:
    """The actor's action bound."""
    for i in range(raw.shape[0]):
        for j in range(raw.shape[1]):
            out[i, j] = min(max(raw[i, j], -ONE), ONE) if is_inverting else np.float32(np.tanh(raw[i, j]))


@_kernel
def _read_batch(
    half: int, start: int, stop: int, u: int, shapes: Shapes, replay: ReplayArrays, batches: Batches, ws: Workspace
) -> None:
    """Copy the patches and actions of samples ``start`` to ``stop`` of minibatch ``u``."""
    n_rows, run = len(replay.observations), shapes.kernel_size * shapes.channels
    starts = shapes.starts[0, : shapes.convolutions[0, 2] * shapes.kernel_size]
    images = matrix(ws.images[half], 0, stop - start, shapes.channels * shapes.side * shapes.side)
    shape = (stop - start, len(starts) * run)
    for patches, ahead in ((ws.patches, 0), (ws.next_patches, 1)):
        for b in range(start, stop):
            row, env, last = (batches.rows[u, b] + ahead) % n_rows, batches.envs[u, b], batches.last_index[u, b]
            observation = batches.last[last] if ahead and last >= 0 else replay.observations[row, env]
            read_image(images[b - start], observation, shapes.channels, shapes.side, b < batches.n_mirrored)
        gather_patches(matrix(patches[half], 0, *shape), images, starts, run)
    n_actions = replay.actions.shape[2]
    for b in range(start, stop):
        row, env = batches.rows[u, b], batches.envs[u, b]
        for k in range(n_actions):
            sign = -ONE if k == 1 and b < batches.n_mirrored else ONE
            at = (b - start) * n_actions + k
            ws.actions[half, at] = sign * replay.actions[row, env, k]
            if len(replay.expert_actions):
                ws.expert[half, at] = sign * replay.expert_actions[row, env, k]


@_kernel
def _critic_gradient(
    half: int,
    u: int,
    shapes: Shapes,
    actor: Network,
    critic: Network,
    replay: ReplayArrays,
    batches: Batches,
    hyper: Hyperparameters,
    ws: Workspace,
) -> None:
    """The critics' target of one half of minibatch ``u``, their losses and their gradient."""
    start, stop = _half(half, shapes.batch)
    n, n_actions, width = stop - start, replay.actions.shape[2], shapes.features
    ws.losses[half, 0] = 0.0
    if n == 0:  # a minibatch of one
        critic.gradients[half, :] = 0
        return
    _read_batch(half, start, stop, u, shapes, replay, batches, ws)
    n_head = (shapes.at_actions - shapes.at_head) // shapes.n_critics
    n_action_layer = shapes.action_layer * (n_actions + 1)
    features, features_back = matrix(ws.features[half], 0, n, width), matrix(ws.features_back[half], 0, n, width)
    hidden, hidden_back = ws.hidden[half], ws.hidden_back[half]
    joined = matrix(ws.joined[half], 0, n, width + shapes.action_layer)
    joined_back = matrix(ws.joined_back[half], 0, n, width + shapes.action_layer)
    action_layer = matrix(ws.action_layer[half], 0, n, shapes.action_layer)
    actions, chosen = matrix(ws.actions[half], 0, n, n_actions), matrix(ws.chosen[half], 0, n, n_actions)
    raw = matrix(ws.raw[half], 0, n, n_actions)
    value, value_back, target = matrix(ws.value[half], 0, n, 1), matrix(ws.value_back[half], 0, n, 1), ws.target[half]

    patches_size = shapes.convolutions[0, 2] * shapes.kernel_size * shapes.kernel_size * shapes.channels
    patches, next_patches = ws.patches[half, : n * patches_size], ws.next_patches[half, : n * patches_size]
    _extract(half, n, next_patches, actor.target, shapes, ws, features)
    _head(features, actor.target, shapes.at_head, shapes.actor_widths, hidden, raw)
    _bound(raw, shapes.is_inverting, chosen)
    if len(batches.noise):
        for b in range(n):
            for k in range(n_actions):
                chosen[b, k] = min(max(chosen[b, k] + batches.noise[u, start + b, k], -ONE), ONE)
    _extract(half, n, next_patches, critic.target, shapes, ws, features)
    for c in range(shapes.n_critics):
        _concat_action(features, chosen, critic.target, shapes.at_actions + c * n_action_layer, action_layer, joined)
        _head(joined, critic.target, shapes.at_head + c * n_head, shapes.critic_widths, hidden, value)
        for b in range(n):
            target[b] = value[b, 0] if c == 0 else np.minimum(target[b], value[b, 0])  # NaN stays NaN
    for b in range(n):
        row, env = batches.rows[u, start + b], batches.envs[u, start + b]
        has_ended = replay.dones[row, env] * (ONE - replay.timeouts[row, env])
        target[b] = replay.rewards[row, env] + (ONE - has_ended) * np.float32(hyper.gamma) * target[b]

    w, g = critic.parameters, critic.gradients[half]
    _extract(half, n, patches, w, shapes, ws, features)
    for i in range(n):
        for j in range(width):
            features_back[i, j] = ZERO
    for c in range(shapes.n_critics):
        at, at_head = shapes.at_actions + c * n_action_layer, shapes.at_head + c * n_head
        _concat_action(features, actions, w, at, action_layer, joined)
        _head(joined, w, at_head, shapes.critic_widths, hidden, value)
        for b in range(n):
            difference = value[b, 0] - target[b]
            ws.losses[half, 0] += difference * difference
            value_back[b, 0] = np.float32(2) * difference / np.float32(shapes.batch)
        _head_backward(value_back, joined, w, g, at_head, shapes.critic_widths, hidden, hidden_back, joined_back, True)
        _concat_action_backward(joined_back, action_layer, features_back)
        transposed_product(action_layer, actions, matrix(g, at, shapes.action_layer, n_actions))
        sum_rows(action_layer, g[at + shapes.action_layer * n_actions : at + n_action_layer])
    _extract_backward(half, n, features_back, patches, w, g, shapes, ws, features)


@_kernel
def _actor_gradient(
    half: int, shapes: Shapes, actor: Network, critic: Network, n_actions: int, hyper: Hyperparameters, ws: Workspace
) -> None:
    """The actor's losses on one half of the minibatch that :func:`_critic_gradient` read, and its gradient."""
    start, stop = _half(half, shapes.batch)
    n, width = stop - start, shapes.features
    ws.losses[half, 1] = ws.losses[half, 2] = 0.0
    if n == 0:
        actor.gradients[half, :] = 0
        return
    features, features_back = matrix(ws.features[half], 0, n, width), matrix(ws.features_back[half], 0, n, width)
    hidden, hidden_back = ws.hidden[half], ws.hidden_back[half]
    joined = matrix(ws.joined[half], 0, n, width + shapes.action_layer)
    joined_back = matrix(ws.joined_back[half], 0, n, width + shapes.action_layer)
    action_layer = matrix(ws.action_layer[half], 0, n, shapes.action_layer)
    chosen, expert = matrix(ws.chosen[half], 0, n, n_actions), matrix(ws.expert[half], 0, n, n_actions)
    raw, raw_back = matrix(ws.raw[half], 0, n, n_actions), matrix(ws.raw_back[half], 0, n, n_actions)
    value, value_back = matrix(ws.value[half], 0, n, 1), matrix(ws.value_back[half], 0, n, 1)
    patches_size = shapes.convolutions[0, 2] * shapes.kernel_size * shapes.kernel_size * shapes.channels
    patches = ws.patches[half, : n * patches_size]

    # The gradient of the first critic's value in the action; the state path gets none.
    w = critic.parameters
    _extract(half, n, patches, w, shapes, ws, features_back)
    _extract(half, n, patches, actor.parameters, shapes, ws, features)
    _head(features, actor.parameters, shapes.at_head, shapes.actor_widths, hidden, raw)
    _bound(raw, shapes.is_inverting, chosen)
    _concat_action(features_back, chosen, w, shapes.at_actions, action_layer, joined)
    _head(joined, w, shapes.at_head, shapes.critic_widths, ws.critic_hidden[half], value)
    for b in range(n):
        ws.losses[half, 1] -= value[b, 0]
        value_back[b, 0] = -ONE / np.float32(shapes.batch)
    no_gradients = actor.gradients[half]  # those of the critic are not computed
    _head_backward(
        value_back,
        joined,
        w,
        no_gradients,
        shapes.at_head,
        shapes.critic_widths,
        ws.critic_hidden[half],
        hidden_back,
        joined_back,
        False,
    )
    _concat_action_backward(joined_back, action_layer, features_back)
    product(action_layer, matrix(w, shapes.at_actions, shapes.action_layer, n_actions), raw_back)
    if hyper.bc_coef > 0:
        slope = np.float32(hyper.bc_coef / (n_actions * shapes.batch))
        for b in range(n):
            for k in range(n_actions):
                difference = chosen[b, k] - expert[b, k]
                ws.losses[half, 2] += abs(difference)
                raw_back[b, k] += slope * np.sign(difference)
    if shapes.is_inverting:
        inverting_bound_backward(raw_back, raw, shapes.bound_margin)
    else:
        tanh_backward(raw_back, chosen)
    w, g = actor.parameters, actor.gradients[half]
    _head_backward(raw_back, features, w, g, shapes.at_head, shapes.actor_widths, hidden, hidden_back, features_back, True)
    _extract_backward(half, n, features_back, patches, w, g, shapes, ws, features)


@_kernel
def _step(half: int, network: Network, learning_rate: float, step: int) -> None:
    """One step of a network's optimizer, in one half of its parameters."""
    start, stop = _half(half, len(network.parameters))
    adam(
        network.parameters[start:stop],
        network.exp_avg[start:stop],
        network.exp_avg_sq[start:stop],
        network.gradients[0, start:stop],
        network.gradients[1, start:stop],
        learning_rate,
        step,
    )


@_kernel
def _goes_on(barrier: NDArray[np.int64], thread: int, n_threads: int) -> bool:
    """Wait until the other thread is here, too, if there is one; false if it ended early."""
    return n_threads == 1 or wait_for_other(barrier, thread)


@_kernel
def _update(
    thread: int,
    n_threads: int,
    barrier: NDArray[np.int64],
    shapes: Shapes,
    actor: Network,
    critic: Network,
    replay: ReplayArrays,
    batches: Batches,
    hyper: Hyperparameters,
    ws: Workspace,
    steps: tuple[int, int],
    updates_actor: NDArray[np.bool_],
    losses: NDArray[np.float64],
) -> None:
    """A round of updates, one for each row of ``batches`` (Algorithm 1 of the paper; Fujimoto et al., 2018, for TD3).

    Each of one or two threads calls this with the same arguments and its own number.

    :param thread: 0, or 1 in the second of two threads
    :param barrier: from :func:`~sb3_flock.rl.barrier_kernels.new_barrier`
    :param steps: steps that the actor's and the critics' optimizer have taken
    :param updates_actor: for each update whether it is one of the actor and of the targets, too
    :param losses: ``(updates, 3)``, filled: critic loss, actor loss and behavior cloning loss
    """
    batch, n_actions = shapes.batch, replay.actions.shape[2]
    actor_step, critic_step = steps
    for u in range(len(batches.rows)):
        for half in range(thread, HALVES, n_threads):
            _critic_gradient(half, u, shapes, actor, critic, replay, batches, hyper, ws)
        if not _goes_on(barrier, thread, n_threads):
            return
        critic_step += 1
        losses[u, 0] = (ws.losses[0, 0] + ws.losses[1, 0]) / batch
        for half in range(thread, HALVES, n_threads):
            _step(half, critic, hyper.critic_learning_rate, critic_step)
        if not _goes_on(barrier, thread, n_threads):
            return
        if not updates_actor[u]:
            continue
        for half in range(thread, HALVES, n_threads):
            _actor_gradient(half, shapes, actor, critic, n_actions, hyper, ws)
        if not _goes_on(barrier, thread, n_threads):
            return
        actor_step += 1
        bc_loss = (ws.losses[0, 2] + ws.losses[1, 2]) / (n_actions * batch)
        losses[u, 1], losses[u, 2] = (ws.losses[0, 1] + ws.losses[1, 1]) / batch + hyper.bc_coef * bc_loss, bc_loss
        for half in range(thread, HALVES, n_threads):
            _step(half, actor, hyper.actor_learning_rate, actor_step)
        for network in (actor, critic):
            for half in range(thread, HALVES, n_threads):
                start, stop = _half(half, len(network.parameters))
                polyak(network.target[start:stop], network.parameters[start:stop], hyper.tau)
        if not _goes_on(barrier, thread, n_threads):
            return


def _cached_by(sources: int) -> Any:
    """:func:`_update` for Python, cached. Numba's key for a function has its closure, and so a checksum of other files."""

    @njit(error_model="numpy", cache=True, nogil=True)
    def update(*arguments: Any) -> None:
        if sources >= 0:  # always: a variable is in the closure only where it is used
            _update(*arguments)

    return update


_OTHERS = ("barrier_kernels.py", "blas_kernels.py", "layer_kernels.py")
update = _cached_by(zlib.crc32(b"".join(Path(__file__).with_name(name).read_bytes() for name in _OTHERS)))
