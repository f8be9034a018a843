import pytest

from sb3_flock.cli import main


@pytest.mark.parametrize("command", ["play", "enjoy"])
def test_the_window_gets_the_controller_and_the_scenario(command, monkeypatch):
    opened = []
    monkeypatch.setattr("sb3_flock.viz.play.play", lambda *arguments: opened.append(arguments))
    words = ["--n-vehicles", "4", "--set", "arena=2", "--set", "safety_filter=announce", "--seed", "7", "--speed", "3"]
    assert main([command, "--controller", "go-to-waypoint", *words]) == 0
    ((controller, scenario, seed, speed),) = opened
    assert type(controller).__name__ == "GoToWaypoint"
    assert (scenario.n_vehicles, scenario.arena, seed, speed) == (4, 2.0, 7, 3.0)
    assert scenario.safety_filter == "announce"


def test_enjoy_names_itself_in_its_errors(fails):
    fails(["enjoy"], "enjoy: a POLICY or --controller NAME is needed")
