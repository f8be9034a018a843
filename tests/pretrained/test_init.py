import json
import zipfile

import pytest
from stable_baselines3 import DDPG

from sb3_flock import load_policy, make_vec_env
from sb3_flock._renamed import POLICIES, RenamedWarning
from sb3_flock.pretrained import policy_path, shipped_policies
from sb3_flock.serialization.load import PolicyError
from sb3_flock.settings import SettingsError

TASKS = ("3v1o", "5v1o", "5v2o")
NAMES = {"crossing-5v2o", "general", *(f"{method}-{task}" for method in ("ddpg", "ddpg-bc") for task in TASKS)}


def test_the_shipped_policies_have_their_names_and_a_model_card_each():
    policies = shipped_policies()
    assert set(policies) == NAMES
    for name, path in policies.items():
        assert path.stem == name
        assert json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))["seeds"]


@pytest.mark.parametrize("name", sorted(NAMES))
def test_each_shipped_policy_loads_by_name_for_the_task_in_its_name(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    policy = load_policy(name)
    assert policy.path == shipped_policies()[name]
    assert policy.num_timesteps > 100_000
    if name != "general":
        vehicles, obstacles = policy.scenario.n_vehicles, policy.scenario.n_obstacles
        assert name.endswith(f"{vehicles}v{obstacles}o")
    assert bool(policy.scenario.motion_lag) == (name not in {f"ddpg-{task}" for task in TASKS})
    assert (policy.config.algorithm.bc_coef > 0) == bool(policy.scenario.motion_lag)


@pytest.mark.parametrize("name", ["ddpg-3v1o", "ddpg-bc-5v2o"])
@pytest.mark.parametrize("n_flocks", [1, 3])
def test_sb3_loads_a_shipped_policy_and_learns_with_any_number_of_slots(name, n_flocks):
    env = make_vec_env(load_policy(name).scenario, n_flocks, seed=0)
    model = DDPG.load(policy_path(name), env, device="cpu", custom_objects={"buffer_size": 2000, "gradient_steps": 1})
    model.learning_starts = 20
    model.learn(40 + env.num_envs)
    assert len(model.action_noise.noises) == env.num_envs


def test_the_path_of_a_shipped_policy():
    assert policy_path("general") == shipped_policies()["general"]
    with pytest.raises(SettingsError, match=r"policy = 'ddpg-3v10': one of .*general is needed; did you mean ddpg-3v1o\?"):
        policy_path("ddpg-3v10")
    for old, new in POLICIES.items():
        with pytest.warns(RenamedWarning, match=f"policy {old} is now {new}"):
            assert policy_path(old) == shipped_policies()[new]


@pytest.mark.parametrize(("old", "new"), POLICIES.items())
def test_a_policy_by_its_name_of_the_previous_release_warns_and_loads(old, new, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.warns(RenamedWarning, match=f"policy {old} is now {new}"):
        assert load_policy(old).path == shipped_policies()[new]


def test_a_file_or_a_folder_of_a_shipped_policys_name_comes_first(saved, monkeypatch):
    monkeypatch.chdir(saved.parent)
    saved.rename("general")
    assert load_policy("general").num_timesteps == 0


def test_an_unknown_name_is_refused_with_all_names():
    with pytest.raises(PolicyError, match="no such file or run folder, nor one of ") as error:
        load_policy("ddpg-9v9o")
    assert all(name in str(error.value) for name in NAMES)


def test_shipped_zips_hold_no_optimizer_states():
    for path in shipped_policies().values():
        with zipfile.ZipFile(path) as archive:
            sizes = {info.filename: info.file_size for info in archive.infolist()}
        assert sizes["actor.optimizer.pth"] < 0.1 * sizes["policy.pth"]
