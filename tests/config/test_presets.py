from functools import reduce
from pathlib import Path

import pytest

from sb3_flock.config.presets import EXPERT_PRESETS
from sb3_flock.config.training import TrainingConfig
from sb3_flock.controllers import EXPERTS
from sb3_flock.serialization.yaml_io import load_config
from sb3_flock.settings import leaf_paths, resolve_path

CONFIGS = Path(__file__).parents[2] / "configs"
FILES = {"mpc": "flock.yaml"}
"""The config file beside which a preset stands."""

SHORTER = {
    "mpc": (
        "train_env.flock_sizes",
        "train_env.obstacle_motions",
        "algorithm.buffer_size",
        "algorithm.utd_ratio",
        "network.features_dim",
        "network.net_arch",
        "total_timesteps",
        "n_flocks",
        "eval_freq",
        "save_freq",
    )
}
"""The fields in which a preset's training is shorter than the file's."""


def with_preset(name, **task):
    return load_config(TrainingConfig, overrides={"train_env.expert": name, **task}, defaults=EXPERT_PRESETS[name])


def value_of(config, path):
    return reduce(getattr, path.split("."), config)


@pytest.mark.parametrize("name", EXPERT_PRESETS)
def test_a_preset_is_a_shorter_training_of_its_config_file_for_the_same_task(name):
    file = load_config(TrainingConfig, CONFIGS / FILES[name])
    task = {field: getattr(file.scenario, field) for field in ("n_vehicles", "n_obstacles", "obstacle_motion")}
    preset = with_preset(name, **task)
    differing = {
        path for path in map(".".join, leaf_paths(TrainingConfig)) if value_of(preset, path) != value_of(file, path)
    }
    assert differing <= set(SHORTER[name])
    assert differing >= {"total_timesteps", "train_env.flock_sizes"}
    assert preset.total_timesteps < file.total_timesteps
    other = with_preset(name, n_vehicles=4, n_obstacles=0)
    assert [scenario.n_vehicles for scenario in other.training_scenarios()] == [4]


@pytest.mark.parametrize("name", EXPERT_PRESETS)
def test_a_preset_names_an_expert_and_only_what_differs_from_the_defaults(name):
    assert name in EXPERTS
    default, preset = TrainingConfig(), with_preset(name)
    for path in EXPERT_PRESETS[name]:
        names = path.split(".")
        assert resolve_path(TrainingConfig, path) == tuple(names)
        assert value_of(preset, path) != value_of(default, path), path
