"""A learned policy as a controller."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_flock.controllers.base import Controller
from sb3_flock.sim import Scenario, Sensing, observe

_BLOCK = 256
"""Rows of a network's input, filled up with zeros. Matrix products of another shape may round differently; with one shape
only, a vehicle's action does not depend on how many others are computed with it."""


class PolicyController(Controller):
    """Drives by anything with SB3's ``predict(observations, deterministic=...)``: a model, its policy or a loaded policy.

    :param policy: the policy; one row of its input is one vehicle's observation. For a model whose env is wrapped in
        ``VecNormalize`` the observations are normalized by it
    """

    def __init__(self, policy: Any) -> None:
        self.policy = policy

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.floating]:
        """Deterministic actions ``(flocks, vehicles, 2)`` [m/s, rad/s] from the observations."""
        observations = observe(sensing, scenario)
        rows = observations.reshape(-1, *scenario.observation_shape)
        padded = np.zeros((-(-len(rows) // _BLOCK) * _BLOCK, *rows.shape[1:]), dtype=rows.dtype)
        vec_normalize = getattr(self.policy, "get_vec_normalize_env", lambda: None)()
        padded[: len(rows)] = rows if vec_normalize is None else vec_normalize.normalize_obs(rows)
        actions = [
            self.policy.predict(padded[start : start + _BLOCK], deterministic=True)[0]
            for start in range(0, len(padded), _BLOCK)
        ]
        return np.concatenate(actions)[: len(rows)].reshape(*observations.shape[:2], 2)
