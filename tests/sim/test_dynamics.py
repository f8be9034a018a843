import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_flock.sim.dynamics import DynamicsSettings, directions_of, move, turn, wrap_angle


def test_a_body_moves_along_its_present_heading():
    directions = directions_of(np.array([0.0, np.pi / 2, np.pi]))
    np.testing.assert_allclose(directions, [(1, 0), (0, 1), (-1, 0)], atol=1e-15)
    moved = move(np.array([(0.0, 0.0), (1.0, 1.0), (0.5, 0.0)]), directions, np.array([0.2, 0.1, 0.0]), dt=0.5)
    np.testing.assert_allclose(moved, [(0.1, 0.0), (1.0, 1.05), (0.5, 0.0)], atol=1e-15)


def test_a_heading_turns_by_rate_times_time_and_wraps_around():
    np.testing.assert_allclose(
        turn(np.array([0.0, 3.0, -3.0]), np.array([1.0, 2.0, -2.0]), dt=0.1), [0.1, 3.2 - 2 * np.pi, 2 * np.pi - 3.2]
    )


@given(st.floats(-1e3, 1e3))
def test_a_wrapped_angle_is_the_same_direction_within_its_half_open_interval(angle):
    wrapped = wrap_angle(np.array([angle]))
    assert -np.pi <= wrapped[0] < np.pi
    np.testing.assert_allclose(directions_of(wrapped)[0], (np.cos(angle), np.sin(angle)), atol=1e-9)


@pytest.mark.parametrize(("angle", "wrapped"), [(np.pi, -np.pi), (-np.pi, -np.pi), (0.0, 0.0)])
def test_the_ends_of_the_interval(angle, wrapped):
    assert wrap_angle(np.array(angle)) == wrapped


def test_the_number_of_bodies_in_words():
    assert DynamicsSettings().bodies == "3 vehicles, 1 obstacle"
    assert DynamicsSettings(n_vehicles=1, n_obstacles=0).bodies == "1 vehicle, 0 obstacles"
