"""A replay buffer for the flock's observations that needs a quarter of the memory of SB3's."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_flock._renamed import rename_fields, warn_renamed
from sb3_flock.settings import SettingsError


class ExpertReplayBufferSamples(NamedTuple):
    """A minibatch as SB3's ``ReplayBufferSamples``, with the expert's actions."""

    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None
    expert_actions: th.Tensor
    """``(batch, 2)``, scaled as the actions: -1 to 1."""


class CompactReplayBuffer(ReplayBuffer):
    """Observations in half precision, each stored once: 0.75 GB for a million transitions, where SB3's takes 2.9 GB (three
    channels of 11 x 11; with motion channels both take twice as much).

    A transition's next observation is the one stored after it; the last one of an episode is stored separately. Rounding
    changes the anchors' values by at most 0.05 %. Unlike SB3's ``optimize_memory_usage`` it handles time limits. Steps in which
    no agent acted (``info["alive"]`` is false) are not sampled.

    :param buffer_size: capacity [transitions]
    :param observation_space: a ``Box`` of floats
    :param mirror_augmentation: mirror half of every sample, left for right: the task is symmetric, so a mirrored transition
        is as valid as the original. The last axis of the observations ``(channels, l, l)`` is reversed, and the second action,
        the turn rate, changes its sign
    :param store_expert_actions: also store each info's ``expert_action`` ``(2,)`` [m/s, rad/s], see
        :class:`~sb3_flock.envs.expert_env.ExpertEnv`, and NaN where it has none; samples are then
        :class:`ExpertReplayBufferSamples`
    :raises SettingsError: for ``mirror_augmentation`` with other observations or actions

    The other parameters are those of SB3's ``ReplayBuffer``.

    :ivar lacks_expert_actions: whether an agent's info had no ``expert_action`` although they are stored
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        mirror_augmentation: bool = False,
        store_expert_actions: bool = False,
        **renamed: Any,
    ) -> None:
        if renamed:  # arguments of the previous release
            options, names = rename_fields("CompactReplayBuffer", renamed)
            given = {"mirror_augmentation": mirror_augmentation, "store_expert_actions": store_expert_actions}
            for old, new in names:
                if given[new]:
                    raise TypeError(f"CompactReplayBuffer got {new} and its old name {old}")
                warn_renamed(f"CompactReplayBuffer: {old}", new)
            mirror_augmentation = options.pop("mirror_augmentation", mirror_augmentation)
            store_expert_actions = options.pop("store_expert_actions", store_expert_actions)
            if options:
                raise TypeError(f"CompactReplayBuffer got an unexpected argument {next(iter(options))!r}")
        if mirror_augmentation:
            _check_mirror(observation_space, action_space)
        half = spaces.Box(-1.0, 1.0, observation_space.shape, np.float16)  # only its shape and type count
        # One row more than asked for: the row after the newest holds its next observation, and is not sampled.
        super().__init__(
            buffer_size + n_envs,
            half,
            action_space,
            device,
            n_envs,
            optimize_memory_usage=True,
            handle_timeout_termination=False,
        )
        self.observation_space = observation_space
        self.handle_timeout_termination = handle_timeout_termination
        self.mirror_augmentation = mirror_augmentation
        self.expert_actions = np.zeros_like(self.actions) if store_expert_actions else None
        self.lacks_expert_actions = False
        self.alive = np.ones((self.buffer_size, n_envs), bool)
        self._last_observations: dict[int, dict[int, NDArray[np.float16]]] = {}

    def add(
        self,
        obs: NDArray[Any],
        next_obs: NDArray[Any],
        action: NDArray[Any],
        reward: NDArray[Any],
        done: NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        """Store one vector step."""
        obs, next_obs = _to_half(obs), _to_half(next_obs)
        self._last_observations.pop(self.pos, None)
        if done.any():
            self._last_observations[self.pos] = {env: next_obs[env].copy() for env in np.flatnonzero(done).tolist()}
        self.alive[self.pos] = alive = [info.get("alive", True) for info in infos]
        if self.expert_actions is not None:
            self.lacks_expert_actions |= not all(
                "expert_action" in info for info, acts in zip(infos, alive, strict=True) if acts
            )
            low, high = self.action_space.low, self.action_space.high  # type: ignore[attr-defined]
            none = np.full_like(low, np.nan)
            self.expert_actions[self.pos] = (
                2 * (np.array([info.get("expert_action", none) for info in infos]) - low) / (high - low) - 1
            )
        super().add(obs, next_obs, action, reward, done, infos)

    def sample_indices(self, batch_size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Draw a minibatch: row and env of each transition, each ``(batch,)``, from NumPy's global stream as SB3 does."""
        return self._draw_envs(self._draw_rows(batch_size))

    def _draw_rows(self, count: int) -> NDArray[np.int64]:
        if self.full:  # the row at pos holds the newest transition's next observation alone
            return (np.random.randint(1, self.buffer_size, size=count) + self.pos) % self.buffer_size  # noqa: NPY002
        return np.random.randint(0, self.pos, size=count)  # noqa: NPY002

    def _draw_envs(self, rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """An env for each row; both are drawn again where no agent acted."""
        rows, envs = rows.copy(), np.random.randint(0, high=self.n_envs, size=len(rows))  # noqa: NPY002
        while len(dead := np.flatnonzero(~self.alive[rows, envs])):
            rows[dead] = self._draw_rows(len(dead))
            envs[dead] = np.random.randint(0, high=self.n_envs, size=len(dead))  # noqa: NPY002
        return rows, envs

    def last_observations(
        self, rows: NDArray[np.int64], envs: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float16]]:
        """The next observations of transitions that ended an episode, which are stored outside the rows.

        :return: for each transition its row in the second array, or -1; ``(ends, numbers)``
        """
        index, last = np.full(rows.shape, -1, np.int64), list[NDArray[np.float16]]()
        for place in zip(*np.nonzero(self.dones[rows, envs]), strict=True):
            index[place] = len(last)
            last.append(self._last_observations[rows[place]][envs[place]].reshape(-1))
        numbers = int(np.prod(self.observations.shape[2:]))
        return index, np.array(last, dtype=np.float16).reshape(-1, numbers)

    def _get_samples(  # type: ignore[override]
        self, batch_inds: NDArray[np.int64], env: VecNormalize | None = None
    ) -> ReplayBufferSamples | ExpertReplayBufferSamples:
        at = batch_inds, env_indices = self._draw_envs(batch_inds)
        next_observations: Any = self.observations[(batch_inds + 1) % self.buffer_size, env_indices]
        observations: Any = self.observations[at]
        actions, dones = self.actions[at], self.dones[at]
        index, last = self.last_observations(*at)
        next_observations[index >= 0] = last.reshape(-1, *next_observations.shape[1:])
        if self.mirror_augmentation:
            half = len(batch_inds) // 2
            for rows in (observations, next_observations):
                rows[:half] = rows[:half, ..., ::-1].copy()
            actions[:half, 1] *= -1
        rewards = self.rewards[at][:, None]
        if env is not None:
            observations, next_observations = env.normalize_obs(observations), env.normalize_obs(next_observations)
            rewards = env.normalize_reward(rewards)
        samples = ReplayBufferSamples(
            self._to_float(observations),
            self.to_torch(actions, copy=False),
            self._to_float(next_observations),
            self.to_torch((dones * (1 - self.timeouts[at]))[:, None], copy=False),
            self.to_torch(rewards, copy=False),
        )
        if self.expert_actions is None:
            return samples
        expert_actions = self.expert_actions[at]
        if self.mirror_augmentation:
            expert_actions[:half, 1] *= -1
        return ExpertReplayBufferSamples(*samples, self.to_torch(expert_actions, copy=False))

    def _to_float(self, observations: Any) -> th.Tensor:
        return self.to_torch(observations, copy=False).float()


def _check_mirror(observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    shape = observation_space.shape or ()
    is_map = len(shape) == 3 and shape[1] == shape[2]
    turns = (
        isinstance(action_space, spaces.Box) and action_space.shape == (2,) and action_space.low[1] == -action_space.high[1]
    )
    if not (is_map and turns):
        raise SettingsError(
            f"mirror_augmentation = True: observations of shape (channels, l, l), and actions of a speed and a turn rate within "
            f"[-w, w] are needed, not {observation_space} and {action_space}"
        )


def replay_state(buffer: ReplayBuffer) -> dict[str, Any]:
    """The content of a replay buffer, ours or SB3's: its used rows alone."""
    used = min(buffer.pos + 1, buffer.buffer_size) if not buffer.full else buffer.buffer_size  # + 1: the next observation
    state = {"pos": buffer.pos, "full": buffer.full, "arrays": {name: rows[:used] for name, rows in _rows(buffer).items()}}
    if isinstance(buffer, CompactReplayBuffer):
        last = [(row, env, tensor) for row, envs in buffer._last_observations.items() for env, tensor in envs.items()]
        shape = buffer.observations.shape[2:]
        state["last_places"] = np.array([(row, env) for row, env, _ in last], dtype=np.int64).reshape(-1, 2)
        state["last_observations"] = np.array([tensor for *_, tensor in last], dtype=np.float16).reshape(-1, *shape)
    return state


def load_replay_state(buffer: ReplayBuffer, state: Mapping[str, Any]) -> None:
    """Restore :func:`replay_state` into a buffer of the same class and size.

    :raises ValueError: if the rows do not fit
    """
    for name, rows in _rows(buffer).items():
        if name == "alive" and name not in state["arrays"]:  # a checkpoint of the previous release
            rows[:] = True
            continue
        saved = state["arrays"][name]
        if saved.dtype != rows.dtype or saved.shape[1:] != rows.shape[1:]:
            raise ValueError(
                f"replay buffer's {name}: {saved.dtype} {saved.shape} where {rows.dtype} {rows.shape} is needed"
            )
        rows[: len(saved)] = saved
    buffer.pos, buffer.full = state["pos"], state["full"]
    if isinstance(buffer, CompactReplayBuffer):
        buffer._last_observations = {}
        for (row, env), tensor in zip(state["last_places"].tolist(), state["last_observations"], strict=True):
            buffer._last_observations.setdefault(row, {})[env] = tensor


def _rows(buffer: ReplayBuffer) -> dict[str, NDArray[Any]]:
    """The arrays with one row per vector step."""
    return {
        name: value
        for name, value in vars(buffer).items()
        if isinstance(value, np.ndarray) and value.shape[:2] == (buffer.buffer_size, buffer.n_envs)
    }


def _to_half(observations: NDArray[Any]) -> NDArray[np.float16]:
    """Observations in half precision; NumPy rounds alike, but slowly where Gaussians fade out."""
    half: NDArray[np.float16] = th.from_numpy(np.ascontiguousarray(observations, np.float32)).half().numpy()
    return half
