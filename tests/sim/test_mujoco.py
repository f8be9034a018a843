import numpy as np
import pytest

from sb3_flock.settings import RunError
from sb3_flock.sim import Scenario
from sb3_flock.sim.mujoco import MuJoCo
from tests.sim.simulator_contract import SimulatorContract, simulate

pytest.importorskip("mujoco")


class TestContract(SimulatorContract):
    name = "mujoco"


def test_the_wheels_bound_the_acceleration_as_the_actuators_say():
    speeds, _ = simulate("mujoco", [(0, 0, 0)], [(0.15, 0)] * 10 + [(0, 0)] * 10, actuators={"max_acceleration": 0.3})
    np.testing.assert_allclose(
        speeds[:, 0], [*(0.03, 0.06, 0.09, 0.12), *6 * [0.15], *(0.12, 0.09, 0.06, 0.03), *6 * [0]], atol=3e-3
    )


def test_without_a_bound_the_motors_torque_bounds_it():
    speeds, poses = simulate("mujoco", [(0, 0, 0)], [(0.15, 0)] * 10 + [(0, 0)] * 5)
    assert speeds[0, 0] == pytest.approx(0.15, abs=2e-3)
    way = poses[-1, 0, 0] - poses[9, 0, 0]
    assert 0.15**2 / (2 * 5) < way < 0.15**2 / (2 * 3)  # of 3 to 5 m/s^2


def test_a_turn_lags_and_speeds_up_as_the_actuators_say():
    _, poses = simulate("mujoco", [(0, 0, 0)], [(0, 1.0)] * 10, actuators={"max_turn_acceleration": 2.0})
    assert poses[-1, 0, 2] == pytest.approx(1.0 - 1.0**2 / (2 * 2.0), abs=0.01)
    _, poses = simulate("mujoco", [(0, 0, 0)], [(0, 1.0)] * 10, actuators={"turn_lag": 0.2})
    assert poses[-1, 0, 2] == pytest.approx(1.0 - 0.2 * (1 - np.exp(-5)), abs=0.01)


def test_a_minimum_speed_is_kept():
    speeds, _ = simulate("mujoco", [(0, 0, 0)], [(0, 0)] * 5, actuators={"min_speed": 0.1})
    np.testing.assert_allclose(speeds[1:], 0.1, atol=1e-3)


def test_a_vehicle_slips_where_another_one_is_in_its_way():
    """Two vehicles drive against each other with their wheels turning: friction, not the wheels, holds them."""
    _, poses = simulate("mujoco", [(0, 0, 0), (0.12, 0, np.pi)], [(0.15, 0)] * 20)
    assert poses[-1, 1, 0] - poses[-1, 0, 0] == pytest.approx(0.07, abs=1e-3)  # their width
    assert np.abs(poses[-1, :, 0] - (0.025, 0.095)).max() < 2e-3


def test_many_vehicles_in_contact_stay_finite():
    side = np.arange(6) * 0.1
    starts = [(x, y, heading) for heading, (x, y) in enumerate((x, y) for x in side for y in side)]
    _, poses = simulate("mujoco", starts, [(0.15, 1.0)] * 5)
    assert np.isfinite(poses).all()
    assert np.abs(poses[-1, :, :2] - np.array(starts)[:, :2]).max() < 0.1


def test_an_unstable_simulation_ends_in_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    simulator = MuJoCo(Scenario(n_vehicles=1), 1)
    simulator.reset(np.zeros((1, 1, 3)))
    simulator._states[0].qvel[0] = np.nan
    with pytest.raises(RunError, match="mujoco: the simulation is unstable"):
        simulator.step(np.zeros((1, 1, 2)))


def test_flocks_do_not_meet_each_other():
    simulator = MuJoCo(Scenario(n_vehicles=1), 2)
    simulator.reset(np.zeros((2, 1, 3)))
    np.testing.assert_allclose(simulator.step(np.zeros((2, 1, 2))), 0.0, atol=1e-4)
