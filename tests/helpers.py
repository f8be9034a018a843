"""What several test modules share: tiny trainings, worlds placed by hand, and comparisons of states."""

import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch as th
from gymnasium.utils.env_checker import data_equivalence
from rich.console import Console

from sb3_flock import FlockCNN, TrainingConfig, flocking_v0
from sb3_flock.controllers import EXPERTS
from sb3_flock.envs.expert_env import ExpertEnv
from sb3_flock.envs.vec_env import flatten
from sb3_flock.evaluation.rollout import rollout_batch
from sb3_flock.serialization.load import checkpoint_paths
from sb3_flock.serialization.yaml_io import load_config
from sb3_flock.sim import World, episode_rng
from sb3_flock.training.checkpoint import LoadedCheckpoint

TINY = {
    "total_timesteps": 300, "n_flocks": 2, "eval_freq": 120, "n_eval_episodes": 2, "save_freq": 150, "max_cycles": 20,
    "learning_starts": 60, "buffer_size": 1000, "batch_size": 16, "utd_ratio": 0.34, "features_dim": 16, "net_arch": [16],
    "train_env.flock_sizes": 3,
}  # fmt: skip
"""Overrides of the default config for a training of seconds."""

SMALL_MODEL = load_config(TrainingConfig, overrides={"buffer_size": 10, "n_flocks": 1, "features_dim": 16})
"""The config of the ``model`` fixture."""


def tiny(tmp_path, **changes):
    """A config of :data:`TINY` in a temporary folder."""
    return load_config(TrainingConfig, overrides={**TINY, "output_dir": str(tmp_path / "runs"), **changes})


def quiet():
    """A console that prints nowhere."""
    return Console(file=io.StringIO(), width=200)


class PlainCNN(FlockCNN):
    """The same network in torch's own convolutions."""

    def forward(self, observations):
        return self.dense(self.cnn(observations))


def place(scenario, positions, headings, obstacles=(), waypoint=(0.0, 0.0)):
    """A world of one flock with every body where the caller wants it."""
    world = World(scenario.replace(n_vehicles=len(positions), n_obstacles=len(obstacles)))
    world.reset([episode_rng(0, 0)])
    world.positions = np.array([positions], dtype=float)
    world.headings = np.array([headings], dtype=float)
    world.obstacle_positions = np.array([obstacles], dtype=float).reshape(1, -1, 2)
    world.obstacle_headings = np.zeros((1, len(obstacles)))
    world.waypoints = np.array([waypoint], dtype=float)
    return world


def assert_copy_continues_alike(env, actions, steps):
    """A copy of this env, restored from its state, gives equal observations to the last bit, within the space."""
    other = flocking_v0.parallel_env(env.scenario)
    other.load_state_dict(env.state_dict())
    for _ in range(steps):
        ours, theirs = env.step(actions)[0], other.step(actions)[0]
        for agent in env.agents:
            np.testing.assert_array_equal(ours[agent], theirs[agent])
            assert env.observation_space(agent).contains(ours[agent])


def mean_metrics(make_controller, scenario, episodes):
    """The mean of each metric over some episodes of a controller that is made from the world."""
    results = rollout_batch(make_controller, scenario, [episode_rng(5, episode) for episode in range(episodes)])
    return {name: np.nanmean(values) for name, values in results.items()}


def training_state(result):
    """Everything that a training leaves, except for wall time."""
    checkpoint = LoadedCheckpoint(checkpoint_paths(result.folder)[-1], 10**9)
    state = {f"{name}/{key}": value for name, tensors in checkpoint.tensors.items() for key, value in flat(tensors)}
    checkpoint.state["parts"]["evaluation"].pop("seconds")
    checkpoint.state["parts"]["evaluation"]["history"].pop("seconds")
    for episode in checkpoint.state["model"]["episodes"]:
        episode.pop("t")
    state.update(flat(checkpoint.state))
    return state


def flat(tree, name=""):
    """The leaves of nested dicts and lists with their paths."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from flat(value, f"{name}/{key}")
    elif isinstance(tree, list | tuple):
        for index, value in enumerate(tree):
            yield from flat(value, f"{name}/{index}")
    else:
        yield name, tree.detach().numpy() if isinstance(tree, th.Tensor) else tree


DATA = Path(__file__).parent / "data"
"""Files of earlier releases, and what those releases computed with them."""


def expert_vec_env(scenario):
    """Two flocks whose expert is ORCA, queried in every step, as a vector env."""
    return flatten(ExpertEnv(scenario, lambda world: EXPERTS["orca"](world, None), 0.5, 0.1, queries=True), 2, seed=0)


def assert_equal_rollouts(one, other, steps):
    """Two vector envs return the same to the last bit, with the same random actions; the infos of each step are returned."""
    rng, space, seen = np.random.default_rng(0), one.action_space, []
    np.testing.assert_array_equal(one.reset(), other.reset())
    for _ in range(steps):
        actions = rng.uniform(space.low, space.high, (one.num_envs, 2)).astype(np.float32)
        ours, theirs = one.step(actions), other.step(actions)
        for mine, yours in zip(ours[:3], theirs[:3], strict=True):
            np.testing.assert_array_equal(mine, yours)
        assert [list(info) for info in ours[3]] == [list(info) for info in theirs[3]]
        assert data_equivalence(ours[3], theirs[3], exact=True)
        seen.append(theirs[3])
    return seen


def run_example(name, *arguments, cwd):
    """What an example prints. It runs on one torch thread, as the tests do."""
    example = Path(__file__).parents[1] / "examples" / name
    return subprocess.run(
        [sys.executable, example, *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    ).stdout
