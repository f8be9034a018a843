import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env as sb3_make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_flock import evaluate, flocking_v0, load_policy, make_vec_env
from sb3_flock.envs.gym_env import FlockEnv, share_parameters
from sb3_flock.settings import SettingsError

ID = "sb3_flock/Flocking-v0"
CONFIG = Path(__file__).parents[2] / "configs" / "rl_zoo3" / "ddpg.yml"


def test_the_registered_env_passes_gymnasiums_checks():
    env = gymnasium.make(ID, n_vehicles=2, n_obstacles=1, max_cycles=5)
    check_env(env.unwrapped, skip_render_check=True)
    assert env.observation_space.shape == (2, 3, 11, 11)
    assert env.action_space.shape == (2, 2)


def test_it_is_the_parallel_env_with_all_vehicles_at_once():
    joint, parallel = FlockEnv(n_vehicles=3, max_cycles=4), flocking_v0.parallel_env(n_vehicles=3, max_cycles=4)
    observation, _ = joint.reset(seed=5)
    observations, _ = parallel.reset(seed=5)
    rng = np.random.default_rng(0)
    for step in range(4):
        np.testing.assert_array_equal(observation, np.stack(list(observations.values())))
        actions = rng.uniform(joint.action_space.low, joint.action_space.high).astype(np.float32)
        observation, reward, terminated, truncated, info = joint.step(actions)
        observations, rewards, *_ = parallel.step(dict(zip(parallel.possible_agents, actions, strict=True)))
        np.testing.assert_array_equal(info["rewards"], list(rewards.values()))
        assert reward == pytest.approx(np.mean(list(rewards.values())))
        assert (terminated, truncated) == (False, step == 3)


@pytest.mark.parametrize("n_flocks", [1, 3])
def test_shared_parameters_are_the_slots_of_make_vec_env(n_flocks):
    fields = {"n_vehicles": 2, "max_cycles": 3}
    shared = share_parameters(sb3_make_vec_env(ID, n_flocks, env_kwargs=fields), seed=4)
    ours = make_vec_env(shared.get_attr("scenario")[0], n_flocks, seed=4)
    assert shared.num_envs == 2 * n_flocks
    np.testing.assert_array_equal(shared.reset(), ours.reset())
    actions = np.array([shared.action_space.sample() for _ in range(shared.num_envs)])
    for _ in range(3):
        (_, rewards, dones, infos), (_, expected, _, _) = shared.step(actions), ours.step(actions)
        np.testing.assert_array_equal(rewards, expected)
    assert dones.all()
    assert all("episode" in info for info in infos)


@pytest.mark.parametrize(
    "makers",
    [
        [lambda: gymnasium.make("Pendulum-v1")],
        [lambda: FlockEnv(n_vehicles=2), lambda: FlockEnv(n_vehicles=2, max_speed=0.2)],
    ],
    ids=["another env", "two scenarios"],
)
def test_other_envs_are_refused(makers):
    with pytest.raises(SettingsError, match=r"share_parameters: a vector env of sb3_flock/Flocking-v0 with one scenario"):
        share_parameters(DummyVecEnv(makers))


def test_sb3_controls_a_flock_as_one_agent():
    model = PPO(
        "MlpPolicy", gymnasium.make(ID, n_vehicles=2, max_cycles=10), n_steps=16, batch_size=8, n_epochs=1, device="cpu"
    )
    assert model.learn(16).num_timesteps == 16


def test_rl_zoo3_trains_with_the_neighbors_rewards(tmp_path):
    """``python -m rl_zoo3.train`` in a process of its own, 500 steps; the callback logs the mixed return."""
    command = [sys.executable, "-m", "rl_zoo3.train", "--algo", "ddpg", "--env", ID, "--gym-packages", "sb3_flock"]
    command += ["-c", str(CONFIG), "-n", "500", "-f", str(tmp_path), "--eval-freq", "80", "--eval-episodes", "5"]
    command += ["--seed", "3", "--tensorboard-log", str(tmp_path / "tb"), "--log-interval", "1", "--num-threads", "1"]
    command += [
        "-params",
        "learning_starts:100",
        "gradient_steps:1",
        "n_envs:4",
        "env_kwargs:dict(n_vehicles=5,max_cycles=10)",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=200)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "ep_mixed_rew_mean" in done.stdout
    (folder,) = (tmp_path / "ddpg").glob("*_1")
    assert np.load(folder / "evaluations.npz")["timesteps"].tolist()
    with pytest.warns(UserWarning, match="saved without its scenario"):
        policy = load_policy(next(folder.glob("*.zip")))
    assert policy.predict(np.zeros((5, 3, 11, 11), np.float32))[0].shape == (5, 2)
    assert evaluate(policy, episodes=1)["tracking_error"].mean > 0
