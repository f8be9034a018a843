"""Untrained models with a filled replay buffer, whose updates the tests compare."""

import numpy as np
import torch as th
from stable_baselines3.common.logger import configure

from sb3_flock import Scenario, make_vec_env
from sb3_flock.rl.registry import ModelSettings, build_model
from tests.helpers import expert_vec_env

UPDATES = 30


def filled(compiled=True, algo="ddpg", motion_lag=0.0, algorithm=None, network=None):
    """A model with a replay buffer of whole episodes and parts of one."""
    options = {"buffer_size": 400, "learning_starts": 10_000, "batch_size": 37, "action_noise_std": 0.4}
    settings = ModelSettings(
        algo=algo,
        algorithm={**options, **(algorithm or {})},
        network={"features_dim": 48, "final_init": 0.1, **(network or {})},
    )
    scenario = Scenario(max_cycles=15, motion_lag=motion_lag)
    env = expert_vec_env(scenario) if settings.algorithm.bc_coef else make_vec_env(scenario, n_flocks=2, seed=0)
    model = build_model(settings, env)
    model.compiled = compiled
    model.set_logger(configure(None, []))
    model.learn(480)
    model._update_current_progress_remaining(0, 1)  # the learning rate is that of the start
    return model


def updated(model, updates=UPDATES):
    """The model after a round of updates on minibatches that are the same for every model."""
    np.random.seed(3)  # noqa: NPY002 - what the buffer draws from
    th.manual_seed(3)
    model.train(updates, model.batch_size)
    return model
