import numpy as np
import pytest

from sb3_flock import flocking_v0
from sb3_flock.controllers import Controller, make_controller
from sb3_flock.evaluation import evaluate
from sb3_flock.evaluation.rollout import rollout
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, World, episode_rng
from sb3_flock.sim.sensors import SensorErrors
from tests.helpers import assert_copy_continues_alike

CROWD = Scenario(n_vehicles=12, n_obstacles=6, arena=0.35, obstacle_arena=0.6)


def begin(scenario, n_flocks=1, first=0):
    world = World(scenario, n_flocks)
    return world, world.reset([episode_rng(0, episode) for episode in range(first, first + n_flocks)])


def with_errors(**errors):
    return CROWD.replace(sensors=SensorErrors(**errors))


def test_exact_sensors_measure_the_truth_and_draw_nothing():
    world, truth = begin(CROWD)
    assert world.sensors.measure(truth) is truth
    other, _ = begin(with_errors(position_noise=0.01))
    np.testing.assert_array_equal(world.positions, other.positions)  # errors change no start
    np.testing.assert_array_equal(world.obstacle_speeds, other.obstacle_speeds)


def test_everything_measured_has_noise_of_the_set_standard_deviation():
    world, truth = begin(with_errors(position_noise=0.02), n_flocks=200)
    measured = world.sensors.measure(truth)
    for contacts, exact in ((measured.neighbors, truth.neighbors), (measured.obstacles, truth.obstacles)):
        np.testing.assert_array_equal(contacts.bodies, exact.bodies)
        error = contacts.positions - exact.positions
        assert error.std() == pytest.approx(0.02, rel=0.05)
        assert abs(error.mean()) < 0.002
        np.testing.assert_allclose(contacts.distances, np.linalg.norm(contacts.positions, axis=-1))
    error = measured.waypoint_positions - truth.waypoint_positions
    assert error.std() == pytest.approx(0.02, rel=0.05)
    np.testing.assert_allclose(measured.waypoint_distances, np.linalg.norm(measured.waypoint_positions, axis=-1))


def test_the_set_share_of_detections_is_missed_but_never_the_waypoint():
    world, truth = begin(with_errors(dropout=0.3), n_flocks=200)
    measured = world.sensors.measure(truth)
    for contacts, exact in ((measured.neighbors, truth.neighbors), (measured.obstacles, truth.obstacles)):
        assert len(contacts.bodies) / len(exact.bodies) == pytest.approx(0.7, abs=0.03)
        pairs = set(zip(exact.observers.tolist(), exact.bodies.tolist(), strict=True))
        assert set(zip(contacts.observers.tolist(), contacts.bodies.tolist(), strict=True)) < pairs
        assert (np.diff(contacts.observers) >= 0).all()
    np.testing.assert_array_equal(measured.waypoint_positions, truth.waypoint_positions)
    world, truth = begin(with_errors(dropout=1.0))
    assert not len(world.sensors.measure(truth).neighbors.bodies)


def test_a_measurement_is_used_after_the_delay():
    world, truth = begin(with_errors(delay=0.3))
    seen = [truth]
    for step in range(8):
        measured = world.sensors.measure(seen[-1])
        np.testing.assert_array_equal(measured.waypoint_positions, seen[max(0, step - 3)].waypoint_positions)
        seen.append(world.step(np.full((1, 12, 2), 0.1))[0])


def test_a_flocks_sensor_errors_do_not_depend_on_the_batch():
    scenario = with_errors(
        position_noise=0.01, dropout=0.2, delay=0.1, field_of_view=4.0, occlusion=0.03, odometry_noise=0.1
    ).replace(motion_lag=0.2)
    many, few = (
        rollout(make_controller("go-to-waypoint"), scenario.replace(max_cycles=20), 6, 0, batch) for batch in (6, 2)
    )
    for name in many:
        np.testing.assert_array_equal(many[name], few[name])


def test_reward_and_metrics_are_of_the_truth():
    class Still(Controller):
        def act(self, sensing, scenario):
            return np.zeros((*sensing.waypoint_distances.shape, 2))

    exact = evaluate(Still(), CROWD, episodes=3)
    assert evaluate(Still(), with_errors(position_noise=0.5, dropout=0.5, delay=1.0), episodes=3) == exact


def test_an_env_shows_what_is_measured_and_continues_from_its_state():
    errors = {"position_noise": 0.02, "dropout": 0.2, "delay": 0.2}
    errors |= {"field_of_view": 5.0, "occlusion": 0.02, "odometry_noise": 0.1}
    env = flocking_v0.parallel_env(with_errors(**errors).replace(motion_lag=0.2))
    exact = flocking_v0.parallel_env(CROWD.replace(motion_lag=0.2))
    observations, _ = env.reset(seed=3)
    truth, _ = exact.reset(seed=3)
    assert any(np.abs(observations[agent] - truth[agent]).max() > 0.1 for agent in env.agents)
    actions = dict.fromkeys(env.agents, np.array([0.1, 0.5], dtype=np.float32))
    _, rewards, *_, infos = env.step(actions)
    _, exact_rewards, *_, exact_infos = exact.step(actions)
    assert rewards == exact_rewards
    assert all(infos[agent]["metrics"] == exact_infos[agent]["metrics"] for agent in env.agents)
    assert_copy_continues_alike(env, actions, steps=4)


def test_sense_is_always_exact():
    world, truth = begin(with_errors(position_noise=0.5))
    np.testing.assert_array_equal(world.sense().waypoint_positions, truth.waypoint_positions)


def test_odometry_has_relative_errors_and_the_motion_channels_use_them():
    scenario = CROWD.replace(motion_lag=0.1, sensors=SensorErrors(odometry_noise=0.2))
    world, truth = begin(scenario, n_flocks=300)
    world.sensors.measure(truth)
    truth, _ = world.step(np.full((300, 12, 2), (0.1, 1.0)))
    measured = world.sensors.measure(truth)
    factors = measured.ego_motion / truth.ego_motion
    np.testing.assert_allclose(factors.std((0, 1)), 0.2, rtol=0.05)
    np.testing.assert_allclose(factors.mean((0, 1)), 1.0, atol=0.01)
    np.testing.assert_array_equal(measured.waypoint_positions, truth.waypoint_positions)
    before = begin(scenario, n_flocks=300)[1]
    expected = before.compensate_ego_motion(measured.ego_motion)
    np.testing.assert_array_equal(measured.previous.waypoint_positions, expected.waypoint_positions)


def test_a_drifting_vehicle_measures_both_parts_of_its_way_with_one_error():
    actuators = {"disturbance": 0.05}
    world, truth = begin(CROWD.replace(sensors=SensorErrors(odometry_noise=0.2), actuators=actuators))
    truth, _ = world.step(np.full((1, 12, 2), (0.1, 1.0)))
    factors = world.sensors.measure(truth).ego_motion / truth.ego_motion
    np.testing.assert_allclose(factors[..., 0], factors[..., 2])
    assert (np.abs(factors[..., 0] - factors[..., 1]) > 1e-6).all()


def test_a_standing_vehicle_measures_that_it_stands():
    world, _ = begin(with_errors(odometry_noise=0.5))
    truth, _ = world.step(np.zeros((1, 12, 2)))
    assert not world.sensors.measure(truth).ego_motion.any()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("position_noise", -1.0),
        ("dropout", 1.1),
        ("delay", float("nan")),
        ("field_of_view", 0.0),
        ("field_of_view", 6.3),
        ("occlusion", -0.1),
        ("odometry_noise", float("inf")),
    ],
)
def test_mistakes_are_one_line(name, value):
    with pytest.raises(SettingsError, match=f"{name} = "):
        SensorErrors(**{name: value})
