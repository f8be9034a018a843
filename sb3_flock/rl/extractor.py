"""FlockCNN: the convolutional features extractor for the flock's tensor."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_flock.settings import SettingsError


class FlockCNN(BaseFeaturesExtractor):
    """Two convolutions with ReLU and one dense layer: three of the state path's four hidden layers (paper, IV-C).

    SB3's NatureCNN cannot take a tensor this small, and SB3 does not treat a float ``Box(3, l, l)`` as an image (neither
    scaled nor transposed), which is right here.

    :param observation_space: ``Box`` of shape ``(channels, l, l)``
    :param features_dim: width of the dense layer
    :param channels: output channels of the two convolutions
    :param kernel_size: side of the convolutions' kernels
    :param stride: stride of both convolutions
    :param layer_norm: normalize the dense layer's output before its ReLU (ours; off in the paper)
    :raises SettingsError: if the convolutions do not fit the tensor
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        features_dim: int = 128,
        channels: Sequence[int] = (16, 32),
        kernel_size: int = 3,
        stride: int = 2,
        layer_norm: bool = False,
    ) -> None:
        if len(observation_space.shape) != 3:
            raise SettingsError(f"FlockCNN needs observations of shape (channels, l, l), not {observation_space.shape}")
        super().__init__(observation_space, features_dim)
        layers: list[nn.Module] = []
        in_channels = observation_space.shape[0]
        for out_channels in channels:
            layers += [nn.Conv2d(in_channels, out_channels, kernel_size, stride), nn.ReLU()]
            in_channels = out_channels
        self.cnn = nn.Sequential(*layers, nn.Flatten())
        with th.no_grad():
            try:
                n_flatten = self.cnn(th.zeros(1, *observation_space.shape)).shape[1]
            except RuntimeError:
                raise SettingsError(
                    f"FlockCNN: {len(channels)} convolutions of kernel {kernel_size} and stride {stride} do not fit a "
                    f"tensor of {observation_space.shape[1:]} anchors; more anchors or a smaller kernel are needed"
                ) from None
        norm = [nn.LayerNorm(features_dim)] if layer_norm else []
        self.dense = nn.Sequential(nn.Linear(n_flatten, features_dim), *norm, nn.ReLU())

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """``(batch, channels, l, l)`` to ``(batch, features_dim)``."""
        return self.dense(self.cnn(observations))
