import warnings

import numpy as np
import pettingzoo
import pytest
from gymnasium.utils.env_checker import data_equivalence

from sb3_flock import flocking_v0
from sb3_flock.envs.flocking_v0 import parallel_env
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Channel, Scenario, register_channel
from sb3_flock.sim.observation import CHANNELS

with warnings.catch_warnings():  # importing PettingZoo's tests imports its deprecated modules
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import (
        api_test,
        max_cycles_test,
        parallel_api_test,
        parallel_seed_test,
        render_test,
        seed_test,
    )

VARIANTS = [
    {},
    {"n_vehicles": 5, "n_obstacles": 2},
    {"n_vehicles": 1, "n_obstacles": 0},
    {"n_vehicles": 2, "max_cycles": 7},
    {"motion_lag": 0.2},
    {"n_flocks": 2, "max_cycles": 7},
]


def episodes_of(env, seed, episodes, action_seed=0):
    """Everything an env returns over several episodes, with the same actions every time."""
    rng = np.random.default_rng(action_seed)
    seen = [env.reset(seed=seed)]
    for episode in range(episodes):
        if episode:
            seen.append(env.reset())
        while env.agents:
            actions = {agent: rng.uniform(*box_bounds(env, agent)).astype(np.float32) for agent in env.agents}
            seen.append(env.step(actions))
    return seen


def box_bounds(env, agent):
    space = env.action_space(agent)
    return space.low, space.high


@pytest.mark.parametrize("kwargs", VARIANTS)
def test_pettingzoos_own_tests_pass_without_warnings(kwargs):
    parallel_api_test(flocking_v0.parallel_env(**kwargs), num_cycles=300)
    parallel_seed_test(lambda: flocking_v0.parallel_env(**kwargs))
    for make in (flocking_v0.env, flocking_v0.raw_env):
        api_test(make(**kwargs), num_cycles=100)
        seed_test(lambda make=make: make(**kwargs))


def test_pettingzoos_cycle_and_render_tests_pass():
    max_cycles_test(flocking_v0)
    render_test(flocking_v0.env)


@pytest.mark.parametrize("kwargs", VARIANTS)
def test_several_episodes_repeat_from_one_seed(kwargs):
    first, second = (episodes_of(flocking_v0.parallel_env(**kwargs), 11, episodes=3) for _ in range(2))
    assert data_equivalence(first, second)
    other = episodes_of(flocking_v0.parallel_env(**kwargs), 12, episodes=1)
    assert not data_equivalence(first[0][0], other[0][0])


def test_episodes_of_one_stream_differ():
    env = flocking_v0.parallel_env(max_cycles=2)
    first, _ = env.reset(seed=0)
    second, _ = env.reset()
    assert not data_equivalence(first, second)


def test_unseeded_envs_differ():
    first, _ = flocking_v0.parallel_env().reset()
    second, _ = flocking_v0.parallel_env().reset()
    assert not data_equivalence(first, second)


def test_registered_with_pettingzoo_and_kwargs_reach_the_scenario():
    env = pettingzoo.make("parallel", "flock/flocking-v0", n_vehicles=4, max_cycles=9)
    assert env.possible_agents == [f"vehicle_{i}" for i in range(4)]
    assert env.scenario == Scenario(n_vehicles=4, max_cycles=9)
    assert pettingzoo.make("aec", "flock/flocking-v0", n_vehicles=2).possible_agents == ["vehicle_0", "vehicle_1"]


def test_spaces_do_not_depend_on_the_number_of_bodies():
    small, large = (
        flocking_v0.parallel_env(n_vehicles=1, n_obstacles=0),
        flocking_v0.parallel_env(n_vehicles=9, n_obstacles=7),
    )
    assert small.observation_space("vehicle_0") == large.observation_space("vehicle_8")
    assert small.action_space("vehicle_0") == large.action_space("vehicle_8")
    action_space = small.action_space("vehicle_0")
    np.testing.assert_allclose(action_space.low, [0, -np.pi], rtol=1e-6)
    np.testing.assert_allclose(action_space.high, [0.15, np.pi], rtol=1e-6)


def test_a_registered_channel_is_part_of_the_observation_space(restored):
    restored(CHANNELS)
    register_channel(
        Channel(
            "obstacles_ahead",
            "obstacles",
            lambda settings: settings.detection_range,
            lambda positions: positions[..., 0] > 0,
        )
    )
    kwargs = {"extra_channels": ["obstacles_ahead"], "motion_lag": 0.2, "n_obstacles": 3, "obstacle_arena": 0.4}
    parallel_api_test(flocking_v0.parallel_env(**kwargs), num_cycles=50)
    env = flocking_v0.parallel_env(**kwargs, arena=0.3)
    space = env.observation_space("vehicle_0")
    assert space.shape == (8, 11, 11)
    assert (space.low[:4] == 0.0).all()
    assert (space.low[4:] < 0.0).all()
    observations, _ = env.reset(seed=0)
    largest, smallest = np.zeros(8), np.zeros(8)
    for _ in range(20):
        observations, *_ = env.step({agent: np.array([0.1, 1.0], dtype=np.float32) for agent in env.agents})
        for observation in observations.values():
            assert space.contains(observation)
            largest = np.maximum(largest, observation.max((1, 2)))
            smallest = np.minimum(smallest, observation.min((1, 2)))
    assert largest[3] > 0.5
    assert smallest[7] < -0.01


def test_infos_hold_neighbors_terms_and_metrics():
    env = flocking_v0.parallel_env(n_vehicles=8, n_obstacles=3, arena=0.3, obstacle_arena=0.5, neighbor_separation=0.05)
    env.reset(seed=3)
    scenario = env.scenario
    some_neighbors = False
    for _ in range(20):
        _, rewards, _, _, infos = env.step({a: np.array([0.1, 1.0], dtype=np.float32) for a in env.agents})
        positions = env.world.positions[0]
        distances = np.linalg.norm(positions[:, None] - positions[None], axis=-1) + np.diag([np.inf] * 8)
        to_obstacles = np.linalg.norm(positions[:, None] - env.world.obstacle_positions[0][None], axis=-1)
        for i, agent in enumerate(env.agents):
            info, metrics = infos[agent], infos[agent]["metrics"]
            np.testing.assert_array_equal(info["neighbors"], np.flatnonzero(distances[i] < scenario.link_range))
            some_neighbors |= len(info["neighbors"]) > 0
            assert set(info["reward_terms"]) == {"connectivity", "obstacle", "waypoint", "control"}
            assert rewards[agent] == pytest.approx(sum(info["reward_terms"].values()))
            assert metrics["nearest_neighbor"] == pytest.approx(distances[i].min())
            assert metrics["nearest_obstacle"] == pytest.approx(to_obstacles[i].min())
            assert metrics["neighbor_violation"] == (distances[i].min() < 0.05)
            assert metrics["obstacle_violation"] == (to_obstacles[i].min() < 0.15)
            reached = np.linalg.matrix_power((distances < scenario.link_range) + np.eye(8), 8)
            assert metrics["connected"] == (reached > 0).all()
            assert metrics["tracking_error"] == pytest.approx(np.linalg.norm(positions[i] - env.world.waypoints[0]))
    assert some_neighbors


def test_a_lone_vehicle_has_no_neighbor_and_no_obstacle():
    env = flocking_v0.parallel_env(n_vehicles=1, n_obstacles=0)
    env.reset(seed=0)
    _, _, _, _, infos = env.step({"vehicle_0": np.array([0.15, 0.0], dtype=np.float32)})
    info = infos["vehicle_0"]
    assert len(info["neighbors"]) == 0
    assert info["metrics"]["nearest_neighbor"] == info["metrics"]["nearest_obstacle"] == np.inf
    assert info["metrics"]["connected"] is True


def test_all_vehicles_are_truncated_together_at_the_time_limit():
    env = flocking_v0.parallel_env(max_cycles=3)
    _, infos = env.reset(seed=0)
    assert all(info == {} for info in infos.values())  # anything else would overwrite the last step's infos in SuperSuit
    for step in range(3):
        _, _, terminations, truncations, infos = env.step({a: env.action_space(a).sample() for a in env.agents})
        assert not any(terminations.values())
        assert all(truncations.values()) == (step == 2)
        assert all(info.get("TimeLimit.truncated", False) == (step == 2) for info in infos.values())
    assert env.agents == []


def test_observations_are_fresh_arrays():
    env = flocking_v0.parallel_env()
    first, _ = env.reset(seed=0)
    kept = first["vehicle_0"].copy()
    env.step({a: env.action_space(a).sample() for a in env.agents})
    env.reset()
    np.testing.assert_array_equal(first["vehicle_0"], kept)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_vehicels": 3}, "did you mean n_vehicles"),
        ({"n_vehicles": 0}, "n_vehicles = 0"),
        ({"render_mode": "ansi"}, "render_mode = 'ansi'"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(kwargs, message):
    with pytest.raises(SettingsError, match=message):
        flocking_v0.parallel_env(**kwargs)


def test_several_flocks_are_shown_one_by_one():
    env = flocking_v0.parallel_env(n_vehicles=2, n_obstacles=1, max_cycles=3, n_flocks=3, arena=0.2, obstacle_arena=0.4)
    names = ["flock_0/vehicle_0", "flock_0/vehicle_1", "flock_1/vehicle_0"]
    assert env.possible_agents[:3] == names
    assert env.copy_at(2).agents == []
    env.reset(seed=5)
    alone = flocking_v0.parallel_env(env.scenario)
    alone.reset(seed=7)
    for _ in range(3):
        one = env.copy_at(2)
        assert one.possible_agents == one.agents == alone.agents
        np.testing.assert_array_equal(one.state(), alone.state())
        np.testing.assert_array_equal(one.state(), env.state()[4:])
        env.step(dict.fromkeys(env.agents, np.array([0.1, 1.0])))
        alone.step(dict.fromkeys(alone.agents, np.array([0.1, 1.0])))
    assert env.copy_at(2).agents == alone.agents == []
    assert alone.copy_at(0) is alone


def test_a_state_of_another_number_of_flocks_is_refused():
    env = flocking_v0.parallel_env(n_flocks=3)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="the state is of 3 flocks: 2 are needed"):
        flocking_v0.parallel_env(n_flocks=2).load_state_dict(env.state_dict())
    with pytest.raises(SettingsError, match="n_flocks = 0"):
        flocking_v0.parallel_env(n_flocks=0)


def test_a_repeated_action_takes_as_many_sampling_periods_and_gives_their_mean_reward():
    task = Scenario(n_vehicles=3, n_obstacles=1, max_cycles=5, motion_lag=0.2)
    plain, repeating = parallel_env(task), parallel_env(task, action_repeat=2)
    plain.reset(seed=0), repeating.reset(seed=0)
    rng = np.random.default_rng(0)
    for periods in (2, 2, 1):  # the last step ends with the episode
        actions = {name: rng.uniform([0, -3], [0.15, 3]).astype(np.float32) for name in repeating.agents}
        steps = [plain.step(actions) for _ in range(periods)]
        observations, rewards, _, truncations, infos = repeating.step(actions)
        for name in observations:
            np.testing.assert_array_equal(observations[name], steps[-1][0][name])
            assert rewards[name] == pytest.approx(np.mean([step[1][name] for step in steps]), abs=1e-12)
            assert sum(infos[name]["reward_terms"].values()) == pytest.approx(rewards[name])
            assert infos[name]["metrics"] == steps[-1][-1][name]["metrics"]
        assert truncations == steps[-1][3]
    assert not repeating.agents


def test_a_repetition_that_is_not_a_positive_number_is_refused():
    with pytest.raises(SettingsError, match="action_repeat = 0"):
        parallel_env(action_repeat=0)
