"""The weights of a model that is updated by compiled code are still torch's own."""

from copy import deepcopy

import pytest
import torch as th

from sb3_flock import make_vec_env
from sb3_flock.rl import compiled_update
from sb3_flock.rl.compiled_update import can_compile, cores, update_threads
from sb3_flock.rl.ddpg import FlockDDPG
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


@pytest.mark.parametrize("change", ["weight_decay", "no fast extra", "another buffer"])
def test_without_the_parts_torch_updates(monkeypatch, change):
    model = filled()
    if change == "weight_decay":
        model.critic.optimizer.param_groups[0]["weight_decay"] = 0.1
    elif change == "no fast extra":
        monkeypatch.setattr(compiled_update, "compiled_kernels", lambda: None)
    else:
        model = FlockDDPG(FlockPolicy, make_vec_env(n_flocks=2, seed=0), learning_starts=600, batch_size=16, device="cpu")
        model.learn(360)
    assert not can_compile(model)
    before = model.policy.state_dict()["critic.qf0.0.weight"].clone()
    updated(model)
    assert not th.equal(before, model.policy.state_dict()["critic.qf0.0.weight"])


def test_no_updates_change_nothing():
    model = filled()
    before = deepcopy(model.policy.state_dict())
    model.train(0, 16)
    assert all(th.equal(tensor, before[name]) for name, tensor in model.policy.state_dict().items())


@pytest.mark.parametrize(
    ("available", "omp", "wanted", "expected"),
    [(1, None, 0, 1), (2, None, 0, 2), (8, "4", 0, 2), (8, "1", 0, 1), (8, "1", 2, 2), (1, None, 4, 2), (8, None, 1, 1)],
)
def test_two_threads_where_two_cores_may_be_used(monkeypatch, available, omp, wanted, expected):
    monkeypatch.setattr(compiled_update, "cores", lambda: available)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if omp:
        monkeypatch.setenv("OMP_NUM_THREADS", omp)
    assert update_threads(wanted) == expected


def test_this_process_may_use_a_core():
    assert cores() >= 1
