"""TrainingConfig: everything that decides a training. Its descriptions are the ``--help`` and the YAML comments."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, field_validator, model_validator

from sb3_flock.controllers import EXPERTS
from sb3_flock.controllers.mpc import MPCConfig
from sb3_flock.rl.registry import ModelSettings
from sb3_flock.rl.settings import Count, Width
from sb3_flock.settings import NotNegative, Positive, Settings, SettingsError, suggest
from sb3_flock.sim import Scenario
from sb3_flock.sim.actuators import Actuators
from sb3_flock.sim.dynamics import MAX_BODIES
from sb3_flock.sim.obstacles import WALK, check_obstacle_motion
from sb3_flock.sim.randomization import check_ranges
from sb3_flock.sim.sensors import SensorErrors
from sb3_flock.sim.simulators import SIMULATORS
from sb3_flock.sim.world import check_randomization

TRAINING_TASK: dict[str, Any] = {"safety_filter": "announce", "shared_detections": True}
"""What a training's task has, unless it says otherwise, in place of the defaults of :class:`~sb3_flock.sim.Scenario`, which are
the paper's."""

Sizes = Annotated[tuple[Width, ...], BeforeValidator(lambda value: (value,) if type(value) is int else value)]
"""One or several; a number alone is one."""


class TrainEnvConfig(Settings):
    """How the training env differs from the task. The task itself, on which policies are evaluated, never changes.

    With the paper's random walk an obstacle seldom meets the flock, and a policy that keeps exactly the minimum separation
    violates it at the slightest error: the obstacles' square is smaller and the separations are wider than the task's. In a
    large flock every vehicle's exploration disturbs all others; in a small one vehicles meet too seldom: the default is a flock
    of five. The effect of one action over a tenth of a second is small beside the noise of the value estimates: an action is
    repeated, and ``algorithm.gamma`` counts the longer steps. A policy that explores seldom visits dense packs at rest, and
    learns to avoid them: an expert demonstrates them.
    """

    flock_sizes: Sizes | None = Field(
        (5,),
        min_length=1,
        max_length=16,
        description="vehicles per flock, one or several sizes; null: as in the task (paper: null)",
    )
    obstacle_motions: tuple[Annotated[str, AfterValidator(check_obstacle_motion)], ...] | None = Field(
        None,
        min_length=1,
        max_length=16,
        description="motions of the obstacles, each with flocks of its own; null: as in the task (paper: null)",
    )
    extra_obstacles: int = Field(0, ge=0, le=MAX_BODIES, description="obstacles added if the task has any (paper: 0)")
    obstacle_arena_scale: Positive = Field(
        0.5, description="factor on the square of obstacles that walk, unless obstacle_starts is set (paper: 1)"
    )
    time_step_scale: Positive = Field(1.0, description="factor on the sampling period (paper: 1)")
    action_repeat: int = Field(2, ge=1, le=1000, description="sampling periods for which an action is repeated (paper: 1)")
    separation_scale: float = Field(1.015, ge=1, le=1e6, description="factor on the minimum separations (paper: 1)")
    obstacle_separation_scale: float | None = Field(
        1.08, ge=1, le=1e6, description="the same for obstacles; null: separation_scale (paper: 1)"
    )
    randomization: dict[str, tuple[float, float]] = Field(
        {},
        description="domain randomization: [lowest, highest] value of fields of scenario.sensors and scenario.actuators by name, "
        "such as {actuators.speed_lag: [0, 0.3]}, drawn for each flock and episode; the expert and the reward see the truth "
        "(paper: none)",
    )
    expert: str | None = Field(
        None,
        description="expert to learn from: mpc (plans for the whole flock from the full state), orca, olfati-saber; "
        "null: none (paper: null)",
    )
    expert_fraction: float = Field(
        0.25, ge=0, le=1, description="share of the episodes that the expert drives (DAgger's beta; paper: 0)"
    )
    expert_noise_std: NotNegative = Field(
        0.1, description="standard deviation of the noise on the expert's actions [half the action range]"
    )
    mpc: MPCConfig = Field(default_factory=MPCConfig, description="the cost and the optimizer of the expert mpc")

    @field_validator("randomization")
    @classmethod
    def _ranges_are_of_fields(cls, ranges: dict[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
        check_ranges(ranges, {"sensors": SensorErrors(), "actuators": Actuators()})
        return ranges

    def __hash__(self) -> int:
        values = {name: getattr(self, name) for name in type(self).model_fields}
        return hash((frozenset(values.pop("randomization").items()), *values.values()))

    @model_validator(mode="after")
    def _expert_is_known(self) -> TrainEnvConfig:
        if self.expert is not None and self.expert not in EXPERTS:
            raise ValueError(
                f"expert = {self.expert!r}: one of {', '.join(EXPERTS)} or null is needed{suggest(self.expert, EXPERTS)}"
            )
        return self


class TaskConfig(Settings):
    """The task, and how the training env differs from it."""

    scenario: Scenario = Field(
        default_factory=lambda: Scenario(**TRAINING_TASK),
        description="the task, on which policies are evaluated; with the safety filter and shared detections unless it says "
        "otherwise",
    )
    train_env: TrainEnvConfig = Field(
        default_factory=TrainEnvConfig, description="how the training env differs from the task"
    )

    @field_validator("scenario", mode="before")
    @classmethod
    def _has_a_filter(cls, value: Any) -> Any:
        return {**TRAINING_TASK, **value} if isinstance(value, Mapping) else value

    @model_validator(mode="after")
    def _ranges_fit_the_task(self) -> TaskConfig:
        check_randomization(self.train_env.randomization, self.scenario)
        return self

    @model_validator(mode="after")
    def _no_simulator_trains(self) -> TaskConfig:
        if self.scenario.dynamics in SIMULATORS:
            raise ValueError(
                f"scenario.dynamics = {self.scenario.dynamics}: the state of a simulator is in no checkpoint; simulators "
                "evaluate, render and play"
            )
        return self

    @model_validator(mode="after")
    def _training_env_is_possible(self) -> TaskConfig:
        steps = self.scenario.motion_lag_steps / self.train_env.time_step_scale
        if not math.isclose(steps, round(steps), rel_tol=1e-6) or (self.scenario.motion_lag and steps < 0.5):
            step = f"{self.scenario.time_step * self.train_env.time_step_scale:g} s, the training env's sampling period"
            raise ValueError(f"motion_lag = {self.scenario.motion_lag}: input should be a multiple of {step}")
        try:
            for scenario in self.training_scenarios():
                self.training_safety(scenario)
        except SettingsError as error:
            scale = self.train_env.time_step_scale
            raise ValueError(f"train_env.time_step_scale = {scale}: in the training env {error}") from None
        return self

    def training_scenarios(self) -> list[Scenario]:
        """The scenarios of the training env: ``scenario`` changed as ``train_env`` says, one for each flock size.

        The safety filter is off in them; :meth:`training_safety` has its settings.
        """
        scenario, train_env = self.scenario, self.train_env
        changed = scenario.replace(
            safety_filter="off",
            obstacle_filter=False,
            time_step=scenario.time_step * train_env.time_step_scale,
            max_cycles=max(1, round(scenario.max_cycles / train_env.time_step_scale)),
            n_obstacles=scenario.n_obstacles + (train_env.extra_obstacles if scenario.n_obstacles else 0),
            neighbor_separation=min(scenario.neighbor_separation * train_env.separation_scale, scenario.link_range),
            obstacle_separation=min(
                scenario.obstacle_separation * (train_env.obstacle_separation_scale or train_env.separation_scale),
                scenario.detection_range,
            ),
        )
        # The others, such as crossing ones, meet the flock where it gathers: their square stays as it is.
        wide = scenario.obstacle_half_side
        narrow = wide * (1.0 if scenario.obstacle_starts else train_env.obstacle_arena_scale)
        motions = [
            changed.replace(obstacle_motion=motion, obstacle_arena=narrow if motion == WALK else wide)
            for motion in train_env.obstacle_motions or (scenario.obstacle_motion,)
        ]
        sizes = train_env.flock_sizes or (scenario.n_vehicles,)
        return [motion.replace(n_vehicles=size) for motion in motions for size in sizes]

    def training_safety(self, scenario: Scenario) -> Scenario:
        """The settings of the safety filter for one of :meth:`training_scenarios`: it keeps the task's separations.

        The wider ones are for the reward and the expert. The filter would hold vehicles that keep just those.
        """
        names = ("safety_filter", "obstacle_filter", "neighbor_separation", "obstacle_separation")
        return scenario.replace(**{name: getattr(self.scenario, name) for name in names})


class TrainingConfig(ModelSettings, TaskConfig):
    """A training: the task, the algorithm, the networks and the bookkeeping.

    Totals and frequencies count transitions. One transition is one step of one vehicle: a vector step of ``n_flocks`` flocks
    counts ``n_flocks`` times the flock size.

    :raises SettingsError: one line naming the parameter, its value and what is accepted
    """

    total_timesteps: int = Field(400_000, ge=1, le=10**12, description="transitions to train for")
    n_flocks: Width = Field(32, description="flocks in the training env, of each flock size")
    num_cpus: int = Field(
        0, ge=0, le=1024, description="SuperSuit worker processes; 0: simulate in the training process, which is faster"
    )
    torch_threads: int = Field(
        0,
        ge=0,
        le=1024,
        description="threads of torch, and of the compiled update, which has two at most; 0: of torch one for batches under "
        "1024, where more are no faster, else one per core, and of the update two where there are two cores, unless the "
        "environment variable OMP_NUM_THREADS is 1",
    )

    eval_freq: Count = Field(10_000, description="transitions between evaluations; 0: none")
    n_eval_episodes: int = Field(100, ge=1, le=1_000_000, description="episodes of an evaluation, the same ones every time")
    n_test_episodes: int = Field(
        1000, ge=1, le=1_000_000, description="episodes of the final evaluation of the best model, on a separate seed"
    )
    save_freq: Count = Field(100_000, description="transitions between checkpoints; 0: none")
    keep_checkpoints: int = Field(
        2,
        ge=1,
        le=1_000_000,
        description="number of newest checkpoints to keep; a resumed training continues from the newest",
    )
    init_from: str | None = Field(None, description="policy (zip or run folder) with the initial weights; null: random")
    output_dir: str = Field("runs", description="folder in which run folders are created")

    @model_validator(mode="after")
    def _bc_has_an_expert(self) -> TrainingConfig:
        # The velocity that Olfati-Saber's controller integrates is defined only where the controller drives.
        if self.algorithm.bc_coef and self.train_env.expert in (None, "olfati-saber"):
            raise ValueError(
                f"algorithm.bc_coef = {self.algorithm.bc_coef}: input should be 0 without train_env.expert mpc or orca"
            )
        return self
