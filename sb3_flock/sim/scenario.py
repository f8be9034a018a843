"""Scenario: every parameter of the task, composed of the settings of its parts."""

from __future__ import annotations

from pydantic import Field

from sb3_flock.sim.observation import ObservationSettings
from sb3_flock.sim.reward import RewardWeights
from sb3_flock.sim.world import WorldSettings


class Scenario(WorldSettings, ObservationSettings):
    """The flocking task of Lyu et al. (2018), sections III to V.

    Instances are frozen; ``scenario.replace(n_vehicles=5)`` gives a changed copy. Lengths are in meters, times in seconds,
    angles in radians; the paper's arena is 2 m wide.

    :raises SettingsError: one line naming the parameter, its value and what is accepted
    """

    reward: RewardWeights = Field(default_factory=RewardWeights, description="weights of the reward")
