"""Vehicle dynamics of your own in the env: actuators that follow the commands with a lag."""

import sys

import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_flock import CompactReplayBuffer, FlockDDPG, FlockPolicy, NeighborInclusiveReward, Scenario, World, flatten
from sb3_flock.envs import flocking_v0


class LaggingWorld(World):
    """A world whose vehicles' speeds and turn rates close a share of the gap to their commands in each step."""

    share = 0.4

    def reset(self, rngs):
        self.rates = np.zeros((self.n_flocks, self.scenario.n_vehicles, 2))
        return super().reset(rngs)

    def step(self, actions):
        commands = np.clip(np.asarray(actions, dtype=np.float64), self.action_low, self.action_high)
        self.rates = self.rates + self.share * (commands - self.rates)
        return super().step(self.rates)


class LaggingEnv(flocking_v0.parallel_env):
    """The flocking env in this world."""

    def __init__(self, scenario):
        super().__init__(scenario)
        self.world = LaggingWorld(scenario)


steps = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
scenario = Scenario(n_vehicles=3, n_obstacles=1)
env = LaggingEnv(scenario)
env.reset(seed=0)
start = env.world.positions[0, 0]
env.step(dict.fromkeys(env.agents, (scenario.max_speed, 0.0)))
speed = np.linalg.norm(env.world.positions[0, 0] - start) / scenario.time_step
print(f"speed in the first step: {speed:.3f} m/s of the commanded {scenario.max_speed:.3f} m/s")

options: dict = dict(
    replay_buffer_class=CompactReplayBuffer, learning_starts=1000, buffer_size=50_000, gradient_steps=5, seed=0
)
model = FlockDDPG(FlockPolicy, flatten(env, n_copies=8, seed=0), **options)
model.learn(steps, NeighborInclusiveReward(lambda_=0.7))
print(f"mean return {evaluate_policy(model, flatten(env, 4, seed=1), n_eval_episodes=24, warn=False)[0]:.2f}")
