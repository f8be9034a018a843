import pytest

from sb3_flock.config.training import TrainingConfig
from sb3_flock.settings import SettingsError, leaf_paths, resolve_path


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
