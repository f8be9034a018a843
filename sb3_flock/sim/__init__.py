"""The task: vehicles, obstacles and waypoint, what a vehicle senses, observes and is rewarded for. NumPy, numba if installed."""

from typing import Any

from sb3_flock._renamed import renamed_member
from sb3_flock.sim.dynamics import VehicleDynamics, register_dynamics
from sb3_flock.sim.observation import Channel, observe, register_channel
from sb3_flock.sim.obstacles import ObstacleMotion, register_obstacle_motion
from sb3_flock.sim.reward import RewardWeights, mix_rewards, own_reward, register_reward_term, reward_terms
from sb3_flock.sim.scenario import Scenario
from sb3_flock.sim.sensing import Contacts, Sensing
from sb3_flock.sim.simulators import Simulator, register_simulator
from sb3_flock.sim.world import World, check_actions, episode_rng

__all__ = [
    "Channel",
    "Contacts",
    "ObstacleMotion",
    "RewardWeights",
    "Scenario",
    "Sensing",
    "Simulator",
    "VehicleDynamics",
    "World",
    "check_actions",
    "episode_rng",
    "mix_rewards",
    "observe",
    "own_reward",
    "register_channel",
    "register_dynamics",
    "register_obstacle_motion",
    "register_reward_term",
    "register_simulator",
    "reward_terms",
]


def __getattr__(name: str) -> Any:
    return renamed_member(__name__, name)
