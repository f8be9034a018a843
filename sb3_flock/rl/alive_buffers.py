"""SB3's buffers for envs whose agents die or join: they hold the steps of living agents alone."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.type_aliases import RolloutBufferSamples


class AliveReplayBuffer(ReplayBuffer):
    """SB3's replay buffer, in which a step is stored only where an agent acted, as ``info["alive"]`` says.

    :param n_envs: slots of the vector env; their transitions share the capacity, however many each of them has
    :param handle_timeout_termination: as in SB3's ``ReplayBuffer``

    The other parameters are those of SB3's ``ReplayBuffer``; ``optimize_memory_usage`` is not among them.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        n_envs: int = 1,
        handle_timeout_termination: bool = True,
        **options: Any,
    ) -> None:
        if options.pop("optimize_memory_usage", False) or options:
            given = next(iter(options), "optimize_memory_usage")
            raise TypeError(f"AliveReplayBuffer got an unexpected argument {given!r}")
        super().__init__(
            buffer_size, observation_space, action_space, device, handle_timeout_termination=handle_timeout_termination
        )

    def add(
        self,
        obs: NDArray[Any],
        next_obs: NDArray[Any],
        action: NDArray[Any],
        reward: NDArray[Any],
        done: NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        """Store the living agents' part of one vector step."""
        for slot, info in enumerate(infos):
            if info.get("alive", True):
                one = slice(slot, slot + 1)
                super().add(obs[one], next_obs[one], action[one], reward[one], done[one], [info])


class AliveRolloutBuffer(RolloutBuffer):
    """SB3's rollout buffer, whose minibatches leave out the steps in which no agent acted.

    :class:`~sb3_flock.rl.callbacks.DropDeadTransitions` gives it to a model and fills :attr:`alive`. The parameters are those
    of SB3's ``RolloutBuffer``.

    :ivar alive: ``(steps, slots)``, whether an agent acted
    """

    alive: NDArray[np.bool_]

    def reset(self) -> None:
        """Empty the buffer."""
        super().reset()
        self.alive = np.ones((self.buffer_size, self.n_envs), bool)

    def get(self, batch_size: int | None = None) -> Generator[RolloutBufferSamples, None, None]:
        """Minibatches of the living agents' steps in random order.

        :param batch_size: steps in a minibatch; by default all of them
        """
        if not self.generator_ready:
            for name in ("observations", "actions", "values", "log_probs", "advantages", "returns", "alive"):
                setattr(self, name, self.swap_and_flatten(getattr(self, name)))
            self.generator_ready = True
        indices = np.random.permutation(np.flatnonzero(self.alive))  # noqa: NPY002 - what SB3 draws from
        for start in range(0, len(indices), batch_size or len(indices)):
            yield self._get_samples(indices[start : start + (batch_size or len(indices))])
