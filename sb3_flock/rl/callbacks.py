"""SB3 callbacks: the neighbor-inclusive reward, the flock's metrics in the log, noise decay, and a stop on divergence."""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecNormalize, unwrap_vec_wrapper

from sb3_flock._compat import progress_remaining, set_noise_std
from sb3_flock._renamed import renamed_member
from sb3_flock.envs.vec_reward import VecNeighborInclusiveReward, check_share, count_agents, mix_by_infos
from sb3_flock.rl.alive_buffers import AliveReplayBuffer, AliveRolloutBuffer
from sb3_flock.rl.buffers import CompactReplayBuffer
from sb3_flock.settings import RunError, SettingsError


class NeighborInclusiveReward(BaseCallback):
    """Rewrites each transition's reward into r_{i} = lambda r_i + (1 - lambda) mean of the neighbors' r_j (section IV-B).

    It works on any PettingZoo env flattened by SuperSuit into a parameter-shared vector env whose infos follow this
    contract: ``info["neighbors"]`` holds the indices into ``possible_agents`` of the agent's own copy of the env. An info
    without that key means no neighbors, and the agent keeps its own reward. A neighbor that did not act (``info["alive"]`` is
    false) has no reward, and does not count.

    SB3 calls it after the env's step and before the transition is stored. The callback rewrites the rewards in place, so that
    the replay buffer stores the mixed ones. The raw reward stays in ``rollout/ep_rew_mean``, and the callback copies it to each
    info's ``reward`` key; the mixed one is logged as ``rollout/ep_mixed_rew_mean``. Both are means over the last 100 episodes.

    With ``VecNormalize``, on policy (PPO, A2C) the rewards are mixed before they are normalized: the buffer stores the mixed
    reward divided by the standard deviation of the raw rewards' discounted returns, and clipped, which is what ``VecNormalize``
    computes. Off policy (DDPG, TD3, SAC) it is refused, also with ``norm_reward=False``: SB3 takes the rewards that the replay
    buffer stores from ``VecNormalize``, below which no callback reaches. There
    :class:`~sb3_flock.envs.vec_reward.VecNeighborInclusiveReward` mixes them, below ``VecNormalize``.

    :param lambda_: share of a vehicle's own reward, in [0, 1]
    :param n_agents: agents in one copy of the env; needed only on vector envs that :func:`sb3_flock.flatten` did not make
    :param verbose: SB3's verbosity
    :raises SettingsError: for a share outside [0, 1]; at the start of the training, if the agents cannot be counted or an
        off-policy algorithm's env is wrapped in ``VecNormalize``, or if the rewards would be mixed twice
    """

    def __init__(self, lambda_: float = 0.4, n_agents: int | None = None, verbose: int = 0) -> None:
        super().__init__(verbose)
        check_share(lambda_)
        self.lambda_ = lambda_
        self.n_agents = n_agents
        self._agents_per_copy = n_agents or 1
        self._vec_normalize: VecNormalize | None = None
        self._returns = np.zeros(0)
        self._finished: deque[float] = deque(maxlen=100)

    def _init_callback(self) -> None:
        self._vec_normalize = self.model.get_vec_normalize_env()
        if self._vec_normalize is not None and isinstance(self.model, OffPolicyAlgorithm):
            raise SettingsError(
                f"VecNormalize is not accepted with {type(self.model).__name__}: the replay buffer would store its rewards and "
                "not the neighbor-inclusive ones; a VecNeighborInclusiveReward below VecNormalize mixes them before"
            )
        if unwrap_vec_wrapper(self.training_env, VecNeighborInclusiveReward) is not None:
            raise SettingsError("NeighborInclusiveReward: the env's VecNeighborInclusiveReward mixes the rewards already")
        self._agents_per_copy = count_agents(self.training_env, self.n_agents)
        self._returns = np.zeros(self.training_env.num_envs)

    def _on_training_start(self) -> None:
        if _count(self.locals.get("callback"), NeighborInclusiveReward) > 1:
            raise SettingsError(
                "NeighborInclusiveReward is among the callbacks more than once: it would mix the rewards again"
            )

    def _on_step(self) -> bool:
        rewards, infos = self.locals["rewards"], self.locals["infos"]
        dones = np.asarray(self.locals["dones"], dtype=bool)  # SuperSuit's own wrapper gives integers
        raw = rewards if self._vec_normalize is None else self._vec_normalize.get_original_reward()
        for info, reward in zip(infos, raw.tolist(), strict=True):
            info["reward"] = reward
        mixed = self.mix(raw, infos).astype(np.float32)
        rewards[:] = mixed if self._vec_normalize is None else self._vec_normalize.normalize_reward(mixed)
        self._returns += mixed
        if dones.any():
            self._finished.extend(self._returns[dones].tolist())
            self._returns[dones] = 0.0
            self.logger.record("rollout/ep_mixed_rew_mean", float(np.mean(self._finished)))
        return True

    def state_dict(self) -> dict[str, Any]:
        """The returns of the current episodes and of the last finished ones."""
        return {"returns": self._returns, "finished": list(self._finished)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self._returns[:] = state["returns"]
        self._finished.extend(state["finished"])

    def mix(self, rewards: np.ndarray, infos: list[dict[str, Any]]) -> np.ndarray:
        """The mixed reward of every slot of the vector env, ``(slots,)``."""
        return mix_by_infos(rewards, infos, self._agents_per_copy, self.lambda_)


def _count(callback: Any, kind: type[BaseCallback]) -> int:
    """How often a kind of callback is in a callback, at any depth of SB3's lists and events."""
    below = [*getattr(callback, "callbacks", ()), getattr(callback, "callback", None)]
    return isinstance(callback, kind) + sum(_count(one, kind) for one in below if one is not None)


class StoreExecutedActions(BaseCallback):
    """Stores the actions that the env executed, where an expert drove, in place of the policy's, which were not executed.

    The infos of an :class:`~sb3_flock.envs.expert_env.ExpertEnv` hold them as ``executed_action``. The logged returns, raw and
    mixed, are of all episodes, the expert's included.
    """

    def _on_step(self) -> bool:
        for slot, info in enumerate(self.locals["infos"]):
            if info.get("expert_drives"):
                self.locals["buffer_actions"][slot] = self.model.policy.scale_action(info["executed_action"])
        return True


class DropDeadTransitions(BaseCallback):
    """Lets a model learn from living agents alone, in an env whose agents die or join (:func:`sb3_flock.flatten`).

    A step is left out where the slot's ``info["alive"]`` is false. A model with SB3's own buffer gets an
    :class:`~sb3_flock.rl.alive_buffers.AliveReplayBuffer` or an :class:`~sb3_flock.rl.alive_buffers.AliveRolloutBuffer` in its
    place; a :class:`~sb3_flock.rl.buffers.CompactReplayBuffer` needs no callback. ``num_timesteps`` counts all slots.

    :raises SettingsError: at the start of the training, for a model with another buffer, or whose buffer has been filled without
        this callback
    """

    def _init_callback(self) -> None:
        model: Any = self.model
        buffer = model.replay_buffer if isinstance(model, OffPolicyAlgorithm) else model.rollout_buffer
        spaces = model.observation_space, model.action_space, model.device
        if type(buffer) is ReplayBuffer and not buffer.optimize_memory_usage and buffer.size() == 0:
            model.replay_buffer = AliveReplayBuffer(
                buffer.buffer_size * buffer.n_envs, *spaces, handle_timeout_termination=buffer.handle_timeout_termination
            )
        elif type(buffer) is RolloutBuffer:
            model.rollout_buffer = AliveRolloutBuffer(
                buffer.buffer_size, *spaces, buffer.gae_lambda, buffer.gamma, buffer.n_envs
            )
        elif not isinstance(buffer, AliveReplayBuffer | AliveRolloutBuffer | CompactReplayBuffer):
            raise SettingsError(
                f"DropDeadTransitions: the model has a {type(buffer).__name__}; SB3's own ReplayBuffer, empty and without "
                "optimize_memory_usage, its RolloutBuffer, or a CompactReplayBuffer is needed"
            )

    def _on_step(self) -> bool:
        buffer = self.locals.get("rollout_buffer")
        if isinstance(buffer, AliveRolloutBuffer):
            buffer.alive[buffer.pos] = _alive(self.locals["infos"])
        return True


def _alive(infos: list[dict[str, Any]]) -> np.ndarray:
    """Whether an agent acted in each slot, ``(slots,)``."""
    return np.array([info.get("alive", True) for info in infos])


class FlockMetrics(BaseCallback):
    """Logs the infos' ``metrics`` and ``reward_terms`` as ``flock/...``: means over the steps since an episode last ended.

    Steps that an expert drove, or in which no agent acted, are left out.
    """

    def __init__(self, verbose: int = 0) -> None:
        super().__init__(verbose)
        self._sums: dict[str, float] = defaultdict(float)
        self._count = 0

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if info.get("expert_drives") or not info.get("alive", True):
                continue
            for values in (info.get("metrics", {}), info.get("reward_terms", {})):
                for name, value in values.items():
                    if math.isfinite(value):
                        self._sums[name] += value
            self._count += 1
        if self.locals["dones"].any():
            for name, total in self._sums.items():
                self.logger.record(f"flock/{name}", total / self._count)
            self._sums.clear()
            self._count = 0
        return True

    def state_dict(self) -> dict[str, Any]:
        """The sums so far."""
        return {"sums": dict(self._sums), "count": self._count}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self._sums.update(state["sums"])
        self._count = state["count"]


class LinearNoiseDecay(BaseCallback):
    """Changes the standard deviation of Gaussian action noise linearly over the training.

    :param start: standard deviation at the start, in units of the normalized action
    :param end: standard deviation at the end
    """

    def __init__(self, start: float, end: float) -> None:
        super().__init__()
        self.start, self.end = start, end

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        noise = self.model.action_noise
        sigma = self.end + (self.start - self.end) * progress_remaining(self.model)
        for part in noise.noises if isinstance(noise, VectorizedActionNoise) else [noise]:
            if isinstance(part, NormalActionNoise):
                set_noise_std(part, sigma)
        self.logger.record("train/action_noise_std", sigma)


class DivergedError(RunError):
    """A loss is no longer finite. A training resumed from the last checkpoint would diverge again."""


class StopOnNonFiniteLoss(BaseCallback):
    """Stops a training whose losses are no longer finite, before anything of it is saved.

    :raises DivergedError: one line that names the loss
    """

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        for name, value in self.logger.name_to_value.items():
            if name.startswith("train/") and name.endswith("loss") and not np.isfinite(value):
                raise DivergedError(
                    f"{name} = {value} after {self.num_timesteps} transitions: the training diverged; a smaller "
                    "learning_rate or reward scale may help"
                )


def __getattr__(name: str) -> Any:
    return renamed_member(__name__, name)
