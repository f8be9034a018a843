"""The update of DDPG and TD3 as one function, compiled by numba: the twin of SB3's, tested against it.

The parameters of a network are one flat array in the order of ``module.parameters()``; torch's modules are views of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sb3_flock.rl.layer_kernels import (
    ONE,
    ZERO,
    Array,
    Indices,
    adam,
    add_bias,
    bias_relu,
    gather_patches,
    gather_rows,
    inverting_bound_backward,
    matrix,
    norm_relu,
    norm_relu_backward,
    polyak,
    product,
    product_transposed,
    relu_backward,
    scatter_rows,
    sum_rows,
    swap_inner,
    tanh_backward,
    transposed_product,
)


class Shapes(NamedTuple):
    """Shapes of the networks and of a minibatch."""

    batch: int
    convolutions: Indices
    """A row for each convolution: output channels, inputs of a kernel, positions, input channels."""
    first_taps: Indices
    """Pixel of each entry of an observation's patches, ``(positions * channels * kernel_size^2,)``."""
    mirrored_taps: Indices
    taps: Indices
    """For each further convolution the positions below under every kernel position, flat, filled up with zeros."""
    features: int
    has_norm: bool
    actor_widths: Indices
    """Widths of the actor's layers behind the features, the features' first."""
    critic_widths: Indices
    n_critics: int
    action_layer: int
    is_inverting: bool
    bound_margin: float


class Learned(NamedTuple):
    """A network that an optimizer changes, all arrays flat and alike."""

    parameters: Array
    gradient: Array
    mean: Array
    square: Array
    target: Array
    """The target network's parameters."""


class Replay(NamedTuple):
    """The arrays of a :class:`~sb3_flock.rl.buffers.CompactReplayBuffer`."""

    observations: NDArray[np.uint16]
    """Bits of the float16 observations, ``(rows, envs, pixels)``."""
    actions: Array
    rewards: Array
    ends: Array
    """1 where an episode ended for another reason than its time limit."""
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


class Trace(NamedTuple):
    """Memory of one extractor's forward or backward pass."""

    inputs: Array
    outputs: Array
    kernels: Array
    z: Array
    normed: Array
    scale: Array
    features: Array


@njit(error_model="numpy", cache=True)
def _convolution(shapes: Shapes, layer: int) -> tuple[int, int, int, int]:
    """Output channels, inputs of a kernel, positions and input channels of a convolution."""
    row = shapes.convolutions[layer]
    return row[0], row[1], row[2], row[3]


@njit(error_model="numpy", cache=True)
def _extract(patches: Array, w: Array, shapes: Shapes, trace: Trace, features: Array) -> None:
    """The features extractor's forward pass."""
    batch, width = shapes.batch, shapes.features
    at, at_in, at_out, below = 0, 0, 0, 0
    for layer in range(len(shapes.convolutions)):
        channels, k, positions, channels_below = _convolution(shapes, layer)
        rows, n_taps = batch * positions, k // channels_below
        out = matrix(trace.outputs, at_out, rows, channels)
        if layer == 0:
            product_transposed(patches, matrix(w, at, channels, k), out)
        else:
            kernel = trace.kernels[at : at + channels * k]
            swap_inner(w[at : at + channels * k], kernel, channels, channels_below, n_taps)
            inputs = trace.inputs[at_in : at_in + rows * k]
            gather_rows(inputs, trace.outputs[below:at_out], shapes.taps[layer, : positions * n_taps], batch, channels_below)
            product_transposed(inputs.reshape(rows, k), kernel.reshape(channels, k), out)
            at_in += rows * k
        bias_relu(out, w[at + channels * k : at + channels * (k + 1)])
        at += channels * (k + 1)
        below, at_out = at_out, at_out + rows * channels
    flat = trace.outputs[below:at_out].reshape(batch, (at_out - below) // batch)
    n = width * flat.shape[1]
    product_transposed(flat, matrix(w, at, width, flat.shape[1]), trace.z)
    bias = w[at + n : at + n + width]
    if shapes.has_norm:
        at += n + width
        norm_relu(trace.z, bias, w[at : at + width], w[at + width : at + 2 * width], trace.normed, trace.scale, features)
    else:
        bias_relu(trace.z, bias)
        features[:] = trace.z


@njit(error_model="numpy", cache=True)
def _extract_backward(
    gradient: Array, patches: Array, w: Array, g: Array, shapes: Shapes, trace: Trace, features: Array, back: Trace
) -> None:
    """Its backward pass; ``gradient`` of the features is overwritten, the parameters' goes to ``g``."""
    batch, width, n_layers = shapes.batch, shapes.features, len(shapes.convolutions)
    at, at_in, at_out, last = 0, 0, 0, 0
    for layer in range(n_layers):
        channels, k, positions, _ = _convolution(shapes, layer)
        at += channels * (k + 1)
        at_in += batch * positions * k if layer else 0
        last = batch * positions * channels
        at_out += last
    flat = trace.outputs[at_out - last : at_out].reshape(batch, last // batch)
    bias = at + width * flat.shape[1]
    if shapes.has_norm:
        norm, norm_bias = bias + width, bias + 2 * width
        d_norm, d_norm_bias = g[norm:norm_bias], g[norm_bias : norm_bias + width]
        norm_relu_backward(gradient, w[norm:norm_bias], trace.normed, trace.scale, features, d_norm, d_norm_bias)
    else:
        relu_backward(gradient, features)
    sum_rows(gradient, g[bias : bias + width])
    transposed_product(gradient, flat, matrix(g, at, width, flat.shape[1]))
    product(gradient, matrix(w, at, width, flat.shape[1]), matrix(back.outputs, at_out - last, batch, flat.shape[1]))
    for layer in range(n_layers - 1, -1, -1):
        channels, k, positions, channels_below = _convolution(shapes, layer)
        rows, n_taps = batch * positions, k // channels_below
        at -= channels * (k + 1)
        at_out -= rows * channels
        up = matrix(back.outputs, at_out, rows, channels)
        relu_backward(up, matrix(trace.outputs, at_out, rows, channels))
        sum_rows(up, g[at + channels * k : at + channels * (k + 1)])
        if layer == 0:
            transposed_product(up, patches, matrix(g, at, channels, k))
        else:
            at_in -= rows * k
            d_kernel = back.kernels[at : at + channels * k]
            transposed_product(up, matrix(trace.inputs, at_in, rows, k), d_kernel.reshape(channels, k))
            swap_inner(d_kernel, g[at : at + channels * k], channels, n_taps, channels_below)
            d_inputs = back.inputs[at_in : at_in + rows * k]
            product(up, matrix(trace.kernels, at, channels, k), d_inputs.reshape(rows, k))
            size = batch * shapes.convolutions[layer - 1, 2] * channels_below
            below = back.outputs[at_out - size : at_out]
            scatter_rows(d_inputs, below, shapes.taps[layer, : positions * n_taps], batch, channels_below)


@njit(error_model="numpy", cache=True)
def _head(below: Array, w: Array, at: int, widths: Indices, hidden: Array, out: Array) -> None:
    """Linear layers with ReLU between them, whose parameters start at ``at``."""
    batch, o = below.shape[0], 0
    for k in range(len(widths) - 1):
        n_in, n_out = widths[k], widths[k + 1]
        weight, bias = matrix(w, at, n_out, n_in), w[at + n_in * n_out : at + (n_in + 1) * n_out]
        if k == len(widths) - 2:
            product_transposed(below, weight, out)
            add_bias(out, bias)
        else:
            above = matrix(hidden, o, batch, n_out)
            product_transposed(below, weight, above)
            bias_relu(above, bias)
            o += batch * n_out
            below = above
        at += n_out * (n_in + 1)


@njit(error_model="numpy", cache=True)
def _head_backward(
    up: Array,
    bottom: Array,
    w: Array,
    g: Array,
    at: int,
    widths: Indices,
    hidden: Array,
    d_hidden: Array,
    d_bottom: Array,
    needs_weights: bool,
) -> None:
    """Its backward pass, from the gradient ``up`` of its output to that of its input."""
    batch, o = bottom.shape[0], 0
    for k in range(len(widths) - 1):
        at += widths[k + 1] * (widths[k] + 1)
        o += batch * widths[k] if k else 0
    for k in range(len(widths) - 2, -1, -1):
        n_in, n_out = widths[k], widths[k + 1]
        at -= n_out * (n_in + 1)
        o -= batch * n_in if k else 0
        below = matrix(hidden, o, batch, n_in) if k else bottom
        if needs_weights:
            transposed_product(up, below, matrix(g, at, n_out, n_in))
            sum_rows(up, g[at + n_in * n_out : at + (n_in + 1) * n_out])
        down = matrix(d_hidden, o, batch, n_in) if k else d_bottom
        product(up, matrix(w, at, n_out, n_in), down)
        if k:
            relu_backward(down, below)
        up = down


@njit(error_model="numpy", cache=True)
def _join(features: Array, actions: Array, w: Array, at: int, action_out: Array, joined: Array) -> None:
    """A critic's action layer, whose parameters start at ``at``, and its concatenation with the features."""
    (batch, width), n = features.shape, actions.shape[1]
    n_out = action_out.shape[1]
    product_transposed(actions, matrix(w, at, n_out, n), action_out)
    bias_relu(action_out, w[at + n_out * n : at + n_out * (n + 1)])
    for i in range(batch):
        for j in range(width):
            joined[i, j] = features[i, j]
        for j in range(n_out):
            joined[i, width + j] = action_out[i, j]


@njit(error_model="numpy", cache=True)
def _split(d_joined: Array, action_out: Array, d_features: Array) -> None:
    """The backward pass of :func:`_join`: adds to ``d_features``, and replaces ``action_out`` by its gradient."""
    batch, width = d_features.shape
    for i in range(batch):
        for j in range(width):
            d_features[i, j] += d_joined[i, j]
        for j in range(action_out.shape[1]):
            action_out[i, j] = d_joined[i, width + j] if action_out[i, j] > 0 else ZERO


@njit(error_model="numpy", cache=True)
def _bound(raw: Array, is_inverting: bool, out: Array) -> None:
    """The actor's action bound."""
    for i in range(raw.shape[0]):
        for j in range(raw.shape[1]):
            out[i, j] = min(max(raw[i, j], -ONE), ONE) if is_inverting else np.float32(np.tanh(raw[i, j]))


@njit(error_model="numpy", cache=True)
def _new_trace(shapes: Shapes) -> Trace:
    n_in, n_out, n_kernels = 0, 0, 0
    for layer in range(len(shapes.convolutions)):
        channels, k, positions, _ = _convolution(shapes, layer)
        n_in += shapes.batch * positions * k if layer else 0
        n_out += shapes.batch * positions * channels
        n_kernels += channels * (k + 1)
    batch, width, f32 = shapes.batch, shapes.features, np.float32
    return Trace(
        np.empty(n_in, f32),
        np.empty(n_out, f32),
        np.empty(n_kernels, f32),
        np.empty((batch, width), f32),
        np.empty((batch, width), f32),
        np.empty(batch, f32),
        np.empty((batch, width), f32),
    )


@njit(error_model="numpy", cache=True)
def update(
    shapes: Shapes,
    actor: Learned,
    critic: Learned,
    replay: Replay,
    batches: Batches,
    actor_step: int,
    critic_step: int,
    policy_delay: int,
    n_updates_before: int,
    learning_rates: tuple[float, float],
    gamma: float,
    tau: float,
    bc_coef: float,
    n_mirrored: int,
    losses: NDArray[np.float64],
) -> None:
    """A round of updates, one for each row of ``batches`` (Algorithm 1 of the paper; Fujimoto et al., 2018, for TD3).

    :param actor_step: steps that the actor's optimizer has taken; ``critic_step`` the same for the critic's
    :param policy_delay: updates of the critics for each one of the actor and of the targets
    :param n_updates_before: updates so far, which decide when the actor's turn is
    :param losses: ``(updates, 3)``: critic loss, actor loss and behavior cloning loss; NaN where the actor was not updated
    """
    f32 = np.float32
    batch, width, n_actions = shapes.batch, shapes.features, replay.actions.shape[2]
    widths, n_extractor = shapes.critic_widths, 0
    for layer in range(len(shapes.convolutions)):
        n_extractor += shapes.convolutions[layer, 0] * (shapes.convolutions[layer, 1] + 1)
    n_extractor += width * (shapes.convolutions[-1, 2] * shapes.convolutions[-1, 0] + 1)
    n_extractor += 2 * width if shapes.has_norm else 0
    n_head = 0
    for k in range(len(widths) - 1):
        n_head += widths[k + 1] * (widths[k] + 1)
    at_actions, n_action_layer = n_extractor + shapes.n_critics * n_head, shapes.action_layer * (n_actions + 1)

    trace, back = _new_trace(shapes), _new_trace(shapes)
    features, d_features = trace.features, back.features
    patches_shape = (batch * shapes.convolutions[0, 2], shapes.convolutions[0, 1])
    patches, next_patches = np.empty(patches_shape, f32), np.empty(patches_shape, f32)
    n_hidden = batch * max(shapes.actor_widths.sum(), widths.sum())
    hidden, d_hidden, spare = np.empty(n_hidden, f32), np.empty(n_hidden, f32), np.empty(n_hidden, f32)
    joined, d_joined = (
        np.empty((batch, width + shapes.action_layer), f32),
        np.empty((batch, width + shapes.action_layer), f32),
    )
    action_out = np.empty((batch, shapes.action_layer), f32)
    actions, chosen, expert = (
        np.empty((batch, n_actions), f32),
        np.empty((batch, n_actions), f32),
        np.empty((batch, n_actions), f32),
    )
    raw, d_raw = np.empty((batch, n_actions), f32), np.empty((batch, n_actions), f32)
    q, d_q, target = np.empty((batch, 1), f32), np.empty((batch, 1), f32), np.empty(batch, f32)
    in_rows = np.full(batch, -1, np.int64)

    for u in range(len(batches.rows)):
        rows, envs = batches.rows[u], batches.envs[u]
        taps, mirrored = shapes.first_taps, shapes.mirrored_taps
        gather_patches(patches, replay.observations, rows, envs, batches.last, in_rows, taps, mirrored, n_mirrored)
        last_index = batches.last_index[u]
        gather_patches(
            next_patches, replay.observations, rows + 1, envs, batches.last, last_index, taps, mirrored, n_mirrored
        )
        for b in range(batch):
            for k in range(n_actions):
                sign = -ONE if k == 1 and b < n_mirrored else ONE
                actions[b, k] = sign * replay.actions[rows[b], envs[b], k]
                if bc_coef > 0:
                    expert[b, k] = sign * replay.expert_actions[rows[b], envs[b], k]

        # The critics' target.
        _extract(next_patches, actor.target, shapes, trace, features)
        _head(features, actor.target, n_extractor, shapes.actor_widths, hidden, raw)
        _bound(raw, shapes.is_inverting, chosen)
        if len(batches.noise):
            for b in range(batch):
                for k in range(n_actions):
                    chosen[b, k] = min(max(chosen[b, k] + batches.noise[u, b, k], -ONE), ONE)
        _extract(next_patches, critic.target, shapes, trace, features)
        for c in range(shapes.n_critics):
            _join(features, chosen, critic.target, at_actions + c * n_action_layer, action_out, joined)
            _head(joined, critic.target, n_extractor + c * n_head, widths, hidden, q)
            for b in range(batch):
                target[b] = q[b, 0] if c == 0 else min(target[b], q[b, 0])
        for b in range(batch):
            future = (ONE - replay.ends[rows[b], envs[b]]) * f32(gamma) * target[b]
            target[b] = replay.rewards[rows[b], envs[b]] + future

        # The critics.
        _extract(patches, critic.parameters, shapes, trace, features)
        d_features[:] = 0
        loss = 0.0
        for c in range(shapes.n_critics):
            at = at_actions + c * n_action_layer
            _join(features, actions, critic.parameters, at, action_out, joined)
            at_head = n_extractor + c * n_head
            _head(joined, critic.parameters, at_head, widths, hidden, q)
            for b in range(batch):
                difference = q[b, 0] - target[b]
                loss += difference * difference
                d_q[b, 0] = f32(2) * difference / f32(batch)
            w, g = critic.parameters, critic.gradient
            _head_backward(d_q, joined, w, g, at_head, widths, hidden, d_hidden, d_joined, True)
            _split(d_joined, action_out, d_features)
            transposed_product(action_out, actions, matrix(g, at, shapes.action_layer, n_actions))
            sum_rows(action_out, g[at + shapes.action_layer * n_actions : at + n_action_layer])
        losses[u, 0] = loss / batch
        _extract_backward(d_features, patches, critic.parameters, critic.gradient, shapes, trace, features, back)
        adam(critic.parameters, critic.mean, critic.square, critic.gradient, learning_rates[1], critic_step + u + 1)

        if (n_updates_before + u + 1) % policy_delay:
            losses[u, 1] = losses[u, 2] = np.nan
            continue

        # The actor, by the first critic's gradient in the action.
        actor_step += 1
        _extract(patches, critic.parameters, shapes, trace, d_features)
        _extract(patches, actor.parameters, shapes, trace, features)
        _head(features, actor.parameters, n_extractor, shapes.actor_widths, d_hidden, raw)
        _bound(raw, shapes.is_inverting, chosen)
        _join(d_features, chosen, critic.parameters, at_actions, action_out, joined)
        _head(joined, critic.parameters, n_extractor, widths, hidden, q)
        loss = 0.0
        for b in range(batch):
            loss -= q[b, 0]
            d_q[b, 0] = -ONE / f32(batch)
        w = critic.parameters
        _head_backward(d_q, joined, w, critic.gradient, n_extractor, widths, hidden, spare, d_joined, False)
        _split(d_joined, action_out, d_features)
        product(action_out, matrix(w, at_actions, shapes.action_layer, n_actions), d_raw)
        bc_loss = 0.0
        if bc_coef > 0:
            for b in range(batch):
                for k in range(n_actions):
                    difference = chosen[b, k] - expert[b, k]
                    bc_loss += abs(difference)
                    d_raw[b, k] += f32(bc_coef / (n_actions * batch)) * np.sign(difference)
            bc_loss /= n_actions * batch
        losses[u, 1], losses[u, 2] = loss / batch + bc_coef * bc_loss, bc_loss
        if shapes.is_inverting:
            inverting_bound_backward(d_raw, raw, shapes.bound_margin)
        else:
            tanh_backward(d_raw, chosen)
        w, g = actor.parameters, actor.gradient
        _head_backward(d_raw, features, w, g, n_extractor, shapes.actor_widths, d_hidden, hidden, d_features, True)
        _extract_backward(d_features, patches, w, g, shapes, trace, features, back)
        adam(w, actor.mean, actor.square, g, learning_rates[0], actor_step)
        polyak(actor.target, actor.parameters, tau)
        polyak(critic.target, critic.parameters, tau)
