"""The settings that a training with an expert needs, in place of the defaults of ``TrainingConfig``."""

from __future__ import annotations

from typing import Any

EXPERT_PRESETS: dict[str, dict[str, Any]] = {
    "mpc": {
        "scenario.motion_lag": 0.2,
        "scenario.reward.max_distance": 0.3,
        "scenario.reward.scale": 0.05,
        "train_env.flock_sizes": None,  # as in the task
        "train_env.time_step_scale": 1.0,
        "train_env.separation_scale": 1.02,
        "train_env.obstacle_separation_scale": 1.1,
        "algorithm.learning_rate": 0.001,
        "algorithm.batch_size": 256,
        "algorithm.buffer_size": 500_000,
        "algorithm.gamma": 0.98,
        "algorithm.bc_coef": 10.0,
        "algorithm.utd_ratio": 0.06,
        "algorithm.action_noise_std": 0.1,
        "network.channels": (32,),
        "total_timesteps": 500_000,
        "n_flocks": 26,
        "eval_freq": 25_000,
        "save_freq": 100_000,
    },
}
"""By expert: values by the parameter's whole name. For ``mpc`` a test holds them equal to ``configs/ddpg_bc_5v2o.yaml``, whose
task they leave out."""
