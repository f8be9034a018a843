"""Each compiled layer equals torch's, forward and backward."""

import numpy as np
import pytest
import torch as th
from torch.nn import functional as F  # noqa: N812 - torch's name for it

pytest.importorskip("numba")

from sb3_flock.rl import layer_kernels as layers
from sb3_flock.rl.policies import InvertingBound


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def normal(rng, *shape):
    return rng.standard_normal(shape).astype(np.float32)


def near(ours, expected, atol=2e-5):
    np.testing.assert_allclose(ours, np.asarray(expected), rtol=1e-4, atol=atol)


@pytest.mark.parametrize("width", [1, 5, 16, 37])
def test_norm_and_relu(rng, width):
    shapes = ((9, width), (width,), (width,), (width,), (9, width))
    z, bias, weight, norm_bias, up = (normal(rng, *shape) for shape in shapes)
    leaves = [th.tensor(part, requires_grad=True) for part in (z, weight, norm_bias)]
    expected = F.layer_norm(leaves[0] + th.tensor(bias), (width,), leaves[1], leaves[2]).relu()
    expected.backward(th.tensor(up))
    normed, scale, out = np.empty_like(z), np.empty(9, np.float32), np.empty_like(z)
    layers.norm_relu(z, bias, weight, norm_bias, normed, scale, out)
    near(out, expected.detach())
    d_weight, d_norm_bias = np.empty(width, np.float32), np.empty(width, np.float32)
    layers.norm_relu_backward(up, weight, normed, scale, out, d_weight, d_norm_bias)
    for ours, leaf in ((up, leaves[0]), (d_weight, leaves[1]), (d_norm_bias, leaves[2])):
        near(ours, leaf.grad)


def test_bias_and_relu(rng):
    z, bias, up = normal(rng, 7, 5), normal(rng, 5), normal(rng, 7, 5)
    leaves = [th.tensor(part, requires_grad=True) for part in (z, bias)]
    expected = (leaves[0] + leaves[1]).relu()
    expected.backward(th.tensor(up))
    added = z.copy()
    layers.add_bias(added, bias)
    near(added, z + bias)
    layers.bias_relu(z, bias)
    near(z, expected.detach())
    layers.relu_backward(up, z)
    near(up, leaves[0].grad)
    total = np.empty(5, np.float32)
    layers.sum_rows(up, total)
    near(total, leaves[1].grad)


def test_a_not_finite_number_stays_one(rng):
    z, bias = normal(rng, 3, 4), np.zeros(4, np.float32)
    z[1, 2] = np.nan
    normed, scale, out = np.empty_like(z), np.empty(3, np.float32), np.empty_like(z)
    layers.norm_relu(z, bias, np.ones(4, np.float32), bias, normed, scale, out)
    assert np.isnan(scale).tolist() == [False, True, False]
    assert np.isnan(normed[1]).all()


def test_bounds(rng):
    raw, up = 2 * normal(rng, 50, 2), normal(rng, 50, 2)
    leaf = th.tensor(raw, requires_grad=True)
    InvertingBound()(leaf).backward(th.tensor(up))
    ours = up.copy()
    layers.inverting_bound_backward(ours, raw, InvertingBound.MARGIN)
    near(ours, leaf.grad)
    leaf = th.tensor(raw, requires_grad=True)
    leaf.tanh().backward(th.tensor(up))
    layers.tanh_backward(up, np.tanh(raw))
    near(up, leaf.grad)


def test_patches_are_those_of_a_convolution(rng):
    channels, side, size, stride = 3, 7, 3, 2
    images, kernel = normal(rng, 4, channels, side, side), normal(rng, 5, channels, size, size)
    leaf = th.tensor(images, requires_grad=True)
    expected = F.conv2d(leaf, th.tensor(kernel), stride=stride)
    corners = np.arange(0, side - size + 1, stride)
    starts = ((corners[:, None, None] + np.arange(size)) * side + corners[None, :, None]).reshape(-1) * channels
    patches = np.empty((4, len(starts) * size * channels), np.float32)
    last = np.ascontiguousarray(images.transpose(0, 2, 3, 1)).reshape(4, -1)
    layers.gather_patches(patches, last, starts, size * channels)
    swapped = np.empty(kernel.size, np.float32)
    layers.swap_inner(kernel.reshape(-1), swapped, 5, channels, size * size)
    out = patches.reshape(4, len(corners) ** 2, -1) @ swapped.reshape(5, -1).T
    near(out.transpose(0, 2, 1).reshape(expected.shape), expected.detach())

    up = normal(rng, *expected.shape)
    expected.backward(th.tensor(up))
    by_position = np.ascontiguousarray(up.reshape(4, 5, -1).transpose(0, 2, 1))
    back = np.ascontiguousarray(by_position @ swapped.reshape(5, -1)).reshape(4, -1)
    gradient = np.full_like(last, np.nan)
    layers.scatter_patches(back, gradient, starts, size * channels)
    near(gradient.reshape(4, side, side, channels).transpose(0, 3, 1, 2), leaf.grad)


def test_every_half_is_read_exactly():
    bits = np.arange(1 << 16, dtype=np.uint16)
    bits = bits[: len(bits) // 121 * 121].reshape(-1, 121)
    for half in bits:
        for is_mirrored in (False, True):
            image = np.empty(121, np.float32)
            layers.read_image(image, half, 1, 11, is_mirrored)
            expected = half.view(np.float16).astype(np.float32).reshape(11, 11)
            np.testing.assert_array_equal(image.reshape(11, 11), expected[:, ::-1] if is_mirrored else expected)


def test_an_image_has_its_channels_last(rng):
    observation = rng.random((3, 5, 5)).astype(np.float16)
    image = np.empty(75, np.float32)
    layers.read_image(image, observation.reshape(-1).view(np.uint16), 3, 5, False)
    assert np.array_equal(image.reshape(5, 5, 3), observation.transpose(1, 2, 0).astype(np.float32))


def test_adam_and_polyak_are_torchs(rng):
    start, target = normal(rng, 40), normal(rng, 40)
    parameters, mean, square = start.copy(), np.zeros(40, np.float32), np.zeros(40, np.float32)
    leaf = th.nn.Parameter(th.tensor(start))
    adam = th.optim.Adam([leaf], lr=1e-2)
    for step in range(1, 6):
        first, second = normal(rng, 40), normal(rng, 40)
        leaf.grad = th.tensor(first + second)
        adam.step()
        layers.adam(parameters, mean, square, first, second, 1e-2, step)
    near(parameters, leaf.detach(), atol=1e-6)
    assert abs(parameters - start).max() > 1e-2
    followed = target.copy()
    layers.polyak(followed, parameters, 0.25)
    near(followed, 0.75 * target + 0.25 * parameters, atol=1e-6)


def test_a_part_of_flat_memory_is_a_matrix():
    memory = np.arange(10, dtype=np.float32)
    matrix = layers.matrix(memory, 2, 2, 3)
    assert matrix.tolist() == [[2, 3, 4], [5, 6, 7]]
    assert np.shares_memory(matrix, memory)
