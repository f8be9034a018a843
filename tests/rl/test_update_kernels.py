"""The compiled update ends where the same updates by torch end."""

import pytest
import torch as th

from sb3_flock.rl.compiled_update import can_compile
from tests.rl.filled_models import UPDATES, filled, updated

pytest.importorskip("numba")


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"network": {"n_critics": 1}},
        {"network": {"layer_norm": False, "action_bound": "tanh"}},
        {"motion_lag": 0.2, "network": {"channels": (8,)}},
        {"network": {"channels": (4, 6, 8), "stride": 1, "net_arch": (16, 12)}},
        {"network": {"kernel_size": 2, "net_arch": ()}},
        {"algorithm": {"mirror_augmentation": False, "tau": 0.5}},
        {"algorithm": {"bc_coef": 10.0}},
        {"algorithm": {"batch_size": 1}},
        {"algo": "td3"},
        {"algo": "td3", "algorithm": {"batch_size": 64}, "network": {"action_bound": "tanh"}},
    ],
    ids=str,
)
def test_thirty_updates_end_where_torch_ends(options):
    ours, reference = filled(True, **options), filled(False, **options)
    assert can_compile(ours)
    start = [parameter.detach().clone() for parameter in ours.policy.parameters()]
    for model in (ours, reference):
        updated(model)
    assert ours._n_updates == reference._n_updates == UPDATES
    moved = max(float((a - b).detach().abs().max()) for a, b in zip(start, ours.policy.parameters(), strict=True))
    assert moved > 5e-3
    for (name, a), b in zip(ours.policy.named_parameters(), reference.policy.parameters(), strict=True):
        th.testing.assert_close(a, b, rtol=0, atol=3e-5, msg=name)
    for name, steps in (("actor", UPDATES // ours.policy_delay), ("critic", UPDATES)):
        optimizers = [getattr(model, name).optimizer.state_dict()["state"] for model in (ours, reference)]
        for number, state in optimizers[0].items():
            assert float(state["step"]) == float(optimizers[1][number]["step"]) == steps
            for moment in ("exp_avg", "exp_avg_sq"):
                th.testing.assert_close(state[moment], optimizers[1][number][moment], rtol=2e-3, atol=1e-5)
    logged = [model.logger.name_to_value for model in (ours, reference)]
    assert logged[0].keys() == logged[1].keys()
    for name in logged[0]:
        assert logged[0][name] == pytest.approx(logged[1][name], rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("algo", ["ddpg", "td3"])
def test_one_thread_and_two_end_at_the_same_bits(algo):
    ends = []
    for threads in (1, 2):
        model = filled(algo=algo)
        model.update_threads = threads
        ends.append(updated(model))
    for a, b in zip(*(model.policy.parameters() for model in ends), strict=True):
        assert th.equal(a, b)
    for name in ("train/actor_loss", "train/critic_loss"):
        assert ends[0].logger.name_to_value[name] == ends[1].logger.name_to_value[name]


def test_rounds_of_updates_continue_td3s_delay():
    """An odd number of updates in a round: the next round starts with the actor's turn."""
    whole, parts = updated(filled(algo="td3"), 6), filled(algo="td3")
    updated(parts, 3)
    steps = [float(next(iter(parts.actor.optimizer.state.values()))["step"])]
    parts.train(3, parts.batch_size)
    steps.append(float(next(iter(parts.actor.optimizer.state.values()))["step"]))
    assert steps == [1, 3]
    assert float(next(iter(whole.actor.optimizer.state.values()))["step"]) == 3
