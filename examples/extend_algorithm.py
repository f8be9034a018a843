"""An off-policy algorithm of sb3-contrib as a value of ``algo``: TQC (pip install sb3-contrib)."""

import sys
from pathlib import Path

from sb3_contrib import TQC
from sb3_contrib.tqc.policies import TQCPolicy

from sb3_flock import FlockCNN, TrainingConfig, evaluate, load_policy, register_algorithm, render, train
from sb3_flock.rl.registry import AlgorithmSpec, extractor_kwargs


def tqc_networks(network):
    """The ``policy_kwargs`` of TQCPolicy for the ``network`` part of a config."""
    return {
        "features_extractor_class": FlockCNN,
        "features_extractor_kwargs": extractor_kwargs(network),
        "net_arch": list(network.net_arch),
        "n_critics": network.n_critics,
    }


register_algorithm("tqc", AlgorithmSpec(TQC, TQCPolicy, tqc_networks, has_action_noise=False))

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
config = TrainingConfig(algo="tqc", algorithm={"learning_starts": 2000}, total_timesteps=steps, n_flocks=8, eval_freq=0)
result = train(config)
policy = load_policy(result.folder)  # no code from the file is run; a script that loads it registers the algorithm first
print(f"{Path(result.folder).name}: {type(policy.policy).__name__} after {policy.num_timesteps} transitions")
print(f"tracking error {evaluate(policy, episodes=20)['tracking_error'].mean:.3f} m")
render(policy, policy.scenario, "extend_algorithm.png")
