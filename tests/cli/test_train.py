import signal
import subprocess
import sys
import time

import pytest
import yaml

from sb3_flock.cli import main
from sb3_flock.config.training import TrainEnvConfig
from sb3_flock.rl.registry import ALGORITHMS, register_algorithm
from tests.cli.conftest import TINY


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


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--n-vehicles", "0"], ["n_vehicles = '0'", "greater than or equal to 1"]),
        (["--n-vehicles", "many"], ["n_vehicles = 'many'", "integer"]),
        (["-n", "1.5"], ["total_timesteps = '1.5'", "integer"]),
        (["--algo", "ppo"], ["algo = 'ppo'", *ALGORITHMS]),
        (["--obstacle-motion", "siege"], ["obstacle_motion = siege", "walk, crossing"]),
        (["--set", "train_env.expert=magic"], ["train_env.expert = 'magic'", "mpc, olfati-saber, orca or null"]),
        (["--expert", "magic"], ["train_env.expert = 'magic'", "mpc, olfati-saber, orca or null"]),
        (["--expert", "mpc", "--algo", "td3"], ["algorithm.bc_coef = 10.0", "input should be 0 without algo ddpg"]),
        (["--set", "gama=0.9"], ["gama is not a parameter", "did you mean algorithm.gamma?"]),
        (["--set", "gamma"], ["--set gamma", "KEY=VALUE"]),
        (["--set", "n_anchors=5"], ["FlockCNN", "do not fit"]),
        (["--seed", "4294967296"], ["seed"]),
        (["--config", "no/such.yaml"], ["no/such.yaml", "No such file"]),
        (["--device", "abacus"], ["device = 'abacus'"]),
        (["--init-from", "no/such.zip"], ["no/such.zip", "no such file"]),
        (["--output-dir", "/dev/null/x"], ["output_dir = /dev/null/x"]),
        (["--n-vehicles", "400"], ["n_vehicles = 400", "no start"]),
        (["--resume", "no/such"], ["no/such", "not a run folder"]),
        (["--resume", "x", "--config", "y"], ["--resume and --config"]),
    ],
)
def test_a_users_mistake_is_one_line_and_exit_code_2(words, expected, fails, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fails(["train", *words], *expected)


def test_help_says_what_n_vehicles_is_and_lists_every_algorithm(capsys, monkeypatch):
    monkeypatch.setattr("sb3_flock.rl.registry.ALGORITHMS", dict(ALGORITHMS))
    register_algorithm("plugin", ALGORITHMS["td3"])
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    shown = " ".join(capsys.readouterr().out.split())
    assert "learning algorithm: ddpg, ddpg-sb3, td3, sac, plugin [ddpg]" in shown
    (size,) = TrainEnvConfig().flock_sizes
    assert f"number of vehicles of the task (paper: 3 or 5); the training env has flocks of {size}, unless " in shown
    assert "--expert mpc or --set train_env.flock_sizes=null [3]" in shown
    assert "expert to learn from: mpc, olfati-saber, orca; mpc also sets what such a training needs" in shown
    assert "the others set train_env.expert alone [none]" in shown


def test_ctrl_c_leaves_a_checkpoint_and_exits_130(tmp_path):
    words = ["train", "--total-timesteps", "1e7", "--output-dir", str(tmp_path), "--eval-freq", "0", *TINY]
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
