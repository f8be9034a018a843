"""Train a flock in a Stable-Baselines3 script of your own: plain DDPG with the parts of sb3_flock."""

import sys

import numpy as np
from stable_baselines3 import DDPG
from stable_baselines3.common.noise import NormalActionNoise

from sb3_flock import FlockCNN, NeighborInclusiveReward, Scenario, evaluate, make_vec_env, render

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
scenario = Scenario(n_vehicles=3, n_obstacles=1)
model = DDPG(
    "MlpPolicy",
    make_vec_env(scenario, n_flocks=8, seed=0),
    policy_kwargs=dict(features_extractor_class=FlockCNN, net_arch=[64]),
    action_noise=NormalActionNoise(np.zeros(2), np.full(2, 0.3)),
    learning_rate=5e-4,
    gamma=0.98,
    buffer_size=100_000,
    learning_starts=2000,
    gradient_steps=5,
)
model.learn(steps, callback=NeighborInclusiveReward(lambda_=0.7))
model.save("flock_ddpg")
print(evaluate(model, scenario, episodes=100)["tracking_error"])
render(model, scenario, "train_with_sb3.png")  # or .gif, .mp4, .html
