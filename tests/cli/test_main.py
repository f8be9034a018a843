import json
import os
import signal
import subprocess
import sys
import time

import pytest
import yaml

from sb3_flock.cli import main

SETTINGS = ("learning_starts=60", "n_eval_episodes=2", "buffer_size=500", "max_cycles=20", "n_test_episodes=3")
TINY = [word for setting in SETTINGS for word in ("--set", setting)]


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """A run folder made by the command itself."""
    out = tmp_path_factory.mktemp("out")
    words = [
        "train",
        "--n-vehicles",
        "2",
        "--n-obstacles",
        "1",
        "--total-timesteps",
        "200",
        "--n-flocks",
        "2",
        "--seed",
        "3",
    ]
    assert main([*words, "--eval-freq", "100", "--output-dir", str(out), *TINY]) == 0
    return out / "ddpg_2v1o_1"


def fails(capsys, words, *expected):
    """The command ends with exit code 2 and one line on stderr that holds the expected words."""
    try:
        code = main(words)
    except SystemExit as stop:  # argparse's own
        code = stop.code
    captured = capsys.readouterr()
    assert code == 2
    assert captured.err.count("\n") == 1
    assert "Traceback" not in captured.err
    for word in expected:
        assert word in captured.err


def test_train_leaves_a_run_folder_prints_the_table_and_the_path_last(tmp_path, capsys):
    words = ["train", "--n-vehicles", "3", "--n-obstacles", "1", "--total-timesteps", "120", "--n-flocks", "2"]
    assert main([*words, "--algo", "td3", "--output-dir", str(tmp_path), *TINY, "--set", "reward.lambda_=0.5"]) == 0
    lines = capsys.readouterr().out.splitlines()
    folder = tmp_path / "td3_3v1o_1"
    assert lines[-1] == str(folder)
    assert any("tracking_error" in line and "0.080" in line and "0.125" in line for line in lines)  # the paper's two tables
    config = yaml.safe_load((folder / "config.yaml").read_text())
    assert config["scenario"]["reward"]["lambda_"] == 0.5
    assert config["algorithm"]["learning_starts"] == 60
    assert (folder / "command.txt").read_text().startswith("sb3-flock train --n-vehicles 3 --n-obstacles 1 ")


def test_flags_win_over_the_config_file(tmp_path, capsys):
    file = tmp_path / "config.yaml"
    file.write_text("scenario:\n  n_vehicles: 7\nalgo: sac\n")
    assert main(["config", "--config", str(file), "--n-vehicles", "4"]) == 0
    printed = yaml.safe_load(capsys.readouterr().out)
    assert (printed["scenario"]["n_vehicles"], printed["algo"]) == (4, "sac")


def test_evaluate_takes_zip_and_run_folder_and_repeats_to_the_last_digit(run_folder, tmp_path, capsys):
    for name, policy in (("a", run_folder), ("b", run_folder / "best_model.zip")):
        assert main(["evaluate", str(policy), "--episodes", "7", "--seed", "5", "--json", str(tmp_path / name)]) == 0
    first, second = (json.loads((tmp_path / name).read_text()) for name in "ab")
    assert first["metrics"] == second["metrics"]
    assert first["meta"]["episodes"] == 7
    assert first["meta"]["scenario"]["n_vehicles"] == 2
    assert set(first["metrics"]["tracking_error"]) == {"mean", "low", "high", "n"}
    assert "tracking_error" in capsys.readouterr().out


def test_evaluate_flies_another_number_of_vehicles_and_says_where_the_scenario_differs(run_folder, capsys):
    words = ["evaluate", str(run_folder), "--episodes", "2", "--n-vehicles", "5", "--n-obstacles", "2"]
    assert main(words) == 0
    captured = capsys.readouterr()
    assert "5 vehicles, 2 obstacles" in captured.out
    assert "0.147" in captured.out  # the paper's row for (5, 2)
    assert captured.err == ""
    assert main([*words, "--set", "link_range=0.3"]) == 0
    assert "trained with link_range = 0.15, flown with 0.3" in capsys.readouterr().err


def test_evaluate_flies_a_hand_written_law_too(tmp_path, capsys):
    file = tmp_path / "result.json"
    words = ["evaluate", "--controller", "olfati-saber", "--n-vehicles", "4", "--scenario", "crossing", "--episodes", "2"]
    assert main([*words, "--json", str(file)]) == 0
    assert "olfati-saber:\n4 vehicles, 1 obstacle," in capsys.readouterr().out
    meta = json.loads(file.read_text())["meta"]
    assert meta["controller"] == "olfati-saber"
    assert meta["scenario"]["obstacle_motion"] == "crossing"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["train", "--n-vehicles", "0"], ["n_vehicles = '0'", "greater than or equal to 1"]),
        (["train", "--n-vehicles", "many"], ["n_vehicles = 'many'", "integer"]),
        (["train", "--algo", "ppo"], ["algo = 'ppo'", "ddpg"]),
        (["train", "--set", "gama=0.9"], ["gama is not a parameter", "did you mean algorithm.gamma?"]),
        (["train", "--set", "gamma"], ["--set gamma", "KEY=VALUE"]),
        (["train", "--set", "n_anchors=5"], ["FlockCNN", "do not fit"]),
        (["train", "--seed", "4294967296"], ["seed"]),
        (["train", "--config", "no/such.yaml"], ["no/such.yaml", "No such file"]),
        (["train", "--device", "abacus"], ["device = 'abacus'"]),
        (["train", "--init-from", "no/such.zip"], ["no/such.zip", "no such file"]),
        (["train", "--output-dir", "/dev/null/x"], ["output_dir = /dev/null/x"]),
        (["train", "--n-vehicles", "400"], ["n_vehicles = 400", "no start"]),
        (["train", "--n-vehicle", "3"], ["unrecognized arguments"]),
        (["evaluate"], ["POLICY or --controller NAME"]),
        (["evaluate", "x.zip", "--controller", "orca"], ["not both"]),
        (["evaluate", "--controller", "boids"], ["controller = 'boids'", "olfati-saber"]),
        (["evaluate", "--controller", "random", "--scenario", "siege"], ["obstacle_motion = 'siege'", "crossing"]),
        (["evaluate", "no/such.zip"], ["no/such.zip", "no such file or run folder"]),
        (["evaluate", __file__], ["damaged or not a policy file"]),
        (["evaluate", os.path.dirname(__file__)], ["no best_model.zip"]),
        (["fly"], ["invalid choice: 'fly'"]),
        ([], ["COMMAND"]),
    ],
)
def test_a_users_mistake_is_one_line_and_exit_code_2(words, expected, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fails(capsys, words, *expected)


@pytest.mark.parametrize(
    ("extra", "expected"),
    [
        (["--episodes", "0"], ["--episodes", "at least 1"]),
        (["--seed", "-1"], ["--seed", "at least 0"]),
        (["--n-vehicles", "0"], ["n_vehicles = '0'"]),
        (["--json", "no/such/folder.json"], ["--json", "no folder"]),
        (["--set", "n_anchors=9"], ["(3, 11, 11)", "n_anchors = 9"]),
        (["--set", "speed=9"], ["speed is not a parameter"]),
        (["--device", "abacus"], ["device"]),
    ],
)
def test_evaluates_mistakes_too(run_folder, extra, expected, capsys):
    fails(capsys, ["evaluate", str(run_folder), "--episodes", "2", *extra], *expected)


@pytest.mark.parametrize(
    "words", [["--help"], ["train", "--help"], ["evaluate", "--help"], ["reproduce", "--help"], ["config", "--help"]]
)
def test_help_fits_a_screen_and_gives_an_example(words, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 0
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 80
    assert len(shown.splitlines()) <= 55
    assert "example: sb3-flock" in shown


def test_the_command_is_installed_and_help_needs_no_torch():
    command = os.path.join(os.path.dirname(sys.executable), "sb3-flock")
    shown = subprocess.run([command, "--version"], capture_output=True, text=True, check=True)
    assert shown.stdout.startswith("sb3-flock 0.")
    code = "import sys; from sb3_flock.cli import _parser; _parser(); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_ctrl_c_leaves_a_checkpoint_and_exits_130(tmp_path):
    words = ["train", "--total-timesteps", "10000000", "--output-dir", str(tmp_path), "--eval-freq", "0", *TINY]
    # A background job inherits an ignored SIGINT, and so would its children: have the handler set as in a terminal.
    code = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code += "from sb3_flock.cli import main; sys.exit(main(sys.argv[1:]))"
    process = subprocess.Popen([sys.executable, "-c", code, *words], stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 120
        while not list(tmp_path.glob("ddpg_3v1o_1/progress.csv")) and time.monotonic() < deadline:
            time.sleep(0.2)
        time.sleep(2)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 130
    assert "interrupted" in errors
    assert "Traceback" not in errors
    assert len(list((tmp_path / "ddpg_3v1o_1").glob("rl_model_*_steps.zip"))) == 1
