"""The settings that a training with an expert needs, in place of the defaults of ``TrainingConfig``."""

from __future__ import annotations

from typing import Any

EXPERT_PRESETS: dict[str, dict[str, Any]] = {
    "mpc": {
        "scenario.motion_lag": 0.2,
        "scenario.obstacle_radius": 0.35,
        "scenario.reward.link_bonus": 0.5,
        "scenario.reward.max_distance": 0.3,
        "scenario.reward.lambda_": 0.7,
        "scenario.reward.scale": 0.05,
        "train_env.flock_sizes": None,  # as in the task
        "train_env.expert_fraction": 0.0,
        "train_env.action_repeat": 1,
        "train_env.separation_scale": 1.02,
        "train_env.obstacle_separation_scale": 1.18,
        "train_env.mpc.max_link_length": 0.85,
        "train_env.mpc.link_cutoff": 1.0,
        "train_env.mpc.separation_weight": 200.0,
        "train_env.mpc.clearance_weight": 500.0,
        "train_env.mpc.link_weight": 120.0,
        "algorithm.learning_rate": 0.001,
        "algorithm.batch_size": 256,
        "algorithm.gamma": 0.98,
        "algorithm.bc_coef": 10.0,
        "algorithm.utd_ratio": 0.06,
        "algorithm.action_noise_std": 0.1,
        "algorithm.final_action_noise_std": 0.05,
        "network.channels": (32,),
        "network.action_bound": "tanh",
        "total_timesteps": 200_000,
        "n_flocks": 26,
        "eval_freq": 25_000,
    },
}
"""By expert: values by the parameter's whole name. A test holds those of ``mpc`` beside ``configs/flock.yaml``, from which they
differ in what makes that training long."""
