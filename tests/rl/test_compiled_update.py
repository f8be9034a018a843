"""The weights of a model that is updated by compiled code are still torch's own."""

import gc
import threading
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_flock import CompactReplayBuffer, FlockCNN, make_vec_env
from sb3_flock.rl import compiled_update
from sb3_flock.rl.compiled_update import can_compile
from sb3_flock.rl.ddpg import FlockDDPG, FlockTD3
from sb3_flock.rl.policies import FlockPolicy
from tests.rl.filled_models import filled, updated

pytest.importorskip("numba")


def test_the_weights_stay_the_modules_own(tmp_path):
    model = updated(filled())
    saved = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    model.save(tmp_path / "model.zip")
    loaded = FlockDDPG.load(tmp_path / "model.zip")
    for name, tensor in loaded.policy.state_dict().items():
        assert th.equal(tensor, saved[name]), name
    model.set_parameters(deepcopy(loaded.get_parameters()))  # the optimizers get new tensors: the next update takes them up
    twin = filled()
    twin.set_parameters(deepcopy(loaded.get_parameters()))
    twin.replay_buffer = model.replay_buffer
    for one in (model, twin):
        updated(one)
    for a, b in zip(model.policy.parameters(), twin.policy.parameters(), strict=True):
        assert th.equal(a, b)
    assert not th.equal(model.policy.state_dict()["actor.mu.0.weight"], saved["actor.mu.0.weight"])


def test_torchs_updates_continue_where_compiled_ones_end():
    """Both paths work on the same tensors, in turn."""
    mixed, reference = filled(), filled(False)
    for model in (mixed, reference):
        updated(model, 10)
    mixed.compiled = False
    for model in (mixed, reference):
        updated(model, 10)
    mixed.compiled = True
    for model in (mixed, reference):
        updated(model, 10)
    for a, b in zip(mixed.policy.parameters(), reference.policy.parameters(), strict=True):
        th.testing.assert_close(a, b, rtol=0, atol=3e-5)


def test_a_copy_of_a_model_is_updated_by_itself():
    model = updated(filled(), 10)
    twin = deepcopy(model)
    before = model.policy.state_dict()["actor.mu.0.weight"].clone()
    updated(twin, 10)
    assert th.equal(model.policy.state_dict()["actor.mu.0.weight"], before)
    updated(model, 10)
    for a, b in zip(model.policy.parameters(), twin.policy.parameters(), strict=True):
        assert th.equal(a, b)


def test_weights_that_torch_moved_are_taken_up():
    moved, still = updated(filled(), 10), updated(filled(), 10)
    for parameter in moved.policy.parameters():
        parameter.data = parameter.data.clone()  # as `Module.to` does
    for model in (moved, still):
        updated(model, 10)
    for a, b in zip(moved.policy.parameters(), still.policy.parameters(), strict=True):
        assert th.equal(a, b)


class Normed(FlockPolicy):
    """Our policy with another actor."""

    def make_actor(self, features_extractor=None):
        actor = super().make_actor(features_extractor)
        actor.mu = nn.Sequential(nn.LayerNorm(actor.features_dim), *actor.mu)
        return actor


class Elu(FlockCNN):
    """Our extractor with another activation."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.dense[-1] = nn.ELU()


class Shuffled(CompactReplayBuffer):
    """Our buffer with another way to sample."""

    def _get_samples(self, batch_inds, env=None):
        return super()._get_samples(batch_inds[::-1], env)


def model_with(policy=FlockPolicy, buffer=CompactReplayBuffer, **policy_kwargs):
    env = make_vec_env(n_flocks=2, seed=0)
    options = {"learning_starts": 600, "buffer_size": 600, "batch_size": 16, "device": "cpu"}
    model = FlockTD3(policy, env, replay_buffer_class=buffer, policy_kwargs=policy_kwargs, **options)
    model.learn(300)
    model._update_current_progress_remaining(0, 1)
    return model


def test_our_own_parts_are_compiled():
    assert can_compile(model_with())


@pytest.mark.parametrize(
    "parts",
    [
        {"activation_fn": nn.Tanh},
        {"share_features_extractor": True},
        {"policy": Normed},
        {"features_extractor_class": Elu},
        {"buffer": Shuffled},
        {"buffer": None},
        {"optimizer_class": th.optim.AdamW},
        {"optimizer_kwargs": {"eps": 1e-3}},
    ],
    ids=str,
)
def test_with_other_parts_torch_updates(parts):
    model = model_with(**parts)
    assert not can_compile(model)
    before = model.policy.state_dict()["critic.qf0.0.weight"].clone()
    updated(model, 2)
    assert not th.equal(before, model.policy.state_dict()["critic.qf0.0.weight"])


def test_with_vec_normalize_torch_updates_from_normalized_samples():
    env = VecNormalize(make_vec_env(n_flocks=2, seed=0), clip_obs=0.01, clip_reward=0.02)
    options = {"learning_starts": 60, "buffer_size": 600, "batch_size": 16, "device": "cpu", "seed": 0}
    model = FlockTD3(FlockPolicy, env, replay_buffer_class=CompactReplayBuffer, **options)
    model.learn(120)
    assert not can_compile(model)
    observations = model.replay_buffer.sample(50, env).observations
    assert observations.abs().max() == np.float32(0.01)
    assert model.replay_buffer.sample(50, env).rewards.abs().max() <= 0.02
    seen = []
    model.critic.features_extractor.register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))
    model.train(2, 16)
    assert max(inputs.abs().max() for inputs in seen) == np.float32(0.01)


def test_frozen_weights_stay_where_they_are():
    model = model_with()
    for network in (model.actor, model.critic):
        network.features_extractor.requires_grad_(False)
    assert not can_compile(model)


def test_without_the_fast_extra_torch_updates(monkeypatch):
    model = filled()
    monkeypatch.setattr(compiled_update, "compiled_kernels", lambda: None)
    assert not can_compile(model)
    before = model.policy.state_dict()["critic.qf0.0.weight"].clone()
    updated(model)
    assert not th.equal(before, model.policy.state_dict()["critic.qf0.0.weight"])


def test_a_thread_that_fails_ends_the_other(monkeypatch):
    """An interrupt of the main thread, or no memory in the second, must not leave a thread that waits for ever."""
    from sb3_flock.rl import update_kernels

    compiled, failing = update_kernels.update, []

    def fails(thread, *arguments):
        if thread in failing:
            raise KeyboardInterrupt
        compiled(thread, *arguments)

    model = updated(filled(), 1)
    model.update_threads = 2
    monkeypatch.setattr(update_kernels, "update", fails)
    threads = threading.active_count()
    for thread in (0, 1):
        failing[:] = [thread]
        before = deepcopy(model.policy.state_dict())
        with pytest.raises(KeyboardInterrupt):
            updated(model, 5)
        assert threading.active_count() == threads
        assert all(th.equal(tensor, before[name]) for name, tensor in model.policy.state_dict().items())
    monkeypatch.undo()
    updated(model, 5)


def test_the_update_holds_no_model():
    """Else a model that is no longer used would keep its replay buffer until the next collection of garbage."""
    model = updated(filled(), 1)
    assert model not in vars(model._update).values()
    assert not any(model is referent for referent in gc.get_referents(model._update))


def test_a_replay_buffer_with_nan_ends_in_a_loss_that_is_nan():
    model = filled()
    model.replay_buffer.observations[:] = np.nan
    updated(model, 2)
    assert np.isnan(model.logger.name_to_value["train/critic_loss"])


@pytest.mark.parametrize(
    ("torch_threads", "update_threads", "expected"), [(1, 0, 1), (2, 0, 2), (4, 0, 2), (1, 2, 2), (4, 1, 1)]
)
def test_as_many_threads_as_torch_has_two_at_most(monkeypatch, torch_threads, update_threads, expected):
    used = []
    monkeypatch.setattr(compiled_update, "_run", lambda threads, *arguments: used.append(threads))
    monkeypatch.setattr(th, "get_num_threads", lambda: torch_threads)
    model = filled()
    model.update_threads = update_threads
    updated(model, 1)
    assert used == [expected]


def test_no_updates_change_nothing():
    model = filled()
    before = deepcopy(model.policy.state_dict())
    model.train(0, 16)
    assert all(th.equal(tensor, before[name]) for name, tensor in model.policy.state_dict().items())
