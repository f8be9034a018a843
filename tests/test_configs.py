"""Every config loads, is complete, and carries the comments that the package itself would write."""

from pathlib import Path

import pytest

from sb3_flock.config.training import TrainingConfig
from sb3_flock.serialization.yaml_io import load_config, to_yaml

CONFIGS = sorted(
    path for path in (Path(__file__).parents[1] / "configs").glob("*.yaml") if not path.name.startswith("sweep_")
)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_a_config_is_what_the_package_would_write(path):
    assert path.read_text() == to_yaml(load_config(TrainingConfig, path))


@pytest.mark.parametrize(("name", "setup"), [("1_3v1o", (3, 1)), ("2_5v1o", (5, 1)), ("2_5v2o", (5, 2))])
def test_the_papers_experiments_are_the_defaults_with_its_numbers_of_bodies(name, setup):
    config = load_config(TrainingConfig, Path(__file__).parents[1] / "configs" / f"experiment{name}.yaml")
    assert (config.scenario.n_vehicles, config.scenario.n_obstacles) == setup
    assert config.replace(scenario=TrainingConfig().scenario) == TrainingConfig()


def test_the_plain_recipe_is_the_papers():
    config = load_config(TrainingConfig, Path(__file__).parents[1] / "configs" / "paper_plain.yaml")
    reward = config.scenario.reward
    assert (reward.link_bonus, reward.separation_penalty, reward.obstacle_penalty, reward.scale) == (1, 1, 1, 1)
    assert (config.algo, config.network.n_critics, config.algorithm.utd_ratio) == ("ddpg", 1, 1)
    assert config.training_scenarios()[0].replace(obstacle_arena=None) == config.scenario
