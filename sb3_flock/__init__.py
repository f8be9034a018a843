"""sb3_flock: multi-vehicle flocking by reinforcement learning, as a Stable-Baselines3 plugin.

The public names below are imported when they are first used, so that importing the package is quick. Importing it registers
the environment with PettingZoo as ``flock/flocking-v0`` and with Gymnasium as ``sb3_flock/Flocking-v0``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import gymnasium
import pettingzoo

from sb3_flock import _renamed

if TYPE_CHECKING:
    from sb3_flock.config.training import TrainingConfig
    from sb3_flock.controllers import Controller, make_controller, register_controller
    from sb3_flock.deploy.c_export import export_c
    from sb3_flock.deploy.onnx_export import export
    from sb3_flock.envs import flocking_v0
    from sb3_flock.envs.expert_env import ExpertEnv
    from sb3_flock.envs.groups import flatten_groups, learn_groups
    from sb3_flock.envs.vec_env import flatten, make_vec_env
    from sb3_flock.envs.vec_reward import VecNeighborInclusiveReward
    from sb3_flock.evaluation import evaluate, register_metric
    from sb3_flock.pretrained import policy_path
    from sb3_flock.rl.buffers import CompactReplayBuffer
    from sb3_flock.rl.callbacks import DropDeadTransitions, NeighborInclusiveReward
    from sb3_flock.rl.ddpg import FlockDDPG, FlockTD3
    from sb3_flock.rl.policies import FlockPolicy, FlockSACPolicy
    from sb3_flock.rl.registry import register_algorithm
    from sb3_flock.rl.torch_layers import FlockCNN
    from sb3_flock.serialization.load import load_policy
    from sb3_flock.serialization.save import save_model
    from sb3_flock.sim import (
        ObstacleMotion,
        RewardWeights,
        Scenario,
        Simulator,
        VehicleDynamics,
        World,
        register_channel,
        register_dynamics,
        register_obstacle_motion,
        register_reward_term,
        register_simulator,
    )
    from sb3_flock.training.eval_callback import FlockEvalCallback
    from sb3_flock.training.train import resume, train
    from sb3_flock.viz.video import render

__all__ = [
    "CompactReplayBuffer",
    "Controller",
    "DropDeadTransitions",
    "ExpertEnv",
    "FlockCNN",
    "FlockDDPG",
    "FlockEvalCallback",
    "FlockPolicy",
    "FlockSACPolicy",
    "FlockTD3",
    "NeighborInclusiveReward",
    "ObstacleMotion",
    "RewardWeights",
    "Scenario",
    "Simulator",
    "TrainingConfig",
    "VecNeighborInclusiveReward",
    "VehicleDynamics",
    "World",
    "evaluate",
    "export",
    "export_c",
    "flatten",
    "flatten_groups",
    "flocking_v0",
    "learn_groups",
    "load_policy",
    "make_controller",
    "make_vec_env",
    "policy_path",
    "register_algorithm",
    "register_channel",
    "register_controller",
    "register_dynamics",
    "register_metric",
    "register_obstacle_motion",
    "register_reward_term",
    "register_simulator",
    "render",
    "resume",
    "save_model",
    "train",
]

_HOMES = {
    "CompactReplayBuffer": "rl.buffers",
    "Controller": "controllers",
    "DropDeadTransitions": "rl.callbacks",
    "ExpertEnv": "envs.expert_env",
    "FlockCNN": "rl.torch_layers",
    "FlockDDPG": "rl.ddpg",
    "FlockEvalCallback": "training.eval_callback",
    "FlockPolicy": "rl.policies",
    "FlockSACPolicy": "rl.policies",
    "FlockTD3": "rl.ddpg",
    "NeighborInclusiveReward": "rl.callbacks",
    "ObstacleMotion": "sim",
    "RewardWeights": "sim",
    "Scenario": "sim",
    "Simulator": "sim",
    "TrainingConfig": "config.training",
    "VecNeighborInclusiveReward": "envs.vec_reward",
    "VehicleDynamics": "sim",
    "World": "sim",
    "evaluate": "evaluation",
    "export": "deploy.onnx_export",
    "export_c": "deploy.c_export",
    "flatten": "envs.vec_env",
    "flatten_groups": "envs.groups",
    "learn_groups": "envs.groups",
    "load_policy": "serialization.load",
    "make_controller": "controllers",
    "make_vec_env": "envs.vec_env",
    "policy_path": "pretrained",
    "register_algorithm": "rl.registry",
    "register_channel": "sim",
    "register_controller": "controllers",
    "register_dynamics": "sim",
    "register_metric": "evaluation",
    "register_obstacle_motion": "sim",
    "register_reward_term": "sim",
    "register_simulator": "sim",
    "render": "viz.video",
    "resume": "training.train",
    "save_model": "serialization.save",
    "train": "training.train",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("sb3_flock")
    if name == "flocking_v0":
        return importlib.import_module("sb3_flock.envs.flocking_v0")
    if name in _HOMES:
        return getattr(importlib.import_module(f"sb3_flock.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__", *(name for name in globals() if name.startswith("__"))])


_renamed.install()
if "flock/flocking-v0" not in pettingzoo.parallel_registry:
    pettingzoo.register("parallel", "flock/flocking-v0", entry_point="sb3_flock.envs.flocking_v0:parallel_env")
    pettingzoo.register("aec", "flock/flocking-v0", entry_point="sb3_flock.envs.flocking_v0:env")
if "sb3_flock/Flocking-v0" not in gymnasium.registry:
    gymnasium.register("sb3_flock/Flocking-v0", entry_point="sb3_flock.envs.gym_env:FlockEnv")
