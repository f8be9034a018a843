"""The compiled update ends where the same updates by torch end."""

from copy import deepcopy

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.logger import configure

from sb3_flock import Scenario, make_vec_env
from sb3_flock.rl.compiled_update import can_compile
from sb3_flock.rl.ddpg import FlockDDPG
from sb3_flock.rl.registry import ModelSettings, build_model
from tests.helpers import expert_vec_env

pytest.importorskip("numba")

UPDATES = 30


def filled(compiled, motion_lag=0.0, algorithm=None, network=None):
    """A model with a replay buffer of whole episodes and parts of one, untrained."""
    settings = ModelSettings(
        algorithm={
            "buffer_size": 400,
            "learning_starts": 10_000,
            "batch_size": 37,
            "action_noise_std": 0.4,
            **(algorithm or {}),
        },
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


def updated(model):
    np.random.seed(3)  # noqa: NPY002 - what the buffer draws from
    model.train(UPDATES, model.batch_size)
    return model


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"network": {"n_critics": 1}},
        {"network": {"layer_norm": False, "action_bound": "tanh"}},
        {"motion_lag": 0.2, "network": {"channels": (8,)}},
        {"network": {"channels": (4, 6, 8), "stride": 1, "net_arch": (16, 12)}},
        {"network": {"kernel_size": 2, "net_arch": ()}},
        {"algorithm": {"mirror_augmentation": False, "tau": 0.5}},
        {"algorithm": {"bc_coef": 10.0}},
    ],
    ids=lambda options: str(options),
)
def test_thirty_updates_end_where_torch_ends(options):
    ours, reference = filled(None, **options), filled(False, **options)
    assert can_compile(ours)
    start = [parameter.detach().clone() for parameter in ours.policy.parameters()]
    for model in (ours, reference):
        updated(model)
    assert ours._n_updates == reference._n_updates == UPDATES
    moved = max(float((a - b).detach().abs().max()) for a, b in zip(start, ours.policy.parameters(), strict=True))
    assert moved > 5e-3
    for (name, a), b in zip(ours.policy.named_parameters(), reference.policy.parameters(), strict=True):
        th.testing.assert_close(a, b, rtol=0, atol=3e-5, msg=name)
    for name in ("actor", "critic"):
        optimizers = [getattr(model, name).optimizer.state_dict()["state"] for model in (ours, reference)]
        for number, state in optimizers[0].items():
            assert float(state["step"]) == float(optimizers[1][number]["step"]) == UPDATES
            for moment in ("exp_avg", "exp_avg_sq"):
                th.testing.assert_close(state[moment], optimizers[1][number][moment], rtol=2e-3, atol=1e-5)
    logged = [model.logger.name_to_value for model in (ours, reference)]
    assert logged[0].keys() == logged[1].keys()
    for name in logged[0]:
        assert logged[0][name] == pytest.approx(logged[1][name], rel=1e-3, abs=1e-5)


def test_the_weights_stay_the_modules_own(tmp_path):
    model = updated(filled(None))
    saved = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    model.save(tmp_path / "model.zip")
    loaded = FlockDDPG.load(tmp_path / "model.zip")
    for name, tensor in loaded.policy.state_dict().items():
        assert th.equal(tensor, saved[name]), name
    model.set_parameters(deepcopy(loaded.get_parameters()))  # the optimizers get new tensors: the next update takes them up
    twin = filled(None)
    twin.set_parameters(deepcopy(loaded.get_parameters()))
    twin.replay_buffer = model.replay_buffer
    for one in (model, twin):
        updated(one)
    for a, b in zip(model.policy.parameters(), twin.policy.parameters(), strict=True):
        assert th.equal(a, b)
    assert not th.equal(model.policy.state_dict()["actor.mu.0.weight"], saved["actor.mu.0.weight"])


def test_without_the_parts_torch_updates():
    model = filled(None)
    model.critic.optimizer.param_groups[0]["weight_decay"] = 0.1
    assert not can_compile(model)
    before = model.policy.state_dict()["critic.qf0.0.weight"].clone()
    updated(model)
    assert not th.equal(before, model.policy.state_dict()["critic.qf0.0.weight"])
