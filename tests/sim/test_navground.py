import numpy as np
import pytest

from tests.sim.simulator_contract import SimulatorContract, simulate

pytest.importorskip("navground")


class TestContract(SimulatorContract):
    name = "navground"


def test_the_drive_bounds_the_acceleration():
    speeds, _ = simulate("navground", [(0, 0, 0)], [(0.15, 0)] * 10 + [(0, 0)] * 10, actuators={"max_acceleration": 0.3})
    np.testing.assert_allclose(np.diff(speeds[1:5, 0]), 0.03, atol=1e-4)
    np.testing.assert_allclose(speeds[9, 0], 0.15, atol=1e-3)
    np.testing.assert_allclose(np.diff(speeds[10:14, 0]), -0.03, atol=2e-3)
    np.testing.assert_allclose(speeds[19, 0], 0.0, atol=1e-3)


def test_a_vehicle_brakes_while_it_turns():
    speeds, poses = simulate(
        "navground", [(0, 0, 0)], [(0.15, 0)] * 10 + [(0, 3.0)] * 10, actuators={"max_acceleration": 0.3}
    )
    np.testing.assert_allclose(np.diff(speeds[10:14, 0]), -0.03, atol=2e-3)
    bound = 4 * 0.3 / 0.053  # [rad/s^2]
    assert poses[19, 0, 2] == pytest.approx(3.0 - 3.0**2 / (2 * bound), abs=0.06)


def test_the_turn_acceleration_is_bounded():
    _, poses = simulate("navground", [(0, 0, 0)], [(0, 1.0)] * 10, actuators={"max_turn_acceleration": 2.0})
    assert poses[-1, 0, 2] == pytest.approx(1.0 - 1.0**2 / (2 * 2.0), abs=0.03)
