import io

import pytest
from rich.console import Console

from sb3_flock import Scenario, load_policy
from sb3_flock.cli import main
from sb3_flock.evaluation.robustness import errors_table, evaluate_with_errors, sensor_errors


@pytest.fixture(scope="module")
def rows():
    """Without the safety filter, so that there are violations."""
    policy = load_policy("ddpg")
    unfiltered = policy.scenario.replace(n_vehicles=3, n_obstacles=1, max_cycles=100, safety_filter="off")
    return evaluate_with_errors(policy, unfiltered, episodes=20)


def test_a_policy_tracks_worse_with_much_noise_than_with_none(rows):
    assert rows["none"]["tracking_error"].mean < rows["noise of 0.04 m"]["tracking_error"].mean
    assert rows["none"]["neighbor_violation_rate"].mean < rows["50% of detections missed"]["neighbor_violation_rate"].mean


def test_errors_follow_the_scenario():
    field = sensor_errors(Scenario(link_range=6.0, time_step=0.5))
    assert field["noise of 0.2 m"].position_noise == 0.2
    assert field["delay of 4 s"].delay == 4.0
    assert field.keys() >= {"none", "10% of detections missed", "noise of 1.6 m", "delay of 0.5 s"}


def test_the_table_fits_80_columns(rows):
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(errors_table(rows))
    shown = console.export_text().splitlines()
    assert len([line for line in shown if line.strip()]) == 3 + len(rows)  # two lines of headings and a rule
    assert not any("…" in line for line in shown)


def test_the_command(capsys):
    words = ["evaluate", "--controller", "go-to-waypoint", "--sensors", "--episodes", "2", "--set", "max_cycles=4"]
    assert main(words) == 0
    assert "delay of 0.8 s" in capsys.readouterr().out
