import re

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.sac.policies import SACPolicy

from sb3_flock import CompactReplayBuffer, FlockCNN, FlockDDPG, FlockPolicy, load_policy, make_vec_env, save_model
from sb3_flock.config.training import TrainingConfig
from sb3_flock.rl.ddpg import FlockTD3
from sb3_flock.rl.policies import InvertingBound
from sb3_flock.rl.registry import (
    ALGORITHMS,
    AlgorithmSpec,
    ModelSettings,
    build_model,
    fewest_parameters,
    policy_kwargs,
    register_algorithm,
)
from sb3_flock.rl.settings import AlgorithmConfig
from sb3_flock.serialization.yaml_io import load_config
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario
from tests.helpers import tiny

SCENARIO = Scenario()


def settings(**overrides):
    return load_config(ModelSettings, overrides={"buffer_size": 12, "features_dim": 16, **overrides})


def build(n_flocks=2, **overrides):
    return build_model(settings(**overrides), make_vec_env(SCENARIO, n_flocks, seed=0))


@pytest.mark.parametrize(
    ("algo", "algorithm", "buffer", "bound"),
    [
        ("ddpg", FlockDDPG, CompactReplayBuffer, InvertingBound),
        ("ddpg-sb3", DDPG, ReplayBuffer, InvertingBound),
        ("td3", FlockTD3, CompactReplayBuffer, InvertingBound),
        ("sac", SAC, CompactReplayBuffer, None),
    ],
)
def test_each_algorithm_is_built_with_its_own_defaults(algo, algorithm, buffer, bound):
    model = build(algo=algo)
    assert type(model) is algorithm
    assert type(model.replay_buffer) is buffer
    assert getattr(model.replay_buffer, "mirror_augmentation", True)  # null: wherever the buffer can
    assert (model.action_noise is None) == (algo == "sac")
    assert all(isinstance(network.features_extractor, FlockCNN) for network in (model.actor, model.critic))
    if bound is not None:
        assert isinstance(model.actor.mu[-1], bound)


def test_the_settings_reach_the_model():
    model = build(
        gamma=0.9, tau=0.1, batch_size=7, learning_rate=1e-3, final_learning_rate=1e-4, learning_starts=5, train_freq=2,
        utd_ratio=0.5, action_noise_std=0.3, action_bound="tanh", n_critics=3, mirror_augmentation=False, seed=4, bc_coef=2.0,
    )  # fmt: skip
    assert (model.gamma, model.tau, model.batch_size, model.learning_starts, model.seed) == (0.9, 0.1, 7, 5, 4)
    assert [model.lr_schedule(remaining) for remaining in (1.0, 0.5, 0.0)] == pytest.approx([1e-3, 5.5e-4, 1e-4])
    assert model.gradient_steps == 0.5 * 2 * model.n_envs
    np.testing.assert_array_equal(model.action_noise._sigma, [0.3, 0.3])
    assert isinstance(model.actor.mu[-1], th.nn.Tanh)
    assert model.critic.n_critics == 3
    assert not model.replay_buffer.mirror_augmentation
    assert model.replay_buffer.expert_actions is not None
    assert model.bc_coef == 2.0
    assert build(action_noise_std=0).action_noise is None
    np.testing.assert_array_equal(build(action_noise_std=0, final_action_noise_std=0.1).action_noise._sigma, [0, 0])


@pytest.mark.parametrize(("stds", "expected"), [((0.3, None), (0.3, 0.3)), ((0.3, 0.1), (0.3, 0.1)), ((0.3, 0), (0.3, 0))])
def test_the_noise_stays_unless_its_end_is_given(stds, expected):
    assert AlgorithmConfig(action_noise_std=stds[0], final_action_noise_std=stds[1]).action_noise_stds == expected


@pytest.mark.parametrize("algo", ["ddpg", "td3", "sac"])
def test_returns_over_several_steps_need_sb3s_buffer(algo):
    model = build(algo=algo, n_steps=3)
    assert type(model.replay_buffer) is NStepReplayBuffer


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"algo": "ddpg-sb3", "mirror_augmentation": True}, "mirror_augmentation = True: .*with algo = ddpg-sb3"),
        ({"n_steps": 2, "mirror_augmentation": True}, "mirror_augmentation = True: .*with n_steps = 2"),
        (
            {"algo": "sac", "action_bound": "inverting"},
            "network.action_bound = 'inverting': .* tanh or null with algo = sac",
        ),
        ({"algo": "td3", "bc_coef": 1.0}, "bc_coef = 1.0: input should be 0 without algo ddpg and n_steps 1"),
        ({"algo": "sac", "bc_coef": 1.0}, "bc_coef = 1.0: input should be 0 without algo ddpg and n_steps 1"),
        ({"algo": "ddpg-sb3", "bc_coef": 1.0}, "bc_coef = 1.0: input should be 0 without algo ddpg and n_steps 1"),
        ({"n_steps": 2, "bc_coef": 1.0}, "bc_coef = 1.0: input should be 0 without algo ddpg and n_steps 1"),
        ({"algo": "tdd3"}, r"algo = 'tdd3': one of ddpg, ddpg-sb3, td3, sac is needed; did you mean td3\?"),
    ],
)
def test_an_option_that_does_not_apply_is_refused_in_one_line(overrides, message):
    with pytest.raises(SettingsError, match=message) as error:
        settings(**overrides)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_what_the_other_algorithms_refuse_is_accepted_where_it_applies(algo):
    spec = ALGORITHMS[algo]
    for bound in spec.action_bounds:
        assert policy_kwargs(settings(algo=algo, action_bound=bound))["action_bound"] == bound
    if spec.has_compact_buffer:
        assert build(algo=algo, mirror_augmentation=True).replay_buffer.mirror_augmentation
    assert settings(algo=algo, mirror_augmentation=False).algorithm.mirror_augmentation is False


@pytest.fixture
def _clean_registry():
    before = dict(ALGORITHMS)
    yield
    ALGORITHMS.clear()
    ALGORITHMS.update(before)


class PlainTD3(TD3):
    """An algorithm of another package."""


@pytest.mark.usefixtures("_clean_registry")
@pytest.mark.parametrize("by_name", [False, True])
def test_an_algorithm_registered_from_outside_trains_saves_and_loads(tmp_path, by_name):
    where = f"{__name__}:PlainTD3" if by_name else PlainTD3
    with pytest.raises(SettingsError, match="algo = 'plain-td3'"):
        tiny(tmp_path, algo="plain-td3")
    register_algorithm("plain-td3", AlgorithmSpec(where, FlockPolicy, action_bounds=("tanh",), has_compact_buffer=False))
    config = tiny(tmp_path, algo="plain-td3")
    model = build_model(config, make_vec_env(config.scenario, 2, seed=0))
    assert type(model) is PlainTD3
    assert type(model.replay_buffer) is ReplayBuffer
    assert isinstance(model.actor.mu[-1], th.nn.Tanh)
    model.learn(90)
    assert model._n_updates > 0
    loaded = load_policy(save_model(model, tmp_path / "policy.zip", config))
    assert loaded.config.algo == "plain-td3"
    observations = np.random.default_rng(0).random((4, 3, 11, 11)).astype(np.float32)
    np.testing.assert_array_equal(loaded.predict(observations)[0], model.predict(observations, deterministic=True)[0])
    with pytest.raises(SettingsError, match="mirror_augmentation = True"):
        tiny(tmp_path, algo="plain-td3", mirror_augmentation=True)
    with pytest.raises(SettingsError, match="action_bound = 'inverting': input should be one of tanh or null"):
        tiny(tmp_path, algo="plain-td3", action_bound="inverting")


@pytest.mark.usefixtures("_clean_registry")
def test_bc_coef_goes_to_a_registered_algorithm_that_has_it():
    register_algorithm("cloned", AlgorithmSpec(FlockDDPG, FlockPolicy, action_bounds=("inverting",), has_bc=True))
    assert build(algo="cloned", bc_coef=3.0).bc_coef == 3.0
    with pytest.raises(SettingsError, match=re.escape("without algo ddpg, cloned and n_steps 1")):
        settings(algo="td3", bc_coef=3.0)


@pytest.mark.usefixtures("_clean_registry")
def test_a_name_is_registered_once():
    spec = AlgorithmSpec(PlainTD3, SACPolicy)
    register_algorithm("once", spec)
    register_algorithm("once", spec)  # the same again, as when a module is reloaded
    for name in ("once", "ddpg"):
        with pytest.raises(ValueError, match=f"algorithm '{name}' is registered already"):
            register_algorithm(name, AlgorithmSpec(PlainTD3, FlockPolicy))


def test_a_whole_training_config_builds_the_same_networks_as_its_model_settings():
    config = load_config(TrainingConfig, overrides={"buffer_size": 12, "features_dim": 16, "seed": 3})
    env = make_vec_env(SCENARIO, 2, seed=0)
    ours, theirs = (build_model(one, env).policy.state_dict() for one in (config, settings(seed=3)))
    assert all(th.equal(value, theirs[name]) for name, value in ours.items())


@pytest.mark.parametrize("algo", ALGORITHMS)
@pytest.mark.parametrize("net_arch", [[], [64], [32, 48]])
def test_fewest_parameters_is_a_bound_close_to_the_networks(algo, net_arch):
    one = settings(algo=algo, net_arch=net_arch, n_critics=3)
    model = build_model(one, make_vec_env(SCENARIO, 1, seed=0))
    networks = {id(p): p.numel() for network in (model.actor, model.critic) for p in network.parameters()}
    assert 0.7 * sum(networks.values()) < fewest_parameters(one, SCENARIO.observation_shape) <= sum(networks.values())
