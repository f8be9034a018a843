import warnings

import numpy as np
import pytest

from sb3_flock.envs.flocking_v0 import parallel_env
from sb3_flock.envs.multi_flock import MultiFlockEnv
from sb3_flock.envs.vec_env import flatten
from sb3_flock.rl.callbacks import NeighborInclusiveReward
from sb3_flock.sim import Scenario
from tests.helpers import assert_equal_rollouts

with warnings.catch_warnings():  # importing PettingZoo's tests imports its deprecated modules
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import parallel_api_test, parallel_seed_test

CROWDED = Scenario(arena=0.3, link_range=0.3, max_cycles=6)


def three_flocks(n_copies=1):
    return MultiFlockEnv([parallel_env(CROWDED, n_vehicles=n, n_flocks=n_copies) for n in (2, 5, 1)])


def test_it_is_a_parallel_env_that_can_be_reset_after_its_end():
    env = three_flocks()
    parallel_api_test(env, num_cycles=20)
    parallel_seed_test(three_flocks, num_cycles=8)
    assert env.possible_agents[:3] == ["flock_0/vehicle_0", "flock_0/vehicle_1", "flock_1/vehicle_0"]
    assert len(env.possible_agents) == 8


def test_a_flock_moves_as_it_does_alone():
    env = three_flocks()
    env.reset(seed=3)
    alone = parallel_env(CROWDED, n_vehicles=5)
    alone.reset(seed=int(np.random.SeedSequence(3).generate_state(3)[1]))
    rng = np.random.default_rng(0)
    for _ in range(6):
        actions = {agent: rng.uniform((0, -3), (0.15, 3)).astype(np.float32) for agent in env.possible_agents}
        observations, rewards, _, truncations, infos = env.step(actions)
        own = alone.step({f"vehicle_{i}": actions[f"flock_1/vehicle_{i}"] for i in range(5)})
        for i in range(5):
            name, theirs = f"flock_1/vehicle_{i}", f"vehicle_{i}"
            np.testing.assert_array_equal(observations[name], own[0][theirs])
            assert rewards[name] == own[1][theirs]
            assert truncations[name] == own[3][theirs]
            np.testing.assert_array_equal(infos[name]["neighbors"], own[4][theirs]["neighbors"] + 2)
    assert env.agents == [] == alone.agents


def test_copies_in_a_batch_equal_copies_of_the_env():
    copies, batch = flatten(three_flocks(), n_copies=3, seed=2), flatten(three_flocks(n_copies=3), seed=2)
    assert_equal_rollouts(copies, batch, steps=14)  # over the ends of two episodes
    assert copies.n_agents == batch.n_agents == 8
    names = batch.env_method("copy_at", 0, indices=0)[0].possible_agents
    assert names == three_flocks().possible_agents
    for slot in (0, 8, 16):
        ours, theirs = copies.get_attr("flocks", slot)[0], batch.get_attr("flocks", slot)[0]
        for one, other in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(one.world.positions, other.world.positions)


@pytest.mark.parametrize("n_copies", [1, 2])
def test_rewards_are_mixed_within_a_flock(n_copies):
    venv = flatten(three_flocks(n_copies), n_copies=2 // n_copies, seed=0)
    assert (venv.num_envs, venv.n_agents) == (16, 8)
    venv.reset()
    for _ in range(5):
        _, _, _, infos = venv.step(np.full((16, 2), 0.05, dtype=np.float32))
    marked = np.zeros(16)
    marked[[2, 3, 4, 5, 6]] = 1.0  # the five of the first copy
    mixed = NeighborInclusiveReward(0.5, n_agents=8).mix(marked, infos)
    assert mixed.tolist() == marked.tolist()
    assert any(len(info["neighbors"]) for info in infos[2:7])


@pytest.mark.parametrize("n_copies", [1, 2])
def test_a_state_continues_to_the_last_bit(n_copies):
    one, other = (flatten(three_flocks(n_copies), 2 // n_copies, seed=seed) for seed in (4, 5))
    rng = np.random.default_rng(1)
    one.reset()
    other.reset()
    for step in range(20):  # over the end of three episodes
        if step == 3:
            other.load_state_dict(one.state_dict())
        actions = rng.uniform((0, -3), (0.15, 3), (16, 2)).astype(np.float32)
        ours, theirs = one.step(actions), other.step(actions)
        if step >= 3:
            np.testing.assert_array_equal(ours[0], theirs[0])
            np.testing.assert_array_equal(ours[1], theirs[1])
