from functools import reduce
from pathlib import Path

import pytest

from sb3_flock.config.presets import EXPERT_PRESETS
from sb3_flock.config.training import TrainingConfig
from sb3_flock.controllers import EXPERTS
from sb3_flock.serialization.yaml_io import load_config
from sb3_flock.settings import resolve_path

CONFIGS = Path(__file__).parents[2] / "configs"
FILES = {"mpc": "ddpg_bc_5v2o.yaml"}
"""The config file that a preset stands for."""


def with_preset(name, **task):
    return load_config(TrainingConfig, overrides={"train_env.expert": name, **task}, defaults=EXPERT_PRESETS[name])


def resolved(config):
    """The config with the flock sizes that it trains with."""
    sizes = tuple(scenario.n_vehicles for scenario in config.training_scenarios())
    return config.replace(train_env=config.train_env.replace(flock_sizes=sizes))


@pytest.mark.parametrize("name", EXPERT_PRESETS)
def test_a_preset_is_the_training_of_its_config_file_for_the_same_task(name):
    file = load_config(TrainingConfig, CONFIGS / FILES[name])
    task = {field: getattr(file.scenario, field) for field in ("n_vehicles", "n_obstacles", "obstacle_motion")}
    assert resolved(with_preset(name, **task)) == resolved(file)
    other = with_preset(name, n_vehicles=4, n_obstacles=0)
    assert [scenario.n_vehicles for scenario in other.training_scenarios()] == [4]


@pytest.mark.parametrize("name", EXPERT_PRESETS)
def test_a_preset_names_an_expert_and_only_what_differs_from_the_defaults(name):
    assert name in EXPERTS
    default, preset = TrainingConfig(), with_preset(name)
    for path in EXPERT_PRESETS[name]:
        names = path.split(".")
        assert resolve_path(TrainingConfig, path) == tuple(names)
        assert reduce(getattr, names, preset) != reduce(getattr, names, default), path
