import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_flock.controllers import make_controller
from sb3_flock.envs import flocking_v0
from sb3_flock.evaluation.rollout import rollout
from sb3_flock.sim import Scenario, World, episode_rng, unicycle
from tests.helpers import assert_copy_continues_alike, place

EVERYTHING = {
    "speed_lag": 0.2,
    "turn_lag": 0.1,
    "max_acceleration": 0.5,
    "max_turn_acceleration": 10.0,
    "min_speed": 0.02,
    "slip": 0.05,
    "disturbance": 0.01,
}


def driven(scenario, n_flocks=1, steps=40, seed=0, first=0):
    """A world after some random commands, which depend on the flock alone, and every position on its way."""
    world = World(scenario, n_flocks)
    world.reset([episode_rng(seed, first + flock) for flock in range(n_flocks)])
    rngs = [np.random.default_rng([seed, first + flock]) for flock in range(n_flocks)]
    path = [world.positions]
    for _ in range(steps):
        world.step(np.stack([rng.normal(size=(scenario.n_vehicles, 2)) * (0.1, 2.0) for rng in rngs]))
        path.append(world.positions)
    return world, np.stack(path)


def test_the_default_is_the_papers_unicycle_by_the_compiled_code():
    assert World(Scenario()).dynamics.is_plain
    assert not World(Scenario(actuators={"slip": 0.1})).dynamics.is_plain


def test_actuators_that_hardly_act_are_the_papers_unicycle(monkeypatch):
    scenario = Scenario(n_vehicles=4, actuators={"max_acceleration": 1e6})
    assert not World(scenario).dynamics.is_plain
    path, plain = driven(scenario)[1], driven(scenario.replace(actuators={}))[1]
    np.testing.assert_allclose(path, plain, atol=1e-5)


def test_a_speed_with_lag_converges_and_the_distance_is_late_by_the_lag():
    world = place(Scenario(actuators={"speed_lag": 0.3}), [(0.0, 0.0)], [0.0])
    for _ in range(60):
        world.step([[(0.1, 0.0)]])
    assert world.dynamics.rates[0, 0, 0] == pytest.approx(0.1, rel=1e-6)
    assert world.positions[0, 0, 0] == pytest.approx(0.1 * (6.0 - 0.3), rel=1e-6)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31))
def test_no_acceleration_exceeds_its_bound(seed):
    scenario = Scenario(n_vehicles=3, actuators={"max_acceleration": 0.3, "max_turn_acceleration": 5.0, "speed_lag": 0.05})
    world, rng = World(scenario), np.random.default_rng(seed)
    world.reset([episode_rng(seed, 0)])
    for _ in range(50):
        before = world.dynamics.rates
        world.step(rng.normal(size=(1, 3, 2)) * (0.3, 5.0))
        assert (np.abs(world.dynamics.rates - before) <= np.array([0.03, 0.5]) + 1e-12).all()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31))
def test_no_vehicle_is_slower_than_the_minimum_speed_or_faster_than_the_top_speed(seed):
    scenario = Scenario(n_vehicles=3, actuators={"min_speed": 0.05, "speed_lag": 0.1})
    path = driven(scenario, seed=seed)[1]
    strides = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    assert strides.min() >= 0.005 - 1e-12
    assert strides.max() <= 0.015 + 1e-12


def test_slip_and_disturbance_have_their_standard_deviations():
    scenario = Scenario(n_vehicles=4, n_obstacles=0, arena=5.0, actuators={"slip": 0.2})
    world = World(scenario, 500)
    world.reset([episode_rng(0, episode) for episode in range(500)])
    sensing, _ = world.step(np.full((500, 4, 2), (0.1, 0.0)))
    assert sensing.ego_motion[..., 0].std() == pytest.approx(0.2 * 0.01, rel=0.05)
    np.testing.assert_allclose(sensing.ego_motion[..., 1:], 0.0, atol=1e-12)
    world = World(scenario.replace(actuators={"disturbance": 0.03}), 500)
    world.reset([episode_rng(0, episode) for episode in range(500)])
    sensing, _ = world.step(np.full((500, 4, 2), (0.1, 0.5)))
    error = sensing.ego_motion - (0.01, 0.05, 0.0)
    np.testing.assert_allclose(error.std((0, 1)), [0.03 * np.sqrt(0.1), 0.0, 0.03 * np.sqrt(0.1)], rtol=0.05, atol=1e-12)


def test_slip_never_moves_a_vehicle_backwards():
    world = World(Scenario(actuators={"slip": 1.0}), 100)
    world.reset([episode_rng(0, episode) for episode in range(100)])
    forward = world.step(np.full((100, 3, 2), (0.1, 0.0)))[0].ego_motion[..., 0]
    assert forward.min() == pytest.approx(0.0, abs=1e-15)


def test_the_measured_motion_of_a_drifting_vehicle_compensates_it_exactly():
    """A body at rest over ground is seen at rest, whatever pushes the vehicle."""
    scenario = Scenario(motion_lag=0.2, obstacle_max_speed=0.0, actuators=EVERYTHING)
    world = place(scenario, [(0.0, 0.0)], [0.3], obstacles=[(0.1, 0.1)])
    sensing = world.sense()
    for _ in range(5):
        measured = world.sensors.measure(sensing)
        sensing, _ = world.step([[(0.1, 1.5)]])
    measured = world.sensors.measure(sensing)
    np.testing.assert_allclose(measured.previous.obstacles.positions, measured.obstacles.positions, atol=1e-12)


def test_a_flocks_motion_does_not_depend_on_the_batch():
    scenario = Scenario(n_vehicles=4, actuators=EVERYTHING)
    together = driven(scenario, 3)[1]
    for flock in range(3):
        np.testing.assert_array_equal(driven(scenario, first=flock)[1][:, 0], together[:, flock])


def test_metrics_do_not_depend_on_the_batch():
    scenario = Scenario(n_vehicles=4, max_cycles=20, actuators=EVERYTHING)
    many, few = (rollout(make_controller("go-to-waypoint"), scenario, 6, 0, batch) for batch in (6, 2))
    for name in many:
        np.testing.assert_array_equal(many[name], few[name])


def test_noise_changes_no_start_and_exact_actuators_draw_nothing():
    starts = [driven(Scenario(actuators=actuators), steps=0)[1] for actuators in ({}, EVERYTHING)]
    np.testing.assert_array_equal(*starts)
    rngs = [episode_rng(0, 0) for _ in range(2)]
    World(Scenario()).reset(rngs[:1])
    World(Scenario(actuators={"speed_lag": 0.1})).reset(rngs[1:])
    assert rngs[0].bit_generator.state == rngs[1].bit_generator.state


def test_an_env_continues_from_its_state_in_the_middle_of_an_episode():
    env = flocking_v0.parallel_env(Scenario(n_vehicles=4, motion_lag=0.2, actuators=EVERYTHING))
    env.reset(seed=0)
    actions = dict.fromkeys(env.possible_agents, np.array([0.1, 0.5], np.float32))
    for _ in range(5):
        env.step(actions)
    assert_copy_continues_alike(env, actions, 20)


def test_one_flock_of_a_batch_can_be_looked_at():
    env = flocking_v0.parallel_env(Scenario(actuators=EVERYTHING), n_flocks=3)
    env.reset(seed=0)
    for _ in range(4):
        env.step(dict.fromkeys(env.possible_agents, np.array([0.1, 0.5], np.float32)))
    one = env.copy_at(1)
    np.testing.assert_array_equal(one.world.dynamics.rates, env.world.dynamics.rates[1:2])
    np.testing.assert_array_equal(one.world.positions, env.world.positions[1:2])
    commands = np.full((3, 3, 2), 0.1)
    one.world.step(commands[:1])
    env.world.step(commands)
    np.testing.assert_array_equal(one.world.positions, env.world.positions[1:2])


def test_a_world_without_numba_moves_alike(monkeypatch):
    fast = driven(Scenario(n_vehicles=5, actuators=EVERYTHING), 3)[1]
    monkeypatch.setattr(unicycle, "compiled", lambda: None)
    np.testing.assert_allclose(driven(Scenario(n_vehicles=5, actuators=EVERYTHING), 3)[1], fast, atol=1e-12)
