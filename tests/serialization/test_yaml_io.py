import pytest
import yaml

from sb3_flock._renamed import RenamedWarning
from sb3_flock.config.training import TrainingConfig
from sb3_flock.serialization.migrate import FORMAT
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
        ("scenario:\n  n_vehicels: 3\n", r"scenario.n_vehicels is not a parameter; did you mean scenario.n_vehicles\?"),
        ("gama: 0.9\n", r"gama is not a parameter; did you mean algorithm.gamma\? That is gamma in the group algorithm"),
        ("algorithm:\n  lr: 0.1\n", r"algorithm.lr is not a parameter; did you mean algorithm.learning_rate\?"),
        ("scenario: 3\n", "scenario = 3: a mapping"),
        ("algorithm:\n  gamma: 1.5\n", "gamma = 1.5"),
        ("[1, 2]", "a mapping of parameters"),
        ("a: [", "not a YAML file"),
        ("!!python/object/apply:os.system ['true']", "not a YAML file"),
        ("algo: ppo\n", "algo = 'ppo'"),
        ("seed: 1\nalgo: td3\nseed: 2\n", "config .*: 'seed' is given twice, again in line 3"),
        ("scenario:\n  reward: {beta: -1, beta: -2}\n", "'beta' is given twice, again in line 2"),
        ("total_timesteps: 1:30\n", "total_timesteps = '1:30': input should be a valid integer"),
        ("scenario: {n_vehicles: yes}\n", "scenario.n_vehicles = 'yes': input should be a valid integer"),
        ("scenario: {n_vehicles: true}\n", "scenario.n_vehicles = True: input should be a number"),
        ("algorithm: {gamma: false}\n", "algorithm.gamma = False: input should be a number"),
        ("train_env: {flock_sizes: true}\n", "train_env.flock_sizes = True: input should be a valid tuple"),
        ("scenario: &a\n  reward: *a\n", "reward"),
        ("network:\n  net_arch: [-1]\n", "net_arch"),
        ("seed: 4294967296\n", "seed = 4294967296"),
        ("train_env:\n  separation_scale: 0.5\n", "separation_scale = 0.5"),
    ],
)
def test_a_wrong_file_is_one_line(tmp_path, text, message):
    with pytest.raises(SettingsError, match=message) as error:
        load_config(TrainingConfig, write(tmp_path, text))
    assert "\n" not in str(error.value)


def test_a_missing_file_is_one_line(tmp_path):
    with pytest.raises(SettingsError, match="No such file"):
        load_config(TrainingConfig, tmp_path / "none.yaml")


@pytest.mark.parametrize("assignment", ["gamma", "=3", "gamma=[", "gamma={a: 1, a: 2}", "gamma=!!python/name:os.system x"])
def test_a_wrong_override_is_one_line(assignment):
    with pytest.raises(SettingsError, match="KEY=VALUE is needed|the value is not YAML|is given twice"):
        parse_overrides([assignment])


def test_scalars_are_those_of_yaml_1_2():
    words = {"yes": "yes", "off": "off", "1:30": "1:30", "010": 10, "2024-01-01": "2024-01-01", "true": True, "~": None}
    numbers = {"1e5": 100_000, "1_000": 1000, "-3": -3, ".5": 0.5, "1.": 1.0, "2.5e-3": 0.0025, ".inf": float("inf")}
    for text, value in {**words, **numbers}.items():
        read = parse_overrides([f"a={text}"])["a"]
        assert (read, type(read)) == (value, type(value)), text
    assert parse_overrides(["a={b: {x: 1, <<: {x: 2, y: 3}}}"]) == {"a": {"b": {"x": 1, "y": 3}}}


def test_yaml_is_plain():
    assert yaml.safe_load(to_yaml(TrainingConfig()))["network"]["channels"] == [16, 32]


def test_the_format_is_written_and_not_taken_for_a_parameter(tmp_path):
    text = to_yaml(TrainingConfig())
    assert text.startswith(f"format: {FORMAT} # ")
    assert load_config(TrainingConfig, write(tmp_path, text)) == TrainingConfig()
    assert load_config(TrainingConfig, write(tmp_path, "seed: 3\n")).seed == 3  # without one: the present format


def test_another_config_is_a_base_whose_values_stay():
    base = TrainingConfig(seed=7, algorithm={"gamma": 0.9})
    config = load_config(TrainingConfig, overrides={"tau": 0.1}, base=base)
    assert (config.seed, config.algorithm.gamma, config.algorithm.tau) == (7, 0.9, 0.1)


def test_an_override_by_an_old_name_warns_and_works():
    with pytest.warns(RenamedWarning, match="update_ratio is now algorithm.utd_ratio"):
        config = load_config(TrainingConfig, overrides={"update_ratio": 0.7})
    assert config.algorithm.utd_ratio == 0.7


def test_defaults_stand_only_where_neither_the_file_nor_an_override_says_otherwise(tmp_path):
    file = tmp_path / "config.yaml"
    file.write_text("algorithm:\n  gamma: 0.9\nn_flocks: 3\n")
    defaults = {"gamma": 0.5, "n_flocks": 7, "seed": 5, "scenario.reward.scale": 0.3, "lambda_": 0.4}
    config = load_config(TrainingConfig, file, {"seed": 6}, defaults=defaults)
    assert (config.algorithm.gamma, config.n_flocks, config.seed) == (0.9, 3, 6)
    assert (config.scenario.reward.scale, config.scenario.reward.lambda_) == (0.3, 0.4)
    assert load_config(TrainingConfig, base=config, defaults=defaults) == config
