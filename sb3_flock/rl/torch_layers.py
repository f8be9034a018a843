"""FlockCNN: the convolutional features extractor for the flock's observation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_flock.settings import SettingsError


class FlockCNN(BaseFeaturesExtractor):
    """Convolutions with ReLU, two by default, and one dense layer: three of the state path's four hidden layers (paper, IV-C).

    SB3's NatureCNN cannot take an observation this small. SB3 does not treat a float ``Box`` as an image: it is neither
    scaled nor transposed.

    A CPU's convolution kernels are slow at 11 x 11 anchors. Instead, the inputs of every kernel position (its *patch*) are
    gathered and all multiplied by the weights at once, which takes half the time, forward and backward. ``cnn`` holds the
    weights; its forward pass in torch's own layers is the reference.

    :param observation_space: ``Box`` of shape ``(channels, l, l)``
    :param features_dim: width of the dense layer
    :param channels: output channels of the convolutions
    :param kernel_size: side of the convolutions' kernels
    :param stride: stride of the convolutions
    :param layer_norm: layer norm on the dense layer's output before its ReLU (the paper has none); without it this task is
        not learned
    :raises SettingsError: if the observation has another shape, such as one with the channels last or stacked along the last
        axis (``VecFrameStack`` without ``channels_order="first"``), or the convolutions do not fit it
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        features_dim: int = 128,
        channels: Sequence[int] = (16, 32),
        kernel_size: int = 3,
        stride: int = 2,
        layer_norm: bool = True,
    ) -> None:
        shape = observation_space.shape
        if shape is None or len(shape) != 3 or shape[1] != shape[2]:
            raise SettingsError(
                f"FlockCNN needs observations of shape (channels, l, l), not {shape}"
                + ("; VecFrameStack needs channels_order='first'" if shape is not None and len(shape) == 3 else "")
            )
        super().__init__(observation_space, features_dim)
        in_channels, side, _ = self.input_shape = shape
        layers: list[nn.Module] = []
        for layer, out_channels in enumerate(channels):
            if kernel_size > side:
                raise SettingsError(
                    f"FlockCNN: {len(channels)} convolutions of kernel {kernel_size} and stride {stride} do not fit an "
                    f"observation of {observation_space.shape[1:]} anchors; more anchors or a smaller kernel are needed"
                )
            layers += [nn.Conv2d(in_channels, out_channels, kernel_size, stride), nn.ReLU()]
            taps = _taps(side, kernel_size, stride)
            if layer == 0:  # single numbers of a channels-first image; later layers take rows of a channels-last one
                taps = taps[..., None] + side * side * th.arange(in_channels)
            self.register_buffer(f"_taps{layer}", taps.reshape(-1), persistent=False)
            in_channels, side = out_channels, int(len(taps) ** 0.5)
        self.cnn = nn.Sequential(*layers, _FlattenByAnchor())
        self._convolutions = [module for module in self.cnn if isinstance(module, nn.Conv2d)]
        norm = [nn.LayerNorm(features_dim)] if layer_norm else []
        self.dense = nn.Sequential(nn.Linear(in_channels * side * side, features_dim), *norm, nn.ReLU())

    def patches(self, observations: th.Tensor) -> th.Tensor:
        """The first convolution's patches. They depend on no weight: networks with the same input batch can share them.

        :param observations: ``(batch, channels, l, l)``
        :return: ``(batch, positions * kernel_size^2, channels)``, which :meth:`forward` takes, too
        """
        numbers = observations.flatten(1).index_select(1, self._taps0)  # type: ignore[arg-type]
        return numbers.view(len(observations), -1, self.input_shape[0])

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """``(batch, channels, l, l)``, or the :meth:`patches` of it, to ``(batch, features_dim)``."""
        patches = self.patches(observations) if observations.dim() == 4 else observations
        taps = [getattr(self, f"_taps{layer}") for layer in range(1, len(self._convolutions))]
        weights = [weight for conv in self._convolutions for weight in (conv.weight, conv.bias)]
        return self.dense(_Convolutions.apply(patches, taps, *weights))


class _FlattenByAnchor(nn.Module):
    """``(batch, channels, a, b)`` to ``(batch, a * b * channels)``: the channels of an anchor stay together."""

    def forward(self, maps: th.Tensor) -> th.Tensor:
        return maps.permute(0, 2, 3, 1).flatten(1)


class _Convolutions(th.autograd.Function):
    """Convolutions with ReLU, channels last: ``(batch, taps, channels)`` patches to ``(batch, positions * channels)``.

    The backward pass is written out: autograd's many small steps would cost as much as the matrix products.
    """

    @staticmethod
    def forward(ctx: Any, patches: th.Tensor, taps: list[th.Tensor], *weights: th.Tensor) -> th.Tensor:
        kernels = [kernel.permute(0, 2, 3, 1).flatten(1) for kernel in weights[::2]]
        batch = len(patches)
        inputs: list[th.Tensor] = []
        outputs: list[th.Tensor] = []
        for layer, (kernel, bias) in enumerate(zip(kernels, weights[1::2], strict=True)):
            if layer:
                patches = outputs[-1].view(batch, -1, kernels[layer - 1].shape[0]).index_select(1, taps[layer - 1])
            inputs.append(patches.reshape(-1, kernel.shape[1]))
            outputs.append(th.addmm(bias, inputs[-1], kernel.t()).relu_())
        ctx.save_for_backward(*inputs, *outputs, *kernels, *taps)
        ctx.shapes = [kernel.shape for kernel in weights[::2]]
        return outputs[-1].view(batch, -1)

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        batch, n = len(gradient), len(ctx.shapes)
        saved = ctx.saved_tensors
        inputs, outputs, kernels, taps = saved[:n], saved[n : 2 * n], saved[2 * n : 3 * n], saved[3 * n :]
        gradients: list[th.Tensor] = []
        for layer in reversed(range(n)):
            features, channels, *window = ctx.shapes[layer]
            gradient = th.ops.aten.threshold_backward(gradient.reshape(-1, features), outputs[layer], 0)
            kernel_gradient = (gradient.t() @ inputs[layer]).view(features, *window, channels).permute(0, 3, 1, 2)
            # Contiguous like the kernel: torch's fused Adam gives wrong results, silently, where their strides differ.
            gradients = [kernel_gradient.contiguous(), gradient.sum(0), *gradients]
            if layer:
                by_tap = (gradient @ kernels[layer]).view(batch, -1, channels)
                below = gradient.new_zeros(batch, len(outputs[layer - 1]) // batch, channels)
                gradient = below.index_add_(1, taps[layer - 1], by_tap)
        patches_gradient = None
        if ctx.needs_input_grad[0]:
            patches_gradient = (gradient @ kernels[0]).view(batch, -1, ctx.shapes[0][1])
        return patches_gradient, None, *gradients


def _taps(side: int, kernel_size: int, stride: int) -> th.Tensor:
    """Index of every anchor under every kernel position: ``(positions, kernel_size^2)`` into a square of ``side`` anchors."""
    starts = th.arange(0, side - kernel_size + 1, stride)
    along = starts[:, None] + th.arange(kernel_size)
    return (along[:, None, :, None] * side + along[None, :, None, :]).reshape(len(starts) ** 2, kernel_size**2)
