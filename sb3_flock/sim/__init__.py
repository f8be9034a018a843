"""The task itself: vehicles, obstacles, waypoint, what a vehicle senses and what it is paid for. NumPy; numba where installed."""

from sb3_flock.sim.observation import observe
from sb3_flock.sim.reward import RewardWeights, mix_rewards, own_reward, reward_terms
from sb3_flock.sim.scenario import Scenario
from sb3_flock.sim.sensing import Contacts, Sensing, sense
from sb3_flock.sim.world import World, episode_rng

__all__ = [
    "Contacts",
    "RewardWeights",
    "Scenario",
    "Sensing",
    "World",
    "episode_rng",
    "mix_rewards",
    "observe",
    "own_reward",
    "reward_terms",
    "sense",
]
