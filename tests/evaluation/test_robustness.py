import io

import pytest
from rich.console import Console

from sb3_flock import Scenario, load_policy
from sb3_flock.cli import main
from sb3_flock.controllers import make_controller
from sb3_flock.evaluation.robustness import (
    conditions,
    errors_table,
    evaluate_robustness,
    sensor_errors,
)
from sb3_flock.sim.actuators import Actuators
from sb3_flock.sim.sensors import SensorErrors


@pytest.fixture(scope="module")
def rows():
    """Without the safety filter, so that there are violations."""
    policy = load_policy("ddpg")
    unfiltered = policy.scenario.replace(n_vehicles=3, n_obstacles=1, max_cycles=100, safety_filter="off")
    return evaluate_robustness(policy, unfiltered, episodes=20)


def test_a_policy_tracks_worse_with_much_noise_than_with_none(rows):
    assert rows["none"]["tracking_error"].mean < rows["noise of 0.04 m"]["tracking_error"].mean
    assert rows["none"]["neighbor_violation_rate"].mean < rows["50% of detections missed"]["neighbor_violation_rate"].mean


def test_errors_follow_the_scenario():
    field = sensor_errors(Scenario(link_range=6.0, time_step=0.5))
    assert field["noise of 0.2 m"].position_noise == 0.2
    assert field["delay of 4 s"].delay == 4.0
    assert field.keys() >= {"none", "10% of detections missed", "noise of 1.6 m", "delay of 0.5 s"}


def test_a_condition_is_what_its_name_says():
    sensors = {name: scenario.sensors for name, scenario in conditions(Scenario()).items()}
    assert sensors["odometry error of 10%"].odometry_noise == 0.1
    assert sensors["field of view of 180 deg"].field_of_view == pytest.approx(3.14159, abs=1e-4)
    assert sensors["10% of detections missed"].dropout == 0.1
    assert sensors["none"] == SensorErrors()


def test_the_table_fits_80_columns(rows):
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(errors_table(rows))
    shown = console.export_text().splitlines()
    assert len([line for line in shown if line.strip()]) == 3 + len(rows)  # two lines of headings and a rule
    assert not any("…" in line for line in shown)
    assert any(line.split()[:1] == ["conditions"] for line in shown)


def test_the_command(capsys):
    words = ["evaluate", "--controller", "go-to-waypoint", "--robustness", "--episodes", "2", "--set", "max_cycles=4"]
    assert main([*words, "--set", "safety_filter=announce"]) == 0
    shown, error = capsys.readouterr()
    for row in ("delay of 0.8 s", "speed lag of 0.3 s", "acceleration of 0.3 m/s^2", "slip of 5%", "field conditions"):
        assert row in shown
    assert error == ""  # rows without a guarantee are what was asked for


def test_the_flags_old_name_works_with_one_line(capsys):
    words = ["evaluate", "--controller", "go-to-waypoint", "--sensors", "--episodes", "1", "--set", "max_cycles=2"]
    assert main(words) == 0
    shown, error = capsys.readouterr()
    assert "field conditions" in shown
    assert error == "sb3-flock: warning: --sensors is now --robustness; the old name works for one release\n"


def test_each_condition_changes_one_thing_and_the_field_several():
    rows = conditions(Scenario(sensors={"dropout": 0.5}, actuators={"slip": 0.5}))
    assert next(iter(rows)) == "none"
    for name, row in rows.items():
        changed = [
            f"{group}.{field}"
            for group, exact in (("sensors", SensorErrors()), ("actuators", Actuators()))
            for field in type(exact).model_fields
            if getattr(getattr(row, group), field) != getattr(exact, field)
        ]
        expected = {"none": 0, "field conditions": 5}.get(name, 1)
        assert len(changed) == expected, (name, changed)
    field = rows["field conditions"]
    assert field.sensors == SensorErrors(position_noise=0.01, dropout=0.1, delay=0.1)
    assert field.actuators == Actuators(speed_lag=0.1, slip=0.05)
    assert [rows[f"acceleration of {value} m/s^2"].actuators.max_acceleration for value in ("1", "0.3")] == [1.0, 0.3]
    assert [rows[f"speed lag of {value} s"].actuators.speed_lag for value in ("0.1", "0.3")] == [0.1, 0.3]


def test_conditions_follow_the_scenario():
    rows = conditions(Scenario(link_range=6.0, neighbor_separation=3.0, time_step=0.5, max_speed=1.5))
    assert rows["speed lag of 1.5 s"].actuators.speed_lag == 1.5
    assert rows["acceleration of 2 m/s^2"].actuators.max_acceleration == 2.0
    assert rows["field conditions"].sensors.position_noise == 0.4


def test_every_condition_has_an_effect():
    """On a controller that uses what it measures of others and of itself; the first row is the scenario itself."""
    rows = evaluate_robustness(
        make_controller("orca"), Scenario(n_vehicles=6, n_obstacles=25, arena=0.7, obstacle_arena=0.5, max_cycles=40), 2
    )
    exact = rows.pop("none")
    for name, row in rows.items():
        assert row["return"] != exact["return"], name
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(errors_table({"none": exact, **rows}))
    assert not any("…" in line for line in console.export_text().splitlines())
