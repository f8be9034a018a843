import pytest
import yaml

from sb3_flock.config.training import TrainingConfig
from sb3_flock.serialization.yaml_io import load_config, parse_overrides, to_yaml
from sb3_flock.settings import SettingsError, leaf_paths


def write(tmp_path, text):
    path = tmp_path / "config.yaml"
    path.write_text(text)
    return path


def test_yaml_round_trips_and_every_key_has_its_comment(tmp_path):
    config = load_config(TrainingConfig, overrides={"n_vehicles": 7, "net_arch": [32, 16], "output_dir": "2024"})
    text = to_yaml(config)
    assert load_config(TrainingConfig, write(tmp_path, text)) == config
    assert all(" # " in line for line in text.splitlines())
    for path in leaf_paths(TrainingConfig):
        assert f"{path[-1]}: " in text


def test_keys_left_out_keep_their_defaults_and_overrides_win(tmp_path):
    path = write(tmp_path, "scenario:\n  n_vehicles: 5\n  n_obstacles: 2\nseed: 9\n")
    config = load_config(TrainingConfig, path, {"scenario.n_vehicles": 4, "lambda_": 0.5})
    assert (config.scenario.n_vehicles, config.scenario.n_obstacles, config.seed) == (4, 2, 9)
    assert config.scenario.reward.lambda_ == 0.5
    assert config.algorithm == TrainingConfig().algorithm


def test_an_empty_file_is_the_defaults(tmp_path):
    assert load_config(TrainingConfig, write(tmp_path, "")) == TrainingConfig()


def test_overrides_are_yaml_and_1e_3_is_a_number():
    assert parse_overrides(["a=1e-3", "b=[1, 2]", "c=null", "d=text", "e={x: 1e-4}"]) == {
        "a": 1e-3, "b": [1, 2], "c": None, "d": "text", "e": {"x": 1e-4},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scenario:\n  n_vehicels: 3\n", r"scenario.n_vehicels is not a parameter; did you mean n_vehicles\?"),
        ("scenario: 3\n", "scenario = 3: a mapping"),
        ("learner:\n  gamma: 1.5\n", "gamma = 1.5"),
        ("[1, 2]", "a mapping of parameters"),
        ("a: [", "not a YAML file"),
        ("!!python/object/apply:os.system ['true']", "not a YAML file"),
        ("algo: ppo\n", "algo = 'ppo'"),
        ("output_dir: 2021-13-45\n", "not a YAML file"),
        ("scenario: &a\n  reward: *a\n", "reward"),
        ("network:\n  net_arch: [-1]\n", "net_arch"),
        ("seed: 4294967296\n", "seed = 4294967296"),
        ("practice:\n  separation_scale: 0.5\n", "separation_scale = 0.5"),
    ],
)
def test_a_wrong_file_is_one_line(tmp_path, text, message):
    with pytest.raises(SettingsError, match=message) as error:
        load_config(TrainingConfig, write(tmp_path, text))
    assert "\n" not in str(error.value)


def test_a_missing_file_is_one_line(tmp_path):
    with pytest.raises(SettingsError, match="No such file"):
        load_config(TrainingConfig, tmp_path / "none.yaml")


@pytest.mark.parametrize("assignment", ["gamma", "=3", "gamma=[", "gamma=2021-13-45"])
def test_a_wrong_override_is_one_line(assignment):
    with pytest.raises(SettingsError, match="--set"):
        parse_overrides([assignment])


def test_practice_flies_its_own_number_of_vehicles_or_the_tasks():
    for vehicles, flown in ((3, [3]), ([9], [9]), (None, [5]), ([3, 20], [3, 20])):
        config = load_config(TrainingConfig, overrides={"n_vehicles": 5, "train_env.flock_sizes": vehicles})
        assert [scenario.n_vehicles for scenario in config.training_scenarios()] == flown
        assert config.scenario.n_vehicles == 5


def test_practice_is_harder_than_the_task_and_scales_with_it():
    overrides = {"n_obstacles": 1, "obstacle_arena": 40.0, "neighbor_separation": 2.0, "link_range": 2.04}
    overrides |= {"obstacle_separation": 3.0, "detection_range": 5.0}
    config = load_config(TrainingConfig, overrides={**overrides, "extra_obstacles": 3, "separation_scale": 1.1})
    flown = config.training_scenarios()[0]
    assert (flown.n_obstacles, flown.obstacle_arena, flown.neighbor_separation) == (4, 20.0, 2.04)
    assert flown.obstacle_separation == pytest.approx(3.3)
    apart = config.replace(train_env=config.train_env.replace(obstacle_separation_scale=1.5)).training_scenarios()[0]
    assert (apart.neighbor_separation, apart.obstacle_separation) == (2.04, 4.5)
    assert config.scenario.n_obstacles == 1
    none = load_config(TrainingConfig, overrides={"n_obstacles": 0, "extra_obstacles": 3})
    assert none.training_scenarios()[0].n_obstacles == 0


def test_practice_takes_longer_steps_for_the_same_time():
    config = load_config(TrainingConfig, overrides={"max_cycles": 200, "time_step": 0.1, "time_step_scale": 2.5})
    flown = config.training_scenarios()[0]
    assert (flown.max_cycles, flown.time_step) == (80, 0.25)
    shortest = load_config(TrainingConfig, overrides={"max_cycles": 1, "time_step_scale": 10})
    assert shortest.training_scenarios()[0].max_cycles == 1


def test_yaml_is_plain():
    assert yaml.safe_load(to_yaml(TrainingConfig()))["network"]["channels"] == [16, 32]
