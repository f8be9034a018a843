from pathlib import Path

import pytest
import yaml

from sb3_flock.cli import main

RUN = Path(__file__).parent.parent / "data" / "format_2" / "runs" / "ddpg"


def printed(capsys, *words):
    assert main(["config", *words]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    return yaml.safe_load(captured.out)


def write(tmp_path, text):
    file = tmp_path / "config.yaml"
    file.write_text(text)
    return str(file)


def test_flags_win_over_the_config_file(tmp_path, capsys):
    file = write(tmp_path, "scenario:\n  n_vehicles: 7\nalgo: sac\n")
    config = printed(capsys, "--config", file, "--n-vehicles", "4")
    assert (config["scenario"]["n_vehicles"], config["algo"]) == (4, "sac")


@pytest.mark.parametrize("flag", ["-n", "--total-timesteps", "--n-timesteps"])
def test_rl_zoos_flags_are_ours_and_numbers_may_have_an_exponent(flag, capsys):
    config = printed(capsys, flag, "1e5", "-f", "logs", "-i", "flock", "--set", "learning_starts=2e3")
    assert (config["total_timesteps"], config["algorithm"]["learning_starts"]) == (100_000, 2000)
    assert (config["output_dir"], config["init_from"]) == ("logs", "flock")
    config = printed(capsys, "--log-folder", "a", "--trained-agent", "b", "--seed", "3.0")
    assert (config["output_dir"], config["init_from"], config["seed"]) == ("a", "b", 3)


def test_numbers_of_a_file_may_have_an_exponent(tmp_path, capsys):
    text = "total_timesteps: 1e5\nalgorithm:\n  batch_size: 1e2\n  gamma: 9e-1\ntrain_env:\n  flock_sizes: 1e1\n"
    config = printed(capsys, "--config", write(tmp_path, text))
    assert (config["total_timesteps"], config["train_env"]["flock_sizes"]) == (100_000, [10])
    assert (config["algorithm"]["batch_size"], config["algorithm"]["gamma"]) == (100, 0.9)


def test_expert_mpc_is_a_training_of_its_own_for_any_task(capsys):
    """Beside which config file it stands is tested with the presets."""
    preset = printed(capsys, "--expert", "mpc", "--n-vehicles", "5", "--n-obstacles", "2")
    assert preset["train_env"]["flock_sizes"] is None  # as in the task
    other = printed(capsys, "--expert", "mpc")
    task = {"n_vehicles": 3, "n_obstacles": 1}
    assert other == {**preset, "scenario": {**preset["scenario"], **task}}


def test_the_task_of_a_training_has_the_filter_unless_the_file_or_a_flag_says_otherwise(tmp_path, capsys):
    for words in ([], ["--n-vehicles", "5"], ["--expert", "mpc"], ["--config", write(tmp_path, "scenario: {arena: 2}\n")]):
        scenario = printed(capsys, *words)["scenario"]
        assert (scenario["safety_filter"], scenario["shared_detections"]) == ("announce", True)
    scenario = printed(capsys, "--set", "safety_filter=off", "--set", "shared_detections=false")["scenario"]
    assert (scenario["safety_filter"], scenario["shared_detections"]) == ("off", False)
    for off in ("off", "'off'"):
        file = write(tmp_path, f"scenario: {{safety_filter: {off}}}\n")
        assert printed(capsys, "--config", file)["scenario"]["safety_filter"] == "off"
        assert printed(capsys, "--config", file, "--expert", "mpc")["scenario"]["safety_filter"] == "off"
        heading = printed(capsys, "--config", file, "--set", "safety_filter=heading")
        assert heading["scenario"]["safety_filter"] == "heading"


def test_ranges_that_do_not_fit_the_filter_are_one_line_that_says_that_it_can_be_off(fails, capsys):
    words = ["config", "--set", "max_speed=0.5"]
    fails(words, "link_range = 0.15: safety_filter needs more than neighbor_separation", "it can be off")
    assert main([*words, "--set", "safety_filter=off"]) == 0
    assert "max_speed: 0.5 " in capsys.readouterr().out


def test_the_preset_of_an_expert_gives_way_to_the_file_and_to_every_other_flag(tmp_path, capsys):
    file = write(tmp_path, "total_timesteps: 300000\nalgorithm:\n  gamma: 0.9\ntrain_env:\n  expert: orca\n")
    words = ["--expert", "mpc", "--config", file, "--n-flocks", "4", "--set", "bc_coef=2"]
    config = printed(capsys, *words)
    assert (config["total_timesteps"], config["n_flocks"], config["train_env"]["expert"]) == (300_000, 4, "mpc")
    algorithm = config["algorithm"]
    assert (algorithm["gamma"], algorithm["bc_coef"], algorithm["batch_size"]) == (0.9, 2.0, 256)
    assert printed(capsys, *words, "--set", "train_env.expert=orca")["train_env"]["expert"] == "orca"


@pytest.mark.parametrize("name", ["orca", "olfati-saber"])
def test_an_expert_without_a_preset_is_the_only_change(name, capsys):
    default, config = printed(capsys), printed(capsys, "--expert", name)
    assert config == {**default, "train_env": {**default["train_env"], "expert": name}}


def test_output_writes_the_config_to_a_file(tmp_path, capsys, fails):
    file = tmp_path / "mine.yaml"
    assert main(["config", "--n-vehicles", "5", "-o", str(file)]) == 0
    assert capsys.readouterr().out == f"{file}\n"
    assert main(["config", "--n-vehicles", "5"]) == 0
    assert file.read_text() == capsys.readouterr().out
    fails(["config", "-o", "/dev/full"], "--output /dev/full: No space left on device")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "n_vehicles: 5\n",
            "n_vehicles is not a parameter; did you mean scenario.n_vehicles? That is n_vehicles in the group scenario",
        ),
        ("lr: 1e-3\n", "did you mean algorithm.learning_rate? That is learning_rate in the group algorithm"),
        ("learning_rate: 1e-3\n", "did you mean algorithm.learning_rate? That is learning_rate in the group algorithm"),
        ("network:\n  lr: 1e-3\n", "network.lr is not a parameter; did you mean algorithm.learning_rate?"),
        ("scenario:\n  n_vehicels: 3\n", "scenario.n_vehicels is not a parameter; did you mean scenario.n_vehicles?\n"),
        ("scenario:\n  reward:\n    beta: 3\n", "scenario.reward.beta = 3: input should be less than or equal to 0"),
        ("network:\n  action_bound: x\n", "network.action_bound = 'x': input should be 'inverting' or 'tanh'"),
        ("scenario:\n  motion_lag: 0.15\n", "scenario.motion_lag = 0.15: input should be a multiple of time_step"),
    ],
)
def test_a_wrong_key_or_value_is_named_in_full_with_what_was_meant(text, expected, tmp_path, fails):
    fails(["config", "--config", write(tmp_path, text)], expected)


def test_old_names_in_a_file_are_one_short_line_that_says_how_to_rewrite_it(tmp_path, capsys):
    for _ in range(2):  # a second file of the same process warns again
        assert main(["config", "--config", str(RUN / "config.yaml")]) == 0
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert error.startswith(f"sb3-flock: warning: {RUN / 'config.yaml'}: written by an earlier release (")
        assert "practice is now train_env" in error
        assert error.endswith(f" more); `sb3-flock migrate {RUN / 'config.yaml'}` rewrites it\n")
        assert len(error) < 2 * len(str(RUN)) + 250


def test_old_names_of_fields_work_with_one_line_each(capsys):
    assert main(["config", "--set", "practice.vehicles=3", "--set", "guidance=0"]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert [line.split("; ")[0] for line in lines] == [
        "sb3-flock: warning: practice.vehicles is now train_env.flock_sizes",
        "sb3-flock: warning: guidance is now algorithm.bc_coef",
    ]
