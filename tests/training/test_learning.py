"""A short training that fails if anything between the env and the weights is broken."""

import io

from rich.console import Console

from sb3_flock import evaluate, load_policy, make_vec_env, train
from sb3_flock.config.training import TrainingConfig
from sb3_flock.rl.registry import build_model
from sb3_flock.serialization.yaml_io import load_config


def test_two_vehicles_learn_to_go_to_the_waypoint(tmp_path):
    overrides = {
        "n_vehicles": 2, "n_obstacles": 0, "max_cycles": 60, "arena": 0.5, "waypoint_speed": 0.0, "goal_radius": 0.8,
        "scale": 0.1, "gamma": 0.9, "learning_rate": 1e-3, "learning_starts": 1_000, "utd_ratio": 0.3, "n_flocks": 10,
        "features_dim": 64, "channels": [8, 16], "n_critics": 1, "total_timesteps": 12_000, "eval_freq": 3_000,
        "n_eval_episodes": 50, "output_dir": str(tmp_path),
    }  # fmt: skip
    config = load_config(TrainingConfig, overrides=overrides)
    result = train(config, Console(file=io.StringIO()))
    untrained = build_model(config, make_vec_env(config.scenario, 1))
    before = evaluate(untrained, config.scenario, episodes=50, seed=3)["tracking_error"].mean
    after = evaluate(load_policy(result.folder), episodes=50, seed=3)["tracking_error"].mean
    assert before > 0.3
    assert after < before / 2
