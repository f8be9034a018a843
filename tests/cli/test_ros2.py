import pytest

from sb3_flock.cli import main

POLICY = "ddpg"


def test_the_node_gets_the_policy_the_task_and_the_arguments_of_ros(monkeypatch, capsys):
    calls = []
    monkeypatch.setattr("sb3_flock.deploy.ros2_node.drive", lambda *args: calls.append(args) or "3 decisions")
    ros = ["-p", "n_vehicles:=8", "-r", "/waypoint:=/goal", "--log-level", "warn"]
    assert main(["ros2", POLICY, "--vehicle", "2", "--set", "safety_filter=heading", "--ros-args", *ros]) == 0
    ((policy, scenario, vehicle, arguments),) = calls
    assert policy.path.stem == POLICY
    assert (scenario.safety_filter, vehicle, arguments) == ("heading", 2, ros)
    assert capsys.readouterr().err == "3 decisions\n"


def test_without_arguments_of_ros_there_are_none(monkeypatch):
    calls = []
    monkeypatch.setattr("sb3_flock.deploy.ros2_node.drive", lambda *args: calls.append(args) or "")
    assert main(["ros2", POLICY, "--vehicle", "0"]) == 0
    assert calls[0][3] == []


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["no/such", "--vehicle", "0"], "no/such: no such file or run folder"),
        ([POLICY], "--vehicle"),
        ([POLICY, "--vehicle", "-1"], "-1: an integer of at least 0 is needed"),
        ([POLICY, "--vehicle", "0", "--set", "safety_filter=yes"], "safety_filter = 'yes': input should be 'off'"),
        ([POLICY, "--vehicle", "0", "--ros-arg", "-p", "rate:=5"], "did you mean --ros-args?"),
    ],
)
def test_a_users_mistake_is_one_line(words, expected, fails):
    fails(["ros2", *words], expected)
