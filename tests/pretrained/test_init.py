import json
import zipfile

import pytest
from stable_baselines3 import DDPG

from sb3_flock import load_policy, make_vec_env
from sb3_flock._renamed import POLICIES, RenamedWarning
from sb3_flock.evaluation.model_cards import read_card
from sb3_flock.pretrained import policy_path, shipped_policies
from sb3_flock.serialization.load import PolicyError
from sb3_flock.settings import SettingsError

NAMES = {"ddpg", "flock", "paper-plain"}


def test_the_shipped_policies_have_their_names_and_a_model_card_each():
    policies = shipped_policies()
    assert set(policies) == NAMES
    for name, path in policies.items():
        assert path.stem == name
        assert json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))["seeds"]


@pytest.mark.parametrize("name", sorted(NAMES))
def test_each_shipped_policy_loads_by_name_for_its_task(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    policy = load_policy(name)
    assert policy.path == shipped_policies()[name]
    assert 100_000 < policy.num_timesteps <= max(seed["transitions"] for seed in read_card(name)["seeds"])
    scenario = policy.scenario
    assert (scenario.n_vehicles, scenario.n_obstacles, scenario.obstacle_motion) == (5, 2, "walk")
    with_filter = name != "paper-plain"
    assert (scenario.safety_filter, scenario.shared_detections) == (("announce", True) if with_filter else ("off", False))
    assert bool(scenario.motion_lag) == (name == "flock")
    assert (policy.config.algorithm.bc_coef > 0) == (name == "flock")
    assert policy.config.train_env.expert == ("mpc" if name == "flock" else None)


@pytest.mark.parametrize("name", sorted(NAMES))
@pytest.mark.parametrize("n_flocks", [1, 3])
def test_sb3_loads_a_shipped_policy_and_learns_with_any_number_of_slots(name, n_flocks):
    env = make_vec_env(load_policy(name).scenario, n_flocks, seed=0)
    model = DDPG.load(policy_path(name), env, device="cpu", custom_objects={"buffer_size": 2000, "gradient_steps": 1})
    model.learning_starts = 20
    model.learn(40 + env.num_envs)
    assert len(model.action_noise.noises) == env.num_envs


def test_the_path_of_a_shipped_policy():
    assert policy_path("flock") == shipped_policies()["flock"]
    with pytest.raises(
        SettingsError, match=r"policy = 'flok': one of ddpg, flock, paper-plain is needed; did you mean flock\?"
    ):
        policy_path("flok")
    assert set(POLICIES.values()) == {"ddpg", "flock"}
    assert not NAMES & set(POLICIES)
    for old, new in POLICIES.items():
        with pytest.warns(RenamedWarning, match=f"policy {old} is now {new}, with its own task and the safety filter"):
            assert policy_path(old) == shipped_policies()[new]


@pytest.mark.parametrize(("old", "new"), POLICIES.items())
def test_a_policy_by_its_name_of_the_previous_release_warns_and_loads(old, new, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.warns(RenamedWarning, match=f"policy {old} is now {new}, with its own task") as warned:
        assert load_policy(old).path == shipped_policies()[new]
    assert [warning.filename for warning in warned] == [__file__]


def test_a_file_or_a_folder_of_a_shipped_policys_name_comes_first(saved, monkeypatch):
    monkeypatch.chdir(saved.parent)
    saved.rename("flock")
    assert load_policy("flock").num_timesteps == 0


def test_an_unknown_name_is_refused_with_all_names():
    with pytest.raises(PolicyError, match="no such file or run folder, nor one of ") as error:
        load_policy("ddpg-9v9o")
    assert all(name in str(error.value) for name in NAMES)


def test_shipped_zips_hold_no_optimizer_states():
    for path in shipped_policies().values():
        with zipfile.ZipFile(path) as archive:
            sizes = {info.filename: info.file_size for info in archive.infolist()}
        assert sizes["actor.optimizer.pth"] < 0.1 * sizes["policy.pth"]
