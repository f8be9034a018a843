"""Files of every earlier format: tests/data holds some, with what the releases that wrote them computed with them."""

import csv
import json
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import torch as th
import yaml
from gymnasium.utils.env_checker import data_equivalence

from sb3_flock import FlockCNN, load_policy, resume
from sb3_flock._renamed import FIELDS, POLICIES, RenamedWarning
from sb3_flock.config.training import TrainingConfig
from sb3_flock.controllers import EXPERTS
from sb3_flock.controllers.policy import PolicyController
from sb3_flock.envs.expert_env import ExpertEnv
from sb3_flock.envs.flocking_v0 import observation_space, parallel_env
from sb3_flock.envs.multi_flock import MultiFlockEnv
from sb3_flock.envs.vec_env import flatten
from sb3_flock.evaluation.rollout import rollout
from sb3_flock.serialization.load import PolicyError
from sb3_flock.serialization.migrate import FORMAT, check_format, migrate_config, migrate_state, migrate_weights
from sb3_flock.serialization.save import save_model
from sb3_flock.serialization.yaml_io import load_config
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario
from sb3_flock.training.checkpoint import LoadedCheckpoint
from tests.helpers import DATA, SMALL_MODEL, quiet

FORMAT_2, FORMAT_3 = DATA / "format_2", DATA / "format_3"

OLD_CONFIG = """
scenario:
  n_vehicles: 5
  look_back: 0.2
practice:
  vehicles: [3, 4]
  obstacle_arena_ratio: 0.6
  time_step_ratio: 1.0
  separation_ratio: 1.02
  obstacle_separation_ratio: 1.1
  teacher: foresight
  teacher_share: 0.4
  teacher_noise: 0.3
  foresight: {reach: 0.9, slack: 0.5, reach_weight: 50.0, sight: 1.5, steps: 7, rounds: 11, pace: 0.05, separation: 1.07}
algo: ddpg
learner: {guidance: 3.0, mirror: false, update_ratio: 0.7, noise: 0.2, final_noise: 0.1, gamma: 0.9}
eval_episodes: 12
test_episodes: 34
"""

SAME_CONFIG = {
    "scenario": {"n_vehicles": 5, "motion_lag": 0.2},
    "train_env": {
        "flock_sizes": [3, 4],
        "obstacle_arena_scale": 0.6,
        "time_step_scale": 1.0,
        "separation_scale": 1.02,
        "obstacle_separation_scale": 1.1,
        "expert": "mpc",
        "expert_fraction": 0.4,
        "expert_noise_std": 0.3,
        "mpc": {
            "max_link_length": 0.9, "link_cutoff": 0.5, "link_weight": 50.0, "obstacle_visibility": 1.5, "horizon": 7,
            "n_iterations": 11, "step_size": 0.05, "separation": 1.07,
        },
    },
    "algo": "ddpg",
    "algorithm": {
        "bc_coef": 3.0, "mirror_augmentation": False, "utd_ratio": 0.7, "action_noise_std": 0.2,
        "final_action_noise_std": 0.1, "gamma": 0.9,
    },
    "n_eval_episodes": 12,
    "n_test_episodes": 34,
}  # fmt: skip


def with_earlier_defaults(values):
    """The same values with the defaults of format 3 where format 4 has others."""
    scenario, train_env = values.get("scenario", {}), values.get("train_env", {})
    reward = {"link_bonus": 0.5, "lambda_": 0.7, **scenario.get("reward", {})}
    then = {
        "flock_sizes": (4,),
        "extra_obstacles": 1,
        "time_step_scale": 2.0,
        "action_repeat": 1,
        "separation_scale": 1.06,
        "obstacle_separation_scale": None,
    }
    off = {"safety_filter": "off", "shared_detections": False}
    return {**values, "scenario": {**off, **scenario, "reward": reward}, "train_env": {**then, **train_env}}


# -- format numbers --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [0, FORMAT + 1, 9, -1, 1.5, "2", None, [1], "9" * 10**5])
def test_an_unknown_format_is_one_short_line(number):
    with pytest.raises(SettingsError, match=f"format = .*: this version reads formats 1 to {FORMAT}$") as error:
        check_format(number)
    assert len(str(error.value)) < 500


@pytest.mark.parametrize("number", range(1, FORMAT + 1))
def test_every_format_so_far_is_read(number):
    assert check_format(number) == number


def with_format(path, number, copy):
    """The same zip with another format number."""
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(copy, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            new.writestr(name, json.dumps({**json.loads(content), "format": number}) if name == "flock.json" else content)
    return copy


def test_files_of_a_later_format_are_refused_in_one_line(tmp_path, saved):
    later = f"format = {FORMAT + 1}: this version reads formats 1 to {FORMAT}"
    with pytest.raises(PolicyError, match=later) as policy_error:
        load_policy(with_format(saved, FORMAT + 1, tmp_path / "later.zip"))
    checkpoint = with_format(FORMAT_2 / "runs/ddpg/rl_model_400_steps.zip", FORMAT + 1, tmp_path / "later_checkpoint.zip")
    with pytest.raises(PolicyError, match=later) as checkpoint_error:
        LoadedCheckpoint(checkpoint, 10**8)
    config = tmp_path / "config.yaml"
    config.write_text(f"format: {FORMAT + 1}\nseed: 1\n")
    with pytest.raises(SettingsError, match=later) as config_error:
        load_config(TrainingConfig, config)
    assert not any("\n" in str(error.value) for error in (policy_error, checkpoint_error, config_error))


def test_what_is_written_has_the_present_format(saved):
    with zipfile.ZipFile(saved) as archive:
        assert json.loads(archive.read("flock.json"))["format"] == FORMAT


def test_migration_is_importable_without_torch():
    code = "import sys; import sb3_flock.serialization.migrate; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


# -- configs ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", range(1, FORMAT + 1))
def test_every_old_key_of_a_config_is_renamed(number):
    current, renamed = migrate_config(TrainingConfig, yaml.safe_load(OLD_CONFIG), number)
    expected_values = SAME_CONFIG if number == FORMAT else with_earlier_defaults(SAME_CONFIG)
    assert current == expected_values
    assert TrainingConfig(**current) == TrainingConfig(**expected_values)
    owners = ("Scenario", "TrainingConfig", "TrainEnvConfig", "MPCConfig", "AlgorithmConfig")
    expected = {pair for owner in owners for pair in FIELDS[owner].items()}
    names = {tuple(name.rsplit(".", 1)[-1] for name in pair) for pair in renamed}
    assert expected <= names  # this test knows every old key
    assert ("practice", "train_env") in renamed
    assert ("train_env.mpc.reach", "train_env.mpc.max_link_length") in renamed
    assert ("train_env.expert = foresight", "train_env.expert = mpc") in renamed


def test_a_present_config_is_not_changed():
    values = TrainingConfig().model_dump(mode="json")
    assert migrate_config(TrainingConfig, values, FORMAT) == (values, [])


def test_an_old_file_warns_in_one_line_and_means_the_same(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(OLD_CONFIG)
    with pytest.warns(RenamedWarning) as warned:
        config = load_config(TrainingConfig, path)
    assert config == TrainingConfig(**with_earlier_defaults(SAME_CONFIG))
    (line,) = [str(warning.message) for warning in warned]
    _, renamed = migrate_config(TrainingConfig, yaml.safe_load(OLD_CONFIG), FORMAT)
    assert line.startswith(f"{path}: written by an earlier release (practice is now train_env, ")
    assert f"and {len(renamed) - 2} more" in line


def test_an_old_and_a_new_name_together_are_refused(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("learner: {gamma: 0.9}\nalgorithm: {tau: 0.1}\n")
    with pytest.raises(SettingsError, match="learner is not a parameter"):
        load_config(TrainingConfig, path)


@pytest.mark.parametrize(
    ("old", "ignored"),
    [
        ({"algo": "ddpg-stock", "learner": {"mirror": True, "gamma": 0.9}}, "mirror"),
        ({"algo": "td3", "learner": {"mirror": True, "n_steps": 3, "gamma": 0.9}}, "mirror"),
        ({"algo": "sac", "learner": {"gamma": 0.9}, "network": {"action_bound": "tanh", "n_critics": 3}}, "action_bound"),
    ],
)
def test_options_that_an_earlier_release_ignored_are_dropped(old, ignored):
    current, _ = migrate_config(TrainingConfig, old, 2)
    config = TrainingConfig(**current)
    assert config.algo == {"ddpg-stock": "ddpg-sb3"}.get(old["algo"], old["algo"])
    assert config.algorithm.gamma == 0.9
    if ignored == "mirror":
        assert config.algorithm.mirror_augmentation is None
    else:
        assert (config.network.action_bound, config.network.n_critics) == (None, 3)


def test_options_that_do_not_apply_are_not_dropped_from_a_present_config():
    values = {"algo": "sac", "network": {"action_bound": "inverting"}}
    current, _ = migrate_config(TrainingConfig, values, FORMAT)
    with pytest.raises(SettingsError, match="network.action_bound = 'inverting'"):
        TrainingConfig(**current)


def test_a_config_of_format_3_keeps_the_defaults_of_then_and_one_without_a_number_has_the_present_ones(tmp_path):
    path = tmp_path / "config.yaml"
    text = "scenario:\n  n_vehicles: 4\n  reward: {epsilon: 2.0}\ntrain_env: {separation_scale: 1.01}\n"
    path.write_text(text)
    present = load_config(TrainingConfig, path)
    assert (present.scenario.safety_filter, present.scenario.shared_detections) == ("announce", True)
    assert present == TrainingConfig(**yaml.safe_load(text))
    path.write_text(f"format: {FORMAT}\n{text}")
    assert load_config(TrainingConfig, path) == present
    path.write_text("format: 3\n" + text)
    then = load_config(TrainingConfig, path)
    assert then == TrainingConfig(**with_earlier_defaults(yaml.safe_load(text)))
    assert (then.scenario.safety_filter, then.scenario.reward.epsilon, then.train_env.separation_scale) == ("off", 2, 1.01)


def test_a_whole_config_of_format_3_is_unfiltered_unless_it_says_otherwise(tmp_path):
    text = (FORMAT_3 / "run/config.yaml").read_text()
    assert text.startswith("format: 3 ")
    config = load_config(TrainingConfig, FORMAT_3 / "run/config.yaml")
    assert (config.scenario.safety_filter, config.scenario.shared_detections) == ("off", False)
    assert config.train_env.action_repeat == 1
    assert config.train_env.time_step_scale == 2.0
    path = tmp_path / "config.yaml"
    path.write_text(text.replace("safety_filter: 'off'", "safety_filter: voronoi").replace("scale: 2.0", "scale: 1.0"))
    assert load_config(TrainingConfig, path).scenario.safety_filter == "voronoi"


@pytest.mark.parametrize(("n_vehicles", "size"), [(5, 4), (3, 3)])
def test_the_first_configs_bounded_the_flock_size_and_had_no_scales(n_vehicles, size):
    old = {"scenario": {"n_vehicles": n_vehicles}, "practice": {"max_vehicles": 4, "extra_obstacles": 2}}
    current, _ = migrate_config(TrainingConfig, old, 1)
    config = TrainingConfig(**current)
    train_env = config.train_env
    assert (train_env.flock_sizes, train_env.extra_obstacles) == ((size,), 2)
    assert (train_env.time_step_scale, train_env.obstacle_separation_scale) == (1.0, 1.0)
    assert config.algorithm.mirror_augmentation is False


# -- policies --------------------------------------------------------------------------------------------------------


def test_a_policy_of_format_1_computes_the_actions_it_computed_then():
    policy = load_policy(DATA / "format_1/policy.zip")
    observations = np.random.default_rng(0).random((20, 3, 11, 11)).astype(np.float32)
    actions, expected = policy.predict(observations)[0], np.load(DATA / "format_1/actions.npy")
    assert expected.std() > 0.1
    # The features are summed in another order now: equal up to rounding.
    np.testing.assert_allclose(actions, expected, atol=5e-6)


def test_weights_of_format_1_are_those_of_features_flattened_channel_by_channel():
    th.manual_seed(0)
    cnn = FlockCNN(observation_space(Scenario()), features_dim=8, channels=(4, 6), layer_norm=False)
    by_channel = {name: value.clone() for name, value in cnn.state_dict().items()}
    observations = th.rand(5, 3, 11, 11)
    maps = cnn.cnn[:-1](observations)  # without the flattening
    expected = th.relu(th.nn.functional.linear(maps.flatten(1), by_channel["dense.0.weight"], by_channel["dense.0.bias"]))
    for number in (1, 2):
        policy = {f"actor.features_extractor.{name}": value for name, value in by_channel.items()}
        migrated = {name.split(".", 2)[2]: value for name, value in migrate_weights(policy, number).items()}
        cnn.load_state_dict(migrated)
        assert th.allclose(cnn(observations), expected, atol=1e-6) == (number == 1)


OLD_POLICIES = {path.stem: path for path in sorted((FORMAT_2 / "policies").glob("*.zip"))}
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("crossing-5v2o", "general")]


@pytest.mark.parametrize("name", [*SLOW, *(name for name in OLD_POLICIES if name not in ("crossing-5v2o", "general"))])
def test_a_policy_of_format_2_gives_the_episodes_it_gave_then(name):
    policy = load_policy(OLD_POLICIES[name])
    results = rollout(PolicyController(policy), policy.scenario, 50, 7)
    with np.load(FORMAT_2 / "expected/rollouts.npz") as file:
        expected = {key.split("/")[1]: file[key] for key in file.files if key.split("/")[0] == name}
    assert len(expected) > 10
    for metric, values in expected.items():
        # Another processor rounds otherwise, and an episode may take another course; the means over 50 episodes stay close.
        np.testing.assert_allclose(np.nanmean(results[metric]), np.nanmean(values), rtol=0.1, atol=0.05, err_msg=metric)


@pytest.mark.parametrize("name", OLD_POLICIES)
def test_every_policy_of_format_2_loads_with_its_task_and_its_weights(name, tmp_path):
    policy = load_policy(OLD_POLICIES[name])
    with zipfile.ZipFile(OLD_POLICIES[name]) as archive:
        member = json.loads(archive.read("flock.json"))
        tensors = th.load(archive.open("policy.pth"), weights_only=True)
    old = member["config"]
    assert member["format"] == 2
    assert policy.scenario.motion_lag == old["scenario"].get("look_back", 0.0)
    assert policy.config.algorithm.bc_coef == old["learner"].get("guidance", 0.0)
    assert policy.config.train_env.flock_sizes == tuple(np.atleast_1d(old["practice"]["vehicles"]))
    assert policy.num_timesteps == member["num_timesteps"]
    state = policy.policy.state_dict()
    assert state.keys() == tensors.keys()
    assert all(th.equal(state[key], value) for key, value in tensors.items())
    assert (policy.scenario.safety_filter, policy.scenario.shared_detections) == ("off", False)
    assert policy.config.train_env.action_repeat == 1
    assert name in POLICIES  # whoever asks for it by name is told what replaced it


@pytest.mark.parametrize("name", ["unfiltered", "announce"])
def test_a_policy_of_format_3_gives_the_episodes_it_gave_then(name):
    policy = load_policy(FORMAT_3 / f"{name}.zip")
    scenario, train_env = policy.scenario, policy.config.train_env
    if name == "unfiltered":
        assert (scenario.safety_filter, scenario.shared_detections, scenario.obstacle_radius) == ("off", False, None)
    else:
        assert (scenario.safety_filter, scenario.shared_detections) == ("announce", True)
        assert scenario.obstacle_radius == scenario.detection_range  # null meant this range, also with shared detections
    assert train_env.action_repeat == 1
    results = rollout(PolicyController(policy), scenario.replace(max_cycles=100), 5, 7)
    with np.load(FORMAT_3 / "rollouts.npz") as file:
        expected = {key.split("/")[1]: file[key] for key in file.files if key.split("/")[0] == name}
    assert len(expected) > 10
    for metric, values in expected.items():
        np.testing.assert_allclose(results[metric], values, rtol=1e-3, atol=1e-4, err_msg=metric)


@pytest.mark.parametrize(
    ("scenario", "radius"),
    [
        ({"shared_detections": True, "detection_range": 0.3}, 0.3),
        ({"shared_detections": True, "obstacle_radius": None}, Scenario().detection_range),
        ({"shared_detections": True, "obstacle_radius": 0.2}, 0.2),
        ({"shared_detections": False, "detection_range": 0.3}, None),
        ({}, None),
    ],
)
def test_before_format_4_the_obstacle_channel_did_not_widen_with_shared_detections(scenario, radius):
    for number in (1, 2, 3):
        assert migrate_config(TrainingConfig, {"scenario": scenario}, number)[0]["scenario"].get("obstacle_radius") == radius
    assert migrate_config(TrainingConfig, {"scenario": scenario}, FORMAT)[0]["scenario"] == scenario


# -- checkpoints -----------------------------------------------------------------------------------------------------


def test_the_state_of_an_old_checkpoint_has_the_present_keys():
    history = [{"looks": 1, "moved": 2}, {"earlier": 3}]
    old = {"surroundings": {"torch": "2"}, "env": history, "rest": {"taught": {"planned": 4, "wanted": 5, "advice": 6}}}
    state = migrate_state(old, 2)
    assert state == {
        "runtime_info": {"torch": "2"},
        "env": [{"history": 1, "ego_motion": 2}, {"previous": 3}],
        "rest": {"expert": {"next_actions": 4, "velocities": 5, "expert_actions": 6}},
    }
    assert migrate_state(old, FORMAT) == old


def test_the_first_checkpoints_with_an_expert_held_its_noisy_action_alone():
    assert migrate_state({"taught": {"planned": 4}}, 2) == {"expert": {"next_actions": 4, "expert_actions": 4}}


def copy_of_run(run, tmp_path):
    folder = tmp_path / run.name
    folder.mkdir()
    for path in run.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


def tensors_of(path):
    with zipfile.ZipFile(path) as archive:
        return th.load(archive.open("policy.pth"), weights_only=True)


@pytest.mark.parametrize(("name", "checkpoint"), [("ddpg", "rl_model_400_steps"), ("ddpg_expert", "rl_model_402_steps")])
def test_a_run_of_format_2_ends_as_the_release_that_began_it_ended_it(name, checkpoint, tmp_path):
    folder = copy_of_run(FORMAT_2 / "runs" / name, tmp_path)
    start = tensors_of(folder / f"{checkpoint}.zip")
    with pytest.warns(RenamedWarning, match="config.yaml"):
        result = resume(folder, quiet())
    expected, ended = tensors_of(FORMAT_2 / f"expected/{name}.zip"), tensors_of(folder / "final_model.zip")
    assert ended.keys() == expected.keys()
    # Another processor and the compiled update round otherwise: up to that, what was learned since is the same.
    distance, learned = (
        sum(float((tensors[key] - expected[key]).square().sum()) for key in expected) ** 0.5 for tensors in (ended, start)
    )
    assert distance < 0.01 * learned
    assert load_policy(folder / "final_model.zip").config == result.config
    assert load_config(TrainingConfig, folder / "config.yaml") == result.config  # without a warning: of the present format
    evaluations = np.load(folder / "evaluations.npz")
    steps = evaluations["timesteps"].tolist()
    assert steps == sorted(steps)
    assert steps[0] < 450
    assert steps[-1] >= 1000
    assert all(len(evaluations[metric]) == len(steps) for metric in evaluations.files)
    assert np.isnan(evaluations["violation_free_rate"][0])  # a metric that the earlier release did not have
    assert np.isfinite(evaluations["violation_free_rate"][-1])
    with open(folder / "progress.csv", encoding="utf-8") as file:
        rows = [int(row["time/total_timesteps"]) for row in csv.DictReader(file) if row["time/total_timesteps"]]
    assert rows[0] < 450
    assert rows[-1] >= 1000


def test_a_run_of_format_3_goes_on_without_a_filter(tmp_path):
    folder = copy_of_run(FORMAT_3 / "run", tmp_path)
    start = tensors_of(folder / "rl_model_304_steps.zip")
    result = resume(folder, quiet())
    assert (result.config.scenario.safety_filter, result.config.train_env.action_repeat) == ("off", 1)
    expected, ended = tensors_of(FORMAT_3 / "unfiltered.zip"), tensors_of(folder / "final_model.zip")
    distance, learned = (
        sum(float((tensors[key] - expected[key]).square().sum()) for key in expected) ** 0.5 for tensors in (ended, start)
    )
    assert distance < 0.01 * learned


def test_a_migrated_policy_saved_again_has_the_present_format(model, tmp_path):
    path = save_model(model, tmp_path / "again.zip", SMALL_MODEL)
    with zipfile.ZipFile(path) as archive:
        config = json.loads(archive.read("flock.json"))["config"]
    assert migrate_config(TrainingConfig, config, FORMAT) == (config, [])


def flock_by_flock(env):
    """The state of a vector env with one flock in every copy, as the first checkpoints kept it."""

    def of_one_flock(state):
        if "flocks" in state:
            return {"flocks": [of_one_flock(flock) for flock in state["flocks"]]}
        old = {"world": state["world"], "rng": state["rngs"][0]}
        if "expert" in state:
            expert = state["expert"] and dict(state["expert"])
            if expert:
                expert.pop("drives")
                for name in ("expert_actions", "next_actions"):
                    expert[name] = None if expert[name] is None else expert[name][0]
            old["expert"] = expert
        return old

    return [of_one_flock(copy) for copy in env.state_dict()]


CROWD = Scenario(
    n_vehicles=3,
    n_obstacles=2,
    arena=0.3,
    obstacle_arena=0.4,
    max_cycles=8,
    motion_lag=0.2,
    sensors={"delay": 0.1, "dropout": 0.1},
)


def plain(n_flocks):
    return parallel_env(CROWD, n_flocks=n_flocks)


def several_sizes(n_flocks):
    return MultiFlockEnv([parallel_env(CROWD, n_vehicles=size, n_flocks=n_flocks) for size in (2, 4)])


def with_expert(name, fraction, queries):
    return lambda n_flocks: ExpertEnv(CROWD, lambda world: EXPERTS[name](world, None), fraction, 0.1, queries, n_flocks)


@pytest.mark.parametrize(
    "make_env",
    [
        plain,
        several_sizes,
        with_expert("orca", 0.5, True),
        with_expert("orca", 0.5, False),
        with_expert("orca", 0.0, True),
        with_expert("orca", 0.0, False),
        with_expert("olfati-saber", 0.5, False),
    ],
)
def test_states_of_single_flocks_continue_in_a_batch(make_env):
    old, new = flatten(make_env(1), n_copies=5, seed=1), flatten(make_env(5), seed=2)
    rng = np.random.default_rng(0)
    old.reset()
    new.reset()
    for step in range(20):  # over the ends of two episodes
        if step == 4:
            state = migrate_state({"model": {"env": flock_by_flock(old), "replay": 1}}, FORMAT)
            assert state["model"]["replay"] == 1
            assert migrate_state(state, FORMAT) == state
            new.load_state_dict(state["model"]["env"])
        actions = rng.uniform((0, -3), (0.15, 3), (old.num_envs, 2)).astype(np.float32)
        ours, theirs = old.step(actions), new.step(actions)
        if step >= 4:
            for mine, yours in zip(ours, theirs, strict=True):
                assert data_equivalence(mine, yours, exact=True)
