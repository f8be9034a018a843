import json
import zipfile
from importlib.metadata import version

import numpy as np
import pytest
from stable_baselines3.common.vec_env import VecNormalize

from sb3_flock import FlockDDPG, load_policy, make_vec_env, save_model
from sb3_flock.rl.registry import build_model
from sb3_flock.serialization.save import atomic_write, versions
from sb3_flock.settings import SettingsError
from tests.helpers import SMALL_MODEL


def test_a_saved_model_loads_with_its_config_and_actions(model, saved):
    policy = load_policy(saved)
    assert policy.config == SMALL_MODEL
    observations = np.random.default_rng(0).random((4, 3, 11, 11)).astype(np.float32)
    np.testing.assert_array_equal(policy.predict(observations)[0], model.predict(observations, deterministic=True)[0])
    assert [path.name for path in saved.parent.iterdir()] == ["policy.zip"]
    assert load_policy(saved, device="auto").config == SMALL_MODEL


def test_a_file_without_optimizer_states_is_smaller_acts_the_same_and_trains_on(tmp_path):
    config = SMALL_MODEL.replace(algorithm=SMALL_MODEL.algorithm.replace(learning_starts=3))
    model = build_model(config, make_vec_env(config.scenario, 1, seed=0))
    model.learn(12)
    whole, small = (save_model(model, tmp_path / f"{name}.zip", config, name == "whole") for name in ("whole", "small"))
    assert small.stat().st_size < 0.75 * whole.stat().st_size
    assert model.actor.optimizer.state  # the model keeps its own
    observations = np.random.default_rng(0).random((4, 3, 11, 11)).astype(np.float32)
    np.testing.assert_array_equal(load_policy(small).predict(observations)[0], load_policy(whole).predict(observations)[0])
    loaded = FlockDDPG.load(small, env=model.get_env())
    assert not loaded.actor.optimizer.state
    loaded.learn(12)
    assert loaded.actor.optimizer.state


def test_a_file_does_not_grow_with_the_number_of_flocks(tmp_path):
    sizes = []
    for n_flocks in (1, 32):
        model = build_model(SMALL_MODEL, make_vec_env(SMALL_MODEL.scenario, n_flocks, seed=0))
        model.learn(1)
        sizes.append(save_model(model, tmp_path / "policy.zip", SMALL_MODEL).stat().st_size)
    assert sizes[1] < sizes[0] + 20_000
    again = FlockDDPG.load(tmp_path / "policy.zip", make_vec_env(SMALL_MODEL.scenario, 32, seed=0), device="cpu")
    again.learn(2 * again.n_envs, reset_num_timesteps=False)
    assert again.num_timesteps >= 3 * again.n_envs


def test_the_json_member_holds_the_config_the_transitions_and_the_versions(tmp_path):
    model = build_model(SMALL_MODEL, make_vec_env(SMALL_MODEL.scenario, 1, seed=0))
    model.learn(9)
    with zipfile.ZipFile(save_model(model, tmp_path / "policy.zip", SMALL_MODEL)) as archive:
        member = json.loads(archive.read("flock.json"))
    assert type(SMALL_MODEL)(**member["config"]) == SMALL_MODEL
    assert member["num_timesteps"] == 9
    assert member["versions"] == versions()
    assert member["versions"]["torch"] == version("torch")


def test_a_model_that_flies_on_normalized_observations_is_refused_in_one_line(tmp_path):
    env = VecNormalize(make_vec_env(SMALL_MODEL.scenario, 1, seed=0))
    with pytest.raises(SettingsError, match="^save_model: VecNormalize normalizes the model's observations"):
        save_model(build_model(SMALL_MODEL, env), tmp_path / "policy.zip", SMALL_MODEL)
    env = VecNormalize(make_vec_env(SMALL_MODEL.scenario, 1, seed=0), norm_obs=False)
    save_model(build_model(SMALL_MODEL, env), tmp_path / "policy.zip", SMALL_MODEL)


def test_a_write_that_fails_leaves_the_earlier_file_and_nothing_else(tmp_path):
    path = tmp_path / "file"
    path.write_text("earlier")

    def fail():
        with atomic_write(path) as temporary:
            temporary.write_text("half")
            assert path.read_text() == "earlier"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("file", "earlier")]
    with atomic_write(path) as temporary:
        temporary.write_text("later")
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("file", "later")]


def test_a_model_that_cannot_be_saved_leaves_the_earlier_file(model, saved):
    before = saved.read_bytes()

    def fail(archive):
        archive.writestr("more", "x")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        save_model(model, saved, SMALL_MODEL, extra=fail)
    assert saved.read_bytes() == before
    assert [path.name for path in saved.parent.iterdir()] == ["policy.zip"]
