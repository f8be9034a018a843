import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_flock import CompactReplayBuffer, FlockCNN, FlockDDPG, FlockPolicy, make_vec_env
from sb3_flock.settings import SettingsError
from tests.helpers import PlainCNN


def model(algorithm, extractor, fused, **kwargs):
    built = algorithm(
        FlockPolicy,
        make_vec_env(n_flocks=2, seed=0),
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


@pytest.mark.parametrize("n_critics", [1, 2])
def test_fifty_updates_end_where_stock_ddpg_with_plain_convolutions_ends(n_critics):
    lean, stock = (
        model(FlockDDPG, FlockCNN, True, n_critics=n_critics),
        model(DDPG, PlainCNN, False, n_critics=n_critics),
    )
    start = [parameter.clone() for parameter in lean.policy.parameters()]
    for one in (lean, stock):
        one.learn(600)
        np.random.seed(1)  # noqa: NPY002 - what SB3 draws from
        one.train(50, 64)
    assert lean._n_updates == stock._n_updates == 50
    for parameter, first in zip(lean.policy.parameters(), start, strict=True):
        assert not th.equal(parameter, first)
    for (name, ours), (same, theirs) in zip(lean.policy.named_parameters(), stock.policy.named_parameters(), strict=True):
        assert name == same
        th.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-5, msg=lambda text, name=name: f"{name}: {text}")
    for name in ("train/actor_loss", "train/critic_loss"):
        assert lean.logger.name_to_value[name] == pytest.approx(stock.logger.name_to_value[name], rel=1e-3)


@pytest.mark.parametrize("bc_coef", [0.0, 30.0])
def test_guidance_draws_the_actor_to_what_is_advised(bc_coef):
    lean, rng = model(FlockDDPG, FlockCNN, True), np.random.default_rng(0)
    lean.bc_coef, advised = bc_coef, np.array([0.5, -0.25])
    envs, shape = lean.n_envs, lean.observation_space.shape
    lean.replay_buffer = CompactReplayBuffer(1200, lean.observation_space, lean.action_space, "cpu", envs, advice=True)
    for _ in range(100):
        tensors, actions = rng.random((2, envs, *shape)), rng.uniform(-1, 1, (envs, 2))
        infos = [{"advice": lean.policy.unscale_action(advised)}] * envs
        lean.replay_buffer.add(*tensors, actions, rng.normal(size=envs), np.zeros(envs, bool), infos)
    lean._update_current_progress_remaining(0, 1)
    lean.train(200, 64)
    observations = lean.replay_buffer.sample(200).observations
    actions = lean.actor(observations).detach().numpy()
    gap = np.square(actions - advised).mean()
    if bc_coef:
        assert gap < 0.01
        assert lean.logger.name_to_value["train/bc_loss"] < 0.1
    else:
        assert gap > 0.1
        assert "train/bc_loss" not in lean.logger.name_to_value


def test_guidance_without_advice_is_refused_in_one_line():
    with pytest.raises(SettingsError, match="bc_coef = 2.0: needs a CompactReplayBuffer with advice=True, or be 0"):
        FlockDDPG(FlockPolicy, make_vec_env(n_flocks=1), bc_coef=2.0, device="cpu")


def test_another_extractor_is_refused_in_one_line():
    with pytest.raises(SettingsError, match="features_extractor_class = FlattenExtractor: FlockDDPG needs FlockCNN"):
        FlockDDPG(
            FlockPolicy, make_vec_env(n_flocks=1), policy_kwargs={"features_extractor_class": FlattenExtractor}, device="cpu"
        )
