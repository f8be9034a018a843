import json

import numpy as np
import pytest
import torch as th

from sb3_flock import FlockDDPG, evaluate, load_policy, train
from sb3_flock.config.training import TrainingConfig
from sb3_flock.evaluation import model_cards
from sb3_flock.evaluation.metrics import Metric
from sb3_flock.evaluation.model_cards import over_seeds, read_card, ship
from sb3_flock.evaluation.tasks import TASKS, with_bodies_of
from sb3_flock.pretrained import shipped_policies
from sb3_flock.serialization.load import PolicyError, find_policy
from sb3_flock.serialization.migrate import FORMAT, migrate_config
from tests.helpers import quiet, tiny

SHIPPED = sorted(shipped_policies())


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_policy_behaves_as_its_card_says(name):
    policy, card = load_policy(name), read_card(name)
    assert policy.path.stat().st_size < 1_200_000
    check = card["check"]
    metrics = evaluate(policy, episodes=check["episodes"], seed=check["seed"])
    assert metrics["tracking_error"].mean == pytest.approx(check["tracking_error"], abs=0.003)
    config, _ = migrate_config(TrainingConfig, card["config"], card["format"])
    assert TrainingConfig(**config) == policy.config
    assert card["versions"] == policy.versions
    assert card["shipped_seed"] in [seed["seed"] for seed in card["seeds"]]
    for seed in card["seeds"]:
        assert list(seed["tasks"]) == list(TASKS)
        own = [task for task, scenario in TASKS.items() if with_bodies_of(policy.scenario, scenario) == policy.scenario]
        assert own  # it was trained for one of the tasks, whose results are thus in the card twice
        assert all(seed["tasks"][task] == seed["metrics"] for task in own)


def test_a_card_keeps_every_training_and_the_zip_is_the_best_ones(tmp_path, monkeypatch):
    runs = [train(tiny(tmp_path, seed=seed, eval_freq=60), quiet()).folder for seed in (0, 1, 2)]
    path = ship("mine", runs, tmp_path, episodes=3)
    monkeypatch.setattr(model_cards, "shipped_policies", lambda: {"mine": path})
    card = read_card("mine")
    scores = [np.load(run / "evaluations.npz")["score"].min() for run in runs]
    best = int(np.argmin(scores))
    assert [seed["seed"] for seed in card["seeds"]] == [0, 1, 2]
    assert card["shipped_seed"] == best
    shipped, original = load_policy(path), load_policy(runs[best])
    assert path.stat().st_size < 0.4 * original.path.stat().st_size
    assert shipped.config == original.config.replace(output_dir="runs")
    weights = original.policy.state_dict()
    for key, tensor in shipped.policy.state_dict().items():
        assert tensor.dtype == th.float32
        assert th.equal(tensor, weights[key.replace("_target.", ".")].half().float())
    model = FlockDDPG.load(path, device="cpu")  # SB3 reads it as before
    assert th.equal(model.policy.state_dict()["actor.mu.0.weight"], shipped.policy.state_dict()["actor.mu.0.weight"])
    errors = [evaluate(load_policy(run), episodes=3, seed=0)["tracking_error"].mean for run in runs]
    over = over_seeds(card)["tracking_error"]
    assert over.mean == pytest.approx(np.median(errors), abs=1e-4)
    assert (over.low, over.high, over.n) == (pytest.approx(min(errors), abs=1e-4), pytest.approx(max(errors), abs=1e-4), 3)
    assert card["format"] == FORMAT
    assert set(card["robustness"]) == {"episodes", "conditions"}
    assert {"none", "field conditions"} < set(card["robustness"]["conditions"])
    crossing = with_bodies_of(original.scenario, TASKS["5v2o-crossing"])
    recorded = card["seeds"][best]["tasks"]["5v2o-crossing"]["tracking_error"]
    assert recorded == pytest.approx(evaluate(original, crossing, 3, seed=0)["tracking_error"].mean, abs=1e-4)
    assert len(card["seeds"][0]["curve"]["timesteps"]) == len(card["seeds"][0]["curve"]["return"]) == 5
    json.dumps(card, allow_nan=False)


def test_over_seeds_are_the_median_the_lowest_and_the_highest_of_a_task():
    card = {
        "seeds": [
            {"metrics": {"tracking_error": error}, "tasks": {"3v1o": {"tracking_error": 10 * error, "success_rate": 0.5}}}
            for error in (0.3, 0.1, 0.15)
        ]
    }
    assert over_seeds(card) == {"tracking_error": Metric(0.15, 0.1, 0.3, 3)}
    assert over_seeds(card, "3v1o") == {"tracking_error": Metric(1.5, 1.0, 3.0, 3), "success_rate": Metric(0.5, 0.5, 0.5, 3)}
    with pytest.raises(KeyError):
        over_seeds(card, "5v1o")


def test_a_metric_that_not_every_training_has_is_left_out():
    old = {"tracking_error": 0.1, "connectivity": None}
    card = {"seeds": [{"metrics": {**old, "violation_free_rate": 0.5}}, {"metrics": old}]}
    assert over_seeds(card) == {"tracking_error": Metric(0.1, 0.1, 0.1, 2)}


def test_a_file_of_the_same_name_wins_over_a_shipped_policy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_policy("ddpg").parent.name == "pretrained"
    (tmp_path / "ddpg").write_bytes(b"mine")
    assert find_policy("ddpg").read_bytes() == b"mine"
    with pytest.raises(PolicyError, match="nor one of .*ddpg"):
        find_policy("ddpg-9v9o")
