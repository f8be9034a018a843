import json
import zipfile

import pytest

from sb3_flock import load_policy
from sb3_flock._renamed import POLICIES, RenamedWarning
from sb3_flock.pretrained import shipped_policies
from sb3_flock.serialization.load import PolicyError

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
