"""The task for tools that make their envs by a Gymnasium id, such as rl_zoo3: ``sb3_flock/Flocking-v0``.

One Gymnasium env is one flock under a central controller. :func:`share_parameters` turns a vector env of such flocks into the
one that this package trains on, with a slot for each vehicle and one policy for all.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from sb3_flock.envs.flocking_v0 import parallel_env
from sb3_flock.envs.vec_env import ParameterSharingVecEnv, make_vec_env
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario


class FlockEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One flock as a single agent: the observations and actions of all vehicles together, and the mean of their rewards.

    ``gymnasium.make("sb3_flock/Flocking-v0", n_vehicles=5)`` makes it. The infos hold those of
    :class:`~sb3_flock.envs.flocking_v0.parallel_env` by agent, and the vehicles' ``rewards``, ``(vehicles,)``.

    :param scenario: the task; fields given by name change it
    :param render_mode: ``None``, ``"human"`` or ``"rgb_array"``
    :param fields: fields of :class:`~sb3_flock.Scenario` by name
    :raises SettingsError: for an unknown field, a value that is not accepted or an unknown render mode

    :ivar observation_space: ``(vehicles, channels, l, l)``
    :ivar action_space: ``(vehicles, 2)`` [m/s, rad/s]
    """

    metadata = parallel_env.metadata

    def __init__(self, scenario: Scenario | None = None, render_mode: str | None = None, **fields: Any) -> None:
        self.flock = parallel_env(scenario, render_mode, **fields)
        self.scenario, self.render_mode = self.flock.scenario, render_mode
        agents = self.flock.possible_agents
        self.observation_space = batch_space(self.flock.observation_space(agents[0]), len(agents))
        self.action_space = batch_space(self.flock.action_space(agents[0]), len(agents))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; ``seed`` seeds the flock's random stream."""
        super().reset(seed=seed)
        observations, infos = self.flock.reset(seed, options)
        return np.stack(list(observations.values())), dict(infos)

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Move everything by a sampling period; the time limit truncates the episode."""
        actions = dict(zip(self.flock.agents, action, strict=True))
        observations, rewards, _, truncations, infos = self.flock.step(actions)
        each = np.array(list(rewards.values()))
        info = {**infos, "rewards": each}
        return np.stack(list(observations.values())), float(each.mean()), False, any(truncations.values()), info

    def render(self) -> Any:
        """As :meth:`~sb3_flock.envs.flocking_v0.parallel_env.render`."""
        return self.flock.render()

    def close(self) -> None:
        """Close the window, if there is one."""
        self.flock.close()


def share_parameters(venv: VecEnv, seed: int | None = None) -> ParameterSharingVecEnv:
    """rl_zoo3's ``vec_env_wrapper``: a vector env of :class:`FlockEnv` as one with a slot for each vehicle.

    The given env is closed. SB3's episode statistics are in the infos (``Monitor``).

    :param venv: flocks of one scenario
    :param seed: seeds the flocks; a model seeds them again with its own seed
    :raises SettingsError: if the envs are others
    """
    try:
        scenarios = venv.get_attr("scenario")
    except AttributeError:
        scenarios = [None]
    if not isinstance(scenarios[0], Scenario) or scenarios.count(scenarios[0]) < len(scenarios):
        raise SettingsError("share_parameters: a vector env of sb3_flock/Flocking-v0 with one scenario is needed")
    n_flocks, render_mode = venv.num_envs, venv.render_mode
    venv.close()
    return make_vec_env(scenarios[0], n_flocks, seed=seed, render_mode=render_mode, monitor=True)
