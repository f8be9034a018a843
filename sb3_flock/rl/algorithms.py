"""From a config to an SB3 model: which algorithm, which policy, which networks."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_flock.rl.config import TrainingConfig
from sb3_flock.rl.ddpg import FlockDDPG
from sb3_flock.rl.policy import FlockPolicy, FlockSACPolicy
from sb3_flock.rl.replay import CompactReplayBuffer

ALGORITHMS: dict[str, tuple[type[OffPolicyAlgorithm], type[BasePolicy]]] = {
    "ddpg": (FlockDDPG, FlockPolicy),
    "ddpg-stock": (DDPG, FlockPolicy),
    "td3": (TD3, FlockPolicy),
    "sac": (SAC, FlockSACPolicy),
}
"""The algorithm and our policy class by the name of ``TrainingConfig.algo``."""


def policy_kwargs(config: TrainingConfig) -> dict[str, Any]:
    """The ``policy_kwargs`` that build a config's networks."""
    network = config.network
    bound = {} if config.algo == "sac" else {"action_bound": network.action_bound}
    return {
        **bound,
        "net_arch": list(network.net_arch),
        "n_critics": network.n_critics,
        "action_layer": network.action_layer,
        "final_init": network.final_init,
        "features_extractor_kwargs": {
            "features_dim": network.features_dim,
            "channels": list(network.channels),
            "kernel_size": network.kernel_size,
            "stride": network.stride,
            "layer_norm": network.layer_norm,
        },
        "optimizer_kwargs": {"fused": True},  # one pass over all parameters: the update is a tenth faster on a CPU
    }


def build_model(config: TrainingConfig, env: VecEnv) -> OffPolicyAlgorithm:
    """The SB3 model of a config, untrained."""
    learner = config.learner
    gradient_steps = max(1, round(learner.update_ratio * learner.train_freq * env.num_envs))
    algorithm, policy = ALGORITHMS[config.algo]
    buffer = _replay_buffer_class(config)
    more: dict[str, Any] = {"guidance": learner.guidance} if algorithm is FlockDDPG else {}
    return algorithm(
        policy,
        env,
        learning_rate=LinearSchedule(learner.learning_rate, learner.final_learning_rate, 1.0),
        buffer_size=learner.buffer_size,
        learning_starts=learner.learning_starts,
        batch_size=learner.batch_size,
        tau=learner.tau,
        gamma=learner.gamma,
        train_freq=learner.train_freq,
        gradient_steps=gradient_steps,
        n_steps=learner.n_steps,
        replay_buffer_class=buffer,
        replay_buffer_kwargs={"mirror": learner.mirror, "advice": learner.guidance > 0} if buffer else None,
        action_noise=_noise(config),
        policy_kwargs=policy_kwargs(config),
        seed=config.seed,
        device=config.device,
        **more,
    )


def _replay_buffer_class(config: TrainingConfig) -> type[ReplayBuffer] | None:
    """Ours, or SB3's own choice for the stock algorithm and for returns over several steps, which ours does not know."""
    return None if config.algo == "ddpg-stock" or config.learner.n_steps > 1 else CompactReplayBuffer


def _noise(config: TrainingConfig) -> ActionNoise | None:
    """Gaussian noise on the normalized action; SAC explores by itself."""
    if config.algo == "sac" or max(config.learner.noise, config.learner.final_noise) == 0:
        return None
    return NormalActionNoise(np.zeros(2), np.full(2, config.learner.noise))
