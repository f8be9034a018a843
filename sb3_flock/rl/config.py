"""TrainingConfig: everything that decides a training run. Its descriptions are the ``--help`` and the YAML comments."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from sb3_flock.evaluation.controllers.foresight import ForesightGains
from sb3_flock.settings import NotNegative, Positive, Settings
from sb3_flock.sim import Scenario
from sb3_flock.sim.scenario import MAX_BODIES

Width = Annotated[int, Field(ge=1, le=65_536)]
Count = Annotated[int, Field(ge=0, le=10**12)]
Sizes = Annotated[tuple[Width, ...], BeforeValidator(lambda value: (value,) if isinstance(value, int) else value)]
"""One or several; a number alone is one."""


class NetworkConfig(Settings):
    """The networks' shapes (paper, IV-C)."""

    channels: tuple[Width, ...] = Field(
        (16, 32), min_length=1, max_length=16, description="output channels of the convolutions, two in the paper (open)"
    )
    kernel_size: int = Field(3, ge=1, le=15, description="side of the convolutions' kernels [anchors] (open)")
    stride: int = Field(2, ge=1, le=101, description="stride of the convolutions [anchors] (open)")
    features_dim: Width = Field(128, description="width of the dense layer behind the convolutions (open)")
    net_arch: tuple[Width, ...] = Field(
        (64,), max_length=16, description="widths of the hidden layers behind the features (open)"
    )
    action_layer: Width = Field(32, description="width of the critic's hidden layer for the action (open)")
    layer_norm: bool = Field(True, description="normalize the dense layer's output (ours; paper: no)")
    final_init: float | None = Field(
        3e-3, gt=0, description="bound of the output layers' uniform start; null: torch's own (open)"
    )
    action_bound: Literal["inverting", "tanh"] = Field(
        "inverting",
        description="how the actor's output is bounded, but for sac: a clamp with inverting gradients or tanh (open)",
    )
    n_critics: int = Field(2, ge=1, le=32, description="critic networks, the smallest value counts (ours; paper: 1)")


class LearnerConfig(Settings):
    """The learning algorithm's parameters, named as in Stable-Baselines3."""

    learning_rate: float = Field(5e-4, gt=0, le=1e6, description="Adam's learning rate at the start (open)")
    final_learning_rate: float = Field(0.0, ge=0, le=1e6, description="learning rate at the end, reached linearly (open)")
    batch_size: int = Field(128, ge=1, le=1_000_000, description="transitions in a minibatch (open)")
    buffer_size: int = Field(200_000, ge=1, le=10**9, description="transitions the shared replay buffer holds (open)")
    learning_starts: Count = Field(4_000, description="transitions flown with random actions before learning (open)")
    gamma: float = Field(0.96, ge=0, lt=1, description="discount factor (open)")
    tau: float = Field(0.005, gt=0, le=1, description="update rate of the target networks (open)")
    guidance: NotNegative = Field(
        0.0,
        description="weight of the mean absolute difference to the teacher's actions in the actor's loss; ddpg alone (ours)",
    )
    mirror: bool = Field(
        True,
        description="mirror half of every minibatch, left for right; not with ddpg-stock or n_steps > 1 (ours; paper: no)",
    )
    n_steps: int = Field(1, ge=1, le=1000, description="steps of the return in the critic's target (paper: 1)")
    train_freq: int = Field(
        1, ge=1, le=1_000_000, description="vector steps (one transition a vehicle) between rounds of updates"
    )
    update_ratio: Positive = Field(0.4, description="updates for each transition flown (paper, Algorithm 1: 1)")
    noise: NotNegative = Field(
        0.4, description="standard deviation of the exploration noise at the start [half the action range] (open)"
    )
    final_noise: NotNegative = Field(0.05, description="exploration noise at the end, reached linearly (open)")


class PracticeConfig(Settings):
    """How the scenario flown while training differs from the task, which is never changed itself.

    With the paper's walk an obstacle seldom meets the flock, and a policy that keeps exactly the minimum separation breaks it
    at the slightest error: practice is harder than the task. In a large flock everyone's exploration disturbs everyone, and
    packs that are loose enough to bear it are what is learned; in a small one too little happens: practice flies four. What
    one action gains in a tenth of a second drowns in the noise of the values: practice decides less often. The learner's
    gamma is for these longer steps. Who explores seldom sees a flock at close rest, and learns to avoid it: a teacher shows it.
    """

    vehicles: Sizes | None = Field(
        (4,),
        min_length=1,
        max_length=16,
        description="sizes of the flocks [vehicles]; null: the task's. The policy fits any number, and four teach it best (ours)",
    )
    extra_obstacles: int = Field(
        1, ge=0, le=MAX_BODIES, description="obstacles added, where the task has any (ours; paper: 0)"
    )
    obstacle_arena_ratio: Positive = Field(
        0.5,
        description="side of the obstacles' square, relative to the task's, if none has a given start (ours; paper: 1)",
    )
    time_step_ratio: Positive = Field(
        2.0, description="sampling period while training, relative to the task's (ours; paper: 1)"
    )
    separation_ratio: float = Field(
        1.06, ge=1, le=1e6, description="minimum separations, relative to the task's (ours; paper: 1)"
    )
    obstacle_separation_ratio: float | None = Field(
        None, ge=1, le=1e6, description="the same for obstacles; null: separation_ratio (ours; paper: 1)"
    )
    teacher: Literal["orca", "olfati-saber", "foresight"] | None = Field(
        None,
        description="who flies some episodes to learn from; foresight: plans for the whole flock; null: none (ours)",
    )
    teacher_share: float = Field(0.25, ge=0, le=1, description="share of the episodes that the teacher flies (ours)")
    teacher_noise: NotNegative = Field(
        0.1, description="standard deviation of the noise on the teacher's actions [half the action range] (ours)"
    )
    foresight: ForesightGains = Field(default_factory=ForesightGains, description="what the teacher foresight keeps (ours)")


class TrainingConfig(Settings):
    """A training run: the task, the learner and the bookkeeping. Totals and the frequencies of saving count transitions.

    One transition is one step of one vehicle: a vector step of ``n_flocks`` flocks adds that many times the vehicles flown.

    :raises SettingsError: one line naming the parameter, its value and what is accepted
    """

    scenario: Scenario = Field(default_factory=Scenario, description="the task, as it is evaluated")
    practice: PracticeConfig = Field(default_factory=PracticeConfig, description="how training differs from the task")
    algo: Literal["ddpg", "ddpg-stock", "td3", "sac"] = Field(
        "ddpg", description="learning algorithm (paper: ddpg); ddpg-stock: the same mathematics in SB3's own code, slower"
    )
    learner: LearnerConfig = Field(default_factory=LearnerConfig, description="the learner")
    network: NetworkConfig = Field(default_factory=NetworkConfig, description="the networks")

    total_timesteps: int = Field(300_000, ge=1, le=10**12, description="transitions to train for")
    n_flocks: Width = Field(32, description="flocks flown side by side, of each size practiced")
    num_cpus: int = Field(
        0, ge=0, le=1024, description="SuperSuit worker processes; 0: fly in the training process (faster)"
    )
    seed: int = Field(0, ge=0, le=2**32 - 1, description="seed of the networks, the noise and the flocks")
    device: str = Field("cpu", description="torch device: cpu, cuda, cuda:0, ... or auto")
    torch_threads: int = Field(
        0,
        ge=0,
        le=1024,
        description="torch threads; 0: one for batches under 1024, where more gain nothing, else one for each core",
    )

    eval_freq: Count = Field(10_000, description="transitions between evaluations; 0: none")
    eval_episodes: int = Field(100, ge=1, le=1_000_000, description="episodes of an evaluation, the same ones every time")
    test_episodes: int = Field(
        1000, ge=1, le=1_000_000, description="episodes of the table that `sb3-flock train` prints at the end"
    )
    save_freq: Count = Field(25_000, description="transitions between checkpoints; 0: none")
    keep_checkpoints: int = Field(
        2, ge=1, le=1_000_000, description="newest checkpoints that are kept; `train --resume` goes on from one"
    )
    init_from: str | None = Field(None, description="policy (zip or run folder) whose weights to start from")
    output_dir: str = Field("runs", description="folder of the run folders")

    @model_validator(mode="after")
    def _practice_looks_back_as_far(self) -> TrainingConfig:
        steps = self.scenario.look_back_steps / self.practice.time_step_ratio
        if not math.isclose(steps, round(steps), rel_tol=1e-6) or (self.scenario.look_back and steps < 0.5):
            step = f"{self.scenario.time_step * self.practice.time_step_ratio:g} s, the sampling period of practice"
            raise ValueError(f"look_back = {self.scenario.look_back}: input should be a multiple of {step}")
        return self

    @model_validator(mode="after")
    def _guided_by_someone(self) -> TrainingConfig:
        # Olfati-Saber's law knows its velocity only where it flies.
        advises = self.practice.teacher in ("orca", "foresight")
        if self.learner.guidance and not (advises and self.algo == "ddpg" and self.learner.n_steps == 1):
            needed = "practice.teacher orca or foresight, algo ddpg and n_steps 1"
            raise ValueError(f"guidance = {self.learner.guidance}: input should be 0 without {needed}")
        return self

    def flown_scenarios(self) -> list[Scenario]:
        """The scenarios flown side by side while training: ``scenario`` changed as ``practice`` says, one a size of flock."""
        scenario, practice = self.scenario, self.practice
        flown = scenario.replace(
            time_step=scenario.time_step * practice.time_step_ratio,
            max_cycles=max(1, round(scenario.max_cycles / practice.time_step_ratio)),
            n_obstacles=scenario.n_obstacles + (practice.extra_obstacles if scenario.n_obstacles else 0),
            obstacle_arena=scenario.obstacle_half_side
            * (1.0 if scenario.obstacle_starts else practice.obstacle_arena_ratio),
            neighbor_separation=min(scenario.neighbor_separation * practice.separation_ratio, scenario.link_range),
            obstacle_separation=min(
                scenario.obstacle_separation * (practice.obstacle_separation_ratio or practice.separation_ratio),
                scenario.detection_range,
            ),
        )
        return [flown.replace(n_vehicles=vehicles) for vehicles in practice.vehicles or (scenario.n_vehicles,)]
