"""Files that plain SB3 wrote with the parts of an earlier release: SB3's own ``load`` still reads them."""

import warnings

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG

from sb3_flock import CompactReplayBuffer, FlockDDPG, FlockPolicy, FlockSACPolicy, load_policy, make_vec_env
from sb3_flock._renamed import RenamedWarning
from sb3_flock.envs.flocking_v0 import action_space, observation_space
from sb3_flock.serialization.format2 import FlockCNNOfFormat2, FlockPolicyOfFormat2, FlockSACPolicyOfFormat2
from sb3_flock.sim import Scenario
from tests.helpers import DATA

PLAIN = DATA / "format_2/plain"
OBSERVATIONS = np.random.default_rng(0).random((4, 3, 11, 11)).astype(np.float32)
ACTIONS = [[0.0747939, -0.0012500], [0.0747915, -0.0011587], [0.0747907, -0.0012989], [0.0747971, -0.0012486]]
"""What the earlier release computed from these observations, with both files."""


def load_with_sb3(algorithm, name, **kwargs):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RenamedWarning)  # only the first import of an old module in a process warns
        return algorithm.load(PLAIN / name, device="cpu", **kwargs)


def has_layer_norm(network):
    return any(isinstance(module, th.nn.LayerNorm) for module in network.modules())


@pytest.mark.parametrize("name", ["plain_ddpg.zip", "plain_flock_ddpg.zip"])
def test_load_policy_reads_them(name):
    with pytest.warns(UserWarning, match="saved without its scenario; the default is assumed"):
        loaded = load_policy(PLAIN / name)
    np.testing.assert_allclose(loaded.predict(OBSERVATIONS)[0], ACTIONS, atol=1e-6)
    assert not loaded.config.network.layer_norm


@pytest.mark.parametrize(
    ("algorithm", "name"),
    [(DDPG, "plain_ddpg.zip"), (DDPG, "plain_flock_ddpg.zip"), (FlockDDPG, "plain_flock_ddpg.zip")],
)
def test_sb3_loads_them_without_layer_norm(algorithm, name):
    model = load_with_sb3(algorithm, name)
    np.testing.assert_allclose(model.predict(OBSERVATIONS, deterministic=True)[0], ACTIONS, atol=1e-6)
    assert not any(has_layer_norm(network) for network in (model.actor, model.critic, model.actor_target))
    assert isinstance(model.policy, FlockPolicy)


def test_a_loaded_flock_ddpg_trains_on_and_saves(tmp_path):
    model = load_with_sb3(FlockDDPG, "plain_flock_ddpg.zip", env=make_vec_env(seed=0))
    assert model.bc_coef == 0.0
    assert isinstance(model.replay_buffer, CompactReplayBuffer)
    assert model.replay_buffer.mirror_augmentation
    model.learning_starts, before = 0, model.actor.mu[0].weight.clone()
    model.learn(3 * model.n_envs)
    assert not th.equal(before, model.actor.mu[0].weight)
    model.save(tmp_path / "again.zip")
    with pytest.warns(RenamedWarning, match="CompactReplayBuffer: mirror is now mirror_augmentation"):
        again = FlockDDPG.load(tmp_path / "again.zip", device="cpu")
    expected = model.predict(OBSERVATIONS, deterministic=True)[0]
    np.testing.assert_array_equal(again.predict(OBSERVATIONS, deterministic=True)[0], expected)
    with pytest.warns(UserWarning, match="the default is assumed"):
        np.testing.assert_array_equal(load_policy(tmp_path / "again.zip").predict(OBSERVATIONS)[0], expected)


@pytest.mark.parametrize(("then", "now"), [(FlockPolicyOfFormat2, FlockPolicy), (FlockSACPolicyOfFormat2, FlockSACPolicy)])
def test_only_the_default_of_layer_norm_was_another(then, now):
    spaces = observation_space(Scenario()), action_space(Scenario())

    def build(kind, **kwargs):
        th.manual_seed(0)
        return kind(*spaces, lr_schedule=lambda _: 1e-3, **kwargs)

    old, given = build(then), build(now, features_extractor_kwargs={"layer_norm": False})
    assert type(old.actor.features_extractor) is FlockCNNOfFormat2
    ours, theirs = old.state_dict(), given.state_dict()
    assert ours.keys() == theirs.keys()
    assert all(th.equal(value, theirs[name]) for name, value in ours.items())
    assert has_layer_norm(build(now))
    assert has_layer_norm(build(then, features_extractor_kwargs={"layer_norm": True}))


def test_layer_norm_given_by_position_counts():
    space = observation_space(Scenario())
    assert has_layer_norm(FlockCNNOfFormat2(space, 8, (4, 8), 3, 2, True))
    assert not has_layer_norm(FlockCNNOfFormat2(space, 8, (4, 8), 3, 2, False))
    assert not has_layer_norm(FlockCNNOfFormat2(space, 8, (4, 8), 3, 2))
