import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from sb3_flock import CompactReplayBuffer, FlockCNN, FlockDDPG, FlockPolicy, make_vec_env
from sb3_flock._renamed import RenamedWarning
from sb3_flock.settings import SettingsError
from tests.helpers import PlainCNN


def model(algorithm, extractor, fused, wrap=lambda env: env, **kwargs):
    built = algorithm(
        FlockPolicy,
        wrap(make_vec_env(n_flocks=2, seed=0)),
        buffer_size=1200,
        learning_starts=600,
        action_noise=None,
        policy_kwargs={
            "features_extractor_class": extractor,
            "features_extractor_kwargs": {"layer_norm": True},
            # Adam divides a gradient by its own size: at torch's eps a rounding error where it is nearly 0 is a whole step.
            "optimizer_kwargs": {"fused": fused, "eps": 1e-3},
            "final_init": 0.1,
            **kwargs,
        },
        learning_rate=1e-3,
        tau=0.05,
        seed=0,
        device="cpu",
    )
    built.set_logger(configure(None, []))
    return built


@pytest.mark.parametrize(("n_critics", "wrap"), [(1, VecMonitor), (2, VecMonitor), (2, VecNormalize)])
def test_fifty_updates_equal_those_of_sb3s_ddpg_with_torchs_convolutions_up_to_rounding(n_critics, wrap):
    ours, sb3 = (
        model(FlockDDPG, FlockCNN, True, wrap, n_critics=n_critics),
        model(DDPG, PlainCNN, False, wrap, n_critics=n_critics),
    )
    start = [parameter.clone() for parameter in ours.policy.parameters()]
    for one in (ours, sb3):
        one.learn(600)
        np.random.seed(1)  # noqa: NPY002 - what SB3 draws from
        one.train(50, 64)
    assert ours._n_updates == sb3._n_updates == 50
    for parameter, first in zip(ours.policy.parameters(), start, strict=True):
        assert not th.equal(parameter, first)
    for (name, value), (same, expected) in zip(ours.policy.named_parameters(), sb3.policy.named_parameters(), strict=True):
        assert name == same
        th.testing.assert_close(value, expected, rtol=1e-3, atol=1e-5, msg=lambda text, name=name: f"{name}: {text}")
    for name in ("train/actor_loss", "train/critic_loss"):
        assert ours.logger.name_to_value[name] == pytest.approx(sb3.logger.name_to_value[name], rel=1e-3)


@pytest.mark.parametrize("bc_coef", [0.0, 30.0])
def test_behavior_cloning_moves_the_actor_to_the_experts_actions(bc_coef):
    ddpg, rng = model(FlockDDPG, FlockCNN, True), np.random.default_rng(0)
    ddpg.bc_coef, expert_action = bc_coef, np.array([0.5, -0.25])
    envs, shape = ddpg.n_envs, ddpg.observation_space.shape
    ddpg.replay_buffer = CompactReplayBuffer(
        1200, ddpg.observation_space, ddpg.action_space, "cpu", envs, store_expert_actions=True
    )
    for _ in range(100):
        observations, actions = rng.random((2, envs, *shape)), rng.uniform(-1, 1, (envs, 2))
        infos = [{"expert_action": ddpg.policy.unscale_action(expert_action)}] * envs
        ddpg.replay_buffer.add(*observations, actions, rng.normal(size=envs), np.zeros(envs, bool), infos)
    ddpg._update_current_progress_remaining(0, 1)
    ddpg.train(200, 64)
    observations = ddpg.replay_buffer.sample(200).observations
    actions = ddpg.actor(observations).detach().numpy()
    gap = np.square(actions - expert_action).mean()
    if bc_coef:
        assert gap < 0.01
        assert ddpg.logger.name_to_value["train/bc_loss"] < 0.1
    else:
        assert gap > 0.1
        assert "train/bc_loss" not in ddpg.logger.name_to_value


def test_bc_coef_without_expert_actions_is_refused_in_one_line():
    with pytest.raises(
        SettingsError, match="bc_coef = 2.0: a CompactReplayBuffer with store_expert_actions=True is needed, or bc_coef 0"
    ):
        FlockDDPG(FlockPolicy, make_vec_env(n_flocks=1), bc_coef=2.0, device="cpu")


def test_infos_without_expert_actions_are_refused_before_an_update_where_bc_coef_needs_them():
    kwargs = {"replay_buffer_class": CompactReplayBuffer, "replay_buffer_kwargs": {"store_expert_actions": True}}
    options = {"buffer_size": 400, "learning_starts": 3, "device": "cpu", **kwargs}
    ddpg = FlockDDPG(FlockPolicy, make_vec_env(n_flocks=1), bc_coef=2.0, **options)
    with pytest.raises(
        SettingsError, match="^bc_coef = 2.0: the infos have no expert_action; an ExpertEnv with queries=True"
    ):
        ddpg.learn(60)
    assert ddpg._n_updates == 0
    ddpg.bc_coef = 0.0
    ddpg.learn(60)
    sb3s = DDPG(FlockPolicy, make_vec_env(n_flocks=1), **options)  # which clones no behavior
    sb3s.learn(60)
    assert min(ddpg._n_updates, sb3s._n_updates) > 0
    assert all(th.isfinite(parameter).all() for one in (ddpg, sb3s) for parameter in one.policy.parameters())


def test_guidance_of_the_previous_release_warns_and_is_bc_coef():
    options = {"replay_buffer_class": CompactReplayBuffer, "replay_buffer_kwargs": {"store_expert_actions": True}}
    env = make_vec_env(n_flocks=1)
    with pytest.warns(RenamedWarning, match="FlockDDPG: guidance is now bc_coef"):
        ddpg = FlockDDPG(FlockPolicy, env, guidance=2.0, buffer_size=12, device="cpu", **options)
    assert ddpg.bc_coef == 2.0
    with pytest.raises(TypeError, match="FlockDDPG got bc_coef and its old name guidance"):
        FlockDDPG(FlockPolicy, env, guidance=2.0, bc_coef=1.0, buffer_size=12, device="cpu", **options)


def test_another_extractor_is_refused_in_one_line():
    with pytest.raises(SettingsError, match="features_extractor_class = FlattenExtractor: FlockDDPG needs FlockCNN"):
        FlockDDPG(
            FlockPolicy, make_vec_env(n_flocks=1), policy_kwargs={"features_extractor_class": FlattenExtractor}, device="cpu"
        )


def test_the_learning_rate_follows_its_schedule():
    ddpg = model(FlockDDPG, FlockCNN, True)
    ddpg.learn(600)
    ddpg.lr_schedule = lambda remaining: 2e-3 * remaining
    ddpg._current_progress_remaining = 0.25
    ddpg.train(1, 64)
    assert [group["lr"] for network in (ddpg.actor, ddpg.critic) for group in network.optimizer.param_groups] == [5e-4] * 2
