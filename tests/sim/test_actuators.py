import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario
from sb3_flock.sim.actuators import Actuators, follow
from sb3_flock.sim.randomization import UNBOUNDED

RATES = st.floats(-3, 3)


def one(rate, command, lag, bound, dt):
    return [float(value) for value in follow(*map(np.float64, (rate, command, lag, bound)), dt)]


def integrated(rate, command, lag, bound, dt, n=20_000):
    """The same by many small steps."""
    distance = 0.0
    for _ in range(n):
        change = np.clip((command - rate) / lag, -bound, bound) * dt / n
        distance += (rate + change / 2) * dt / n
        rate += change
    return rate, distance


@pytest.mark.parametrize(
    ("rate", "command", "lag", "bound"),
    [
        (0.0, 0.15, 0.3, UNBOUNDED),
        (0.15, 0.0, 0.1, 0.3),
        (0.1, 0.15, 0.02, 1.0),
        (-2.0, 3.0, 0.1, 8.0),
        (0.1, 0.1, 0.2, 1.0),
    ],
)
def test_a_step_is_the_solution_of_the_differential_equation(rate, command, lag, bound):
    np.testing.assert_allclose(one(rate, command, lag, bound, 0.1), integrated(rate, command, lag, bound, 0.1), atol=2e-5)


def test_without_lag_and_bound_the_command_is_followed_at_once():
    assert one(0.02, 0.13, 0.0, UNBOUNDED, 0.1) == [0.13, 0.13 * 0.1]


def test_a_bound_alone_is_a_ramp():
    np.testing.assert_allclose(one(0.0, 1.0, 0.0, 2.0, 0.1), [0.2, 0.01])
    np.testing.assert_allclose(one(0.0, 1.0, 0.0, 20.0, 0.1), [1.0, 0.025 + 0.05])  # 0.05 s up, 0.05 s at 1


@settings(max_examples=200, deadline=None)
@given(RATES, RATES, st.floats(0, 2), st.floats(0.01, 100), st.floats(0.01, 1), st.integers(2, 5))
def test_the_length_of_the_steps_changes_nothing_while_the_command_stays(rate, command, lag, bound, dt, n):
    whole, distance, parts = one(rate, command, lag, bound, dt), 0.0, rate
    for _ in range(n):
        parts, part = one(parts, command, lag, bound, dt / n)
        distance += part
    np.testing.assert_allclose([parts, distance], whole, atol=1e-9)


@settings(max_examples=200, deadline=None)
@given(RATES, RATES, st.floats(0, 2), st.floats(0.01, 100))
def test_a_rate_converges_to_its_command_and_never_passes_it_or_its_bound(rate, command, lag, bound):
    for _ in range(40):
        before = rate
        rate, distance = one(rate, command, lag, bound, 0.1)
        assert abs(rate - before) <= bound * 0.1 + 1e-12
        assert min(before, command) - 1e-12 <= rate <= max(before, command) + 1e-12
        assert min(before, rate) - 1e-9 <= distance / 0.1 <= max(before, rate, command) + 1e-9 or command < before
    if lag <= 0.2 and bound >= 2:
        assert rate == pytest.approx(command, abs=1e-5)


@pytest.mark.parametrize(
    ("name", "value"), [("speed_lag", -0.1), ("slip", 1.5), ("max_acceleration", 0.0), ("disturbance", float("nan"))]
)
def test_mistakes_are_one_line(name, value):
    with pytest.raises(SettingsError, match=f"actuators.{name} = .*: input should be"):
        Scenario(actuators={name: value})


def test_every_field_has_its_unit_and_the_papers_value():
    for name, field in Actuators.model_fields.items():
        assert "(paper: " in field.description, name
        assert "[" in field.description or "relative" in field.description, name
