"""The learning algorithms by name, and the SB3 model that settings describe.

The module is importable without torch: classes of SB3 are named here and imported when a model is built.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field, model_validator

from sb3_flock.rl.settings import AlgorithmConfig, NetworkConfig
from sb3_flock.settings import Settings, suggest

if TYPE_CHECKING:
    from stable_baselines3.common.noise import ActionNoise
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
    from stable_baselines3.common.policies import BasePolicy
    from stable_baselines3.common.vec_env import VecEnv


def flock_policy_kwargs(network: NetworkConfig) -> dict[str, Any]:
    """The ``policy_kwargs`` of :class:`FlockPolicy` and :class:`FlockSACPolicy` that build a config's networks."""
    return {
        "net_arch": list(network.net_arch),
        "n_critics": network.n_critics,
        "action_layer": network.action_layer,
        "final_init": network.final_init,
        "features_extractor_kwargs": extractor_kwargs(network),
        "optimizer_kwargs": {"fused": True},  # one pass over all parameters: the update is a tenth faster on a CPU
    }


def extractor_kwargs(network: NetworkConfig) -> dict[str, Any]:
    """The arguments of :class:`FlockCNN` for a config's networks."""
    return {
        "features_dim": network.features_dim,
        "channels": list(network.channels),
        "kernel_size": network.kernel_size,
        "stride": network.stride,
        "layer_norm": network.layer_norm,
    }


@dataclass(frozen=True)
class AlgorithmSpec:
    """An off-policy algorithm of SB3 or sb3-contrib, and which options of a config it has."""

    algorithm: type[OffPolicyAlgorithm] | str
    """The class, or its name as ``module:class``."""
    policy: type[BasePolicy] | str
    """The same for the policy."""
    policy_kwargs: Callable[[NetworkConfig], dict[str, Any]] = flock_policy_kwargs
    action_bounds: tuple[str, ...] = ()
    """Accepted values of ``network.action_bound``, which go to the policy as ``action_bound``; the first stands for null. Without
    any, the policy gets none, and tanh and null are accepted."""
    has_compact_buffer: bool = True
    """Whether it samples from a :class:`~sb3_flock.rl.buffers.CompactReplayBuffer`; otherwise from SB3's own buffer."""
    has_action_noise: bool = True
    """Whether ``algorithm.action_noise_std`` applies; a stochastic actor explores by itself."""
    has_bc: bool = False
    """Whether ``algorithm.bc_coef`` applies: the algorithm then takes ``bc_coef``."""

    def load(self) -> tuple[type[OffPolicyAlgorithm], type[BasePolicy]]:
        """The classes of the algorithm and of its policy."""
        return _load(self.algorithm), _load(self.policy)


def _load(target: Any) -> Any:
    if not isinstance(target, str):
        return target
    module, _, name = target.partition(":")
    return getattr(importlib.import_module(module), name)


_FLOCK_POLICY, _BOUNDS = "sb3_flock.rl.policies:FlockPolicy", ("inverting", "tanh")

ALGORITHMS: dict[str, AlgorithmSpec] = {
    "ddpg": AlgorithmSpec("sb3_flock.rl.ddpg:FlockDDPG", _FLOCK_POLICY, action_bounds=_BOUNDS, has_bc=True),
    "ddpg-sb3": AlgorithmSpec("stable_baselines3:DDPG", _FLOCK_POLICY, action_bounds=_BOUNDS, has_compact_buffer=False),
    "td3": AlgorithmSpec("sb3_flock.rl.ddpg:FlockTD3", _FLOCK_POLICY, action_bounds=_BOUNDS),
    "sac": AlgorithmSpec("stable_baselines3:SAC", "sb3_flock.rl.policies:FlockSACPolicy", has_action_noise=False),
}
"""The algorithms by the value of ``algo``."""


def register_algorithm(name: str, spec: AlgorithmSpec) -> None:
    """Make an algorithm available as a value of ``algo``.

    :raises ValueError: if the name is taken
    """
    if ALGORITHMS.setdefault(name, spec) is not spec:
        raise ValueError(f"algorithm {name!r} is registered already")


class ModelSettings(Settings):
    """What builds an SB3 model: the algorithm, its parameters, the networks, the seed and the device."""

    algo: str = Field(
        "ddpg",
        description="learning algorithm: ddpg, td3, sac, or ddpg-sb3 (ddpg with SB3's own update code, slower) (paper: ddpg)",
    )
    algorithm: AlgorithmConfig = Field(default_factory=AlgorithmConfig, description="the learning algorithm's parameters")
    network: NetworkConfig = Field(default_factory=NetworkConfig, description="the networks")
    seed: int = Field(0, ge=0, le=2**32 - 1, description="seed of the networks, the noise and the flocks")
    device: str = Field("cpu", description="torch device: cpu, cuda, cuda:0, ... or auto")

    @model_validator(mode="after")
    def _options_apply(self) -> ModelSettings:
        if self.algo not in ALGORITHMS:
            raise ValueError(f"algo = {self.algo!r}: one of {_names(ALGORITHMS)} is needed{suggest(self.algo, ALGORITHMS)}")
        spec, algorithm, bound = ALGORITHMS[self.algo], self.algorithm, self.network.action_bound
        bounds = spec.action_bounds or ("tanh",)  # a stochastic actor has a tanh of its own
        if bound is not None and bound not in bounds:
            raise ValueError(
                f"network.action_bound = {bound!r}: input should be one of {_names(bounds)} or null with algo = {self.algo}"
            )
        if algorithm.mirror_augmentation and not uses_compact_buffer(self):
            raise ValueError(
                "algorithm.mirror_augmentation = True: input should be false or null with "
                + (f"algo = {self.algo}" if not spec.has_compact_buffer else f"n_steps = {algorithm.n_steps}")
            )
        if algorithm.bc_coef and not (spec.has_bc and algorithm.n_steps == 1):
            with_bc = _names(name for name, other in ALGORITHMS.items() if other.has_bc)
            raise ValueError(
                f"algorithm.bc_coef = {algorithm.bc_coef}: input should be 0 without algo {with_bc} and n_steps 1"
            )
        return self


def _names(names: Iterable[str]) -> str:
    return ", ".join(names)


def policy_kwargs(settings: ModelSettings) -> dict[str, Any]:
    """The ``policy_kwargs`` that build the networks."""
    spec = ALGORITHMS[settings.algo]
    bound = {"action_bound": settings.network.action_bound or spec.action_bounds[0]} if spec.action_bounds else {}
    return {**bound, **spec.policy_kwargs(settings.network)}


def build_model(settings: ModelSettings, env: VecEnv) -> OffPolicyAlgorithm:
    """The untrained SB3 model that the settings describe.

    :param settings: for instance a whole :class:`~sb3_flock.config.training.TrainingConfig`
    :param env: the flattened training env
    """
    from stable_baselines3.common.utils import LinearSchedule

    from sb3_flock.rl.buffers import CompactReplayBuffer

    spec, algorithm = ALGORITHMS[settings.algo], settings.algorithm
    model_class, policy_class = spec.load()
    gradient_steps = max(1, round(algorithm.utd_ratio * algorithm.train_freq * env.num_envs))
    is_compact = uses_compact_buffer(settings)
    buffer_kwargs = {
        "mirror_augmentation": algorithm.mirror_augmentation is not False,
        "store_expert_actions": algorithm.bc_coef > 0,
    }
    options: dict[str, Any] = {"bc_coef": algorithm.bc_coef} if spec.has_bc else {}
    return model_class(
        policy_class,
        env,
        learning_rate=LinearSchedule(algorithm.learning_rate, algorithm.final_learning_rate, 1.0),
        buffer_size=algorithm.buffer_size,
        learning_starts=algorithm.learning_starts,
        batch_size=algorithm.batch_size,
        tau=algorithm.tau,
        gamma=algorithm.gamma,
        train_freq=algorithm.train_freq,
        gradient_steps=gradient_steps,
        n_steps=algorithm.n_steps,
        replay_buffer_class=CompactReplayBuffer if is_compact else None,
        replay_buffer_kwargs=buffer_kwargs if is_compact else None,
        action_noise=_action_noise(settings),
        policy_kwargs=policy_kwargs(settings),
        seed=settings.seed,
        device=settings.device,
        **options,
    )


def uses_compact_buffer(settings: ModelSettings) -> bool:
    """Whether the model has a :class:`~sb3_flock.rl.buffers.CompactReplayBuffer`, which stores no returns over several steps."""
    return ALGORITHMS[settings.algo].has_compact_buffer and settings.algorithm.n_steps == 1


def _action_noise(settings: ModelSettings) -> ActionNoise | None:
    """Gaussian noise on the normalized action."""
    start, end = settings.algorithm.action_noise_stds
    if not ALGORITHMS[settings.algo].has_action_noise or max(start, end) == 0:
        return None
    from stable_baselines3.common.noise import NormalActionNoise

    return NormalActionNoise(np.zeros(2), np.full(2, start))


def fewest_parameters(settings: ModelSettings, observation_shape: tuple[int, ...]) -> int:
    """A lower bound of the number of parameters of an actor and its critics, without building them.

    :param observation_shape: ``(channels, l, l)``
    """
    network = settings.network
    fan_in, side, _ = observation_shape
    extractor = 0
    for channels in network.channels:
        extractor += (fan_in * network.kernel_size**2 + 1) * channels
        fan_in, side = channels, max(0, (side - network.kernel_size) // network.stride + 1)
    extractor += (fan_in * side**2 + 1) * network.features_dim
    widths = [network.features_dim, *network.net_arch, 1]
    head = sum((fan_in + 1) * fan_out for fan_in, fan_out in pairwise(widths))
    return 2 * extractor + (1 + network.n_critics) * head
