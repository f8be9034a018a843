"""The neighbor-inclusive reward (section IV-B) in a vector env."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, unwrap_vec_wrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_flock.settings import SettingsError
from sb3_flock.sim import mix_rewards


class VecNeighborInclusiveReward(VecEnvWrapper):
    """Turns each reward into r_{i} = lambda r_i + (1 - lambda) mean of the neighbors' r_j, with any algorithm and no callback.

    The rewards are those of :class:`~sb3_flock.rl.callbacks.NeighborInclusiveReward`, which states the contract for the infos;
    a training has one or the other. The raw reward stays in each info, under ``reward``.

    The wrapper belongs below ``VecNormalize``, on and off policy. ``VecMonitor`` around it logs the mixed return, below it the
    raw one.

    :param venv: a vector env with shared parameters, as :func:`sb3_flock.flatten` makes it
    :param lambda_: share of a vehicle's own reward, in [0, 1]
    :param n_agents: agents in one copy of the env; needed only on vector envs that :func:`sb3_flock.flatten` did not make
    :raises SettingsError: for a share outside [0, 1], if the agents cannot be counted, or if ``venv`` is wrapped in
        ``VecNormalize`` or in this class already
    """

    def __init__(self, venv: VecEnv, lambda_: float = 0.4, n_agents: int | None = None) -> None:
        check_share(lambda_)
        for kind in (VecNormalize, VecNeighborInclusiveReward):
            if unwrap_vec_wrapper(venv, kind) is not None:
                raise SettingsError(
                    f"VecNeighborInclusiveReward: it is needed below VecNormalize, once, not around {kind.__name__}"
                )
        super().__init__(venv)
        self.lambda_ = lambda_
        self._agents_per_copy = count_agents(venv, n_agents)

    def reset(self) -> VecEnvObs:
        """Reset every copy."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Collect the step, with mixed rewards."""
        observations, rewards, dones, infos = self.venv.step_wait()
        for info, reward in zip(infos, rewards.tolist(), strict=True):
            info["reward"] = reward
        mixed = mix_by_infos(rewards, infos, self._agents_per_copy, self.lambda_).astype(rewards.dtype)
        return observations, mixed, dones, infos


def mix_by_infos(
    rewards: NDArray[np.floating], infos: Sequence[dict[str, Any]], n_agents: int, lambda_: float
) -> NDArray[np.float64]:
    """The neighbor-inclusive reward of every slot of a vector env, ``(slots,)``, by :func:`~sb3_flock.sim.reward.mix_rewards`.

    :param rewards: ``(slots,)``, raw
    :param infos: ``neighbors`` of each are indices of agents of the slot's copy; neighbors that did not act do not count
    :param n_agents: agents in one copy
    """
    neighbors = [info.get("neighbors", ()) for info in infos]
    observers = np.repeat(np.arange(len(infos)), [len(found) for found in neighbors])
    first = observers - observers % n_agents  # slot of the copy's first agent
    found = first + np.concatenate(neighbors).astype(np.int64)
    acted = np.array([info.get("alive", True) for info in infos])[found]
    return mix_rewards(rewards, observers[acted], found[acted], lambda_)


def check_share(lambda_: float) -> None:
    """Check the share of the own reward.

    :raises SettingsError: outside [0, 1]
    """
    if not 0 <= lambda_ <= 1:
        raise SettingsError(f"lambda_ = {lambda_}: input should be between 0 and 1")


def count_agents(env: VecEnv, given: int | None) -> int:
    """The number of agents in one copy of an env, counted or given.

    :raises SettingsError: if they cannot be counted, or the given number is another
    """
    counted = getattr(env, "n_agents", None)
    n_agents = given or counted
    if n_agents is None or env.num_envs % n_agents or n_agents != (counted or n_agents):
        raise SettingsError(
            f"n_agents = {n_agents}: the number of agents in one copy of the env is needed, "
            + (f"which is {counted}" if counted else f"a divisor of {env.num_envs}")
        )
    return int(n_agents)
