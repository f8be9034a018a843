"""What a sweep's file can hold, and which trials it makes."""

from pathlib import Path

import pytest

from sb3_flock._renamed import RenamedWarning
from sb3_flock.serialization.yaml_io import to_yaml
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario
from sb3_flock.sweep.config import Range, load_sweep

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("sweep_*.yaml"))


def read(text, **changes):
    return load_sweep("there.yaml", text=text, **changes)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_trial_of_a_shipped_sweep_is_accepted(path):
    config = load_sweep(path)
    for point in config.points():
        if config.policy is None:
            config.training(point)
        else:
            config.evaluation(point, Scenario())


def test_a_grid_is_every_combination_over_the_shared_fields():
    config = read("base: {n_vehicles: 4, scenario: {n_obstacles: 2}}\ngrid: {lambda_: [0.3, 1], seed: [7, 8, 9]}")
    trained = [config.training(point) for point in config.points()]
    assert len(trained) == 6
    assert {(c.scenario.reward.lambda_, c.seed) for c in trained} == {(x, y) for x in (0.3, 1.0) for y in (7, 8, 9)}
    assert {(c.scenario.n_vehicles, c.scenario.n_obstacles, c.torch_threads) for c in trained} == {(4, 2, 1)}


def test_the_base_may_be_a_file_beside_it_and_is_kept_whole(tmp_path):
    (tmp_path / "mine.yaml").write_text("total_timesteps: 77\nscenario: {n_vehicles: 6}\ntorch_threads: 9\n")
    (tmp_path / "sweep.yaml").write_text("base: mine.yaml\ngrid: {seed: [0, 1]}\nresources: {cpus: 2}\n")
    config = load_sweep(tmp_path / "sweep.yaml", {"gamma": 0.5})
    trained = config.training(config.points()[1])
    assert (trained.total_timesteps, trained.scenario.n_vehicles, trained.algorithm.gamma) == (77, 6, 0.5)
    assert (trained.seed, trained.torch_threads) == (1, 2)


def test_the_points_of_a_search_cover_all_ends_and_choices():
    config = read("search: {batch_size: {low: 8, high: 64}, gamma: [0.9, 0.99]}")
    assert config.search["algorithm.batch_size"] == Range(low=8, high=64)
    points = config.points()
    assert {point["algorithm.batch_size"] for point in points} == {8, 64}
    assert {point["algorithm.gamma"] for point in points} == {0.9, 0.99}


def test_an_evaluation_has_the_policys_scenario_with_the_points_changes():
    config = read("base: {obstacle_arena: 0.5}\ngrid: {n_vehicles: [3, 20], seed: [1, 2]}")
    scenario, seed = config.evaluation(config.points()[-1], Scenario(n_obstacles=4, max_speed=0.3))
    assert (scenario.n_vehicles, scenario.n_obstacles, scenario.max_speed, scenario.obstacle_arena) == (20, 4, 0.3, 0.5)
    assert seed == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "a grid or a search is needed, and not both"),
        ("grid: {seed: [0]}\nsearch: {gamma: [0.9]}", "a grid or a search is needed, and not both"),
        ("grid: [1]", "grid = [1]: a mapping of fields to values is needed"),
        ("grid: 3", "grid = 3: a mapping of fields to values is needed"),
        ("grid: {sede: [0]}", "sede is not a parameter; did you mean seed?"),
        ("grid: {seed: 0}", "grid.seed = 0: input should be a valid list"),
        ("grid: {seed: []}", "seed = []: a list of different values is needed"),
        ("grid: {seed: [1, 1]}", "seed = [1, 1]: a list of different values is needed"),
        ("grid: {output_dir: [a, b]}", "output_dir: a sweep sets it by itself"),
        ("format: 9\ngrid: {seed: [0]}", "format = 9: this version reads formats 1 to"),
        ("base: [1]\ngrid: {seed: [0]}", "base = [1]: a config's file or a mapping of its fields is needed"),
        ("base: nowhere.yaml\ngrid: {seed: [0]}", "config nowhere.yaml: No such file or directory"),
        ("grid: {seed: [0]}\ntasks: [gamma]", "tasks = algorithm.gamma: a field of the grid is needed"),
        ("grid: {seed: [0]}\nmetric: speed", "metric = 'speed': score or one of"),
        ("grid: {seed: [0]}\ntrails: 3", "trails is not a parameter of SweepConfig; did you mean trials?"),
        ("search: {gamma: {low: 0.9, high: 0.1}}", "low = 0.9: at most high = 0.1 is needed"),
        ("search: {gamma: {low: 0, high: 0.1, log: true}}", "more than 0 with log"),
        ("search: {gamma: 3}", "gamma"),
        ("search: {gamma: [0.9]}\npolicy: general", "search: a policy is evaluated over a grid"),
        ("grid: {seed: [0]}\nresources: {cpus: 0}", "cpus = 0: input should be greater than or equal to 1"),
        (f"grid: {{seed: {list(range(400))}, n_flocks: {list(range(1, 400))}}}", "grid: more than 100000 trials"),
    ],
)
def test_a_mistake_is_named(text, message):
    with pytest.raises(SettingsError) as caught:
        read(text)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_field_that_does_not_affect_an_evaluation_is_refused():
    config = read("grid: {gamma: [0.9, 0.99]}")
    with pytest.raises(SettingsError, match=r"grid: algorithm\.gamma does not affect an evaluation"):
        config.evaluation(config.points()[0], Scenario())


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_a_sweep_reads_the_file_that_it_writes(path):
    config = load_sweep(path)
    assert read(to_yaml(config)) == config


OF_THE_PREVIOUS_RELEASE = """
base: {scenario.n_vehicles: 5, scenario.look_back: 0.2, practice.vehicles: [4], practice.teacher: foresight, \
learner.update_ratio: 0.06, learner.mirror: true, network.action_bound: inverting, eval_episodes: 30}
grid: {practice.foresight.reach: [0.85, 0.93], algo: [ddpg, ddpg-stock, sac], seed: [0]}
tasks: [practice.foresight.reach]
metric: score
"""


def test_a_sweep_of_the_previous_release_is_the_same_sweep_under_todays_names():
    with pytest.warns(RenamedWarning) as caught:
        config = read(OF_THE_PREVIOUS_RELEASE)
    renamed = " ".join(str(warning.message) for warning in caught)
    assert "practice.foresight.reach is now train_env.mpc.max_link_length" in renamed
    assert list(config.grid) == ["train_env.mpc.max_link_length", "algo", "seed"]
    assert config.tasks == ["train_env.mpc.max_link_length"]
    with pytest.warns(RenamedWarning):  # of the values foresight and ddpg-stock
        trained = [config.training(point) for point in config.points()]
    assert {(c.train_env.mpc.max_link_length, c.algo) for c in trained} == {
        (length, algo) for length in (0.85, 0.93) for algo in ("ddpg", "ddpg-sb3", "sac")
    }
    for one in trained:  # options that the release before ignored with ddpg-stock and sac
        assert (one.algorithm.mirror_augmentation, one.network.action_bound) == (None, None)
        assert (one.scenario.motion_lag, one.train_env.flock_sizes, one.train_env.expert) == (0.2, (4,), "mpc")
        assert (one.algorithm.utd_ratio, one.n_eval_episodes) == (0.06, 30)


def test_the_points_of_the_previous_release_train_as_before():
    """Ray's state of a sweep keeps each trial's point under the names of its release."""
    config = read("base: {train_env.flock_sizes: [4]}\ngrid: {seed: [0]}")
    with pytest.warns(RenamedWarning):
        trained = config.training({"practice.vehicles": [7], "learner.noise": 0.2})
    assert (trained.train_env.flock_sizes, trained.algorithm.action_noise_std) == ((7,), 0.2)


def test_an_option_is_kept_where_it_is_given_under_its_present_name():
    config = read("base: {algo: td3, network.action_bound: inverting}\ngrid: {seed: [0]}")
    assert config.training({"seed": 0}).network.action_bound == "inverting"
