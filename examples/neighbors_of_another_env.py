"""The neighbor-inclusive reward on another env: MPE2's simple_spread (pip install mpe2 pillow).

The callback needs only ``info["neighbors"]``: the indices into ``possible_agents`` of each agent's neighbors.
"""

import sys

import numpy as np
from mpe2 import simple_spread_v3
from pettingzoo.utils import BaseParallelWrapper
from PIL import Image
from stable_baselines3 import DDPG

from sb3_flock import NeighborInclusiveReward, flatten


class NeighborsWithinOne(BaseParallelWrapper):
    """The neighbors of an agent are the agents within distance 1."""

    def step(self, actions):
        observations, rewards, terminations, truncations, infos = super().step(actions)
        positions = np.array([observations[agent][2:4] for agent in observations])
        for agent, position in zip(observations, positions, strict=True):
            distances = np.linalg.norm(positions - position, axis=-1)
            infos[agent]["neighbors"] = np.flatnonzero((distances > 0) & (distances < 1))
        return observations, rewards, terminations, truncations, infos


spread = simple_spread_v3.parallel_env(N=3, local_ratio=1.0, continuous_actions=True, render_mode="rgb_array")
env = flatten(NeighborsWithinOne(spread), n_copies=4, seed=0)
model = DDPG("MlpPolicy", env, learning_starts=500, buffer_size=50_000, gradient_steps=2)
model.learn(int(sys.argv[1]) if len(sys.argv) > 1 else 20_000, callback=NeighborInclusiveReward(lambda_=0.5))
assert model.replay_buffer is not None  # it is off policy
print(f"{model.num_timesteps} transitions, mean stored reward {model.replay_buffer.rewards[:100].mean():.3f}")
Image.fromarray(np.asarray(env.render())).save("neighbors_of_another_env.png")
