"""The environment works in RLlib's wrapper."""

import pytest

from sb3_flock import flocking_v0

wrappers = pytest.importorskip("ray.rllib.env.wrappers.pettingzoo_env")


def test_an_episode_in_rllibs_wrapper():
    env = wrappers.ParallelPettingZooEnv(flocking_v0.parallel_env(n_vehicles=4, n_obstacles=2, max_cycles=25))
    observations, _ = env.reset(seed=3)
    again, _ = env.reset(seed=3)
    assert set(observations) == {f"vehicle_{i}" for i in range(4)}
    for name, observation in observations.items():
        assert env.observation_space[name].contains(observation)
        assert (observation == again[name]).all()
    env.action_space.seed(0)
    for step in range(25):
        observations, rewards, terminations, truncations, infos = env.step(env.action_space.sample())
        assert set(observations) == set(rewards) == set(infos)
        assert truncations["__all__"] == (step == 24)
        assert not terminations["__all__"]
    env.close()
