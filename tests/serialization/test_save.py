import json
import platform
import zipfile
from importlib.metadata import version

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import VecNormalize

from sb3_flock import FlockDDPG, FlockPolicy, TrainingConfig, load_policy, make_vec_env, save_model
from sb3_flock.rl.registry import build_model
from sb3_flock.serialization.save import atomic_write, versions
from sb3_flock.serialization.yaml_io import load_config
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


@pytest.mark.parametrize(("trained", "loaded"), [(1, 3), (3, 1)])
@pytest.mark.parametrize("algorithm", [DDPG, FlockDDPG])
def test_sb3_loads_a_file_and_learns_with_any_number_of_slots(tmp_path, algorithm, trained, loaded):
    model = build_model(SMALL_MODEL, make_vec_env(SMALL_MODEL.scenario, trained, seed=0))
    model.learn(2 * model.n_envs)
    noise = model.action_noise
    save_model(model, tmp_path / "policy.zip", SMALL_MODEL)
    assert model.action_noise is noise
    env = make_vec_env(SMALL_MODEL.scenario, loaded, seed=0)
    again = algorithm.load(tmp_path / "policy.zip", env, device="cpu")
    again.learn(2 * env.num_envs)
    assert len(again.action_noise.noises) == env.num_envs


def test_our_algorithms_load_what_sb3_saved_for_any_number_of_slots(tmp_path):
    model = build_model(SMALL_MODEL, make_vec_env(SMALL_MODEL.scenario, 1, seed=0))
    model.learn(2 * model.n_envs)
    model.save(tmp_path / "model.zip")
    again = FlockDDPG.load(tmp_path / "model.zip", make_vec_env(SMALL_MODEL.scenario, 3, seed=0), device="cpu")
    again.learn(2 * again.n_envs)
    assert len(again.action_noise.noises) == again.n_envs == 9


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
    assert member["versions"]["python"] == platform.python_version()
    assert member["versions"]["torch"] == version("torch")


def test_a_model_that_flies_on_normalized_observations_is_refused_in_one_line(tmp_path):
    env = VecNormalize(make_vec_env(SMALL_MODEL.scenario, 1, seed=0))
    with pytest.raises(SettingsError, match=r"^save_model: VecNormalize .*; norm_obs=False is needed, or SB3's own"):
        save_model(build_model(SMALL_MODEL, env), tmp_path / "policy.zip", SMALL_MODEL)
    env = VecNormalize(make_vec_env(SMALL_MODEL.scenario, 1, seed=0), norm_obs=False)
    save_model(build_model(SMALL_MODEL, env), tmp_path / "policy.zip", SMALL_MODEL)


DIFFERENT = {
    "n_anchors": (9, "scenario.n_anchors = 9, observations of shape (3, 9, 9): the model's have (3, 11, 11)"),
    "motion_lag": (0.2, "scenario.motion_lag = 0.2, observations of shape (6, 11, 11): the model's have (3, 11, 11)"),
    "max_speed": (0.1, "scenario.max_speed = 0.1: the model's actions are Box([ 0."),
    "max_turn_rate": (1.0, "scenario.max_turn_rate = 1.0: the model's actions are Box([ 0."),
    "algo": ("sac", "algo = sac, whose policy is a FlockSACPolicy: the model's is a FlockPolicy"),
    "features_dim": (32, "network.features_dim = 32: the model has 16"),
    "channels": ([16], "network.channels = [16]: the model has [16, 32]"),
    "kernel_size": (2, "network.kernel_size = 2: the model has 3"),
    "stride": (1, "network.stride = 1: the model has 2"),
    "layer_norm": (False, "network.layer_norm = False: the model has True"),
    "net_arch": ([64, 64], "network.net_arch = [64, 64]: the model has [64]"),
    "n_critics": (1, "network.n_critics = 1: the model has 2"),
    "action_layer": (8, "network.action_layer = 8: the model has 32"),
    "action_bound": ("tanh", "network.action_bound = tanh: the model has inverting"),
}


@pytest.mark.parametrize("name", DIFFERENT)
def test_a_config_that_the_model_was_not_built_from_is_refused_with_the_field(model, tmp_path, name):
    value, line = DIFFERENT[name]
    state = th.get_rng_state()
    with pytest.raises(SettingsError) as error:
        save_model(model, tmp_path / "policy.zip", load_config(TrainingConfig, overrides={name: value}, base=SMALL_MODEL))
    assert str(error.value).startswith(f"save_model: the config has {line}")
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())
    assert th.equal(state, th.get_rng_state())


def test_what_does_not_change_the_networks_may_differ(model, tmp_path):
    changes = {"learning_rate": 1e-5, "final_init": 0.1, "n_vehicles": 7, "n_flocks": 3, "link_range": 0.2}
    config = load_config(TrainingConfig, overrides=changes, base=SMALL_MODEL)
    assert load_policy(save_model(model, tmp_path / "policy.zip", config)).config == config


def test_a_model_of_ones_own_with_other_layers_is_refused_with_the_first(tmp_path):
    kwargs = {"features_extractor_kwargs": {"features_dim": 16}, "n_critics": 2, "activation_fn": th.nn.Tanh}
    model = FlockDDPG(FlockPolicy, make_vec_env(n_flocks=1), policy_kwargs=kwargs, buffer_size=10, device="cpu")
    with pytest.raises(
        SettingsError, match=r"^save_model: the config has a network with \(1\): ReLU\(\): the model has \(1\): T"
    ):
        save_model(model, tmp_path / "policy.zip", SMALL_MODEL)


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
