"""Motion channels: the difference to what was sensed ``motion_lag`` ago, in the present body frame."""

import numpy as np
import pytest

from sb3_flock import flocking_v0
from sb3_flock.config.training import TrainingConfig
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, World, episode_rng, observe
from sb3_flock.sim.sensing import find_contacts
from sb3_flock.sim.sensors import SensorErrors
from tests.helpers import assert_copy_continues_alike

CROWD = Scenario(n_vehicles=8, n_obstacles=4, arena=0.3, obstacle_arena=0.4, motion_lag=0.3)


def simulated(scenario, steps, n_flocks=2, standing=()):
    """What is measured at the start and after each step of random actions, and the world's states then."""
    world = World(scenario, n_flocks)
    rng = np.random.default_rng(0)
    measured = [world.sensors.measure(world.reset([episode_rng(0, episode) for episode in range(n_flocks)]))]
    states = [world.state_dict()]
    for _ in range(steps):
        actions = rng.uniform(world.action_low, world.action_high, (n_flocks, scenario.n_vehicles, 2))
        actions[:, list(standing)] = 0.0
        measured.append(world.sensors.measure(world.step(actions)[0]))
        states.append(world.state_dict())
    return measured, states


def test_previous_contacts_are_at_their_previous_positions_in_the_present_frame():
    measured, states = simulated(CROWD, 8)
    assert all(sum(len(getattr(now.previous, kind).bodies) for now in measured) for kind in ("neighbors", "obstacles"))
    for step, now in enumerate(measured):
        then, here = states[max(0, step - 3)], states[step]
        headings = here["headings"]
        frames = np.stack((np.cos(headings), np.sin(headings)), axis=-1)
        for contacts, bodies, sensing_range, exclude_self in (
            (now.previous.neighbors, then["positions"], 0.15, True),
            (now.previous.obstacles, then["obstacle_positions"], 0.25, False),
        ):
            in_range_then = find_contacts(then["positions"], frames, bodies, sensing_range, exclude_self)
            seen_from_here = find_contacts(here["positions"], frames, bodies, np.inf)
            pairs = {
                (observer, body): position
                for observer, body, position in zip(
                    seen_from_here.observers.tolist(),
                    seen_from_here.bodies.tolist(),
                    seen_from_here.positions,
                    strict=True,
                )
            }
            assert len(contacts.bodies) == len(in_range_then.bodies)
            expected = [pairs[pair] for pair in zip(contacts.observers.tolist(), contacts.bodies.tolist(), strict=True)]
            np.testing.assert_allclose(contacts.positions, np.reshape(expected, (-1, 2)), atol=1e-12)
            np.testing.assert_array_equal(contacts.observers, in_range_then.observers)
        offsets = then["waypoints"][:, None] - here["positions"]
        x = (offsets * frames).sum(-1)
        np.testing.assert_allclose(now.previous.waypoint_positions[..., 0], x, atol=1e-12)
        np.testing.assert_allclose(now.previous.waypoint_distances, np.linalg.norm(offsets, axis=-1), atol=1e-12)


def test_a_body_at_rest_is_0_in_the_motion_channels_whoever_moves():
    still = CROWD.replace(n_vehicles=4, obstacle_max_speed=0.0, waypoint_speed=0.0, goal_radius=10.0, link_range=9.0)
    still = still.replace(detection_range=9.0, neighbor_radius=0.5, obstacle_radius=0.5)
    measured, _ = simulated(still, 5, standing=(1, 2, 3))
    observations = observe(measured[-1], still)
    np.testing.assert_allclose(observations[:, 0, 3:], 0.0, atol=1e-6)  # vehicle 0 moves and observes bodies at rest
    assert np.abs(observations[:, 1:, 3]).max() > 0.05  # the others are at rest and observe vehicle 0


def test_motion_channels_are_the_difference_of_two_observations_and_the_first_channels_stay():
    measured, _ = simulated(CROWD, 6)
    plain, _ = simulated(CROWD.replace(motion_lag=0.0), 6)
    for now, alone in zip(measured, plain, strict=True):
        observations = observe(now, CROWD)
        assert observations.shape[2:] == CROWD.observation_shape == (6, 11, 11)
        present = observe(alone, CROWD.replace(motion_lag=0.0))
        np.testing.assert_array_equal(observations[:, :, :3], present)
        previous = observe(now.previous, CROWD.replace(motion_lag=0.0))
        np.testing.assert_allclose(observations[:, :, 3:], present - previous, atol=1e-6)
        np.testing.assert_allclose(observe(now, CROWD, use_numba=False), observations, atol=1e-5)
    np.testing.assert_array_equal(observe(measured[0], CROWD)[:, :, 3:], 0.0)


@pytest.mark.parametrize(("motion_lag", "time_step", "steps"), [(0.0, 0.1, 0), (0.2, 0.1, 2), (0.3, 0.1, 3), (0.2, 0.2, 1)])
def test_the_motion_lag_is_a_whole_number_of_steps(motion_lag, time_step, steps):
    assert Scenario(motion_lag=motion_lag, time_step=time_step).motion_lag_steps == steps


def test_a_delay_applies_to_the_present_and_the_previous_measurement():
    late, on_time = (simulated(CROWD.replace(sensors=SensorErrors(delay=delay)), 6)[0] for delay in (0.2, 0.0))
    for step, measured in enumerate(late):
        np.testing.assert_array_equal(observe(measured, CROWD), observe(on_time[max(0, step - 2)], CROWD))


def test_an_env_continues_from_its_state():
    env = flocking_v0.parallel_env(CROWD.replace(sensors=SensorErrors(position_noise=0.01, dropout=0.2, delay=0.1)))
    env.reset(seed=2)
    actions = dict.fromkeys(env.agents, np.array([0.1, 0.5], dtype=np.float32))
    for _ in range(4):
        env.step(actions)
    assert_copy_continues_alike(env, actions, steps=5)


def test_mistakes_are_one_line():
    with pytest.raises(SettingsError, match="motion_lag = -0.1: input should be greater than or equal to 0"):
        Scenario(motion_lag=-0.1)
    for motion_lag in (0.01, 0.25):
        with pytest.raises(SettingsError, match=f"motion_lag = {motion_lag}: input should be a multiple of time_step = 0.1"):
            Scenario(motion_lag=motion_lag)
    for motion_lag in (0.1, 0.3):
        with pytest.raises(
            SettingsError, match=f"motion_lag = {motion_lag}: .* multiple of 0.2 s, the training env's sampling period"
        ):
            TrainingConfig(scenario=Scenario(motion_lag=motion_lag), train_env={"time_step_scale": 2.0})
