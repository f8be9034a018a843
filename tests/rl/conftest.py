"""A small model and its file."""

import pytest

from sb3_flock import TrainingConfig, make_vec_env, save_model
from sb3_flock.rl.algorithms import build_model
from sb3_flock.rl.config_io import load_config

CONFIG = load_config(TrainingConfig, overrides={"buffer_size": 10, "n_flocks": 1, "features_dim": 16})


@pytest.fixture(scope="module")
def model():
    return build_model(CONFIG, make_vec_env(CONFIG.scenario, 1, seed=0))


@pytest.fixture
def saved(model, tmp_path):
    return save_model(model, tmp_path / "policy.zip", CONFIG)
