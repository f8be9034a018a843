"""A learned policy as a controller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.controllers.base import Controller
from sb3_flock.settings import ActionError
from sb3_flock.sim import Scenario, Sensing, observe

_BLOCK = 256
"""Rows of a network's input, filled up with zeros. Matrix products of another shape may round differently; with one shape
only, a vehicle's action does not depend on how many others are computed with it."""


class PolicyController(Controller):
    """Drives by anything with SB3's ``predict(observations, deterministic=...)``: a model, its policy or a loaded policy.

    ``predict`` of a recurrent policy (sb3-contrib's RecurrentPPO) returns its state, and is given ``state`` and
    ``episode_start``, too.

    :param policy: the policy; one row of its input is one vehicle's observation. For a model whose env is wrapped in
        ``VecNormalize`` or ``VecFrameStack`` the observations are normalized and stacked as there
    """

    def __init__(self, policy: Any) -> None:
        self.policy = policy
        self._states: list[Any] = []
        self._stacks: dict[int, Any] = {}

    def reset(self, rngs: Sequence[Generator], scenario: Scenario) -> None:
        """Start episodes: a recurrent policy starts from its initial state, and stacks of frames are empty."""
        self._states, self._stacks = [], {}

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.floating]:
        """Deterministic actions ``(flocks, vehicles, 2)`` [m/s, rad/s] from the observations.

        A state that ``predict`` returns is given to its next call, until the next :meth:`reset`.

        :raises ActionError: if ``predict`` gives actions of another shape
        """
        observations = observe(sensing, scenario)
        rows = self._wrapped(observations.reshape(-1, *scenario.observation_shape))
        padded = np.zeros((-(-len(rows) // _BLOCK) * _BLOCK, *rows.shape[1:]), dtype=rows.dtype)
        padded[: len(rows)] = rows
        blocks = padded.reshape(-1, _BLOCK, *rows.shape[1:])
        memories = self._states if len(self._states) == len(blocks) else [None] * len(blocks)
        results = [self._predict(block, state) for block, state in zip(blocks, memories, strict=True)]
        self._states = [state for _, state in results if state is not None]
        return np.concatenate([actions for actions, _ in results])[: len(rows)].reshape(*observations.shape[:2], 2)

    def _wrapped(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Observations as the wrappers of the model's env give them to the model."""
        for number, wrapper in enumerate(_wrappers_of(self.policy)):
            if "stacked_obs" not in vars(wrapper):
                rows = wrapper.normalize_obs(rows)
                continue
            stack = self._stacks.get(number)
            if stack is not None and len(stack.stacked_obs) == len(rows):
                rows, _ = stack.update(rows, np.zeros(len(rows), bool), [{}] * len(rows))
            else:
                self._stacks[number] = _empty_stack(wrapper.stacked_obs, len(rows))
                rows = self._stacks[number].reset(rows)
        return rows

    def _predict(self, block: NDArray[np.float32], state: Any) -> tuple[NDArray[np.floating], Any]:
        """The actions of a block, ``(rows, 2)``, and a recurrent policy's state after it."""
        memory = {} if state is None else {"state": state, "episode_start": np.zeros(len(block), bool)}
        actions, state = self.policy.predict(block, deterministic=True, **memory)
        if np.shape(actions) != (len(block), 2):
            raise ActionError(f"predict gives actions of the shape {np.shape(actions)}: {(len(block), 2)} is needed")
        return actions, state

    def state_dict(self) -> dict[str, Any]:
        """The states of a recurrent policy, and the stacks of frames."""
        stacks = [[number, stack.stacked_obs] for number, stack in self._stacks.items()]
        return {name: kept for name, kept in (("states", self._states), ("stacks", stacks)) if kept}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self._states, self._stacks = list(state.get("states", ())), {}
        for number, frames in state.get("stacks", ()):
            self._stacks[number] = _empty_stack(_wrappers_of(self.policy)[number].stacked_obs, len(frames))
            self._stacks[number].stacked_obs = frames


def _wrappers_of(policy: Any) -> list[Any]:
    """The ``VecNormalize`` and ``VecFrameStack`` of a model's env, the innermost first."""
    env, found = getattr(policy, "get_env", lambda: None)(), []
    while env is not None:
        # A wrapper's getattr finds the attributes of those below it, too.
        if {"normalize_obs", "stacked_obs"} & {*dir(type(env)), *vars(env)}:
            found.append(env)
        env = vars(env).get("venv")
    return found[::-1]


def _empty_stack(like: Any, rows: int) -> Any:
    """SB3's ``StackedObservations`` of another number of rows."""
    return type(like)(rows, like.n_stack, like.observation_space, "first" if like.channels_first else "last")
