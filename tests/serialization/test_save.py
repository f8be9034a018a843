import numpy as np

from sb3_flock import FlockDDPG, load_policy, make_vec_env, save_model
from sb3_flock.rl.registry import build_model
from tests.helpers import SMALL_MODEL


def test_what_is_saved_is_what_loads(model, saved):
    policy = load_policy(saved)
    assert policy.config == SMALL_MODEL
    observations = np.random.default_rng(0).random((4, 3, 11, 11)).astype(np.float32)
    np.testing.assert_array_equal(policy.predict(observations)[0], model.predict(observations, deterministic=True)[0])
    assert [path.name for path in saved.parent.iterdir()] == ["policy.zip"]
    assert load_policy(saved, device="auto").config == SMALL_MODEL


def test_without_what_the_optimizers_gathered_a_file_is_small_flies_the_same_and_trains_on(tmp_path):
    config = SMALL_MODEL.replace(algorithm=SMALL_MODEL.algorithm.replace(learning_starts=3))
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
        model = build_model(SMALL_MODEL, make_vec_env(SMALL_MODEL.scenario, n_flocks, seed=0))
        model.learn(1)
        sizes.append(save_model(model, tmp_path / "policy.zip", SMALL_MODEL).stat().st_size)
    assert sizes[1] < sizes[0] + 20_000
    again = FlockDDPG.load(tmp_path / "policy.zip", make_vec_env(SMALL_MODEL.scenario, 32, seed=0), device="cpu")
    again.learn(2 * again.n_envs, reset_num_timesteps=False)
    assert again.num_timesteps >= 3 * again.n_envs
