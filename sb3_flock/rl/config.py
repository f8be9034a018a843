"""TrainingConfig: everything that decides a training run. Its descriptions are the ``--help`` and the YAML comments."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from sb3_flock.settings import Settings, SettingsError
from sb3_flock.sim import Scenario


class NetworkConfig(Settings):
    """The networks' shapes (paper, IV-C)."""

    channels: tuple[int, int] = Field((16, 32), description="output channels of the two convolutions (open)")
    kernel_size: int = Field(3, ge=1, description="side of the convolutions' kernels [anchors] (open)")
    stride: int = Field(2, ge=1, description="stride of the convolutions [anchors] (open)")
    features_dim: int = Field(128, ge=1, description="width of the dense layer behind the convolutions (open)")
    net_arch: tuple[int, ...] = Field((64,), description="widths of the hidden layers behind the features (open)")
    action_layer: int = Field(32, ge=1, description="width of the critic's hidden layer for the action (open)")
    layer_norm: bool = Field(False, description="normalize the dense layer's output (ours; paper: no)")
    final_init: float | None = Field(
        3e-3, gt=0, description="bound of the output layers' uniform start; null: torch's own (open)"
    )
    n_critics: int = Field(2, ge=1, description="critic networks, the smallest value counts (ours; paper: 1)")


class LearnerConfig(Settings):
    """The learning algorithm's parameters, named as in Stable-Baselines3."""

    learning_rate: float = Field(1e-3, gt=0, description="Adam's learning rate at the start (open)")
    final_learning_rate: float = Field(0.0, ge=0, description="learning rate at the end, reached linearly (open)")
    batch_size: int = Field(128, ge=1, description="transitions in a minibatch (open)")
    buffer_size: int = Field(500_000, ge=1, description="transitions the shared replay buffer holds (open)")
    learning_starts: int = Field(4_000, ge=0, description="transitions flown at random before learning (open)")
    gamma: float = Field(0.98, ge=0, lt=1, description="discount factor (open)")
    tau: float = Field(0.005, gt=0, le=1, description="update rate of the target networks (open)")
    n_steps: int = Field(1, ge=1, description="steps of the return in the critic's target (paper: 1)")
    train_freq: int = Field(1, ge=1, description="vector steps (one transition a vehicle) between rounds of updates")
    gradient_steps: int = Field(
        8, ge=-1, description="updates a round; -1: one for each transition, the paper's Algorithm 1"
    )
    noise: float = Field(
        0.2, ge=0, description="standard deviation of the exploration noise at the start [half the action range] (open)"
    )
    final_noise: float = Field(0.02, ge=0, description="exploration noise at the end, reached linearly (open)")


class TrainingConfig(Settings):
    """A training run: the task, the learner and the bookkeeping. All frequencies and totals count transitions.

    One transition is one step of one vehicle: a vector step of ``n_flocks`` flocks adds ``n_flocks * n_vehicles``.

    :raises SettingsError: one line naming the parameter, its value and what is accepted
    """

    scenario: Scenario = Field(default_factory=Scenario, description="the task, as it is evaluated")
    training_scenario: dict[str, Any] = Field(
        default_factory=dict, description="scenario fields that differ while training, by name"
    )
    algo: Literal["ddpg", "td3", "sac"] = Field("ddpg", description="learning algorithm (paper: ddpg)")
    learner: LearnerConfig = Field(default_factory=LearnerConfig, description="the learner")
    network: NetworkConfig = Field(default_factory=NetworkConfig, description="the networks")

    total_timesteps: int = Field(400_000, ge=1, description="transitions to train for")
    n_flocks: int = Field(8, ge=1, description="flocks flown side by side")
    num_cpus: int = Field(0, ge=0, description="SuperSuit worker processes; 0: fly in the training process (faster)")
    seed: int = Field(0, ge=0, description="seed of the networks, the noise and the flocks")
    device: str = Field("cpu", description="torch device: cpu, cuda, cuda:0, ... or auto")
    torch_threads: int = Field(1, ge=0, description="torch threads; 1 is fastest for networks this small; 0: torch's choice")

    eval_freq: int = Field(20_000, ge=0, description="transitions between evaluations; 0: none")
    eval_episodes: int = Field(100, ge=1, description="episodes of an evaluation, the same ones every time")
    test_episodes: int = Field(1000, ge=1, description="episodes of the table that `sb3-flock train` prints at the end")
    save_freq: int = Field(100_000, ge=0, description="transitions between checkpoints; 0: none")
    init_from: str | None = Field(None, description="policy (zip or run folder) whose weights to start from")
    output_dir: str = Field("runs", description="folder of the run folders")

    @model_validator(mode="after")
    def _fits(self) -> TrainingConfig:
        self.flown_scenario()  # raises where an override is wrong
        if self.learner.gradient_steps == 0:
            raise ValueError("gradient_steps = 0: input should be -1 or at least 1")
        return self

    def flown_scenario(self) -> Scenario:
        """The scenario flown while training: ``scenario`` with ``training_scenario``'s fields changed."""
        changes = dict(self.training_scenario)
        try:
            if "reward" in changes:
                if not isinstance(changes["reward"], dict):
                    raise SettingsError(f"reward = {changes['reward']!r}: input should be a mapping")
                changes["reward"] = self.scenario.reward.replace(**changes["reward"])
            flown = self.scenario.replace(**changes)
        except (SettingsError, TypeError) as error:
            raise SettingsError(f"training_scenario: {error}") from None
        if flown.observation_shape != self.scenario.observation_shape:
            raise SettingsError(
                f"training_scenario: n_anchors = {flown.n_anchors}: input should be as in scenario, "
                f"{self.scenario.n_anchors}"
            )
        return flown
