import signal

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_flock import FlockDDPG, FlockPolicy, NeighborInclusiveReward, make_vec_env
from sb3_flock.serialization.load import checkpoint_paths
from sb3_flock.sim import Scenario
from sb3_flock.training.checkpoint_callback import CheckpointCallback
from sb3_flock.training.signals import GracefulShutdown

SCENARIO = Scenario(max_cycles=10)


def script_model(**kwargs):
    """A model as a plain script of SB3 makes one, without a config."""
    kwargs = {"learning_starts": 30, "batch_size": 8, "buffer_size": 200, **kwargs}
    policy_kwargs = {"features_extractor_kwargs": {"features_dim": 8, "channels": (4,)}, "net_arch": [8]}
    env = make_vec_env(SCENARIO, n_flocks=2, seed=0)
    return FlockDDPG(FlockPolicy, env, policy_kwargs=policy_kwargs, seed=0, device="cpu", **kwargs)


def names(folder):
    return [path.name for path in checkpoint_paths(folder)]


@pytest.mark.parametrize(("save_freq", "expected"), [(30, (30, 60, 90, 96)), (0, (96,)), (50, (54, 96)), (1000, (96,))])
def test_a_plain_script_saves_on_time_and_at_the_end(tmp_path, save_freq, expected):
    script_model().learn(96, callback=CheckpointCallback(tmp_path, save_freq, keep=9))
    assert names(tmp_path) == [f"rl_model_{steps}_steps.zip" for steps in expected]


def test_the_newest_are_kept(tmp_path):
    (tmp_path / "best_model.zip").touch()
    script_model().learn(96, callback=CheckpointCallback(tmp_path, 18))
    assert names(tmp_path) == ["rl_model_90_steps.zip", "rl_model_96_steps.zip"]
    assert (tmp_path / "best_model.zip").exists()


def test_sb3_loads_what_a_plain_script_saved(tmp_path):
    model = script_model()
    model.learn(60, callback=CheckpointCallback(tmp_path, 0))
    loaded = FlockDDPG.load(tmp_path / "rl_model_60_steps.zip", device="cpu")
    observations = np.random.default_rng(0).random((4, 3, 11, 11)).astype(np.float32)
    expected = model.predict(observations, deterministic=True)[0]
    np.testing.assert_array_equal(loaded.predict(observations, deterministic=True)[0], expected)
    assert loaded.num_timesteps == 60


def test_a_save_function_gets_the_model_the_path_and_the_states_of_the_parts(tmp_path):
    saved, rewards, model = [], NeighborInclusiveReward(0.5), script_model()

    def save(one, path, parts):
        saved.append((one, path, {name: part.state_dict() for name, part in parts.items()}))

    callback = CheckpointCallback(tmp_path, 0, save=save, parts={"rewards": rewards})
    model.learn(48, callback=[rewards, callback])
    ((one, path, states),) = saved
    assert one is model
    assert path == tmp_path / "rl_model_48_steps.zip"
    assert set(states) == {"rewards", "random"}
    np.testing.assert_array_equal(states["random"]["torch"], th.get_rng_state().numpy())
    assert np.abs(states["rewards"]["returns"]).max() > 0


def test_a_signal_saves_first_and_acts_between_two_rounds(tmp_path):
    class Signal(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 42:
                signal.raise_signal(signal.SIGTERM)
            return True

    def train():
        with GracefulShutdown().waiting() as signals:
            script_model().learn(600, callback=[Signal(), CheckpointCallback(tmp_path, 0, signals=signals)])

    handler = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit):
        train()
    assert names(tmp_path) == ["rl_model_42_steps.zip"]
    assert signal.getsignal(signal.SIGTERM) is handler
