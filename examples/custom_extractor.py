"""A features extractor of your own in place of FlockCNN: here, one without convolutions."""

import sys

import torch as th
from stable_baselines3 import DDPG
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_flock import FlockPolicy, NeighborInclusiveReward, Scenario, evaluate, make_vec_env, render


class FlatMLP(BaseFeaturesExtractor):
    """Flattens the observation and passes it through one dense layer; an extractor may be any torch module of this form."""

    def __init__(self, observation_space, features_dim=128):
        super().__init__(observation_space, features_dim)
        size = int(th.tensor(observation_space.shape).prod())
        self.layers = nn.Sequential(nn.Flatten(), nn.Linear(size, features_dim), nn.LayerNorm(features_dim), nn.ReLU())

    def forward(self, observations):
        return self.layers(observations)


scenario = Scenario(n_vehicles=3, n_obstacles=1)
env = make_vec_env(scenario, n_flocks=8, seed=0)
policy_kwargs = dict(features_extractor_class=FlatMLP, features_extractor_kwargs=dict(features_dim=64))
model = DDPG(FlockPolicy, env, policy_kwargs=policy_kwargs, learning_starts=1000, buffer_size=50_000, seed=0)
model.learn(int(sys.argv[1]) if len(sys.argv) > 1 else 30_000, NeighborInclusiveReward(lambda_=0.7))
print(model.policy.actor.features_extractor)
print(f"tracking error {evaluate(model, scenario, episodes=20)['tracking_error'].mean:.3f} m")
render(model, scenario, "custom_extractor.png")
