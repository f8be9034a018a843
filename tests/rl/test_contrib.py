"""sb3-contrib's off-policy algorithms with the parts of this package, in plain scripts."""

import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC, CrossQ
from stable_baselines3.common.callbacks import BaseCallback

from sb3_flock import FlockCNN, NeighborInclusiveReward, Scenario, evaluate, make_vec_env


class RawRewards(BaseCallback):
    """Keeps each step's rewards as the env gave them; listed before the mix."""

    def _on_training_start(self):
        self.rewards = []

    def _on_step(self):
        self.rewards.append(self.locals["rewards"].copy())
        return True


@pytest.mark.parametrize("algorithm", [TQC, CrossQ])
def test_it_learns_with_our_networks_and_the_mixed_rewards(algorithm, tmp_path):
    scenario = Scenario(n_vehicles=2, max_cycles=20, arena=0.15, obstacle_arena=1.0)
    networks = {"features_extractor_class": FlockCNN, "features_extractor_kwargs": {"features_dim": 16}, "net_arch": [16]}
    env = make_vec_env(scenario, n_flocks=3, seed=0)
    model = algorithm("MlpPolicy", env, policy_kwargs=networks, learning_starts=12, buffer_size=500, seed=0, device="cpu")
    before = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    raw = RawRewards()
    model.learn(120, [raw, NeighborInclusiveReward(0.3)])
    cnns = [name for name in before if "cnn" in name and "target" not in name and name.endswith("weight")]
    assert {name.split(".")[0] for name in cnns} == {"actor", "critic"}
    assert not any(th.equal(before[name], model.policy.state_dict()[name]) for name in cnns)
    stored, given = model.replay_buffer.rewards[: model.replay_buffer.pos], np.array(raw.rewards)
    assert len(stored) == len(given) == 20
    assert 0 < (stored != given).mean() < 1  # vehicles without neighbors keep their own
    model.save(tmp_path / "model")
    again = algorithm.load(tmp_path / "model", env=make_vec_env(scenario, n_flocks=1, seed=1), device="cpu")
    first, second = (evaluate(one, scenario, episodes=2)["tracking_error"].mean for one in (model, again))
    assert first == second
