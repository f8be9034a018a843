import numpy as np
import pytest

from sb3_flock.config.training import TrainingConfig
from sb3_flock.settings import (
    SettingsError,
    check_integer,
    field_of,
    format_value,
    group_of,
    leaf_paths,
    resolve_path,
    suggest,
)
from sb3_flock.sim import Scenario


@pytest.mark.parametrize(
    ("key", "path"),
    [
        ("reward.lambda_", ("scenario", "reward", "lambda_")),
        ("lambda_", ("scenario", "reward", "lambda_")),
        ("scenario.n_vehicles", ("scenario", "n_vehicles")),
        ("gamma", ("algorithm", "gamma")),
        ("seed", ("seed",)),
    ],
)
def test_leading_groups_may_be_left_out(key, path):
    assert resolve_path(TrainingConfig, key) == path


@pytest.mark.parametrize(
    ("key", "hint"),
    [("gama", "algorithm.gamma"), ("reward.lamda", "scenario.reward.lambda_"), ("n_vehicel", "scenario.n_vehicles")],
)
def test_an_unknown_key_is_refused_with_the_nearest(key, hint):
    with pytest.raises(SettingsError, match=rf"{key} is not a parameter; did you mean {hint}\?"):
        resolve_path(TrainingConfig, key)


def test_a_group_is_no_parameter():
    with pytest.raises(SettingsError, match="reward is not a parameter"):
        resolve_path(TrainingConfig, "reward")


def test_no_two_parameters_share_a_name_so_that_short_keys_work():
    names = [path[-1] for path in leaf_paths(TrainingConfig)]
    assert len(names) == len(set(names))


def test_a_short_key_that_two_groups_share_is_ambiguous():
    class Inner(type(Scenario().reward)):
        pass

    class Twice(TrainingConfig):
        other: Inner = Inner()

    with pytest.raises(SettingsError, match=r"lambda_ is ambiguous: .*scenario\.reward\.lambda_.*other\.lambda_"):
        resolve_path(Twice, "lambda_")


@pytest.mark.parametrize(
    ("key", "path"),
    [
        ("lr", "algorithm.learning_rate"),
        ("timesteps", "total_timesteps"),
        ("n_envs", "n_flocks"),
        ("n_agents", "scenario.n_vehicles"),
    ],
)
def test_other_libraries_names_are_suggested_as_ours(key, path):
    with pytest.raises(SettingsError, match=f"{key} is not a parameter; did you mean {path}"):
        resolve_path(TrainingConfig, key)


def test_nothing_is_suggested_for_a_name_unlike_all_others():
    assert suggest("qqqq", ["scenario.n_vehicles", "seed"]) == ""
    assert suggest("sed", ["scenario.n_vehicles", "seed"]) == "; did you mean seed?"


def test_fields_and_groups_by_their_path():
    assert field_of(TrainingConfig, "scenario.reward.lambda_").description.startswith("share of a vehicle's own reward")
    assert group_of(TrainingConfig.model_fields["scenario"].annotation) is Scenario
    assert group_of(TrainingConfig.model_fields["seed"].annotation) is None
    assert group_of(tuple[int]) is None


@pytest.mark.parametrize("value", [1, np.int64(3), 10**9])
def test_integers_of_at_least_the_least_are_accepted(value):
    check_integer("episodes", value, least=1)


@pytest.mark.parametrize("value", [0, -1, 1.0, "2", None, float("nan")])
def test_other_values_are_no_counts(value):
    with pytest.raises(SettingsError, match="^episodes = .*: input should be an integer of at least 1$"):
        check_integer("episodes", value, least=1)


def test_a_long_value_is_shortened():
    assert len(format_value("x" * 10**6)) <= 200
    assert len(format_value(list(range(10**5)))) < 100
    assert format_value(0.5) == "0.5"


def test_every_wrong_parameter_is_reported():
    with pytest.raises(SettingsError) as error:
        Scenario(n_vehicles=0, max_speed=-1.0, n_obstacle=3)
    parts = str(error.value).split("; ")
    assert any(part.startswith("n_vehicles = 0: ") for part in parts)
    assert any(part.startswith("max_speed = -1.0: ") for part in parts)
    assert any(part.startswith("n_obstacle is not a parameter of Scenario") for part in parts)
