"""sb3_flock: vehicles that flock by reinforcement learning, as a Stable-Baselines3 plugin.

The public names below load when they are first used, so that importing the package is quick. Importing it registers the
environment with PettingZoo as ``flock/flocking-v0``.
"""

from __future__ import annotations

import importlib
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import pettingzoo

if TYPE_CHECKING:
    from sb3_flock.envs import flocking_v0
    from sb3_flock.envs.vec_env import flatten, make_vec_env
    from sb3_flock.evaluation import evaluate
    from sb3_flock.evaluation.film import render
    from sb3_flock.rl.callbacks import NeighborInclusiveReward
    from sb3_flock.rl.config import TrainingConfig
    from sb3_flock.rl.ddpg import FlockDDPG
    from sb3_flock.rl.extractor import FlockCNN
    from sb3_flock.rl.loading import load_policy
    from sb3_flock.rl.onboard import export
    from sb3_flock.rl.policy import FlockPolicy, FlockSACPolicy
    from sb3_flock.rl.replay import CompactReplayBuffer
    from sb3_flock.rl.saving import save_model
    from sb3_flock.rl.training import resume, train
    from sb3_flock.sim import RewardWeights, Scenario, World

__all__ = [
    "CompactReplayBuffer",
    "FlockCNN",
    "FlockDDPG",
    "FlockPolicy",
    "FlockSACPolicy",
    "NeighborInclusiveReward",
    "RewardWeights",
    "Scenario",
    "TrainingConfig",
    "World",
    "evaluate",
    "export",
    "flatten",
    "flocking_v0",
    "load_policy",
    "make_vec_env",
    "render",
    "resume",
    "save_model",
    "train",
]

_HOMES = {
    "CompactReplayBuffer": "rl.replay",
    "FlockCNN": "rl.extractor",
    "FlockDDPG": "rl.ddpg",
    "FlockPolicy": "rl.policy",
    "FlockSACPolicy": "rl.policy",
    "NeighborInclusiveReward": "rl.callbacks",
    "RewardWeights": "sim",
    "Scenario": "sim",
    "TrainingConfig": "rl.config",
    "World": "sim",
    "evaluate": "evaluation",
    "export": "rl.onboard",
    "flatten": "envs.vec_env",
    "load_policy": "rl.loading",
    "make_vec_env": "envs.vec_env",
    "render": "evaluation.film",
    "save_model": "rl.saving",
    "resume": "rl.training",
    "train": "rl.training",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return version("sb3_flock")
    if name == "flocking_v0":
        return importlib.import_module("sb3_flock.envs.flocking_v0")
    if name in _HOMES:
        return getattr(importlib.import_module(f"sb3_flock.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])


if "flock/flocking-v0" not in pettingzoo.parallel_registry:
    pettingzoo.register("parallel", "flock/flocking-v0", entry_point="sb3_flock.envs.flocking_v0:parallel_env")
    pettingzoo.register("aec", "flock/flocking-v0", entry_point="sb3_flock.envs.flocking_v0:env")
