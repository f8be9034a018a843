import subprocess
import sys

import pytest

from sb3_flock._renamed import RenamedWarning
from sb3_flock.config.training import TaskConfig, TrainEnvConfig, TrainingConfig
from sb3_flock.serialization.yaml_io import load_config, parse_overrides, to_yaml
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario

OFF = {"safety_filter": "off"}
"""For steps so long that the filter needs wider ranges."""


def test_the_training_env_has_its_own_flock_sizes_or_the_tasks():
    for flock_sizes, expected in ((3, [3]), ([9], [9]), (None, [5]), ([3, 20], [3, 20])):
        config = load_config(TrainingConfig, overrides={"n_vehicles": 5, "train_env.flock_sizes": flock_sizes})
        assert [scenario.n_vehicles for scenario in config.training_scenarios()] == expected
        assert config.scenario.n_vehicles == 5


def test_the_training_env_is_harder_than_the_task_and_scales_with_it():
    overrides = {"n_obstacles": 1, "obstacle_arena": 40.0, "neighbor_separation": 2.0, "link_range": 2.04}
    overrides |= {"obstacle_separation": 3.0, "detection_range": 5.0, "safety_filter": "off"}
    overrides |= {"train_env.flock_sizes": 4, "obstacle_arena_scale": 0.5, "obstacle_separation_scale": None}
    config = load_config(TrainingConfig, overrides={**overrides, "extra_obstacles": 3, "separation_scale": 1.1})
    changed = config.training_scenarios()[0]
    assert (changed.n_obstacles, changed.obstacle_arena, changed.neighbor_separation) == (4, 20.0, 2.04)
    assert changed.obstacle_separation == pytest.approx(3.3)
    apart = config.replace(train_env=config.train_env.replace(obstacle_separation_scale=1.5)).training_scenarios()[0]
    assert (apart.neighbor_separation, apart.obstacle_separation) == (2.04, 4.5)
    assert config.scenario.n_obstacles == 1
    none = load_config(TrainingConfig, overrides={"n_obstacles": 0, "extra_obstacles": 3})
    assert none.training_scenarios()[0].n_obstacles == 0


def test_the_training_env_takes_longer_steps_for_the_same_time():
    config = load_config(TrainingConfig, overrides={"max_cycles": 200, "time_step": 0.1, "time_step_scale": 2.5, **OFF})
    changed = config.training_scenarios()[0]
    assert (changed.max_cycles, changed.time_step) == (80, 0.25)
    shortest = load_config(TrainingConfig, overrides={"max_cycles": 1, "time_step_scale": 10, **OFF})
    assert shortest.training_scenarios()[0].max_cycles == 1


def test_obstacles_with_given_starts_keep_their_square():
    config = load_config(TrainingConfig, overrides={"obstacle_starts": [[0.5, 0.5]], "obstacle_arena": 2.0})
    assert config.training_scenarios()[0].obstacle_arena == 2.0
    assert load_config(TrainingConfig, overrides={"obstacle_arena": 2.0}).training_scenarios()[0].obstacle_arena == 1.0


def test_each_motion_of_the_obstacles_has_flocks_of_its_own_and_crossing_obstacles_keep_their_square():
    overrides = {"obstacle_arena": 2.0, "train_env.flock_sizes": [3, 5], "train_env.obstacle_motions": ["walk", "crossing"]}
    changed = load_config(TrainingConfig, overrides=overrides).training_scenarios()
    assert [(env.obstacle_motion, env.n_vehicles, env.obstacle_arena) for env in changed] == [
        ("walk", 3, 1.0),
        ("walk", 5, 1.0),
        ("crossing", 3, 2.0),
        ("crossing", 5, 2.0),
    ]
    (alone,) = load_config(TrainingConfig, overrides={"obstacle_motion": "crossing"}).training_scenarios()
    assert (alone.obstacle_motion, alone.obstacle_arena) == ("crossing", 1.0)


def test_with_every_change_switched_off_the_training_env_is_the_task():
    train_env = TrainEnvConfig(
        flock_sizes=None,
        extra_obstacles=0,
        obstacle_arena_scale=1.0,
        time_step_scale=1.0,
        separation_scale=1.0,
        obstacle_separation_scale=1.0,
    )
    config = TaskConfig(train_env=train_env)
    (same,) = map(config.training_safety, config.training_scenarios())
    assert same == config.scenario.replace(obstacle_arena=config.scenario.obstacle_half_side)


def test_a_motion_lag_must_be_a_multiple_of_the_training_envs_time_step():
    with pytest.raises(SettingsError, match=r"motion_lag = 0\.3: input should be a multiple of 0\.2 s, the training env's"):
        load_config(TrainingConfig, overrides={"motion_lag": 0.3, "time_step_scale": 2.0})
    with pytest.raises(SettingsError, match=r"motion_lag = 0\.1: input should be a multiple of 0\.2 s"):
        load_config(TrainingConfig, overrides={"motion_lag": 0.1, "time_step_scale": 2.0})
    config = load_config(TrainingConfig, overrides={"motion_lag": 0.4, "time_step_scale": 2.0, **OFF})
    assert config.training_scenarios()[0].motion_lag == 0.4


@pytest.mark.parametrize("expert", ["mpc", "orca", "olfati-saber", None])
def test_experts_by_name(expert):
    assert TrainEnvConfig(expert=expert).expert == expert


def test_an_unknown_expert_is_refused_with_the_nearest():
    with pytest.raises(SettingsError, match=r"expert = 'mcp': one of .*orca.* or null is needed; did you mean mpc\?"):
        TrainEnvConfig(expert="mcp")


@pytest.mark.parametrize(
    ("overrides", "is_accepted"),
    [
        ({"bc_coef": 1.0}, False),
        ({"bc_coef": 1.0, "expert": "olfati-saber"}, False),
        ({"bc_coef": 1.0, "expert": "orca"}, True),
        ({"bc_coef": 1.0, "expert": "mpc"}, True),
        ({"expert": "mpc"}, True),
    ],
)
def test_behavior_cloning_needs_an_expert_that_can_be_asked_for_an_action(overrides, is_accepted):
    if is_accepted:
        assert load_config(TrainingConfig, overrides=overrides).algorithm.bc_coef == overrides.get("bc_coef", 0.0)
        return
    with pytest.raises(SettingsError, match=r"bc_coef = 1\.0: input should be 0 without train_env.expert mpc or orca"):
        load_config(TrainingConfig, overrides=overrides)


@pytest.mark.parametrize("algo", ["td3", "sac", "ddpg-sb3"])
def test_behavior_cloning_needs_an_algorithm_that_has_it(algo):
    with pytest.raises(SettingsError, match="bc_coef = 1.0: input should be 0 without algo ddpg"):
        load_config(TrainingConfig, overrides={"bc_coef": 1.0, "expert": "mpc", "algo": algo})


def test_names_of_the_previous_release_warn_and_work():
    with pytest.warns(RenamedWarning) as warned:
        config = TrainingConfig(
            practice=TrainEnvConfig(teacher="foresight", vehicles=(2,)), eval_episodes=5, algo="ddpg-stock"
        )
    lines = "\n".join(str(warning.message) for warning in warned)
    for words in ("TrainEnvConfig: teacher is now expert", "expert = foresight is now expert = mpc",
                  "TrainingConfig: practice is now train_env", "algo = ddpg-stock is now algo = ddpg-sb3"):  # fmt: skip
        assert words in lines
    assert (config.train_env.expert, config.train_env.flock_sizes, config.n_eval_episodes) == ("mpc", (2,), 5)
    assert config.algo == "ddpg-sb3"


@pytest.mark.parametrize("task", [TaskConfig, TrainingConfig])
def test_a_trainings_task_has_the_filter_unless_it_says_otherwise(task):
    with_filter = Scenario(safety_filter="announce", shared_detections=True)
    assert task().scenario == task(scenario={}).scenario == with_filter
    assert task(scenario={"n_vehicles": 5}).scenario == with_filter.replace(n_vehicles=5)
    assert task(scenario={"safety_filter": "off"}).scenario == with_filter.replace(safety_filter="off")
    assert task(scenario={"shared_detections": False}).scenario == with_filter.replace(shared_detections=False)
    assert task(scenario={"safety_filter": "heading"}).scenario.safety_filter == "heading"


def test_a_whole_scenario_stays_as_it_is():
    assert (Scenario().safety_filter, Scenario().shared_detections) == ("off", False)
    assert TrainingConfig(scenario=Scenario()).scenario == Scenario()
    off = TrainingConfig(scenario=Scenario(n_vehicles=4))
    assert off.replace(seed=1).scenario == Scenario(n_vehicles=4)
    assert load_config(TrainingConfig, base=off, overrides={"seed": 1}).scenario == Scenario(n_vehicles=4)
    assert TrainingConfig(**off.model_dump()) == TrainingConfig(**off.model_dump(mode="json")) == off
    assert load_config(TrainingConfig, overrides={"safety_filter": "off"}).scenario.safety_filter == "off"
    with pytest.raises(SettingsError, match="scenario = 3"):
        TrainingConfig(scenario=3)


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        ({"max_speed": 0.5}, "link_range = 0.15: safety_filter needs more than neighbor_separation"),
        ({"link_range": 0.1}, "link_range = 0.1: safety_filter needs more than neighbor_separation"),
        (
            {"time_step_scale": 2.0},
            "time_step_scale = 2.0: in the training env link_range = 0.15: safety_filter needs",
        ),
    ],
)
def test_a_task_whose_ranges_do_not_fit_the_filter_is_one_line_that_says_that_it_can_be_off(overrides, named):
    with pytest.raises(SettingsError, match=named) as error:
        load_config(TrainingConfig, overrides=overrides)
    assert str(error.value).endswith("; it can be off")
    assert "\n" not in str(error.value)
    assert load_config(TrainingConfig, overrides={**overrides, "safety_filter": "off"}).training_scenarios()


def test_a_config_is_importable_without_torch():
    code = "import sys; from sb3_flock import TrainingConfig; TrainingConfig(); sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_filter_of_a_training_env_keeps_the_tasks_separations():
    config = load_config(TrainingConfig, overrides={"separation_scale": 1.3, "safety_margin": 0.01, "n_vehicles": 7})
    (scenario,) = config.training_scenarios()
    safety = config.training_safety(scenario)
    assert scenario.neighbor_separation == pytest.approx(0.13)
    assert (safety.neighbor_separation, safety.obstacle_separation, safety.safety_margin) == (0.1, 0.15, 0.01)
    assert (scenario.safety_filter, safety.safety_filter) == ("off", "announce")
    same = {"neighbor_separation", "obstacle_separation", "safety_filter"}
    assert all(getattr(safety, name) == getattr(scenario, name) for name in set(type(safety).model_fields) - same)


def test_randomized_fields_are_read_checked_and_written(tmp_path):
    overrides = parse_overrides(["randomization={actuators.speed_lag: [0, 0.3], sensors.dropout: [0.1, 0.2]}"])
    config = load_config(TrainingConfig, overrides=overrides)
    assert config.train_env.randomization == {"actuators.speed_lag": (0.0, 0.3), "sensors.dropout": (0.1, 0.2)}
    assert config.scenario == TrainingConfig().scenario  # an evaluation has the task's own values
    (tmp_path / "config.yaml").write_text(to_yaml(config))
    assert load_config(TrainingConfig, tmp_path / "config.yaml") == config
    assert hash(config.train_env) != hash(TrainingConfig().train_env)
    with pytest.raises(
        SettingsError, match=r"^train_env.randomization.sensors.dropout = \[0.1, 2.0\]: input should be less"
    ):
        load_config(TrainingConfig, overrides={"randomization": {"sensors.dropout": [0.1, 2]}})
    with pytest.raises(
        SettingsError, match=r"^randomization.actuators.min_speed = .*: input should be at most max_speed = 0.1"
    ):
        load_config(TrainingConfig, overrides={"max_speed": 0.1, "randomization": {"actuators.min_speed": [0, 0.12]}})
