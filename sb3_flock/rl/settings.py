"""Settings of the networks and of the learning algorithm, importable without torch: the command line reads them at once."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sb3_flock.settings import NotNegative, Positive, Settings

Count = Annotated[int, Field(ge=0, le=10**12)]
Width = Annotated[int, Field(ge=1, le=65_536)]


class NetworkConfig(Settings):
    """The networks (section IV-C)."""

    channels: tuple[Width, ...] = Field(
        (16, 32), min_length=1, max_length=16, description="output channels of the convolutions (paper: two convolutions)"
    )
    kernel_size: int = Field(3, ge=1, le=15, description="side of the convolutions' kernels [anchors] (paper: not stated)")
    stride: int = Field(2, ge=1, le=101, description="stride of the convolutions [anchors] (paper: not stated)")
    features_dim: Width = Field(128, description="width of the dense layer behind the convolutions (paper: not stated)")
    net_arch: tuple[Width, ...] = Field(
        (64,), max_length=16, description="widths of the hidden layers behind the features (paper: one layer)"
    )
    action_layer: Width = Field(32, description="width of the critic's hidden layer for the action (paper: not stated)")
    layer_norm: bool = Field(True, description="layer norm on the dense layer's output (paper: false)")
    final_init: float | None = Field(
        3e-3, gt=0, description="bound of the output layers' uniform initialization; null: torch's own (paper: not stated)"
    )
    action_bound: Literal["inverting", "tanh"] | None = Field(
        None,
        description="how the actor's output is bounded: inverting (a clamp with inverting gradients) or tanh; "
        "null: inverting where the algorithm has a deterministic actor, tanh elsewhere (paper: not stated)",
    )
    n_critics: int = Field(2, ge=1, le=32, description="number of critics; the smallest value counts (paper: 1)")


class AlgorithmConfig(Settings):
    """The learning algorithm's parameters, named as in Stable-Baselines3."""

    learning_rate: float = Field(5e-4, gt=0, le=1e6, description="Adam's learning rate at the start (paper: not stated)")
    final_learning_rate: float = Field(
        0.0, ge=0, le=1e6, description="learning rate at the end, reached linearly (paper: not stated)"
    )
    batch_size: int = Field(128, ge=1, le=1_000_000, description="transitions in a minibatch (paper: not stated)")
    buffer_size: int = Field(
        200_000, ge=1, le=10**9, description="capacity of the shared replay buffer [transitions] (paper: not stated)"
    )
    learning_starts: Count = Field(
        4_000, description="transitions with random actions before the first update (paper: not stated)"
    )
    gamma: float = Field(0.96, ge=0, lt=1, description="discount factor (paper: not stated)")
    tau: float = Field(0.005, gt=0, le=1, description="update rate of the target networks (paper: not stated)")
    bc_coef: NotNegative = Field(
        0.0,
        description="weight of the behavior cloning term, the mean absolute difference to the expert's actions, in the "
        "actor's loss; needs train_env.expert and algo ddpg (paper: 0)",
    )
    mirror_augmentation: bool | None = Field(
        None,
        description="mirror half of every minibatch, left for right; null: where the replay buffer can, that is not with "
        "ddpg-sb3 or n_steps > 1 (paper: false)",
    )
    n_steps: int = Field(1, ge=1, le=1000, description="steps of the return in the critic's target (paper: 1)")
    train_freq: int = Field(
        1, ge=1, le=1_000_000, description="vector steps (one transition a vehicle) between rounds of updates (paper: 1)"
    )
    utd_ratio: Positive = Field(0.4, description="update-to-data ratio: updates for each transition (paper: 1)")
    action_noise_std: NotNegative = Field(
        0.4,
        description="standard deviation of the exploration noise at the start [half the action range] (paper: not stated)",
    )
    final_action_noise_std: NotNegative | None = Field(
        None, description="exploration noise at the end, reached linearly; null: as at the start (paper: not stated)"
    )

    @property
    def action_noise_stds(self) -> tuple[float, float]:
        """The exploration noise at the start and at the end [half the action range]."""
        start, end = self.action_noise_std, self.final_action_noise_std
        return start, start if end is None else end
