import json
import shutil
import zipfile

import numpy as np
import pytest
import torch as th

from sb3_flock import FlockDDPG, load_policy, make_vec_env, save_model
from sb3_flock.rl.algorithms import build_model
from sb3_flock.rl.config import TrainingConfig
from sb3_flock.rl.config_io import load_config
from sb3_flock.rl.saving import PolicyError

CONFIG = load_config(TrainingConfig, overrides={"buffer_size": 10, "n_flocks": 1, "features_dim": 16})


@pytest.fixture(scope="module")
def model():
    return build_model(CONFIG, make_vec_env(CONFIG.scenario, 1, seed=0))


@pytest.fixture
def saved(model, tmp_path):
    return save_model(model, tmp_path / "policy.zip", CONFIG)


def rewrite(path, changes):
    """The same archive with some members changed or (None) left out."""
    copy = path.with_name("changed.zip")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(copy, "w") as new:
        for name in old.namelist():
            content = changes.get(name, old.read(name))
            if content is not None:
                new.writestr(name, content)
    return copy


def test_what_is_saved_is_what_loads(model, saved):
    policy = load_policy(saved)
    assert policy.config == CONFIG
    observations = np.random.default_rng(0).random((4, 3, 11, 11)).astype(np.float32)
    np.testing.assert_array_equal(policy.predict(observations)[0], model.predict(observations, deterministic=True)[0])
    assert [path.name for path in saved.parent.iterdir()] == ["policy.zip"]
    assert load_policy(saved, device="auto").config == CONFIG


def test_without_what_the_optimizers_gathered_a_file_is_small_flies_the_same_and_trains_on(tmp_path):
    config = CONFIG.replace(learner=CONFIG.learner.replace(learning_starts=3))
    model = build_model(config, make_vec_env(config.scenario, 1, seed=0))
    model.learn(12)
    whole, slim = (save_model(model, tmp_path / f"{name}.zip", config, name == "whole") for name in ("whole", "slim"))
    assert slim.stat().st_size < 0.75 * whole.stat().st_size
    assert model.actor.optimizer.state  # the model keeps its own
    observations = np.random.default_rng(0).random((4, 3, 11, 11)).astype(np.float32)
    np.testing.assert_array_equal(load_policy(slim).predict(observations)[0], load_policy(whole).predict(observations)[0])
    loaded = FlockDDPG.load(slim, env=model.get_env())
    assert not loaded.actor.optimizer.state
    loaded.learn(12)
    assert loaded.actor.optimizer.state


def test_a_file_does_not_grow_with_the_flocks_that_were_under_way(tmp_path):
    sizes = []
    for n_flocks in (1, 32):
        model = build_model(CONFIG, make_vec_env(CONFIG.scenario, n_flocks, seed=0))
        model.learn(1)
        sizes.append(save_model(model, tmp_path / "policy.zip", CONFIG).stat().st_size)
    assert sizes[1] < sizes[0] + 20_000
    again = FlockDDPG.load(tmp_path / "policy.zip", make_vec_env(CONFIG.scenario, 32, seed=0), device="cpu")
    again.learn(2 * again.n_envs, reset_num_timesteps=False)
    assert again.num_timesteps >= 3 * again.n_envs


def test_a_run_folder_means_its_best_model_else_its_final(saved, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    with pytest.raises(PolicyError, match=r"no best_model\.zip or final_model\.zip"):
        load_policy(run)
    shutil.copy(saved, run / "final_model.zip")
    assert load_policy(run).path.name == "final_model.zip"
    shutil.copy(saved, run / "best_model.zip")
    assert load_policy(run).path.name == "best_model.zip"


def broken_files(saved):
    """Files that are no policy, with the words that tell why."""
    whole = saved.read_bytes()
    with zipfile.ZipFile(saved) as archive:
        member = json.loads(archive.read("flock.json"))
    truncated, text, empty = (saved.with_name(name) for name in ("truncated.zip", "text.zip", "empty.zip"))
    truncated.write_bytes(whole[: len(whole) // 2])
    text.write_text("not a zip")
    empty.write_bytes(b"")
    wider = {**member, "config": {**member["config"], "network": {**member["config"]["network"], "features_dim": 32}}}
    unknown = {**member, "config": {**member["config"], "colour": "red"}}
    yield saved.with_name("missing.zip"), "no such file"
    yield truncated, "damaged or not a policy"
    yield text, "damaged or not a policy"
    yield empty, "damaged or not a policy"
    for changes, words in (
        ({"flock.json": None}, "not a policy of sb3_flock"),
        ({"flock.json": b"{"}, "damaged or not a policy"),
        ({"flock.json": b"[]"}, "do not fit"),
        ({"flock.json": json.dumps(wider).encode()}, "do not fit"),
        ({"flock.json": json.dumps(unknown).encode()}, "colour is not a parameter"),
        ({"flock.json": json.dumps({**member, "format": 9}).encode()}, "format = 9"),
        ({"policy.pth": b"garbage"}, "damaged or not a policy"),
        ({"policy.pth": None}, "not a policy of sb3_flock"),
    ):
        yield rewrite(saved, changes), words


def test_files_that_are_no_policy_are_told_in_one_line(saved):
    for path, words in broken_files(saved):
        with pytest.raises(PolicyError, match=words) as error:
            load_policy(path)
        assert "\n" not in str(error.value)
        assert str(path) in str(error.value)


def test_weights_that_are_not_finite_are_refused(model, saved):
    state = {name: value.clone() for name, value in model.policy.state_dict().items()}
    state["actor.mu.0.bias"][0] = float("nan")
    with saved.with_name("policy.pth").open("wb") as file:
        th.save(state, file)
    with pytest.raises(PolicyError, match="not finite"):
        load_policy(rewrite(saved, {"policy.pth": saved.with_name("policy.pth").read_bytes()}))


def test_loading_runs_no_code_from_the_file(saved, tmp_path):
    import pickle

    class Hostile:
        def __reduce__(self):
            return (open, (str(tmp_path / "owned"), "w"))

    hostile = pickle.dumps(Hostile())
    data = json.dumps({"policy_class": {":type:": "x", ":serialized:": __import__("base64").b64encode(hostile).decode()}})
    load_policy(rewrite(saved, {"data": data.encode()}))
    with pytest.raises(PolicyError):
        load_policy(rewrite(saved, {"policy.pth": hostile}))
    assert not (tmp_path / "owned").exists()
