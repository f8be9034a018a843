import json

import pytest

from sb3_flock.cli import main


def test_evaluate_takes_zip_and_run_folder_and_repeats_to_the_last_digit(run_folder, tmp_path, capsys):
    for name, policy, flag in (("a", run_folder, "--episodes"), ("b", run_folder / "best_model.zip", "--n-eval-episodes")):
        assert main(["evaluate", str(policy), flag, "7", "--seed", "5", "--output", str(tmp_path / name)]) == 0
    first, second = (json.loads((tmp_path / name).read_text()) for name in "ab")
    assert first["metrics"] == second["metrics"]
    assert first["meta"]["episodes"] == 7
    assert first["meta"]["scenario"]["n_vehicles"] == 2
    assert set(first["metrics"]["tracking_error"]) == {"mean", "low", "high", "n"}
    assert "tracking_error" in capsys.readouterr().out


def test_evaluate_simulates_another_number_of_vehicles_and_says_where_the_scenario_differs(run_folder, capsys):
    words = ["evaluate", str(run_folder), "--episodes", "2", "--n-vehicles", "5", "--n-obstacles", "2"]
    assert main(words) == 0
    captured = capsys.readouterr()
    assert "5 vehicles, 2 obstacles" in captured.out
    assert "0.147" in captured.out  # the paper's row for (5, 2)
    assert captured.err == ""
    assert main([*words, "--set", "link_range=0.3"]) == 0
    error = capsys.readouterr().err
    assert error.startswith("sb3-flock: warning: ")
    assert "trained with link_range = 0.15, evaluated with 0.3; " in error
    assert error.count("\n") == 1


def test_evaluate_simulates_a_baseline_controller_too(tmp_path, capsys):
    file = tmp_path / "result.json"
    words = ["evaluate", "--controller", "olfati-saber", "--n-vehicles", "4", "--obstacle-motion", "crossing"]
    assert main([*words, "-n", "2e0", "-o", str(file)]) == 0
    assert "olfati-saber:\n4 vehicles, 1 obstacle, 2 episodes" in capsys.readouterr().out
    meta = json.loads(file.read_text())["meta"]
    assert meta["controller"] == "olfati-saber"
    assert meta["scenario"]["obstacle_motion"] == "crossing"


def test_a_policys_old_name_works_with_one_line(capsys, monkeypatch):
    monkeypatch.setattr("sb3_flock.cli.shared.evaluate_and_print", lambda *args, **kwargs: {})
    assert main(["evaluate", "second-look-3v1o"]) == 0
    assert capsys.readouterr().err == (
        "sb3-flock: warning: policy second-look-3v1o is now flock, with its own task and the safety filter; "
        "the old name works for one release\n"
    )


@pytest.mark.parametrize(
    ("extra", "expected"),
    [
        (["--episodes", "0"], ["--episodes", "at least 1"]),
        (["--episodes", "1.5"], ["--episodes", "1.5: an integer of at least 1"]),
        (["--seed", "-1"], ["--seed", "at least 0"]),
        (["--n-vehicles", "0"], ["n_vehicles = '0'"]),
        (["--output", "no/such/folder.json"], ["--output no/such/folder.json: there is no folder"]),
        (["--output", "/dev/full"], ["--output /dev/full: No space left"]),
        (["--set", "n_anchors=9"], ["(3, 11, 11)", "n_anchors = 9"]),
        (["--set", "speed=9"], ["speed is not a parameter"]),
        (["--device", "abacus"], ["device"]),
        (["--simulator", "mujocco"], ["--simulator mujocco: one of mujoco, navground is needed; did you mean mujoco?"]),
        (["--simulator", "mujoco", "--robustness"], ["--robustness: the simulator mujoco has dynamics of its own"]),
    ],
)
def test_a_users_mistake_is_one_line_and_exit_code_2(run_folder, extra, expected, fails):
    fails(["evaluate", str(run_folder), "--episodes", "2", *extra], *expected)
